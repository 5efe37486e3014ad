"""Directions: bases, the exact update, the near-axis rule, small angles."""

import numpy as np
import warp as wp

from helpers.launch import Floats, Vectors, launched
from helpers.statistics_of_samples import chi2_p
from spadwarp_kernels import one_minus_cosine, random_block, rotate_direction, u01
from spadwarp_kernels.base.rotations import OFF_AXIS, cos_sin_turn, orthonormal_basis, snap_from


@wp.kernel(enable_backward=False)
def _bases(n: Vectors, b1: Vectors, b2: Vectors):
    i = wp.tid()
    first, second = orthonormal_basis(n[i])
    b1[i] = first
    b2[i] = second


@wp.kernel(enable_backward=False)
def _rotate(u: Vectors, t: Floats, xi: Floats, v: Vectors):
    i = wp.tid()
    v[i] = rotate_direction(u[i], t[i], xi[i])


@wp.kernel(enable_backward=False)
def _walk(u: Vectors, steps: int):
    i = wp.tid()
    v = u[i]
    for k in range(steps):
        block = random_block(wp.uint64(3), wp.uint64(i), wp.uint32(k), wp.uint32(1))
        v = rotate_direction(v, 2.0 * u01(block[0]), u01(block[1]))
    u[i] = v


@wp.kernel(enable_backward=False)
def _snap(u: Vectors, threshold: float, v: Vectors):
    i = wp.tid()
    v[i] = snap_from(u[i], threshold)


@wp.kernel(enable_backward=False)
def _difference(u: Vectors, v: Vectors, t: Floats):
    i = wp.tid()
    t[i] = one_minus_cosine(u[i], v[i])


def _unit_vectors(count, seed=0):
    v = np.random.default_rng(seed).normal(size=(count, 3))
    v[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


def test_bases_are_orthonormal_everywhere(device):
    n = _unit_vectors(100_000)
    n[6:12] = [[1e-4, 0, -1], [0, 1e-7, -1], [1e-20, 0, -1], [1e-4, 0, 1], [3e-8, 0, 1], [-1e-4, 1e-4, -1]]
    n[6:12] /= np.linalg.norm(n[6:12], axis=1, keepdims=True)
    frames = np.stack([*launched(_bases, [n], (wp.vec3, wp.vec3), device), n.astype(np.float64)], axis=1)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=2e-6)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=3e-6)


def test_rotation_turns_by_the_angle_at_a_uniform_azimuth(device):
    rng = np.random.default_rng(1)
    u = _unit_vectors(200_000, seed=2)
    t = (2 * rng.random(len(u)) ** 4).astype(np.float32)
    xi = rng.random(len(u)).astype(np.float32)
    (out,) = launched(_rotate, [u, t, xi], [wp.vec3], device)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(1 - (out * u).sum(axis=1), t, atol=4e-7)
    # The azimuth about u, measured from the direction to the z axis, is uniform.
    east = np.cross(u, [0.0, 0.0, 1.0])
    turned = (np.linalg.norm(east, axis=1) > 1e-3) & (t > 1e-3)
    north = np.cross(east, u)
    azimuth = np.arctan2(
        (out * east).sum(axis=1) / np.linalg.norm(east, axis=1).clip(1e-9),
        (out * north).sum(axis=1) / np.linalg.norm(north, axis=1).clip(1e-9),
    )
    assert chi2_p(azimuth[turned], lambda a: (a + np.pi) / (2 * np.pi), bins=100) > 1e-4


def test_length_stays_one_over_many_events():
    u = wp.array(_unit_vectors(1000), dtype=wp.vec3, device="cpu")
    wp.launch(_walk, 1000, [u, 2000], device="cpu")
    np.testing.assert_allclose(np.linalg.norm(u.numpy().astype(np.float64), axis=1), 1.0, atol=3e-7)


def test_near_axis_rule_snaps_the_direction_unless_it_is_off():
    tilt = np.radians([0.0, 0.5, 1.1, 1.2, 5.0, 178.0, 179.5])
    u = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=1).astype(np.float32)
    # arccos 0.9998 is 1.146 degrees.
    snapped = [True, True, True, False, False, False, True]
    expected = np.where(np.array(snapped)[:, None], [0, 0, 1] * np.sign(u[:, 2:]), u)
    np.testing.assert_array_equal(launched(_snap, [u, 0.9998], [wp.vec3])[0], expected)
    np.testing.assert_array_equal(launched(_snap, [u, float(OFF_AXIS)], [wp.vec3])[0], u)


def test_one_minus_cosine_keeps_small_angles():
    angle = np.geomspace(1e-5, 3.1, 2000)
    u = np.tile([0.6, 0.0, 0.8], (angle.size, 1)).astype(np.float32).astype(np.float64)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.array([0.0, 1.0, 0.0])
    (t,) = launched(_difference, [u, v])
    relative = t / (2 * np.sin(angle / 2) ** 2) - 1
    # Rounding the vectors themselves moves the angle by 6e-8: 1e-4 of 1e-3 rad.
    assert np.abs(relative[angle > 1e-3]).max() < 5e-4
    assert t.max() <= 2.0


@wp.kernel(enable_backward=False)
def _turns(xi: Floats, out: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    out[i] = cos_sin_turn(xi[i])


def test_turns_are_rounded_cosines_and_sines_on_a_cpu():
    xi = (np.arange(1 << 20, dtype=np.float32) + np.float32(0.5)) / np.float32(1 << 20)
    xi = np.concatenate([xi, np.arange(9, dtype=np.float32)[:-1] / 8])
    out = wp.zeros(xi.size, dtype=wp.vec2, device="cpu")
    wp.launch(_turns, dim=xi.size, inputs=[wp.array(xi, device="cpu")], outputs=[out], device="cpu")
    angle = (np.float32(6.2831853) * (xi - np.float32(0.5))).astype(np.float64)
    exact = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    error = np.abs(out.numpy() - exact) / np.spacing(np.abs(exact).astype(np.float32))
    assert error.max() < 0.57
