"""Arrival times in bins: estimators against brute-force references in float64."""

import numpy as np
import pytest
import warp as wp
from scipy.stats import norm

from spadwarp_kernels.base.kernels import launch_pixels
from spadwarp_kernels.detection import PHASES, arrival_bins, first_invalid_row

BINS = 96
SIGMA = 1.7


def response():
    lowest, taps = -10, 21
    edges = lowest + np.arange(taps + 1)[None, :] - np.arange(PHASES)[:, None] / PHASES
    return np.diff(norm.cdf(edges, 0.0, SIGMA), axis=1), lowest


def shape(delay):
    return np.diff(norm.cdf(np.arange(BINS + 1) - np.asarray(delay)[..., None], 0.0, SIGMA), axis=-1)


def drawn(signal, background, pixels=64, seed=5):
    rng = np.random.default_rng(seed)
    delay = rng.uniform(20, 76, pixels)
    return delay, rng.poisson(signal * shape(delay) + background).astype(np.int32)


def run(counts, method, **options):
    options.setdefault("min_significance", 0.0)
    if "background" in options:
        background = np.atleast_2d(np.asarray(options["background"], np.float32))
        options["background"] = wp.array(background, dtype=float, device="cpu")
    if method in ("matched", "likelihood"):
        options["response"], options["lowest_tap"] = response()
    return arrival_bins(wp.array(counts, device="cpu"), method=method, **options).numpy()


def test_peak_is_the_centre_of_the_largest_bin_above_the_background():
    counts = np.array([[0, 3, 9, 2], [9, 0, 4, 0], [0, 0, 0, 0]], np.int32)
    np.testing.assert_array_equal(run(counts, "peak"), [2.5, 0.5, np.nan])
    np.testing.assert_array_equal(run(counts, "peak", background=[8.0, 0.0, 0.0, 0.0]), [2.5, 2.5, np.nan])
    np.testing.assert_array_equal(run(counts, "peak", first=1, stop=2), [1.5, np.nan, np.nan])
    # Rows of background repeat over frames.
    rows = np.outer([0.0, 1e6], np.ones(BINS))
    found = run(drawn(100.0, 0.0, pixels=4)[1], "peak", background=rows)
    np.testing.assert_array_equal(np.isnan(found), [False, True, False, True])


def test_centroid_is_the_mean_of_the_window_about_the_peak():
    counts = np.array([[5, 0, 2, 6, 4, 0, 0, 5]], np.int32)
    np.testing.assert_allclose(run(counts, "centroid", half_width=2), 3.5 + (4 - 2) / 12, rtol=1e-6)
    np.testing.assert_allclose(run(counts, "centroid", half_width=1, background=1.0), 3.5 + (3 - 1) / 9, rtol=1e-6)
    for scale in (1e-30, 1.0, 1e30):  # a rate keeps its digits
        rate = (shape(np.array([40.3])) * scale).astype(np.float32)
        np.testing.assert_allclose(run(rate, "centroid", half_width=8), 40.3, atol=1e-3)


@pytest.mark.parametrize(("signal", "background"), [(200.0, 0.0), (200.0, 1.0), (40.0, 0.2)])
def test_likelihood_finds_the_maximum_of_a_brute_force_search(signal, background):
    _, counts = drawn(signal, background, pixels=8)
    found = run(counts, "likelihood", **({"background": background} if background else {}))
    fine = np.arange(15, 81, 1 / 16)
    floor, shapes = 1e-6 * response()[0].max() * counts.sum(1), shape(fine)
    for pixel, n in enumerate(counts):
        level = max(background, floor[pixel])
        best = np.full(fine.size, -np.inf)
        for amplitude in np.geomspace(0.2, 2.0, 40) * signal:
            best = np.maximum(best, np.log1p(amplitude * shapes / level) @ n - amplitude * shapes.sum(1))
        assert abs(found[pixel] - fine[best.argmax()]) < 1 / 16


def test_matched_filter_is_maximum_likelihood_without_background():
    delay, counts = drawn(150.0, 0.0)
    matched, likelihood = run(counts, "matched"), run(counts, "likelihood")
    np.testing.assert_array_equal(np.concatenate([run(row[None], "matched") for row in counts]), matched)
    np.testing.assert_allclose(matched, likelihood, atol=2e-3)
    # The mean of 150 Gaussian arrival times has the standard deviation sigma / sqrt(150); bins add 1/12.
    expected = np.sqrt((SIGMA**2 + 1 / 12) / 150)
    assert abs(np.std(matched - delay) / expected - 1) < 4 / np.sqrt(2 * delay.size)


def test_likelihood_meets_the_cramer_rao_bound_where_the_centroid_does_not():
    signal, background, pixels = 100.0, 2.5, 600
    delay, counts = drawn(signal, background, pixels=pixels)
    step = 1e-4
    slope = signal * (shape(delay + step) - shape(delay - step)) / (2 * step)
    information = (slope**2 / (signal * shape(delay) + background)).sum(1)
    bound = np.sqrt(np.mean(1 / information))
    relative_error = 1 / np.sqrt(2 * pixels)
    likelihood = np.std(run(counts, "likelihood", background=background) - delay)
    centroid = np.std(run(counts, "centroid", background=background, half_width=6) - delay)
    assert abs(likelihood / bound - 1) < 4 * relative_error
    assert centroid > likelihood * (1 + 4 * relative_error)


def test_a_ramp_of_backscatter_does_not_draw_the_likelihood():
    rng = np.random.default_rng(8)
    ramp = 40.0 * np.exp(-np.arange(BINS) / 12.0) + 0.05
    delay = rng.uniform(40, 70, 300)
    counts = rng.poisson(25.0 * shape(delay) + ramp).astype(np.int32)
    error = run(counts, "likelihood", background=ramp) - delay
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(delay.size)
    assert np.abs(error).max() < 5
    assert np.median(run(counts, "peak")) < 10  # what the eye does


def test_likelihood_reports_nothing_when_no_delay_rises_above_the_background():
    counts = np.full((1, BINS), 2, np.int32)
    assert np.isnan(run(counts, "likelihood", background=3.0)).all()
    assert np.isnan(run(0 * counts, "likelihood")).all() and np.isnan(run(0 * counts, "matched")).all()


def test_invalid_values_are_found():
    for bad, row in ((0.0, None), (-1e-3, 700), (np.nan, 700), (np.inf, 700)):
        values = np.zeros((1000, 3), np.float32)
        values[700, 1] = values[900, 2] = bad
        assert first_invalid_row(wp.array(values, device="cpu")) == row


@wp.kernel(enable_backward=False)
def visit(first_pixel: int, seen: wp.array(dtype=int)):
    seen[first_pixel + wp.tid()] += 1


@pytest.mark.parametrize("count", [0, 1, 5, 1000])
def test_every_pixel_is_launched_once(count):
    seen = wp.zeros(count, dtype=int, device="cpu")
    launch_pixels(visit, count, [seen], device="cpu")
    assert (seen.numpy() == 1).all()
