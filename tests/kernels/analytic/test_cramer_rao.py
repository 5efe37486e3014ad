"""Fisher information, bounds and outliers against published values, dense float64 references and Monte Carlo."""

import math

import numpy as np
import pytest
import warp as wp
from scipy import stats
from scipy.sparse import coo_array

from helpers.launch import on_device
from helpers.lidar import AXIS, lidar
from reference import crlb
from spadwarp_kernels import analytic


def statistics(one, signal, arrival, device="cpu", count_law="per_pulse", acquisitions=1000.0, pulses_per_frame=1.0):
    """α, F, σ* and outlier probability of pixels on the axis, background constant."""
    signal, arrival = np.atleast_1d(signal), np.atleast_1d(arrival)
    numbers = signal, arrival, np.full(len(signal), one.constant * (one.stop - one.start))
    tables = wp.zeros(2, dtype=wp.float64, device=device), wp.zeros((1, 1), dtype=wp.float32, device=device)
    arrays = [on_device([AXIS] * len(signal), device, wp.vec3d), *(on_device(n, device, wp.float64) for n in numbers)]
    options = {"count_law": count_law, "acquisitions": acquisitions, "pulses_per_frame": pulses_per_frame}
    alpha, fisher, sigma_star, _, outlier = analytic.statistics_maps(one, *tables, *arrays, **options)
    return alpha.numpy(), fisher.numpy(), sigma_star.numpy(), outlier.numpy()


def test_fisher_information_is_exact_to_1e_4(device):
    """σ from 10 ps to 2 ns, signal to background from 1e-6 to 1e6, pulses up to and across the window's edges."""
    start, stop = 5e-9, 8e-8
    ratios = 10.0 ** np.arange(-6, 7, 2)
    for sigma in (1e-11, 1.5e-10, 2e-9):
        places = [start + k * sigma for k in (-4, -1, 0, 0.3, 2, 6)] + [3.3e-8]
        places += [stop + k * sigma for k in (-5, -0.7, 0, 3)]
        background = 1e7
        one = lidar(sigma=sigma, start=start, stop=stop, dark=0.4 * background, constant=0.6 * background)
        cases = [(ratio * background * (stop - start), mu) for ratio in ratios for mu in places]
        alpha, fisher, sigma_star, _ = statistics(one, *np.transpose(cases), device=device)
        for found, law, rtol in ((fisher, crlb.fisher_per_photon, 1e-4), (alpha, crlb.alpha, 1e-12)):
            expected = [law(signal, background, mu, sigma, (start, stop)) for signal, mu in cases]
            np.testing.assert_allclose(found, expected, rtol=rtol)
        np.testing.assert_allclose(sigma_star, 1 / np.sqrt(-1000 * np.expm1(-alpha) * fisher), rtol=1e-10)


def test_without_background_the_information_is_that_of_counting_and_without_signal_there_is_no_estimate():
    """F·σ² → S/α as the background goes to 0. No signal, nothing hit, or a return far outside the gate: F = 0 and NaN,
    not infinity."""
    for dark in (1e-3, 1e-6, 0.0):
        alpha, fisher, *_ = statistics(lidar(dark=dark), 0.01, 5e-8)
        assert fisher[0] * 1e-20 == pytest.approx(0.01 / alpha[0], rel=1e-4)
    alpha, fisher, sigma_star, outlier = statistics(lidar(dark=100.0), [0.0, 0.0, 0.1], [5e-8, np.nan, 2e-7])
    assert (fisher == 0).all() and np.isnan(sigma_star).all() and np.isnan(outlier).all()
    np.testing.assert_allclose(alpha, 100.0 * 1e-7)


def binned_information(signal, background, first_photon=False):
    """Of a histogram's shift by a bin, its slope by central differences of fourth order."""
    slope = on_device(np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12, dtype=wp.float64)
    arrays = [on_device(signal[None], dtype=wp.float32), on_device([[background]], dtype=wp.float32)]
    ones = on_device([1.0], dtype=wp.float64)
    return analytic.histogram_information(*arrays, ones, slope, first_photon=first_photon).numpy()[0]


@pytest.mark.parametrize(
    ("rho", "continuous", "binned"), [(200, 6.060, 6.062), (20, 7.263, None), (2, 12.898, 12.906), (0.5, 22.869, None)]
)
def test_published_bounds(rho, continuous, binned):
    """σ = 100 ps, 300 signal photons, 300/ρ background photons per σ, spread over 1e12 pulses; and in bins of 0.1 σ,
    each with 30/ρ of the background."""
    one = lidar(dark=300e-12 / rho / 1e-10)
    found = statistics(one, 300e-12, 5e-8, acquisitions=1e12)[2][0]
    assert round(found * 1e12, 3) == pytest.approx(continuous, abs=1.001e-3)
    if binned:
        information = binned_information(300 * crlb.binned_signal(np.linspace(-10, 10, 201), 0.0, 1.0), 30.0 / rho)
        assert round(10.0 / math.sqrt(information), 3) == pytest.approx(binned, abs=1.001e-3)


def test_information_of_first_photons_is_that_of_their_law():
    """Σ (dP_k)²/P_k over the bins and the empty pulse, by differences of the exact first-photon law."""
    edges = np.linspace(-15, 15, 301)

    def law(mu):
        rate = 0.4 * crlb.binned_signal(edges, mu, 1.0) + 0.01
        before = np.concatenate([[0], np.cumsum(rate)])
        return np.append(np.exp(-before[:-1]) * -np.expm1(-rate), np.exp(-before[-1]))

    h = 1e-5
    slope = (law(0.03 + h) - law(0.03 - h)) / (2 * h) * 0.1  # per bin of 0.1 σ
    expected = (slope**2 / law(0.03)).sum()
    information = binned_information(0.4 * crlb.binned_signal(edges, 0.03, 1.0), 0.01, first_photon=True)
    assert information == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("alpha", [1e-7, 1e-3, 0.3])
