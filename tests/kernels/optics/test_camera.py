"""The lens is filled evenly; what camera and gate see of a flight."""

import numpy as np
import pytest
import warp as wp

from helpers.launch import Vectors, launched
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import Camera, Gate, random_block, u01
from spadwarp_kernels.optics.camera import clip_to_gate, clip_to_view, in_view, lens_point, project, ready_camera

_LENS_POINT = wp.constant(wp.vec2(0.1, -0.25))


@wp.kernel(enable_backward=False)
def _lens(camera: Camera, o: Vectors):
    i = wp.tid()
    block = random_block(wp.uint64(8), wp.uint64(i), wp.uint32(0), wp.uint32(4))
    o[i] = lens_point(camera, u01(block[0]), u01(block[1]))


@wp.kernel(enable_backward=False)
def _clips(camera: Camera, gate: Gate, x: Vectors, u: Vectors, path: float, out: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    o = wp.vec3(_LENS_POINT[0], _LENS_POINT[1], 0.0)
    seen = clip_to_view(camera, camera.view, x[i], u[i], o, 9.0)
    out[i] = clip_to_gate(gate, x[i], u[i], path, o, seen)


@wp.kernel(enable_backward=False)
def _images(camera: Camera, x: Vectors, o: Vectors, pixel: wp.array(dtype=int), visible: wp.array(dtype=int)):
    i = wp.tid()
    pixel[i] = project(camera, camera.view, -1, x[i], o[i])
    visible[i] = int(in_view(camera, camera.view, x[i]))


def test_lens_points_fill_the_aperture_evenly(device):
    camera = Camera()
    camera.aperture_radius = 0.02
    (points,) = launched(_lens, [camera], [wp.vec3], device, sample_count(device))
    assert not points[:, 2].any()
    area = (points[:, :2] ** 2).sum(axis=1) / 0.02**2
    assert area.max() < 1 + 1e-5
    assert chi2_p(area, lambda a: np.minimum(a, 1.0)) > 1e-4
    assert chi2_p(np.arctan2(points[:, 1], points[:, 0]), lambda a: (a + np.pi) / (2 * np.pi)) > 1e-4


def _tangents(x, o, inverse_focus):
    """The line through x and o meets the focus plane where the lens centre sees it; `[..., 2]`."""
    x, o = np.asarray(x, np.float64), np.asarray(o, np.float64)
    if inverse_focus == 0.0:
        return (x[..., :2] - o[..., :2]) / x[..., 2:]
    focus = 1.0 / inverse_focus
    met = o[..., :2] + (x[..., :2] - o[..., :2]) * (focus / x[..., 2:])
    return met / focus


@pytest.mark.parametrize("inverse_focus", [0.0, 0.4])
def test_the_clip_is_what_camera_and_gate_see(inverse_focus, device):
    """Against points along each flight, tested one by one for view and arrival."""
    camera, gate = Camera(), Gate()
    camera.width, camera.height, camera.pixel_tangent, camera.inverse_focus = 20, 12, 0.05, inverse_focus
    ready_camera(camera, camera)
    gate.start, gate.stop = 4.0, 11.0
    rng = np.random.default_rng(5)
    x = rng.uniform([-3, -3, -1], [3, 3, 6], size=(5000, 3)).astype(np.float32)
    u = rng.normal(size=x.shape)
    u = (u / np.linalg.norm(u, axis=1, keepdims=True)).astype(np.float32)
    s0, s1 = launched(_clips, [camera, gate, x, u, 1.5], [wp.vec2], device)[0].T
    s = np.linspace(0.0, 9.0, 901)
    y = x[:, None] + s[:, None] * u[:, None].astype(np.float64)
    o = np.array([*_LENS_POINT, 0.0])
    arrival = 1.5 + s + np.linalg.norm(y - o, axis=2)
    tangents = np.abs(_tangents(y, o, inverse_focus))
    seen = (y[..., 2] > 0) & (tangents[..., 0] < 0.5) & (tangents[..., 1] < 0.3)
    seen &= (arrival >= 4.0) & (arrival < 11.0)
    inside = (s > s0[:, None]) & (s < s1[:, None])
    near_an_end = (np.abs(s - s0[:, None]) < 1e-3) | (np.abs(s - s1[:, None]) < 1e-3)
    assert seen.any() and (seen == inside)[~near_an_end].all()


@pytest.mark.parametrize(("radius", "inverse_focus"), [(0.0, 0.0), (0.3, 0.0), (0.3, 0.4)])
def test_the_lens_images_through_the_focus_plane_and_overlooks_nothing(radius, inverse_focus, device):
    """The pixel by the geometry in float64; a point of which `in_view` is False is seen by no point of the lens, and of
    those in view most are seen by some."""
    camera = Camera()
    camera.width, camera.height, camera.pixel_tangent = 20, 12, 0.05
    camera.aperture_radius, camera.inverse_focus = radius, inverse_focus
    ready_camera(camera, camera)
    rng = np.random.default_rng(7)
    points, lenses = 2000, 200
    x = rng.uniform([-3, -3, -1], [3, 3, 6], size=(points, 3)).astype(np.float32)
    r, phi = radius * np.sqrt(rng.uniform(size=lenses)), rng.uniform(0.0, 2 * np.pi, size=lenses)
    o = np.stack([r * np.cos(phi), r * np.sin(phi), 0 * r], axis=1).astype(np.float32)
    all_x, all_o = np.repeat(x, lenses, axis=0), np.tile(o, (points, 1))
    pixel, visible = launched(_images, [camera, all_x, all_o], [int, int], device)
    place = _tangents(all_x, all_o, inverse_focus) / 0.05 + [10.0, 6.0]
    column, row = np.floor(place).T
    inside = (all_x[:, 2] > 0) & (column >= 0) & (column < 20) & (row >= 0) & (row < 12)
    sure = (np.abs(place - np.round(place)) > 1e-3).all(axis=1)
    np.testing.assert_array_equal(pixel[sure], np.where(inside, row * 20 + column, -1)[sure])
    seen = (pixel.reshape(points, lenses) >= 0).any(axis=1)
    visible = visible.reshape(points, lenses)[:, 0] == 1
    assert not (seen & ~visible).any() and seen.sum() > 0.9 * visible.sum()
