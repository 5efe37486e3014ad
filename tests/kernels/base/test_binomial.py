"""The binomial sampler against the exact law."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from helpers.launch import each, on_device
from spadwarp_kernels.base.binomial import binomial
from spadwarp_kernels.base.native import expm1, log1p

pytestmark = pytest.mark.physics


@wp.func
def draw(n: int, hazard: wp.float64, seed: wp.uint64, id: int):
    count, _block = binomial(n, hazard, seed, wp.uint64(id), wp.uint32(0), wp.uint32(0))
    return count


def sample(n, hazard, *, seed=3, base=0, size=400_000):
    return each(draw, [n, hazard, seed, base + np.arange(size)], [int])


@pytest.mark.parametrize(
    ("n", "p"),
    [
        *((1, 0.3), (5, 0.5), (40, 0.02), (40, 0.97), (30, 0.4), (20, 0.5), (21, 0.9)),
        *((100, 0.0999), (100, 0.1001)),  # the last of inversion, the first of rejection
        *((1000, 0.3), (1000, 0.985), (10_000, 5e-4), (1_000_000, 1.5e-5), (1_000_000, 5e-4)),
        *((100_000_000, 3e-7), (2**31 - 1, 1e-9), (2**31 - 1, 2e-8)),
    ],
)
def test_frequencies_follow_the_law(n, p):
    counts = sample(n, -np.log1p(-p))
    law = stats.binom(n, p)
    low, high = int(law.ppf(1e-4)), int(law.ppf(1 - 1e-4))
    edges = np.arange(low, high + 1)
    expected = law.pmf(edges) * counts.size
    expected[0] += law.cdf(low - 1) * counts.size
    expected[-1] += law.sf(high) * counts.size
    observed = np.bincount(np.clip(counts, low, high) - low, minlength=edges.size)
    # Merge neighbours until each class expects 10.
    classes = np.minimum.accumulate(np.cumsum(expected)[::-1])[::-1] // 10
    merged = np.unique(classes, return_inverse=True)[1]
    observed, expected = np.bincount(merged, observed), np.bincount(merged, expected)
    if observed.size > 1:
        assert stats.chisquare(observed, expected, sum_check=False).pvalue > 1e-4
    else:
        assert (counts == low).all()


@pytest.mark.parametrize("p", [1e-6, 0.25, 0.5, 0.75, 1 - 1e-6])
def test_large_counts_have_the_right_moments(p):
    n = 2**31 - 1
    counts = sample(n, -np.log1p(-p), size=200_000).astype(np.float64)
    z = (counts - n * p) / np.sqrt(n * p * (1 - p))
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / z.size)
    skewness = (1 - 2 * p) / np.sqrt(n * p * (1 - p))
    assert abs(stats.skew(z) - skewness) < 4 * np.sqrt(6 / z.size)


def test_limits():
    for n, hazard, count in ((100, 0.0, 0), (0, 1.0, 0), (100, np.inf, 100), (100, 800.0, 100)):
        assert (sample(n, hazard, size=100) == count).all()


def test_draws_depend_on_seed_and_id_alone():
    whole = sample(1000, 0.2, size=200)
    np.testing.assert_array_equal(sample(1000, 0.2, base=50, size=100), whole[50:150])
    assert (sample(1000, 0.2, seed=4, size=200) != whole).any()


def test_small_arguments_keep_their_digits():
    x = np.concatenate([-np.geomspace(1e-18, 0.9, 200), np.geomspace(1e-18, 30.0, 200)])
    grown, logged = (each(function, [on_device(x, dtype=wp.float64)], [wp.float64]) for function in (expm1, log1p))
    np.testing.assert_allclose(grown, np.expm1(x), rtol=1e-12)
    np.testing.assert_allclose(logged, np.log1p(x), rtol=1e-12)
