"""The parts of the equations: laws of counting, arrow-shaped systems, shifts in time."""

import numpy as np
import pytest

from spadwarp.frames import first_photon_probabilities
from spadwarp.inverse.equations import Equations, Law, solve
from spadwarp.inverse.rendering import subbin_shift

LAWS = {"first photon": Law(True, 0.0, 20), "free running": Law(False, 0.6, 18)}


@pytest.fixture
def rates():
    return np.random.default_rng(1).uniform(0.0, 0.1, (3, 20)).astype(np.float32)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_slopes_of_the_mean_are_its_derivatives(law, rates):
    slopes = np.random.default_rng(2).normal(size=(3, 1, 20)).astype(np.float32)
    trials, step = np.full((3, law.recorded), 1e4, np.float32), 1e-3
    more, less = (law.mean(rates + sign * step * slopes[:, 0], trials).astype(np.float64) for sign in (1, -1))
    found = law.slopes(rates, slopes, trials)[:, 0]
    np.testing.assert_allclose(found, (more - less) / (2 * step), rtol=2e-2, atol=3.0)


def test_mean_of_first_photons_is_their_law(rates):
    law = LAWS["first photon"]
    mean = law.mean(rates, law.planned(rates, 1000))
    np.testing.assert_allclose(mean, 1000 * first_photon_probabilities(rates, device="cpu"), rtol=1e-5)
    # What is left varies as a binomial.
    trials = law.planned(rates, 1000)
    share = mean / trials
    np.testing.assert_allclose(law.variance(mean, trials), trials * share * (1 - share), rtol=1e-5)


def test_an_arrow_is_solved_as_the_whole_matrix():
    random = np.random.default_rng(3)
    pixels, is_per_pixel = 5, np.array([False, True, False, True])
    factor = random.normal(size=(pixels, 4, 12))
    slope = factor @ factor.transpose(0, 2, 1)
    score = random.normal(size=(pixels, 4))
    batches = [np.zeros((1, pixels, 4))] * 2
    weights = np.zeros((pixels, 4, 1), np.float32)
    found = solve(Equations(score, slope, slope, batches, weights), is_per_pixel)
    size = 2 + 2 * pixels
    matrix, right = np.zeros((size, size)), np.zeros(size)
    for p in range(pixels):
        place = np.array([0, 2 + 2 * p, 1, 3 + 2 * p])
        matrix[np.ix_(place, place)] += slope[p]
        right[place] += score[p]
    whole, inverse = np.linalg.solve(matrix, right), np.linalg.inv(matrix)
    np.testing.assert_allclose(found.shared, whole[:2], rtol=1e-9)
    np.testing.assert_allclose(found.pixels.ravel(), whole[2:], rtol=1e-9)
    np.testing.assert_allclose(found.covariance, inverse[:2, :2], rtol=1e-9)
    own = [inverse[2 + 2 * p : 4 + 2 * p, 2 + 2 * p : 4 + 2 * p] for p in range(pixels)]
    np.testing.assert_allclose(found.pixel_bound, own, rtol=1e-9)
    np.testing.assert_allclose(found.gain, 0.5 * whole[:2] @ np.linalg.inv(inverse[:2, :2]) @ whole[:2], rtol=1e-9)


def test_a_shift_keeps_sum_and_shape():
    bins, delay = np.arange(40.0), np.array([0.0, 3.0, 0.3, -2.6])
    rows = np.exp(-0.5 * ((bins - 20) / 1.5) ** 2)[None].repeat(4, axis=0).astype(np.float32)
    later = subbin_shift(rows, delay)
    np.testing.assert_allclose(later.sum(axis=1), rows.sum(axis=1), rtol=1e-6)
    np.testing.assert_allclose(later @ bins / later.sum(axis=1), 20 + delay, atol=1e-5)
    np.testing.assert_allclose(later, np.exp(-0.5 * ((bins - 20 - delay[:, None]) / 1.5) ** 2), atol=1e-2)