def test_count_laws(alpha):
    """Recorded photons: N(1 − e^{−α}), N(1 − e^{−αην}) and the paper's N(1 − (1 − α)^{ην})."""
    recorded = {"per_pulse": -math.expm1(-alpha), "per_frame": -math.expm1(-alpha * 40)}
    for law, part in {**recorded, "per_frame_lu2024": 1 - (1 - alpha) ** 40}.items():
        options = {"count_law": law, "acquisitions": 500, "pulses_per_frame": 40}
        _, fisher, sigma_star, _ = statistics(lidar(), alpha, 5e-8, **options)
        assert 1 / (sigma_star[0] ** 2 * fisher[0]) == pytest.approx(500 * part, rel=1e-6)


def outlier_probability(signal, level, window):
    values = np.broadcast_arrays(*(np.asarray(value, float) for value in (signal, level, window)))
    arrays = [on_device(np.atleast_1d(value), dtype=wp.float64) for value in values]
    return analytic.outlier_probabilities(*arrays).numpy().reshape(values[0].shape)


HARD = [(20, 20, 50), (60, 200, 100), (5, 0.1, 1000)]
MORE = [(40, 20, 50), (20, 20, 200), (8, 1, 1000), (12, 1, 1000), (3, 0.03, 500)]
HARD += [pytest.param(*one, marks=pytest.mark.slow) for one in MORE]


@pytest.mark.physics
@pytest.mark.parametrize("signal, level, window", HARD)
def test_outlier_probability_within_a_fifth_of_monte_carlo(signal, level, window):
    """Maximum likelihood with known signal and background, error over 4 σ; allowed: 20 % and two standard errors."""
    trials = 2000 if window > 300 else 4000
    errors = crlb.likelihood_errors(signal, level, window, trials, seed=7)
    measured = np.mean(np.abs(errors) > 4)
    predicted = outlier_probability(signal, level, window)
    assert abs(predicted - measured) < 0.2 * measured + 2 * math.sqrt(measured * (1 - measured) / trials)


@pytest.mark.physics
def test_outliers_of_a_decaying_background_are_bounded_by_the_model():
    """Backscatter decays up to the return, dark counts follow, the fit knows both: right to twice as large."""
    step, window, delay, trials = 0.1, 200, 120.0, 800
    t = (np.arange(int(window / step)) + 0.5) * step
    level = np.where(t < delay, 5 * np.exp(-t / delay * math.log(25)), 0.02)  # counts per σ
    near = np.arange(len(t))[:, None] + np.arange(-80, 81)
    inside, rows = np.clip(near, 0, len(t) - 1), np.broadcast_to(np.arange(len(t))[:, None], near.shape)
    shape = np.exp(-0.5 * (np.arange(-80, 81) * step) ** 2) / math.sqrt(2 * math.pi)
    rng = np.random.default_rng(4)
    for signal in (4.0, 6.0):
        weight = np.where(near == inside, np.log1p(signal * shape / level[inside]), 0)
        missed = signal * (stats.norm.cdf(-t) + stats.norm.cdf(t - window))  # of the pulse, beyond the window
        counts, hits = rng.poisson(level * step, (trials, len(t))), rng.poisson(signal, trials)
        places = ((delay + rng.standard_normal(hits.sum())) / step).astype(int)
        np.add.at(counts, (np.repeat(np.arange(trials), hits), places), 1)
        score = coo_array((weight.ravel(), (rows.ravel(), inside.ravel()))) @ counts.T + missed[:, None]
        measured = (np.abs(t[score.argmax(axis=0)] - delay) > 4).mean()
        under = (level * np.exp(-0.5 * (t - delay) ** 2)).sum() / math.sqrt(2 * math.pi) * step
        predicted = outlier_probability(signal, under, window)
        error = math.sqrt(measured * (1 - measured) / trials)
        assert measured - 2 * error < predicted < 2 * (measured + 2 * error)


@pytest.mark.physics
def test_maximum_likelihood_meets_the_bound_where_it_is_reachable():
    """300 signal photons on 150 a σ: no outliers, and an error within 5 % of σ*."""
    trials = 3000
    errors = crlb.likelihood_errors(300, 150, 60, trials, seed=3)
    one = lidar(sigma=1e-10, start=0.0, stop=60e-10, dark=150e-6 / 1e-10)
    _, _, sigma_star, outlier = statistics(one, 300e-6, 30e-10, acquisitions=1e6)
    assert outlier[0] < 1e-4 and (np.abs(errors) < 4).all()
    measured = errors.std()
    assert measured == pytest.approx(sigma_star[0] / 1e-10, rel=0.05)
    assert abs(errors.mean()) < 4 * measured / math.sqrt(trials)


def test_outlier_probability_falls_with_signal_and_rises_with_background_and_window():
    p = outlier_probability
    ladder = np.geomspace(0.5, 500, 12)
    for level in (1e-6, 1e-2, 1.0, 1e4):
        values = p(ladder, level, 500)
        assert (np.diff(values) <= 1e-9).all() and (values >= 0).all() and (values <= 1).all()
    assert (np.diff(p(30, np.geomspace(0.1, 1e3, 12), 500)) >= 0).all()
    assert (np.diff(p(20, 10, np.geomspace(20, 1e5, 12))) > 0).all()
    assert (p(5, 0, 500) == 0).all()
    for faint in (0, 1e-30, 1e-6):  # a blind fit is within 4 σ of the truth by chance
        np.testing.assert_allclose(p(faint, 1, 500), 1 - 8 / 500, rtol=1e-3)
