"""Shapes in two worlds for the cameras of simulators."""

import numpy as np
import warp as wp

import spadwarp_kernels as sk

SMALL = {"width": 16, "height": 12, "bins": 64, "gate_distance": (0.5, 6.0), "pulse_energy": 1e-12, "pulses": 1000}
STILL = (0, 0, 0, 0, 0, 0, 1)


def transforms(rows, device):
    return wp.array(np.array(rows, np.float32), dtype=wp.transform, device=device)


def square(device):
    corners = np.array([(-0.7, -0.7, 0), (0.7, -0.7, 0), (0.7, 0.7, 0), (-0.7, 0.7, 0)], np.float32)
    faces = wp.array([0, 1, 2, 0, 2, 3], dtype=int, device=device)
    uv = (corners[:, :2] / 1.4 + 0.5)[[[0, 1, 2], [0, 2, 3]]]
    return wp.Mesh(wp.array(corners, dtype=wp.vec3, device=device), faces), uv


def garden(device):
    """One shape of every kind before a wall, in two worlds; the mesh has an image of two halves."""
    kinds = ["sphere", "capsule", "ellipsoid", "cylinder", "box", "cone"]
    sizes = [(0.35, 0, 0), (0.2, 0.25, 0), (0.4, 0.3, 0.2), (0.25, 0.3, 0), (0.3, 0.2, 0.25), (0.3, 0.35, 0)]
    turn = np.array([0.3, -0.2, 0.4, 0.85]) / np.linalg.norm([0.3, -0.2, 0.4, 0.85])
    places = [(-1.0, -0.6), (0.0, -0.6), (1.0, -0.6), (-1.0, 0.6), (0.0, 0.6), (1.0, 0.6)]
    mesh, uv = square(device)
    return sk.make_shapes(
        ["plane", *kinds, "mesh"],
        [(0, 0, 0), *sizes, (1, 1, 1)],
        body=[-1, 0, 1, 2, 3, 4, 5, -1],
        local=[(0, 0, 4, 0, 0, 0, 1), *[(0, 0, 0, *turn)] * 6, (0, 0, 3, 0, 0, 0, 1)],
        mesh=[None] * 7 + [mesh],
        reflectance=[0.5, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8],
        world=[-1, 0, 0, 0, 0, 0, 0, 1],
        worlds=2,
        first_face=[-1] * 7 + [0],
        textures=sk.make_textures(np.zeros(2, int), uv, [np.array([[0.25, 0.25, 1.0, 1.0]])], device=device),
        device=device,
    ), transforms([(x, y, 2.5, 0, 0, 0, 1) for x, y in places], device)
