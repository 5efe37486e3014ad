"""Emission: each beam profile follows its law."""

import math

import numpy as np
import pytest
import warp as wp

from helpers.launch import Vectors, launched
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import LASER_PROFILES, Laser, emit_photon

AXIS = np.array([0.36, -0.48, 0.8])


@wp.kernel(enable_backward=False)
def _emit(laser: Laser, x: Vectors, u: Vectors):
    i = wp.tid()
    start, direction = emit_photon(laser, wp.uint64(4), wp.uint64(i))
    x[i] = start
    u[i] = direction


def _photons(profile, device, **sizes):
    laser = Laser()
    laser.position, laser.axis = wp.vec3(1.0, 2.0, 3.0), wp.vec3(*AXIS)
    laser.profile = LASER_PROFILES.index(profile)
    for name, value in sizes.items():
        setattr(laser, name, value)
    x, u = launched(_emit, [laser], (wp.vec3, wp.vec3), device, sample_count(device))
    return x - [1, 2, 3], u


@pytest.mark.physics
@pytest.mark.parametrize("half_angle", [2.5, 15.0, 90.0, 180.0])
def test_uniform_cone_is_uniform_in_solid_angle(half_angle, device):
    spread = 2 * math.sin(math.radians(half_angle) / 2) ** 2
    x, u = _photons("uniform_cone", device, spread=spread)
    assert not x.any()
    # |u - axis|^2/2 = 1 - cos is free of cancellation for narrow cones.
    t = 0.5 * ((u - AXIS) ** 2).sum(axis=1)
    assert t.max() < spread * (1 + 1e-4)
    assert chi2_p(t, lambda t: np.minimum(t / spread, 1.0), bins=100) > 1e-4


@pytest.mark.physics
def test_gaussian_has_its_irradiance_profile_on_a_plane(device):
    tangent = math.tan(math.radians(5.0))
    _, u = _photons("gaussian", device, tan2=tangent**2)
    cosine = u @ AXIS
    radius2 = np.maximum(1 - cosine**2, 0.0) / cosine**2
    # Irradiance exp(-2 r^2/w^2): the power within r is 1 - exp(-2 r^2/w^2).
    assert chi2_p(radius2, lambda r2: -np.expm1(-2 * r2 / tangent**2), bins=50) > 1e-4


def test_collimated_fills_a_disc_with_parallel_light(device):
    x, u = _photons("collimated", device, radius=0.02)
    np.testing.assert_allclose(u, np.broadcast_to(AXIS, u.shape), atol=1e-7)
    np.testing.assert_allclose(x @ AXIS, 0.0, atol=1e-6)
    # Positions are stored near 3 m, on a grid of 2.4e-7 m.
    area = (x**2).sum(axis=1) / 0.02**2
    assert chi2_p(area, lambda a: np.clip(a, 0, 1 - 1e-12), bins=50) > 1e-4
