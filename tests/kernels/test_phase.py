"""Henyey-Greenstein: the sampler follows its density, the density is normalised, both hold at the forward peak."""

import numpy as np
import pytest
import warp as wp

from helpers.statistics_of_samples import DEVICES, chi2_p
from spadwarp_kernels import henyey_greenstein_pdf, random_block, sample_henyey_greenstein, u01_fine

ANISOTROPIES = [-0.7, 0.0, 0.01, 0.5, 0.924, 0.99]


@wp.kernel(enable_backward=False)
def _sample(g: float, seed: wp.uint64, t: wp.array(dtype=float)):
    i = wp.tid()
    t[i] = sample_henyey_greenstein(u01_fine(random_block(seed, wp.uint64(i), wp.uint32(0), wp.uint32(1))[1]), g)


@wp.kernel(enable_backward=False)
def _evaluate(g: float, t: wp.array(dtype=float), p: wp.array(dtype=float)):
    i = wp.tid()
    p[i] = henyey_greenstein_pdf(t[i], g)


def _cdf(t, g):
    """Distribution function of t = 1 - cos(theta), from the integral of the density in float64."""
    if g == 0:
        return t / 2
    s = np.sqrt((1 - g) ** 2 + 2 * g * t)
    return (1 - g * g) / (2 * g) * (1 / (1 - g) - 1 / s)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("g", ANISOTROPIES)
def test_samples_follow_the_density(g, device):
    t = wp.empty(10_000_000, dtype=float, device=device)
    wp.launch(_sample, t.size, [g, 11, t], device=device)
    values = t.numpy()
    assert values.min() >= 0.0 and values.max() <= 2.0
    assert chi2_p(values, lambda x: _cdf(x, np.float64(np.float32(g)))) > 1e-4
    # The mean cosine is g; the standard error of a mean of 1e7 numbers in [-1, 1] is below 3.2e-4.
    assert abs(1 - values.mean(dtype=np.float64) - g) < 5 * values.std(dtype=np.float64) / np.sqrt(values.size)


def test_small_angles_are_resolved():
    """At g = 0.99 a third of all angles lie below 3e-3 rad, where 1 - cos in float32 would be a few grid steps."""
    t = wp.empty(1_000_000, dtype=float, device="cpu")
    wp.launch(_sample, t.size, [0.99, 5, t], device="cpu")
    assert len(np.unique(t.numpy()[t.numpy() < 5e-6])) > 10_000


@pytest.mark.parametrize("g", ANISOTROPIES)
def test_density_integrates_to_one_and_has_mean_cosine_g(g):
    fine = np.concatenate([[0.0], np.geomspace(1e-9, 1.0, 10_001)])
    edges = np.concatenate([fine, 2 - fine[-2::-1]])
    middle = 0.5 * (edges[1:] + edges[:-1])
    t = wp.array(middle, dtype=float, device="cpu")
    p = wp.empty(t.size, dtype=float, device="cpu")
    wp.launch(_evaluate, t.size, [g, t, p], device="cpu")
    mass = 2 * np.pi * p.numpy().astype(np.float64) * np.diff(edges)
    assert mass.sum() == pytest.approx(1.0, abs=2e-5)
    assert (mass * (1 - middle)).sum() == pytest.approx(g, abs=2e-5)


def test_values_of_the_reference():
    """g = 0.924: p(pi) = 1.633780e-3 and p(0) = 26.50745 per steradian; p(0) amplifies the rounding of g in float32."""
    t = wp.array([2.0, 0.0], dtype=float, device="cpu")
    p = wp.empty(2, dtype=float, device="cpu")
    wp.launch(_evaluate, 2, [0.924, t, p], device="cpu")
    np.testing.assert_allclose(p.numpy(), [1.633780e-3, 26.50745], rtol=2e-6)
