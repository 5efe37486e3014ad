"""Classical estimates of depth from histograms, against the best of all depth maps of a small frame."""

import itertools

import numpy as np
import pytest
import torch
from scipy.stats import norm

from spadwarp.denoise.baselines import CLASSICAL
from spadwarp.denoise.classical import aggregate, beliefs, classical_depth, total_variation
from spadwarp.denoise.histograms import count_frames
from spadwarp.denoise.networks import neighbour_votes

PIXELS, BINS = 5, 5
TAPS = norm.pdf(np.arange(-4, 5), scale=1.2)


def best_of_each_depth(score, slope, jump):
    """Of all depths of a row of pixels, the largest log-likelihood less the penalties, by pixel and its depth."""
    best = np.full((PIXELS, BINS), -np.inf)
    for depths in itertools.product(range(BINS), repeat=PIXELS):
        apart = np.abs(np.diff(depths))
        penalty = np.select([apart == 0, apart == 1], [0.0, min(slope, jump)], jump).sum()
        for pixel, depth in enumerate(depths):
            best[pixel, depth] = max(best[pixel, depth], score[range(PIXELS), depths].sum() - penalty)
    return best - best.max()


@pytest.mark.parametrize("jump", [0.3, 1.5])
@pytest.mark.parametrize("column", [False, True])
def test_messages_along_a_line_are_exact(jump, column):
    """Max-product on a line gives the best score of each depth; semi-global matching has three times the pixel's own
    besides."""
    score = np.random.default_rng(5).normal(0.0, 1.0, (PIXELS, BINS))
    line = torch.tensor(score).view((1, PIXELS, 1, BINS) if column else (1, 1, PIXELS, BINS))
    for found, own, slope in ((beliefs(line, jump), 0.0, 0.5), (aggregate(line, jump=jump), 3.0, 1.0)):
        by_pixel = found.view(PIXELS, BINS).numpy() - own * score
        by_pixel -= by_pixel.max(axis=1, keepdims=True)
        np.testing.assert_allclose(by_pixel, best_of_each_depth(score, slope, jump), atol=1e-9)


def test_total_variation_finds_the_least_energy():
    """In a row, where a map of least energy takes values of the data alone."""
    rng = np.random.default_rng(6)
    data, weight = rng.random(6), rng.uniform(0.2, 2.0, 6)

    def energy(depth):
        return np.abs(np.diff(depth)).sum() * 0.8 + (weight * np.abs(depth - data)).sum()

    least = min(map(energy, itertools.product(data, repeat=6)))
    row = [torch.tensor(values)[None, None] for values in (data, weight)]
    found = total_variation(*row, strength=0.8, iterations=3000)
    assert energy(found.numpy().ravel()) == pytest.approx(least, rel=1e-3)


@pytest.mark.parametrize("method", CLASSICAL)
def test_neighbours_help_where_photons_are_few_and_edges_stay(method):
    """Two walls, 20 bins apart, seen by two photons a pixel on a background of two."""
    bins, place = 64, np.where(np.arange(24) < 12, 20.5, 40.5) + np.zeros((24, 1))
    rate = 2.0 * np.diff(norm(scale=1.2).cdf(np.arange(bins + 1) - place[..., None]), axis=-1) + 2.0 / bins
    counts = np.random.default_rng(2).poisson(rate)
    frames = count_frames(counts, np.full(bins, 2.0 / bins), TAPS)
    depth = bins * classical_depth(frames, method=method)[0]
    right = (np.abs(depth - place) < 3.0).mean()
    assert 0.6 < right < 0.9 if method == "likelihood" else right > 0.95


# Votes of neighbouring pixels, against their definition pixel by pixel


RING = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]


def agreement(one, other, most):
    """1 where two depths are equal, falling to 0; 0 where one is missing."""
    return 0.0 if np.isnan(one) or np.isnan(other) else max(0.0, 1.0 - abs(one - other) / most)


def votes(depth):
    image = torch.from_numpy(depth).float()[None, None]
    return neighbour_votes(torch.nan_to_num(image, nan=1.0), (~torch.isnan(image)).float())


def test_votes_are_those_of_every_pair_of_pixels():
    generator = np.random.default_rng(1)
    depth = generator.integers(0, 4, (7, 9)) * 0.2 + 0.002 * generator.standard_normal((7, 9))
    depth[generator.random(depth.shape) < 0.3] = np.nan
    padded = np.pad(depth, 2, constant_values=np.nan)
    found = votes(depth)
    for row, column in np.ndindex(depth.shape):
        around = padded[row : row + 5, column : column + 5]
        beside = [around[2 + y, 2 + x] for y, x in RING]
        near = sum(agreement(around[2, 2], value, 0.012) for value in beside) / 8
        wide = sum(agreement(around[2, 2], value, 0.04) for value in around.ravel()) - (not np.isnan(around[2, 2]))
        counts = [sum(agreement(one, other, 0.012) for other in beside) for one in beside]  # each agrees with itself
        expected = {"near": near, "wide": wide / 24, "support": max(counts) / 8}
        for name, share in expected.items():
            assert float(getattr(found, name)[0, 0, row, column]) == pytest.approx(share, abs=1e-4), name


def test_the_depth_with_most_votes_is_that_of_the_side_that_a_pixel_is_on():
    """Beside a straight edge five of eight neighbours are on a pixel's own side, whatever the pixel reports."""
    depth = np.full((12, 12), 0.3)
    depth[:, 6:] = 0.7
    clean = depth.copy()
    depth[5, 5], depth[8, 6], depth[2, 2] = 0.5, 0.1, np.nan
    inside = np.s_[1:-1, 1:-1]
    assert np.abs(votes(depth).depth[0, 0].numpy() - clean)[inside].max() < 0.01


def test_a_frame_without_reports_has_no_votes():
    found = votes(np.full((6, 6), np.nan))
    assert found.support.max() == 0 and found.near.max() == 0 and (found.depth == 1).all()
