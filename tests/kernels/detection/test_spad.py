"""The SPAD model against exact laws and closed forms."""

import numpy as np
import pytest
import warp as wp
from scipy import stats
from scipy.sparse import random_array

from spadwarp_kernels.detection import (
    add_crosstalk,
    coates,
    dark_count_rates,
    event_counts,
    expected_detections,
    first_photon_counts,
    first_photon_probabilities,
)

pytestmark = pytest.mark.physics

BINS = 24
PERIOD = 50e-9


def array(values):
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=float, device="cpu")


def shape(alpha):
    """λ of a return on a slope: large, small, tiny and empty bins."""
    k = np.arange(BINS)
    hazard = np.exp(-0.5 * ((k - 9) / 1.5) ** 2) + 0.3 * np.exp(-k / 6) + 1e-5
    hazard[3] = 0.0
    return hazard * alpha / hazard.sum()


def law(hazard):
    before = np.concatenate([[0.0], np.cumsum(hazard)[:-1]])
    return -np.exp(-before) * np.expm1(-hazard)


def chi_square(counts, probability, pulses):
    """p-value of summed counts against the multinomial, "no count" included."""
    observed = np.append(counts, pulses - counts.sum())
    expected = np.append(probability, 1 - probability.sum()) * pulses
    assert (observed[expected == 0] == 0).all()
    rare = expected < 10
    if expected[rare].sum() > 0:
        observed, expected = np.append(observed, observed[rare].sum()), np.append(expected, expected[rare].sum())
        rare = np.append(rare, False)
    observed, expected = observed[~rare], expected[~rare]
    return stats.chisquare(observed, expected, sum_check=False).pvalue


def first_photon(hazard, **options):
    return first_photon_counts(array(np.atleast_2d(hazard)), **options).numpy()


def events(hazard, *, pulses, recorded=BINS, edges=None, **options):
    edges = np.linspace(0, PERIOD, BINS + 1) if edges is None else edges
    options = {"period": PERIOD, "seed": 6, "recorded": recorded, "pulses": pulses, **options}
    counts, stream = event_counts(array(np.atleast_2d(hazard)), edges=edges, **options)
    return counts.numpy(), stream


@pytest.mark.parametrize("alpha", [0.05, 0.5, 1.0, 5.0])
@pytest.mark.parametrize("pulses", [7, 200, 100_000])
def test_first_photon_counts_and_gated_events_follow_the_exact_law(alpha, pulses):
    hazard = shape(alpha)
    frames = 400_000 // pulses + 20
    counts = first_photon(hazard, pulses=pulses, frames=frames, seed=11)
    assert counts.sum(axis=1).max() <= pulses
    assert chi_square(counts.sum(0), law(hazard), pulses * frames) > 1e-4
    if pulses == 200:
        edges = np.linspace(0, 0.7 * PERIOD, BINS + 1)
        counts, _ = events(hazard, pulses=pulses, frames=1000, gated=True, edges=edges)
        assert chi_square(counts.sum(0), law(hazard), 200_000) > 1e-4


@pytest.mark.parametrize("alpha", [0.5, 3.0])
def test_first_photon_counts_covary_as_a_multinomial(alpha):
    hazard, pulses, frames = shape(alpha), 300, 20_000
    p = law(hazard)
    counts = first_photon(hazard, pulses=pulses, frames=frames, seed=2).astype(np.float64)
    variance = pulses * p * (1 - p)
    bright = variance > 1
    assert np.abs(counts.var(0)[bright] / variance[bright] - 1).max() < 5 * np.sqrt(2 / frames)
    correlation = np.corrcoef(counts[:, 8], counts[:, 10])[0, 1]
    exact = -pulses * p[8] * p[10] / np.sqrt(variance[8] * variance[10])
    assert abs(correlation - exact) < 4 / np.sqrt(frames)


def test_tiny_hazards_count_as_often_as_they_should_and_counters_stop_at_their_depth():
    counts = first_photon(np.full((200, 1000), 3e-9), pulses=1_000_000, seed=5)
    assert abs(counts.sum() - 600) < 4 * np.sqrt(600)
    assert (counts > 1).sum() <= 6  # 0.9 expected
    counts, shallow = (first_photon(shape(1.0), pulses=10_000, seed=4, **one) for one in ({}, {"counter_depth": 255}))
    assert counts.max() > 255
    np.testing.assert_array_equal(shallow, np.minimum(counts, 255))


