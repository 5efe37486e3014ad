"""The analytic kernels behind ports, against rays in float64 that find roots and derivatives by brute force."""

import math

import numpy as np
import pytest
import warp as wp

from helpers.launch import on_device
from helpers.lidar import C0, lidar
from reference import refraction
from spadwarp_kernels import analytic
from spadwarp_kernels.optics import DOME_PORT, FLAT_PORT, make_dome_port, make_flat_port

pytestmark = pytest.mark.physics

INDEX, GROUP_INDEX = (1.0003, 1.5195, 1.3415), (1.0003, 1.5463, 1.3638)
LAYERS = {"index": INDEX, "group_index": GROUP_INDEX}
TILT = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
WINDOW = {"distance": 0.05, "thickness": 0.01, "normal": TILT}
DOME = {"radius": 0.08, "thickness": 0.006, "centre": np.array([0.002, -0.001, -0.012])}
LASER = np.array([0.02, 0.01, 0.0])
PORTS = {
    "flat": (FLAT_PORT, make_flat_port(**WINDOW, **LAYERS), refraction.flat_faces(TILT, 0.05, 0.01)),
    "dome": (DOME_PORT, make_dome_port(**DOME, **LAYERS), refraction.dome_faces(DOME["centre"], 0.08, 0.006)),
}
POINT, NORMAL = np.array([0.7, -0.4, 3.1]), np.array([0.3, 0.1, -1.0]) / math.sqrt(1.1)


def way(faces, end):
    """From the point to the lens or the laser: directions, lengths, transmission and density."""
    straight = (end - POINT) / np.linalg.norm(end - POINT)
    return refraction.connect(faces, INDEX[::-1], POINT, end, straight)


def delayed(lengths):
    return sum(n * length for n, length in zip(GROUP_INDEX[::-1], lengths, strict=True))


def signal_map(name, half_angle, tangent, aim, device):
    """Signal and arrival at the point, of a beam that leaves in the direction -aim."""
    kind, port, _ = PORTS[name]
    one = lidar(half_angle=half_angle, pixel_tangent=tangent, aperture_area=1e-4, extinction=0.2, laser=LASER)
    one.axis, one.speed = wp.vec3d(*-aim), C0 / GROUP_INDEX[2]
    one.ports.camera = one.ports.laser = port
    _, seen, lengths, *_ = way(PORTS[name][2], np.zeros(3))
    arrays = [(-seen[None], wp.vec3d), ([lengths[0]], wp.float64), (NORMAL[None], wp.vec3d), ([0.6], wp.float64)]
    inputs = [on_device(np.array(values), device, dtype) for values, dtype in arrays]
    return (out.numpy()[0] for out in analytic.signal_map(one, *inputs, optics=analytic.make_optics(kind, kind)))


@pytest.mark.parametrize("name", ["dome", pytest.param("flat", marks=pytest.mark.slow)])
def test_signal_of_a_pixel_is_that_of_its_rays(name, device):
    """E·(Γ/π)·T·(n_0/n_w)²·A·cosψ·dΩ_0 with E from the laser's intensity, by derivatives of rays; and of a spot that is
    smaller than the pixel, all of a pencil beam: (Γ/π)·cosθ_out·T·dΩ_w/dA·A·cosψ."""
    to_lens, seen, lengths, through, density = way(PORTS[name][2], np.zeros(3))
    from_laser, aim, laser_lengths, laser_through, laser_density = way(PORTS[name][2], LASER)
    half_angle, tangent, area = 0.5, 1e-3, 1e-4
    passed = math.exp(-0.2 * (lengths[0] + laser_lengths[0]))
    signal, arrival = signal_map(name, half_angle, tangent, aim, device)
    intensity = 1.0 / (2.0 * math.pi * (1.0 - math.cos(half_angle)))
    irradiance = intensity * laser_through * laser_density * (INDEX[2] / INDEX[0]) ** 2 * (from_laser @ NORMAL)
    radiance = irradiance * 0.6 / math.pi * through * (INDEX[0] / INDEX[2]) ** 2
    assert signal == pytest.approx(radiance * area * tangent**2 * seen[2] ** 4 * passed, rel=2e-5)
    assert arrival == pytest.approx((delayed(lengths) + delayed(laser_lengths)) / C0, rel=1e-6)
    signal, _ = signal_map(name, 1e-4, 0.02, aim, device)
    collected = 0.6 / math.pi * (to_lens @ NORMAL) * through * density * area * -seen[2]
    assert signal == pytest.approx(laser_through * collected * passed, rel=1e-3)
