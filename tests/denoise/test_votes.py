"""Votes of neighbouring pixels, against their definition pixel by pixel."""

import numpy as np
import pytest
import torch

from spadwarp.denoise.networks import neighbour_votes

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