def test_counts_and_events_do_not_depend_on_the_cut():
    hazard = np.stack([shape(alpha) for alpha in (0.01, 0.1, 1.0, 2.0)])
    whole = first_photon(hazard, pulses=1000, frames=6, seed=1).reshape(6, 4, BINS)
    later = first_photon(hazard, pulses=1000, frames=2, first_frame=3, seed=1).reshape(2, 4, BINS)
    np.testing.assert_array_equal(later, whole[3:5])
    np.testing.assert_array_equal(first_photon(hazard, pulses=1000, frames=6, summed=True, seed=1), whole.sum(0))
    assert (first_photon(hazard, pulses=1000, frames=6, seed=2).reshape(whole.shape) != whole).any()
    options = {"pulses": 300, "dead_time": 20e-9, "afterpulsing_probability": 0.1, "afterpulsing_time_constant": 1e-8}
    parts = [events(hazard, frames=frames, first_frame=first, **options)[0] for first, frames in ((0, 5), (2, 2))]
    np.testing.assert_array_equal(parts[1], parts[0][8:16])


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
def test_first_photon_probabilities(dtype):
    hazard = np.stack([shape(alpha) for alpha in (1e-6, 0.5, 5.0)])
    found = first_photon_probabilities(wp.array(hazard, dtype=dtype, device="cpu")).numpy()
    np.testing.assert_allclose(found, [law(row) for row in hazard], rtol=1e-6 if dtype == wp.float32 else 1e-12)


@pytest.mark.parametrize("alpha", [0.5, 2.0, 5.0])
def test_coates_undoes_pile_up(alpha):
    # Deep bins of a piled-up histogram see few pulses: they carry less, so the error is weighed by what they say.
    hazard, pulses = shape(alpha), 200_000_000
    counts = first_photon_counts(array(hazard[None]), pulses=pulses, seed=3)
    corrected = coates(counts, pulses=pulses).numpy()[0]
    left = pulses * np.exp(-np.concatenate([[0.0], np.cumsum(hazard)[:-1]]))
    bright = hazard > 1e-3 * alpha
    error = np.sqrt(np.expm1(hazard) / left)[bright]
    assert np.abs((corrected - hazard)[bright] / error).max() < 4.5
    assert np.abs(corrected[bright] / hazard[bright] - 1).max() < 0.01
    assert abs(corrected.sum() / alpha - 1) < 0.001
    # Nothing is known after the last pulse.
    corrected = coates(wp.array(np.array([[2, 3, 0], [1, 0, 2]], np.int32), device="cpu"), pulses=5).numpy()
    expected = [[-np.log1p(-2 / 5), np.nan, np.nan], [-np.log1p(-1 / 5), 0.0, -np.log1p(-2 / 4)]]
    np.testing.assert_allclose(corrected, expected)


# ---- Event by event.


@pytest.mark.parametrize(("rate", "dead_time"), [(1e6, 100e-9), (2e7, 30e-9), (1e8, 77e-9), (1e7, 0.0), (5e7, 250e-9)])
def test_dead_time_gives_the_closed_form_rate(rate, dead_time):
    pulses, frames = 20_000, 20
    counts, _ = events(np.full(BINS, rate * PERIOD / BINS), pulses=pulses, frames=frames, dead_time=dead_time)
    duration = pulses * frames * PERIOD
    expected = rate / (1 + rate * dead_time)  # not extended by photons that meet it
    # Renewal process: the variance of the count is that of the gaps, 1 / rate², over the cube of their mean.
    error = np.sqrt(duration * expected**3 / rate**2) / duration
    # A frame starts with the detector ready, which is worth up to one more count.
    assert abs(counts.sum() / duration - expected) < 4 * error + frames / duration
    assert chi_square(counts.sum(0), np.full(BINS, 1 / BINS) * counts.sum() / 1e9, 10**9) > 1e-4


def test_dead_time_casts_its_shadow_also_from_unrecorded_bins():
    """A strong return early in the period blinds the detector behind it and no further."""
    hazard = np.full(BINS, 1e-3)
    hazard[4] = 3.0
    rate = events(hazard, pulses=100_000, dead_time=6 * PERIOD / BINS)[0][0] / 100_000
    assert abs(rate[4] - (1 - np.exp(-3)) * (1 - 5e-3)) < 0.01
    assert (rate[6:10] < 0.2e-3).all()  # only the 5 % of pulses that did not fire
    np.testing.assert_allclose(rate[12:], 1e-3, rtol=4 / np.sqrt(100))
    # Bins that are not recorded fire unseen.
    counts, _ = events(np.full(BINS, 0.05), pulses=20_000, recorded=10, dead_time=40e-9)
    rate = BINS * 0.05 / PERIOD
    expected = rate / (1 + rate * 40e-9) * PERIOD * 20_000 * 10 / BINS
    assert counts.shape == (1, 10) and abs(counts.sum() - expected) < 4 * np.sqrt(expected)


@pytest.mark.parametrize("dead_time", [0.0, 60e-9])
@pytest.mark.parametrize("time_constant", [5e-9, 200e-9])
def test_afterpulses_add_their_probability(dead_time, time_constant):
    probability, pulses, frames = 0.2, 400_000, 20
    options = {"afterpulsing_probability": probability, "afterpulsing_time_constant": time_constant}
    # 250 µs between primaries: almost no afterpulse meets another chain.
    hazard = np.full(BINS, 2e-4 / BINS)
    counts, _ = events(hazard, pulses=pulses, frames=frames, dead_time=dead_time, **options)
    primaries = 2e-4 * pulses * frames
    # Afterpulses of afterpulses: 1 / (1 − p), less what falls into a dead time begun by a sibling.
    chain = 1 / (1 - probability)
    sibling = probability**2 * (1 - np.exp(-dead_time / time_constant)) * chain
    # Clusters of branching ratio p have the variance p / (1 − p)³ about their mean; Poisson numbers of them add chain².
    error = np.sqrt(primaries * (chain**2 + probability * chain**3))
    assert abs(counts.sum() - primaries * chain) < 4 * error + primaries * sibling


