"""Emission: each beam profile follows its law."""

import math

import numpy as np
import pytest
import warp as wp

from helpers.launch import each, on_device
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import LASER_PROFILES, Laser, emit_photon

pytestmark = pytest.mark.physics

AXIS = np.array([0.36, -0.48, 0.8])


def photons(profile, device, **sizes):
    """Start, from the laser's position, and direction."""
    laser = Laser()
    laser.position, laser.axis, laser.profile = wp.vec3(1, 2, 3), wp.vec3(*AXIS), LASER_PROFILES.index(profile)
    for name, value in sizes.items():
        setattr(laser, name, value)
    ids = on_device(np.arange(sample_count(device)), device, wp.uint64)
    x, u = each(emit_photon, [laser, laser.axis, 4, ids], (wp.vec3, wp.vec3), device)
    return x - [1, 2, 3], u


@pytest.mark.parametrize("half_angle", [2.5, 15.0, 90.0, 180.0])
def test_uniform_cone_is_uniform_in_solid_angle(half_angle, device):
    spread = 2 * math.sin(math.radians(half_angle) / 2) ** 2
    x, u = photons("uniform_cone", device, spread=spread)
    # |u - axis|^2/2 = 1 - cos is free of cancellation for narrow cones.
    t = 0.5 * ((u - AXIS) ** 2).sum(axis=1)
    assert not x.any() and t.max() < spread * (1 + 1e-4)
    assert chi2_p(t, lambda t: np.minimum(t / spread, 1.0), bins=100) > 1e-4


def test_gaussian_has_its_irradiance_profile_on_a_plane(device):
    """Irradiance exp(-2 r^2/w^2): the power within r is 1 - exp(-2 r^2/w^2)."""
    tan2 = math.tan(math.radians(5.0)) ** 2
    cosine = photons("gaussian", device, tan2=tan2)[1] @ AXIS
    radius2 = np.maximum(1 - cosine**2, 0.0) / cosine**2
    assert chi2_p(radius2, lambda r2: -np.expm1(-2 * r2 / tan2), bins=50) > 1e-4


def test_collimated_fills_a_disc_with_parallel_light(device):
    x, u = photons("collimated", device, radius=0.02)
    np.testing.assert_allclose(u, np.broadcast_to(AXIS, u.shape), atol=1e-7)
    np.testing.assert_allclose(x @ AXIS, 0.0, atol=1e-6)
    # Positions are stored near 3 m, on a grid of 2.4e-7 m.
    assert chi2_p((x**2).sum(axis=1) / 0.02**2, lambda a: np.clip(a, 0, 1 - 1e-12), bins=50) > 1e-4
