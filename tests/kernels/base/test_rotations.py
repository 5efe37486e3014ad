"""Directions: bases, the exact update, the near-axis rule, small angles."""

import numpy as np
import warp as wp

from helpers.launch import each, unit
from helpers.statistics_of_samples import chi2_p
from spadwarp_kernels import one_minus_cosine, random_block, rotate_direction, u01
from spadwarp_kernels.base.rotations import OFF_AXIS, cos_sin_turn, orthonormal_basis, snap_from


def unit_vectors(count, seed=0):
    v = np.random.default_rng(seed).normal(size=(count, 3))
    v[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    return unit(v).astype(np.float32)


def test_bases_are_orthonormal_everywhere(device):
    n = unit_vectors(100_000)
    n[6:12] = [[1e-4, 0, -1], [0, 1e-7, -1], [1e-20, 0, -1], [1e-4, 0, 1], [3e-8, 0, 1], [-1e-4, 1e-4, -1]]
    n = unit(n)
    frames = np.stack([*each(orthonormal_basis, [n], (wp.vec3, wp.vec3), device), n.astype(np.float64)], axis=1)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=2e-6)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=3e-6)


def test_rotation_turns_by_the_angle_at_a_uniform_azimuth(device):
    rng = np.random.default_rng(1)
    u = unit_vectors(200_000, seed=2)
    t = (2 * rng.random(len(u)) ** 4).astype(np.float32)
    out = each(rotate_direction, [u, t, rng.random(len(u), np.float32)], [wp.vec3], device)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(1 - (out * u).sum(axis=1), t, atol=4e-7)
    # The azimuth about u, measured from the direction to the z axis, is uniform.
    east = np.cross(u, [0.0, 0.0, 1.0])
    width = np.linalg.norm(east, axis=1)
    azimuth = np.arctan2((out * east).sum(axis=1), (out * np.cross(east, u)).sum(axis=1))
    assert chi2_p(azimuth[(width > 1e-3) & (t > 1e-3)], lambda a: (a + np.pi) / (2 * np.pi), bins=100) > 1e-4


@wp.func
def walk(u: wp.vec3, steps: int, id: int):
    v = u
    for k in range(steps):
        block = random_block(wp.uint64(3), wp.uint64(id), wp.uint32(k), wp.uint32(1))
        v = rotate_direction(v, 2.0 * u01(block[0]), u01(block[1]))
    return v


def test_length_stays_one_over_many_events():
    ends = each(walk, [unit_vectors(1000), 2000, np.arange(1000)], [wp.vec3])
    np.testing.assert_allclose(np.linalg.norm(ends, axis=1), 1.0, atol=3e-7)


def test_near_axis_rule_snaps_the_direction_unless_it_is_off():
    """arccos 0.9998 is 1.146 degrees."""
    tilt = np.radians([0.0, 0.5, 1.1, 1.2, 5.0, 178.0, 179.5])
    u = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=1).astype(np.float32)
    snapped = np.array([True, True, True, False, False, False, True])
    expected = np.where(snapped[:, None], [0, 0, 1] * np.sign(u[:, 2:]), u)
    np.testing.assert_array_equal(each(snap_from, [u, 0.9998], [wp.vec3]), expected)
    np.testing.assert_array_equal(each(snap_from, [u, float(OFF_AXIS)], [wp.vec3]), u)


def test_one_minus_cosine_keeps_small_angles():
    angle = np.geomspace(1e-5, 3.1, 2000)
    u = unit(np.tile(np.float32([0.6, 0.0, 0.8]), (angle.size, 1)).astype(np.float64))
    t = each(one_minus_cosine, [u, np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * [0.0, 1.0, 0.0]])
    # Rounding the vectors themselves moves the angle by 6e-8: 1e-4 of 1e-3 rad.
    assert np.abs(t / (2 * np.sin(angle / 2) ** 2) - 1)[angle > 1e-3].max() < 5e-4
    assert t.max() <= 2.0


def test_turns_are_rounded_cosines_and_sines_on_a_cpu():
    xi = (np.arange(1 << 20, dtype=np.float32) + np.float32(0.5)) / np.float32(1 << 20)
    xi = np.concatenate([xi, np.arange(9, dtype=np.float32)[:-1] / 8])
    angle = (np.float32(6.2831853) * (xi - np.float32(0.5))).astype(np.float64)
    exact = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    error = np.abs(each(cos_sin_turn, [xi], [wp.vec2]) - exact) / np.spacing(np.abs(exact).astype(np.float32))
    assert error.max() < 0.57
