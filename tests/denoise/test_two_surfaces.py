"""Pixels with two returns."""

import numpy as np
from scipy.stats import norm

from spadwarp.denoise import estimate


def test_of_two_returns_the_stronger_one_is_found():
    """65 and 35 % of 30 photons a pixel: by photons alone one pixel in 20 takes the weaker, in the end one in 500.

    The weaker return is 20 bins nearer. 19.5 and 10.5 photons: P(second > first) = P(z > 9 / √30) = 0.05.
    """
    bins, edges = 128, np.arange(129.0)
    first, second = (np.diff(norm.cdf(edges - place, scale=1.2)) for place in (80.3, 60.3))
    rate = np.broadcast_to(19.5 * first + 10.5 * second + 6.0 / bins, (48, 48, bins))
    counts = np.random.default_rng(4).poisson(rate).astype(np.float32)
    taps = np.diff(norm.cdf(np.arange(-4.5, 5.0), scale=1.2))
    depth = 10.0 + 2.56 * (counts.argmax(axis=-1) + 0.5) / bins
    assert np.mean(np.abs(depth - 11.606) > 0.2) > 0.01
    given = {"counts": counts, "background": np.full(bins, 6.0 / bins), "response": taps / taps.sum()}
    found = estimate(depth, gate=(10.0, 12.56), model="histograms", **given)
    assert np.mean(np.abs(found.depth - 11.606) > 0.2) < 0.002
