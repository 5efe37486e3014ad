"""Depth frames of the analytic simulator: noise, outliers with the backscatter's times, and reproducibility."""

import math

import numpy as np
import pytest
from scipy import stats

from helpers.launch import on_device
from spadwarp_kernels import analytic

pytestmark = pytest.mark.physics


def draw(device, *, frames, first=0, seed=5, probability=0.0, flat=0.0, pixels=50):
    view = np.zeros((pixels, 3))
    view[:, 0] = np.linspace(-0.3, 0.3, pixels)
    view[:, 2] = 1.0
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    sigma = np.linspace(0.01, 0.2, pixels)
    sigma[0] = np.nan
    paths = np.linspace(4.0, 20.0, 9)
    cumulative = np.array([0, 0.5, 0.7, 0.8, 0.86, 0.9, 0.94, 0.97, 1.0])

    maps = [np.where(np.isnan(sigma), np.nan, 7.0), sigma, np.full(pixels, probability), np.full(pixels, flat)]
    depth, labels = analytic.sample_frames(
        *(on_device(values, device) for values in (view, *maps, paths[None], cumulative[None])),
        laser=(0.3, 0.0, 0.0),
        gate_paths=(4.0, 20.0),
        first_frame=first,
        frames=frames,
        seed=seed,
    )
    return depth.numpy(), labels.numpy(), view, sigma, (paths, cumulative)


def test_frames_are_normal_about_the_truth_with_the_bound_as_deviation(device):
    depth, labels, _, sigma, _ = draw(device, frames=4001)
    assert np.isnan(depth[:, 0]).all() and not labels.any()
    z = ((depth[:, 1:] - 7.0) / sigma[1:]).ravel()
    assert stats.kstest(z, "norm").pvalue > 1e-3
    pairs = (depth[:-1:2, 1:] - 7.0) * (depth[1::2, 1:] - 7.0) / sigma[1:] ** 2  # two frames of one random block
    assert abs(pairs.mean()) * math.sqrt(pairs.size) < 4


@pytest.mark.parametrize("flat", [0.0, 1.0])
def test_stray_pixels_have_the_given_share_and_the_backscatters_times(device, flat):
    depth, labels, view, _, (paths, cumulative) = draw(device, frames=2000, probability=0.3, flat=flat)
    share = labels.mean()
    assert abs(share - 0.3) < 4 * math.sqrt(0.21 / labels.size)
    points = depth[labels][:, None] / view[:, 2][np.nonzero(labels)[1], None] * view[np.nonzero(labels)[1]]
    path = np.linalg.norm(points, axis=1) + np.linalg.norm(points - [0.3, 0, 0], axis=1)
    law = (paths[[0, -1]], [0, 1]) if flat else (paths, cumulative)
    assert stats.kstest(path, lambda x: np.interp(x, *law)).pvalue > 1e-3


def test_a_frame_depends_on_seed_and_number_alone(device):
    whole = draw(device, frames=11, probability=0.2)
    for first, count in [(0, 1), (3, 5), (4, 7), (10, 1)]:
        part = draw(device, frames=count, first=first, probability=0.2)
        np.testing.assert_array_equal(part[0], whole[0][first : first + count])
        np.testing.assert_array_equal(part[1], whole[1][first : first + count])
    assert not np.array_equal(draw(device, frames=11, seed=6, probability=0.2)[1], whole[1])
