"""Depth frames of the analytic simulator, in metres and as a dataset stores them: noise, background photons, counts."""

import math

import numpy as np
import pytest
import warp as wp
from scipy import stats

from helpers.launch import on_device
from spadwarp_kernels import analytic

WIDTH, HEIGHT = 52, 40  # rows that do not end at a byte
OFFSET, STEP = 9.0, 1e-3
PATHS = np.array([20.0, 24.0, 30.0, 34.0])
CUMULATIVE = np.array([0.0, 0.5, 0.9, 1.0])


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


@pytest.mark.physics
def test_frames_are_normal_about_the_truth_with_the_bound_as_deviation(device):
    depth, labels, _, sigma, _ = draw(device, frames=4001)
    assert np.isnan(depth[:, 0]).all() and not labels.any()
    z = ((depth[:, 1:] - 7.0) / sigma[1:]).ravel()
    assert stats.kstest(z, "norm").pvalue > 1e-3
    pairs = (depth[:-1:2, 1:] - 7.0) * (depth[1::2, 1:] - 7.0) / sigma[1:] ** 2  # two frames of one random block
    assert abs(pairs.mean()) * math.sqrt(pairs.size) < 4


@pytest.mark.physics
@pytest.mark.parametrize("flat", [0.0, 1.0])
def test_stray_pixels_have_the_given_share_and_the_backscatters_times(device, flat):
    depth, labels, view, _, (paths, cumulative) = draw(device, frames=2000, probability=0.3, flat=flat)
    share = labels.mean()
    assert abs(share - 0.3) < 4 * math.sqrt(0.21 / labels.size)
    points = depth[labels][:, None] / view[:, 2][np.nonzero(labels)[1], None] * view[np.nonzero(labels)[1]]
    path = np.linalg.norm(points, axis=1) + np.linalg.norm(points - [0.3, 0, 0], axis=1)
    law = (paths[[0, -1]], [0, 1]) if flat else (paths, cumulative)
    assert stats.kstest(path, lambda x: np.interp(x, *law)).pvalue > 1e-3


@pytest.mark.physics
def test_a_frame_depends_on_seed_and_number_alone(device):
    whole = draw(device, frames=11, probability=0.2)
    for first, count in [(0, 1), (3, 5), (4, 7), (10, 1)]:
        part = draw(device, frames=count, first=first, probability=0.2)
        np.testing.assert_array_equal(part[0], whole[0][first : first + count])
        np.testing.assert_array_equal(part[1], whole[1][first : first + count])
    assert not np.array_equal(draw(device, frames=11, seed=6, probability=0.2)[1], whole[1])


# ---- As a dataset stores them.


def coded(device, *, depth=14.0, sigma=0.01, alpha=1e-4, pulses=20_000, probability=1.0, flat=0.0, fraction, **changes):
    pixels = WIDTH * HEIGHT
    coding = analytic.FrameCoding()
    coding.nearest, coding.farthest = 20.0, 34.0
    coding.width, coding.pixels = WIDTH, pixels
    coding.seed, coding.first_sample = wp.uint64(7), wp.int64(40)
    coding.depth_offset, coding.depth_step = OFFSET, STEP
    coding.pulses, coding.intensity_step = float(pulses), 1.0
    for name, value in changes.items():
        setattr(coding, name, value)

    maps = [np.full(pixels, value) for value in (depth, sigma, alpha, probability, flat)]
    inputs = [np.tile([0.0, 0.0, 1.0], (pixels, 1)), *maps, PATHS[None], CUMULATIVE[None], fraction]
    codes = analytic.draw_frames(coding, *(on_device(values, device) for values in inputs))
    depth_codes, intensity, labels = (one.numpy() for one in codes)
    bits = np.unpackbits(labels.reshape(len(labels), HEIGHT, -1), axis=-1)
    assert not bits[..., WIDTH:].any()
    return depth_codes, intensity, bits[..., :WIDTH].reshape(len(labels), -1).astype(bool)


def test_noise_is_normal_and_background_has_the_share_asked_for(device):
    fractions = np.array([0.0, 0.042, 0.264, 0.48, 1.0] * 3)
    offset, step = 13.5, 2e-5  # fine beside the noise
    codes, _, outliers = coded(device, fraction=fractions, depth_offset=offset, depth_step=step)
    for share, labels in zip(fractions, outliers, strict=True):
        assert stats.binomtest(int(labels.sum()), labels.size, share).pvalue > 1e-3 / len(fractions)
    depth = offset + step * codes[~outliers].astype(float)
    assert stats.kstest((depth - 14.0) / 0.01, "norm").pvalue > 1e-3


@pytest.mark.parametrize("flat", [0.0, 0.3, 1.0])
def test_background_photons_follow_the_distribution_over_path(device, flat):
    codes, _, outliers = coded(device, fraction=np.full(20, 0.5), flat=flat)
    depth = OFFSET + STEP * codes[outliers].astype(float)

    def law(z):
        return (1.0 - flat) * np.interp(2.0 * z, PATHS, CUMULATIVE) + flat * np.clip((2.0 * z - 20.0) / 14.0, 0.0, 1.0)

    # The codes round to a thousandth of what the distribution spans.
    distance = stats.kstest(depth, law)
    assert distance.statistic < 5e-4 + stats.kstwobign.isf(1e-3) / np.sqrt(depth.size)


@pytest.mark.parametrize("mean", [0.3, 5.0, 7.9, 8.1, 40.0, 120.0])
def test_counts_are_binomial(device, mean):
    pulses = 400
    alpha = -np.log1p(-mean / pulses)
    _, counts, _ = coded(device, alpha=alpha, pulses=pulses, fraction=np.zeros(40))
    values = np.arange(256)
    drawn = np.searchsorted(np.sort(counts.ravel()), values, side="right") / counts.size
    error = np.abs(drawn - stats.binom.cdf(values, pulses, mean / pulses)).max()
    assert error < (0.002 if mean >= 8.0 else 0.0) + stats.kstwobign.isf(1e-3) / np.sqrt(counts.size)


def test_what_has_no_estimate_reports_nothing_unless_it_is_stray(device):
    codes, _, outliers = coded(device, depth=np.nan, sigma=np.nan, fraction=np.full(4, 0.3))
    assert ((codes == 0) == ~outliers).all()


def test_estimates_stay_within_the_gate(device):
    codes, _, _ = coded(device, depth=16.9, sigma=1.0, fraction=np.zeros(4))
    depth = OFFSET + STEP * codes.astype(float)
    assert depth.min() >= 10.0 - STEP and depth.max() == pytest.approx(17.0, abs=STEP)


def test_a_frame_depends_on_its_sample_id_alone(device):
    together = coded(device, fraction=np.full(6, 0.3))
    later = coded(device, fraction=np.full(2, 0.3), first_sample=wp.int64(44))
    for one, other in zip(together, later, strict=True):
        np.testing.assert_array_equal(one[4:], other)
    assert (together[0][0] != together[0][1]).any()
