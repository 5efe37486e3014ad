"""Arrival times in bins: estimators against brute-force references in float64."""

import numpy as np
import pytest
import warp as wp

from helpers.launch import Integers
from spadwarp_kernels.base.kernels import launch_pixels
from spadwarp_kernels.detection import PHASES, arrival_bins, first_invalid_row

BINS = 96
SIGMA = 1.7


def _cdf(x):
    from scipy.stats import norm

    return norm.cdf(x, 0.0, SIGMA)


def _response():
    lowest, taps = -10, 21
    edges = lowest + np.arange(taps + 1)[None, :] - np.arange(PHASES)[:, None] / PHASES
    return np.diff(_cdf(edges), axis=1), lowest


def _shape(delay):
    return np.diff(_cdf(np.arange(BINS + 1) - np.asarray(delay)[..., None]), axis=-1)


def _counts(signal, background, pixels=64, seed=5):
    rng = np.random.default_rng(seed)
    delay = rng.uniform(20, 76, pixels)
    return delay, rng.poisson(signal * _shape(delay) + background).astype(np.int32)


def _run(counts, method, **options):
    options.setdefault("min_significance", 0.0)
    if "background" in options:
        background = np.atleast_2d(np.asarray(options["background"], np.float32))
        options["background"] = wp.array(background, dtype=float, device="cpu")
    if method in ("matched", "likelihood"):
        options["response"], options["lowest_tap"] = _response()
    return arrival_bins(wp.array(counts, device="cpu"), method=method, **options).numpy()


def test_peak_is_the_centre_of_the_largest_bin_above_the_background():
    counts = np.array([[0, 3, 9, 2], [9, 0, 4, 0], [0, 0, 0, 0]], np.int32)
    np.testing.assert_array_equal(_run(counts, "peak"), [2.5, 0.5, np.nan])
    np.testing.assert_array_equal(_run(counts, "peak", background=[8.0, 0.0, 0.0, 0.0]), [2.5, 2.5, np.nan])
    np.testing.assert_array_equal(_run(counts, "peak", first=1, stop=2), [1.5, np.nan, np.nan])


def test_centroid_is_the_mean_of_the_window_about_the_peak():
    counts = np.array([[5, 0, 2, 6, 4, 0, 0, 5]], np.int32)
    np.testing.assert_allclose(_run(counts, "centroid", half_width=2), 3.5 + (4 - 2) / 12, rtol=1e-6)
    np.testing.assert_allclose(_run(counts, "centroid", half_width=1, background=1.0), 3.5 + (3 - 1) / 9, rtol=1e-6)


def test_centroid_of_a_tiny_rate_keeps_its_digits():
    rate = _shape(np.array([40.3]))
    for scale in (1e-30, 1.0, 1e30):
        np.testing.assert_allclose(_run((rate * scale).astype(np.float32), "centroid", half_width=8), 40.3, atol=1e-3)


@pytest.mark.parametrize(("signal", "background"), [(200.0, 0.0), (200.0, 1.0), (40.0, 0.2)])
def test_likelihood_finds_the_maximum_of_a_brute_force_search(signal, background):
    _, counts = _counts(signal, background, pixels=8)
    found = _run(counts, "likelihood", **({"background": background} if background else {}))
    fine = np.arange(15, 81, 1 / 32)
    floor = 1e-6 * _response()[0].max() * counts.sum(1)
    shape = _shape(fine)
    for pixel, n in enumerate(counts):
        level = max(background, floor[pixel])
        best = np.full(fine.size, -np.inf)
        for amplitude in np.geomspace(0.2, 2.0, 80) * signal:
            best = np.maximum(best, np.log1p(amplitude * shape / level) @ n - amplitude * shape.sum(1))
        assert abs(found[pixel] - fine[best.argmax()]) < 1 / 16


def test_matched_filter_is_maximum_likelihood_without_background():
    delay, counts = _counts(150.0, 0.0)
    matched, likelihood = _run(counts, "matched"), _run(counts, "likelihood")
    np.testing.assert_allclose(matched, likelihood, atol=2e-3)
    # The mean of 150 Gaussian arrival times has the standard deviation sigma / sqrt(150); bins add 1/12.
    expected = np.sqrt((SIGMA**2 + 1 / 12) / 150)
    assert abs(np.std(matched - delay) / expected - 1) < 4 / np.sqrt(2 * delay.size)


def test_likelihood_meets_the_cramer_rao_bound_where_the_centroid_does_not():
    signal, background, pixels = 100.0, 2.5, 600
    delay, counts = _counts(signal, background, pixels=pixels)
    step = 1e-4
    slope = signal * (_shape(delay + step) - _shape(delay - step)) / (2 * step)
    information = (slope**2 / (signal * _shape(delay) + background)).sum(1)
    bound = np.sqrt(np.mean(1 / information))
    relative_error = 1 / np.sqrt(2 * pixels)
    likelihood = np.std(_run(counts, "likelihood", background=background) - delay)
    centroid = np.std(_run(counts, "centroid", background=background, half_width=6) - delay)
    assert abs(likelihood / bound - 1) < 4 * relative_error
    assert centroid > likelihood * (1 + 4 * relative_error)


def test_a_ramp_of_backscatter_does_not_draw_the_likelihood():
    rng = np.random.default_rng(8)
    ramp = 40.0 * np.exp(-np.arange(BINS) / 12.0) + 0.05
    delay = rng.uniform(40, 70, 300)
    counts = rng.poisson(25.0 * _shape(delay) + ramp).astype(np.int32)
    error = _run(counts, "likelihood", background=ramp) - delay
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(delay.size)
    assert np.abs(error).max() < 5
    assert np.median(_run(counts, "peak")) < 10  # what the eye does


def test_background_rows_repeat_over_frames():
    _, counts = _counts(100.0, 0.0, pixels=4)
    rows = np.zeros((2, BINS), np.float32)
    rows[1] = 1e6
    peak = _run(counts, "peak", background=rows)
    np.testing.assert_array_equal(np.isnan(peak), [False, True, False, True])


def test_likelihood_reports_nothing_when_no_delay_rises_above_the_background():
    counts = np.full((1, BINS), 2, np.int32)
    assert np.isnan(_run(counts, "likelihood", background=3.0)).all()
    assert np.isnan(_run(0 * counts, "likelihood")).all() and np.isnan(_run(0 * counts, "matched")).all()


def test_result_does_not_depend_on_the_cut():
    _, counts = _counts(60.0, 0.5, pixels=37)
    whole = _run(counts, "matched")
    single = np.concatenate([_run(counts[i : i + 1], "matched") for i in range(37)])
    np.testing.assert_array_equal(whole, single)


def test_invalid_values_are_found():
    values = np.zeros((1000, 3), np.float32)
    array = wp.array(values, device="cpu")
    assert first_invalid_row(array) is None
    for bad in (-1e-3, np.nan, np.inf):
        values[:] = 0
        values[700, 1] = values[900, 2] = bad
        assert first_invalid_row(wp.array(values, device="cpu")) == 700


@wp.kernel(enable_backward=False)
def _count(first_pixel: int, seen: Integers):
    pixel = first_pixel + wp.tid()
    seen[pixel] += 1


@pytest.mark.parametrize("count", [0, 1, 5, 1000])
def test_every_pixel_is_launched_once(count):
    seen = wp.zeros(count, dtype=int, device="cpu")
    launch_pixels(_count, count, [seen], device="cpu")
    np.testing.assert_array_equal(seen.numpy(), np.ones(count))
