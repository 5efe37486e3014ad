"""Frames as a dataset stores them: noise, background photons, counts, and the integers that stand for them."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from spadwarp_kernels.analytic import FrameCoding, draw_frames

WIDTH, HEIGHT = 52, 40  # rows that do not end at a byte
OFFSET, STEP = 9.0, 1e-3
PATHS = np.array([20.0, 24.0, 30.0, 34.0])
CUMULATIVE = np.array([0.0, 0.5, 0.9, 1.0])


def draw(device, *, depth=14.0, sigma=0.01, alpha=1e-4, pulses=20_000, probability=1.0, flat=0.0, fraction, **changes):
    pixels = WIDTH * HEIGHT
    coding = FrameCoding()
    coding.nearest, coding.farthest = 20.0, 34.0
    coding.width, coding.pixels = WIDTH, pixels
    coding.seed, coding.first_sample = wp.uint64(7), wp.int64(40)
    coding.depth_offset, coding.depth_step = OFFSET, STEP
    coding.pulses, coding.intensity_step = float(pulses), 1.0
    for name, value in changes.items():
        setattr(coding, name, value)

    def put(values, kind=wp.float32):
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=kind, device=device)

    maps = [np.full(pixels, value) for value in (depth, sigma, alpha, probability, flat)]
    view = put(np.tile([0.0, 0.0, 1.0], (pixels, 1)), wp.vec3)
    codes = draw_frames(coding, view, *map(put, maps), put(PATHS[None]), put(CUMULATIVE[None]), put(fraction))
    depth_codes, intensity, labels = (one.numpy() for one in codes)
    bits = np.unpackbits(labels.reshape(len(labels), HEIGHT, -1), axis=-1)
    assert not bits[..., WIDTH:].any()
    return depth_codes, intensity, bits[..., :WIDTH].reshape(len(labels), -1).astype(bool)


def test_noise_is_normal_and_background_has_the_share_asked_for(device):
    fractions = np.array([0.0, 0.042, 0.264, 0.48, 1.0] * 3)
    offset, step = 13.5, 2e-5  # fine beside the noise
    codes, _, outliers = draw(device, fraction=fractions, depth_offset=offset, depth_step=step)
    for share, labels in zip(fractions, outliers, strict=True):
        assert stats.binomtest(int(labels.sum()), labels.size, share).pvalue > 1e-3 / len(fractions)
    depth = offset + step * codes[~outliers].astype(float)
    assert stats.kstest((depth - 14.0) / 0.01, "norm").pvalue > 1e-3


@pytest.mark.parametrize("flat", [0.0, 0.3, 1.0])
def test_background_photons_follow_the_distribution_over_path(device, flat):
    codes, _, outliers = draw(device, fraction=np.full(20, 0.5), flat=flat)
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
    _, counts, _ = draw(device, alpha=alpha, pulses=pulses, fraction=np.zeros(40))
    values = np.arange(256)
    drawn = np.searchsorted(np.sort(counts.ravel()), values, side="right") / counts.size
    error = np.abs(drawn - stats.binom.cdf(values, pulses, mean / pulses)).max()
    assert error < (0.002 if mean >= 8.0 else 0.0) + stats.kstwobign.isf(1e-3) / np.sqrt(counts.size)


def test_what_has_no_estimate_reports_nothing_unless_it_is_stray(device):
    codes, _, outliers = draw(device, depth=np.nan, sigma=np.nan, fraction=np.full(4, 0.3))
    assert ((codes == 0) == ~outliers).all()


def test_estimates_stay_within_the_gate(device):
    codes, _, _ = draw(device, depth=16.9, sigma=1.0, fraction=np.zeros(4))
    depth = OFFSET + STEP * codes.astype(float)
    assert depth.min() >= 10.0 - STEP and depth.max() == pytest.approx(17.0, abs=STEP)


def test_a_frame_depends_on_its_sample_id_alone(device):
    together = draw(device, fraction=np.full(6, 0.3))
    later = draw(device, fraction=np.full(2, 0.3), first_sample=wp.int64(44))
    for one, other in zip(together, later, strict=True):
        np.testing.assert_array_equal(one[4:], other)
    assert (together[0][0] != together[0][1]).any()
