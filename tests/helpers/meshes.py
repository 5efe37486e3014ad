"""Meshes on a device."""

import numpy as np
import trimesh
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import on_device


def soup(corners):
    """Faces `[n, 3, 3]` that share no vertices."""
    return trimesh.Trimesh(np.reshape(corners, (-1, 3)), np.arange(3 * len(corners)).reshape(-1, 3), process=False)


def mesh_of(vertices, faces, device="cpu", builder=None, leaf_size=1):
    arrays = on_device(np.asarray(vertices, float), device), on_device(np.ravel(faces), device, int)
    return wp.Mesh(*arrays, bvh_constructor=builder, bvh_leaf_size=leaf_size)


def mesh_and_surfaces(shape, device, **options):
    """The mesh, which has to outlive its surfaces, and these."""
    mesh = mesh_of(shape.vertices, shape.faces, device, **options)
    return mesh, sk.make_surfaces(mesh)