def test_afterpulses_come_with_their_time_constant():
    tau, dead_time = 20e-9, 10e-9
    hazard = np.zeros(BINS)
    hazard[0] = 5e-4
    options = {"afterpulsing_probability": 0.3, "afterpulsing_time_constant": tau, "dead_time": dead_time}
    _, stream = events(hazard, pulses=40_000_000, tags=True, **options)
    time = stream["pulse"] * PERIOD + (stream["bin"] + 0.5) * PERIOD / BINS
    gap = np.diff(time)
    gap = gap[gap < 6 * tau + dead_time]  # the next primary is 100 µs away
    assert gap.min() > dead_time - 1.01 * PERIOD / BINS
    late = gap[gap > 15e-9] - 15e-9
    cut = 6 * tau + dead_time - 15e-9
    # Mean of an exponential cut off at `cut`; a percent of the gaps are those of primaries.
    expected = tau - cut / np.expm1(cut / tau)
    assert abs(late.mean() / expected - 1) < 0.06


def test_afterpulses_of_a_gated_detector_wait_for_its_windows():
    """Traps empty from the end of the dead time on: exp(−t/τ) of them reach the next window."""
    tau, probability, dead_time, width = 20e-9, 0.1, 30e-9, PERIOD / BINS
    options = {"afterpulsing_probability": probability, "afterpulsing_time_constant": tau, "dead_time": dead_time}
    counts, _ = events(1e-3 * (np.arange(BINS) == 0), pulses=40_000_000, gated=True, **options)
    left = probability * np.exp(-(PERIOD - width / 2 - dead_time) / tau)
    expected = counts[0, 0] * left * (1 - np.expm1(-width / tau) / np.expm1(-PERIOD / tau))  # beyond the first bin
    assert abs(counts[0, 1:].sum() - expected) < 4 * np.sqrt(expected) + 2 * probability * expected


@pytest.mark.parametrize("gated", [True, False])
def test_the_time_tags_are_the_counts(gated):
    hazard = np.stack([shape(0.2), shape(1.0), np.zeros(BINS)])
    options = {"pulses": 500, "frames": 3, "gated": gated, "dead_time": 20e-9, "afterpulsing_probability": 0.05}
    counts, stream = events(hazard, tags=True, afterpulsing_time_constant=20e-9, **options)
    rebuilt = np.zeros_like(counts)
    np.add.at(rebuilt, (stream["row"], stream["bin"]), 1)
    np.testing.assert_array_equal(rebuilt, counts)
    key = (stream["row"] * 500 + stream["pulse"]) * BINS + stream["bin"]
    assert (np.diff(key) >= 0).all()
    if gated:
        assert np.unique(key // BINS).size == key.size  # at most one a pulse


# ---- Expected detections.


def test_dark_count_rates():
    pixels = 100_000
    options = {"median": 100.0, "spread": 0.5, "hot_fraction": 0.02, "hot_rate": 1e4, "device": "cpu"}
    rates = dark_count_rates(pixels, **options).numpy()
    hot = rates == 1e4
    assert abs(hot.sum() - 2000) < 4 * np.sqrt(2000)
    assert stats.kstest(np.log(rates[~hot] / 100) / 0.5, "norm").pvalue > 1e-3
    np.testing.assert_array_equal(dark_count_rates(50, **options).numpy(), rates[:50])


def test_response_matrix_is_applied_and_noise_added():
    rng = np.random.default_rng(0)
    matrix = random_array((5, 8), density=0.4, rng=rng, format="csr")
    source, width, noise = rng.random((7, 8)), rng.random(5), rng.random(7)
    for dtype in (wp.float32, wp.float64):
        response = {"row_start": matrix.indptr, "source_bin": matrix.indices, "weight": matrix.data}
        light = wp.array(source, dtype=dtype, device="cpu")
        hazard = expected_detections(light, **response, width=width, noise_rate=array(noise))
        np.testing.assert_allclose(hazard.numpy(), source @ matrix.T + noise[:, None] * width, rtol=1e-5)


def test_crosstalk_goes_to_the_four_neighbours():
    light = np.random.default_rng(1).random((4, 5, 3), np.float32)
    hazard = array(light.reshape(20, 3))
    add_crosstalk(hazard, array(light.reshape(20, 3)), image_width=5, probability=0.1)
    padded = np.pad(light, ((1, 1), (1, 1), (0, 0)))
    expected = 0.1 * (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:])
    np.testing.assert_allclose(hazard.numpy().reshape(4, 5, 3) - light, expected, atol=1e-6)
