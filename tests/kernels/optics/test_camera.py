"""The lens is filled evenly; what camera and gate see of a flight."""

import math

import numpy as np
import pytest
import warp as wp

from helpers.launch import each, on_device, unit
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import LASER_PROFILES, Camera, Gate, Laser, emit_photon
from spadwarp_kernels.optics.camera import clip_to_gate, clip_to_view, in_view, lens_point, project, ready_camera


def a_camera(**fields):
    """20 x 12 pixels of tangent 0.05."""
    camera = Camera()
    for name, value in {"width": 20, "height": 12, "pixel_tangent": 0.05, **fields}.items():
        setattr(camera, name, value)
    ready_camera(camera, camera)
    return camera


def tangents(x, o, inverse_focus):
    """The line through x and o meets the focus plane where the lens centre sees it; `[..., 2]`."""
    x, o = np.asarray(x, np.float64), np.asarray(o, np.float64)
    if inverse_focus == 0.0:
        return (x[..., :2] - o[..., :2]) / x[..., 2:]
    focus = 1.0 / inverse_focus
    return (o[..., :2] + (x[..., :2] - o[..., :2]) * (focus / x[..., 2:])) / focus


def test_lens_points_fill_the_aperture_evenly(device):
    xi = np.random.default_rng(8).random((2, sample_count(device)), np.float32)
    points = each(lens_point, [a_camera(aperture_radius=0.02), *xi], [wp.vec3], device)
    area = (points[:, :2] ** 2).sum(axis=1) / 0.02**2
    assert not points[:, 2].any() and area.max() < 1 + 1e-5
    assert chi2_p(area, lambda a: np.minimum(a, 1.0)) > 1e-4
    assert chi2_p(np.arctan2(points[:, 1], points[:, 0]), lambda a: (a + np.pi) / (2 * np.pi)) > 1e-4


@pytest.mark.parametrize("inverse_focus", [0.0, 0.4])
def test_the_clip_is_what_camera_and_gate_see(inverse_focus, device):
    """Against points along each flight, tested one by one for view and arrival."""
    camera, gate, o = a_camera(inverse_focus=inverse_focus), Gate(), wp.vec3(0.1, -0.25, 0.0)
    gate.start, gate.stop = 4.0, 11.0
    rng = np.random.default_rng(5)
    x = rng.uniform([-3, -3, -1], [3, 3, 6], size=(2000, 3)).astype(np.float32)
    u = unit(rng.normal(size=x.shape)).astype(np.float32)
    view = each(clip_to_view, [camera, camera.view, x, u, o, 9.0], [wp.vec2], device)
    s0, s1 = each(clip_to_gate, [gate, x, u, 1.5, o, on_device(view, device, wp.vec2)], [wp.vec2], device).T
    s = np.linspace(0.0, 9.0, 901)
    y = x[:, None] + s[:, None] * u[:, None].astype(np.float64)
    arrival = 1.5 + s + np.linalg.norm(y - o, axis=2)
    across = np.abs(tangents(y, o, inverse_focus))
    seen = (y[..., 2] > 0) & (across[..., 0] < 0.5) & (across[..., 1] < 0.3) & (arrival >= 4.0) & (arrival < 11.0)
    inside = (s > s0[:, None]) & (s < s1[:, None])
    near_an_end = (np.abs(s - s0[:, None]) < 1e-3) | (np.abs(s - s1[:, None]) < 1e-3)
    assert seen.any() and (seen == inside)[~near_an_end].all()


@pytest.mark.parametrize(("radius", "inverse_focus"), [(0.0, 0.0), (0.3, 0.0), (0.3, 0.4)])
def test_the_lens_images_through_the_focus_plane_and_overlooks_nothing(radius, inverse_focus, device):
    """The pixel by the geometry in float64; a point of which `in_view` is False is seen by no point of the lens, and of
    those in view most are seen by some."""
    camera = a_camera(aperture_radius=radius, inverse_focus=inverse_focus)
    rng = np.random.default_rng(7)
    points, lenses = 1000, 200
    x = rng.uniform([-3, -3, -1], [3, 3, 6], size=(points, 3)).astype(np.float32)
    r, phi = radius * np.sqrt(rng.uniform(size=lenses)), rng.uniform(0.0, 2 * np.pi, size=lenses)
    o = np.stack([r * np.cos(phi), r * np.sin(phi), 0 * r], axis=1).astype(np.float32)
    all_x, all_o = np.repeat(x, lenses, axis=0), np.tile(o, (points, 1))
    pixel = each(project, [camera, camera.view, -1, all_x, all_o], [int], device)
    visible = each(in_view, [camera, camera.view, x], [bool], device)
    place = tangents(all_x, all_o, inverse_focus) / 0.05 + [10.0, 6.0]
    column, row = np.floor(place).T
    inside = (all_x[:, 2] > 0) & (column >= 0) & (column < 20) & (row >= 0) & (row < 12)
    sure = (np.abs(place - np.round(place)) > 1e-3).all(axis=1)
    np.testing.assert_array_equal(pixel[sure], np.where(inside, row * 20 + column, -1)[sure])
    seen = (pixel.reshape(points, lenses) >= 0).any(axis=1)
    assert not (seen & ~visible).any() and seen.sum() > 0.9 * visible.sum()


# Emission: each beam profile follows its law


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


@pytest.mark.physics
@pytest.mark.parametrize("half_angle", [2.5, 15.0, 90.0, 180.0])
def test_uniform_cone_is_uniform_in_solid_angle(half_angle, device):
    spread = 2 * math.sin(math.radians(half_angle) / 2) ** 2
    x, u = photons("uniform_cone", device, spread=spread)
    # |u - axis|^2/2 = 1 - cos is free of cancellation for narrow cones.
    t = 0.5 * ((u - AXIS) ** 2).sum(axis=1)
    assert not x.any() and t.max() < spread * (1 + 1e-4)
    assert chi2_p(t, lambda t: np.minimum(t / spread, 1.0), bins=100) > 1e-4


@pytest.mark.physics
def test_gaussian_has_its_irradiance_profile_on_a_plane(device):
    """Irradiance exp(-2 r^2/w^2): the power within r is 1 - exp(-2 r^2/w^2)."""
    tan2 = math.tan(math.radians(5.0)) ** 2
    cosine = photons("gaussian", device, tan2=tan2)[1] @ AXIS
    radius2 = np.maximum(1 - cosine**2, 0.0) / cosine**2
    assert chi2_p(radius2, lambda r2: -np.expm1(-2 * r2 / tan2), bins=50) > 1e-4


@pytest.mark.physics
def test_collimated_fills_a_disc_with_parallel_light(device):
    x, u = photons("collimated", device, radius=0.02)
    np.testing.assert_allclose(u, np.broadcast_to(AXIS, u.shape), atol=1e-7)
    np.testing.assert_allclose(x @ AXIS, 0.0, atol=1e-6)
    # Positions are stored near 3 m, on a grid of 2.4e-7 m.
    assert chi2_p((x**2).sum(axis=1) / 0.02**2, lambda a: np.clip(a, 0, 1 - 1e-12), bins=50) > 1e-4
