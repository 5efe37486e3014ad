"""Henyey-Greenstein: the sampler follows its density, the density is normalised, both hold at the forward peak."""

import numpy as np
import pytest
import warp as wp

from helpers.launch import Floats, launched
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import henyey_greenstein_pdf, random_block, sample_henyey_greenstein
from spadwarp_kernels.base.philox import u01_fine

pytestmark = pytest.mark.physics

ANISOTROPIES = [-0.7, 0.0, 0.01, 0.5, 0.924, 0.99]


@wp.kernel(enable_backward=False)
def _sample(g: float, seed: wp.uint64, t: Floats):
    i = wp.tid()
    t[i] = sample_henyey_greenstein(u01_fine(random_block(seed, wp.uint64(i), wp.uint32(0), wp.uint32(1))[1]), g)


@wp.kernel(enable_backward=False)
def _evaluate(g: float, t: Floats, p: Floats):
    i = wp.tid()
    p[i] = henyey_greenstein_pdf(t[i], g)


def _cdf(t, g):
    """Distribution function of t = 1 - cos(theta), from the integral of the density in float64."""
    if g == 0:
        return t / 2
    s = np.sqrt((1 - g) ** 2 + 2 * g * t)
    return (1 - g * g) / (2 * g) * (1 / (1 - g) - 1 / s)


@pytest.mark.parametrize("g", ANISOTROPIES)
def test_samples_follow_the_density(g, device):
    (values,) = launched(_sample, [g, 11], device=device, count=sample_count(device))
    assert values.min() >= 0.0 and values.max() <= 2.0
    assert chi2_p(values, lambda x: _cdf(x, np.float64(np.float32(g)))) > 1e-4
    # The mean cosine is g; the standard error of a mean of 2e6 numbers in [-1, 1] is below 7.1e-4.
    assert abs(1 - values.mean() - g) < 5 * values.std() / np.sqrt(values.size)


def test_small_angles_are_resolved():
    """At g = 0.99 a third of all angles lie below 3e-3 rad, where 1 - cos in float32 would be a few grid steps."""
    (t,) = launched(_sample, [0.99, 5], count=1_000_000)
    assert len(np.unique(t[t < 5e-6])) > 10_000


@pytest.mark.parametrize("g", ANISOTROPIES)
def test_density_integrates_to_one_and_has_mean_cosine_g(g):
    fine = np.concatenate([[0.0], np.geomspace(1e-9, 1.0, 10_001)])
    edges = np.concatenate([fine, 2 - fine[-2::-1]])
    middle = 0.5 * (edges[1:] + edges[:-1])
    mass = 2 * np.pi * launched(_evaluate, [g, middle])[0] * np.diff(edges)
    assert mass.sum() == pytest.approx(1.0, abs=2e-5)
    assert (mass * (1 - middle)).sum() == pytest.approx(g, abs=2e-5)


def test_values_of_the_reference():
    """g = 0.924: p(pi) = 1.633780e-3 and p(0) = 26.50745 per steradian; p(0) amplifies the rounding of g in float32."""
    np.testing.assert_allclose(
        launched(_evaluate, [0.924, np.array([2.0, 0.0])])[0], [1.633780e-3, 26.50745], rtol=2e-6
    )
