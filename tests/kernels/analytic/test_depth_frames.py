"""Depth frames of the analytic simulator, in metres and as a dataset stores them: noise, background photons, counts."""

import math

import numpy as np
import pytest
import warp as wp
from scipy import stats

from helpers.launch import on_device, unit
from spadwarp_kernels import analytic

pytestmark = pytest.mark.physics

WIDTH, HEIGHT = 52, 40  # rows that do not end at a byte
OFFSET, STEP = 9.0, 1e-3
LASER = np.array([0.3, 0.0, 0.0])
VIEW = unit(np.stack([np.linspace(0.0, 0.6, 50), np.zeros(50), np.ones(50)], axis=1))
SIGMA = np.linspace(0.01, 0.2, 50)
SIGMA[0] = np.nan
TIMES = np.linspace(4.0, 20.0, 9)[None], np.array([[0, 0.5, 0.7, 0.8, 0.86, 0.9, 0.94, 0.97, 1.0]])  # of backscatter


def in_metres(device, frames, *, first=0, seed=5, share=0.0, flat=0.0):
    """Depth and what is stray, of pixels at 7 m with SIGMA; the first has no estimate."""
    maps = [np.where(np.isnan(SIGMA), np.nan, 7.0), SIGMA, np.full(50, share), np.full(50, flat)]
    arrays = [on_device(values, device) for values in (VIEW, *maps, *TIMES)]
    options = {"laser": LASER, "gate_paths": (4.0, 20.0), "first_frame": first, "frames": frames, "seed": seed}
    depth, labels = analytic.sample_frames(*arrays, **options)
    return depth.numpy(), labels.numpy()


PATHS, CUMULATIVE = np.array([20.0, 24.0, 30.0, 34.0]), np.array([0.0, 0.5, 0.9, 1.0])


def in_codes(device, frames, *, first=0, seed=7, share=0.0, flat=0.0, depth=14.0, sigma=0.01, alpha=1e-4, **changes):
    """Codes of depth, counts and what is stray; `share` may be one for each frame."""
    coding = analytic.FrameCoding()
    coding.seed, coding.first_sample = wp.uint64(seed), wp.int64(40 + first)
    fields = {"nearest": 20.0, "farthest": 34.0, "width": WIDTH, "pixels": WIDTH * HEIGHT, "intensity_step": 1.0}
    for name, value in {**fields, "depth_offset": OFFSET, "depth_step": STEP, "pulses": 20_000.0, **changes}.items():
        setattr(coding, name, value)
    maps = [np.full(WIDTH * HEIGHT, value) for value in (depth, sigma, alpha, 1.0, flat)]
    fraction = np.broadcast_to(np.asarray(share, float), frames)
    inputs = [np.tile([0.0, 0.0, 1.0], (WIDTH * HEIGHT, 1)), *maps, PATHS[None], CUMULATIVE[None], fraction]
    codes = analytic.draw_frames(coding, *(on_device(values, device) for values in inputs))
    depth_codes, counts, labels = (one.numpy() for one in codes)
    bits = np.unpackbits(labels.reshape(frames, HEIGHT, -1), axis=-1)
    assert not bits[..., WIDTH:].any()
    return depth_codes, counts, bits[..., :WIDTH].reshape(frames, -1).astype(bool)


@pytest.mark.parametrize("draw", [in_metres, in_codes])
def test_a_frame_depends_on_seed_and_number_alone(draw, device):
    whole = draw(device, 11, share=0.2)
    for first, count in [(0, 1), (3, 5), (4, 7), (10, 1)]:
        for part, frames in zip(draw(device, count, first=first, share=0.2), whole, strict=True):
            np.testing.assert_array_equal(part, frames[first : first + count])
    assert (draw(device, 11, seed=6, share=0.2)[-1] != whole[-1]).any()


def test_frames_are_normal_about_the_truth_with_the_bound_as_deviation(device):
    depth, labels = in_metres(device, 4001)
    assert np.isnan(depth[:, 0]).all() and not labels.any()
    z = (depth[:, 1:] - 7.0) / SIGMA[1:]
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    pairs = z[:-1:2] * z[1::2]  # two frames of one random block
    assert abs(pairs.mean()) * math.sqrt(pairs.size) < 4


@pytest.mark.parametrize("flat", [0.0, 1.0])
def test_stray_pixels_have_the_given_share_and_the_backscatters_times(device, flat):
    depth, labels = in_metres(device, 2000, share=0.3, flat=flat)
    assert abs(labels.mean() - 0.3) < 4 * math.sqrt(0.21 / labels.size)
    view = VIEW[np.nonzero(labels)[1]]
    points = (depth[labels] / view[:, 2])[:, None] * view
    path = np.linalg.norm(points, axis=1) + np.linalg.norm(points - LASER, axis=1)
    law = ([4.0, 20.0], [0, 1]) if flat else (TIMES[0][0], TIMES[1][0])
    assert stats.kstest(path, lambda x: np.interp(x, *law)).pvalue > 1e-3


def test_noise_of_codes_is_normal_and_background_has_the_share_asked_for(device):
    shares = np.array([0.0, 0.042, 0.264, 0.48, 1.0] * 3)
    offset, step = 13.5, 2e-5  # fine beside the noise
    codes, _, outliers = in_codes(device, 15, share=shares, depth_offset=offset, depth_step=step)
    for share, labels in zip(shares, outliers, strict=True):
        assert stats.binomtest(int(labels.sum()), labels.size, share).pvalue > 1e-3 / len(shares)
    depth = offset + step * codes[~outliers].astype(float)
    assert stats.kstest((depth - 14.0) / 0.01, "norm").pvalue > 1e-3


@pytest.mark.parametrize("flat", [0.0, 0.3, 1.0])
def test_background_photons_follow_the_distribution_over_path(device, flat):
    codes, _, outliers = in_codes(device, 20, share=0.5, flat=flat)
    depth = OFFSET + STEP * codes[outliers].astype(float)

    def law(z):
        return (1.0 - flat) * np.interp(2.0 * z, PATHS, CUMULATIVE) + flat * np.clip((2.0 * z - 20.0) / 14.0, 0.0, 1.0)

    # The codes round to a thousandth of what the distribution spans.
    assert stats.kstest(depth, law).statistic < 5e-4 + stats.kstwobign.isf(1e-3) / np.sqrt(depth.size)


@pytest.mark.parametrize("mean", [0.3, 5.0, 7.9, 8.1, 40.0, 120.0])
def test_counts_are_binomial(device, mean):
    pulses = 400
    _, counts, _ = in_codes(device, 40, alpha=-np.log1p(-mean / pulses), pulses=float(pulses))
    values = np.arange(256)
    drawn = np.searchsorted(np.sort(counts.ravel()), values, side="right") / counts.size
    error = np.abs(drawn - stats.binom.cdf(values, pulses, mean / pulses)).max()
    assert error < (0.002 if mean >= 8.0 else 0.0) + stats.kstwobign.isf(1e-3) / np.sqrt(counts.size)


def test_estimates_stay_within_the_gate_and_where_there_is_none_nothing_is_reported_unless_it_is_stray(device):
    codes, _, outliers = in_codes(device, 4, share=0.3, depth=np.nan, sigma=np.nan)
    assert ((codes == 0) == ~outliers).all()
    depth = OFFSET + STEP * in_codes(device, 4, depth=16.9, sigma=1.0)[0].astype(float)
    assert depth.min() >= 10.0 - STEP and depth.max() == pytest.approx(17.0, abs=STEP)
