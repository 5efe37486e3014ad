"""Directions: bases, the exact update, the near-axis rule, Lambert's law, small angles."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from helpers.statistics_of_samples import DEVICES, chi2_p
from spadwarp_kernels import (
    one_minus_cosine,
    orthonormal_basis,
    random_block,
    rotate_direction,
    sample_lambert,
    snap_direction,
    u01,
)


@wp.kernel(enable_backward=False)
def _bases(n: wp.array(dtype=wp.vec3), b1: wp.array(dtype=wp.vec3), b2: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    first, second = orthonormal_basis(n[i])
    b1[i] = first
    b2[i] = second


@wp.kernel(enable_backward=False)
def _rotate(
    u: wp.array(dtype=wp.vec3), t: wp.array(dtype=float), xi: wp.array(dtype=float), v: wp.array(dtype=wp.vec3)
):
    i = wp.tid()
    v[i] = rotate_direction(u[i], t[i], xi[i])


@wp.kernel(enable_backward=False)
def _walk(u: wp.array(dtype=wp.vec3), steps: int):
    i = wp.tid()
    v = u[i]
    for k in range(steps):
        block = random_block(wp.uint64(3), wp.uint64(i), wp.uint32(k), wp.uint32(1))
        v = rotate_direction(v, 2.0 * u01(block[0]), u01(block[1]))
    u[i] = v


@wp.kernel(enable_backward=False)
def _snap(u: wp.array(dtype=wp.vec3), threshold: float, v: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    v[i] = snap_direction(u[i], threshold)


@wp.kernel(enable_backward=False)
def _lambert(normal: wp.vec3, v: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    block = random_block(wp.uint64(9), wp.uint64(i), wp.uint32(0), wp.uint32(1))
    v[i] = sample_lambert(normal, u01(block[0]), u01(block[1]))


@wp.kernel(enable_backward=False)
def _difference(u: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), t: wp.array(dtype=float)):
    i = wp.tid()
    t[i] = one_minus_cosine(u[i], v[i])


def _unit_vectors(count, seed=0):
    v = np.random.default_rng(seed).normal(size=(count, 3))
    v[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("device", DEVICES)
def test_bases_are_orthonormal_everywhere(device):
    n = _unit_vectors(100_000)
    n[6:12] = [[1e-4, 0, -1], [0, 1e-7, -1], [1e-20, 0, -1], [1e-4, 0, 1], [3e-8, 0, 1], [-1e-4, 1e-4, -1]]
    n[6:12] /= np.linalg.norm(n[6:12], axis=1, keepdims=True)
    b1, b2 = (wp.empty(len(n), dtype=wp.vec3, device=device) for _ in range(2))
    wp.launch(_bases, len(n), [wp.array(n, dtype=wp.vec3, device=device), b1, b2], device=device)
    frames = np.stack([b1.numpy(), b2.numpy(), n], axis=1).astype(np.float64)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=2e-6)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=3e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_rotation_turns_by_the_angle_at_a_uniform_azimuth(device):
    rng = np.random.default_rng(1)
    u = _unit_vectors(200_000, seed=2)
    t = (2 * rng.random(len(u)) ** 4).astype(np.float32)
    xi = rng.random(len(u)).astype(np.float32)
    v = wp.empty(len(u), dtype=wp.vec3, device=device)
    arrays = [wp.array(u, dtype=wp.vec3, device=device), *(wp.array(a, dtype=float, device=device) for a in (t, xi))]
    wp.launch(_rotate, len(u), [*arrays, v], device=device)
    out = v.numpy().astype(np.float64)
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


def test_near_axis_rule_snaps_the_direction_and_threshold_one_is_exact():
    tilt = np.radians([0.0, 0.5, 1.1, 1.2, 5.0, 178.0, 179.5])
    u = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=1).astype(np.float32)
    device_u = wp.array(u, dtype=wp.vec3, device="cpu")
    v = wp.empty(len(u), dtype=wp.vec3, device="cpu")
    wp.launch(_snap, len(u), [device_u, 0.9998, v], device="cpu")
    # arccos 0.9998 is 1.146 degrees.
    snapped = [True, True, True, False, False, False, True]
    expected = np.where(np.array(snapped)[:, None], [0, 0, 1] * np.sign(u[:, 2:]), u)
    np.testing.assert_array_equal(v.numpy(), expected)
    wp.launch(_snap, len(u), [device_u, 1.0, v], device="cpu")
    np.testing.assert_array_equal(v.numpy(), u)


@pytest.mark.parametrize("device", DEVICES)
def test_lambert_follows_the_cosine_law(device):
    normal = np.array([0.48, -0.6, 0.64])
    v = wp.empty(10_000_000, dtype=wp.vec3, device=device)
    wp.launch(_lambert, v.size, [wp.vec3(*normal), v], device=device)
    cosine = v.numpy() @ normal
    assert cosine.min() > -1e-6
    # cos^2 is uniform under the cosine law.
    assert chi2_p(cosine, lambda c: np.clip(c, 0, 1) ** 2) > 1e-4


def test_one_minus_cosine_keeps_small_angles():
    angle = np.geomspace(1e-5, 3.1, 2000)
    u = np.tile([0.6, 0.0, 0.8], (angle.size, 1)).astype(np.float32).astype(np.float64)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * np.array([0.0, 1.0, 0.0])
    t = wp.empty(angle.size, dtype=float, device="cpu")
    wp.launch(_difference, angle.size, [*(wp.array(a, dtype=wp.vec3, device="cpu") for a in (u, v)), t], device="cpu")
    relative = t.numpy() / (2 * np.sin(angle / 2) ** 2) - 1
    # Rounding the vectors themselves moves the angle by 6e-8: 1e-4 of 1e-3 rad.
    assert np.abs(relative[angle > 1e-3]).max() < 5e-4
    assert stats.describe(t.numpy()).minmax[1] <= 2.0
