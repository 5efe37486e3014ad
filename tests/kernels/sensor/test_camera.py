"""The lens is filled evenly; what camera and gate see of a flight."""

import numpy as np
import warp as wp

from helpers.launch import Vectors, launched
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import (
    Camera,
    Gate,
    lens_point,
    random_block,
    u01,
)
from spadwarp_kernels.sensor import clip_to_gate, clip_to_planes, field


@wp.kernel(enable_backward=False)
def _lens(camera: Camera, o: Vectors):
    i = wp.tid()
    block = random_block(wp.uint64(8), wp.uint64(i), wp.uint32(0), wp.uint32(4))
    o[i] = lens_point(camera, u01(block[0]), u01(block[1]))


@wp.kernel(enable_backward=False)
def _clips(camera: Camera, gate: Gate, x: Vectors, u: Vectors, path: float, out: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    seen = clip_to_planes(field(camera), x[i], u[i], 9.0)
    out[i] = clip_to_gate(gate, x[i], u[i], path, wp.vec3(0.001, -0.002, 0.0), seen)


def test_lens_points_fill_the_aperture_evenly(device):
    camera = Camera()
    camera.aperture_radius = 0.02
    (points,) = launched(_lens, [camera], [wp.vec3], device, sample_count(device))
    assert not points[:, 2].any()
    area = (points[:, :2] ** 2).sum(axis=1) / 0.02**2
    assert area.max() < 1 + 1e-5
    assert chi2_p(area, lambda a: np.minimum(a, 1.0)) > 1e-4
    assert chi2_p(np.arctan2(points[:, 1], points[:, 0]), lambda a: (a + np.pi) / (2 * np.pi)) > 1e-4


def test_the_clip_is_what_camera_and_gate_see(device):
    """Against points along each flight, tested one by one for view and arrival."""
    camera, gate = Camera(), Gate()
    camera.width, camera.height, camera.pixel_tangent = 20, 12, 0.05
    gate.start, gate.stop = 4.0, 11.0
    rng = np.random.default_rng(5)
    x = rng.uniform([-3, -3, -1], [3, 3, 6], size=(5000, 3)).astype(np.float32)
    u = rng.normal(size=x.shape)
    u = (u / np.linalg.norm(u, axis=1, keepdims=True)).astype(np.float32)
    s0, s1 = launched(_clips, [camera, gate, x, u, 1.5], [wp.vec2], device)[0].T
    s = np.linspace(0.0, 9.0, 901)
    y = x[:, None] + s[:, None] * u[:, None].astype(np.float64)
    arrival = 1.5 + s + np.linalg.norm(y - [0.001, -0.002, 0.0], axis=2)
    seen = (y[..., 2] > 0) & (np.abs(y[..., 0]) < 0.5 * y[..., 2]) & (np.abs(y[..., 1]) < 0.3 * y[..., 2])
    seen &= (arrival >= 4.0) & (arrival < 11.0)
    inside = (s > s0[:, None]) & (s < s1[:, None])
    near_an_end = (np.abs(s - s0[:, None]) < 1e-3) | (np.abs(s - s1[:, None]) < 1e-3)
    assert seen.any() and (seen == inside)[~near_an_end].all()
