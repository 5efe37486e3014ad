"""Bins that are added up where light is sparse."""

import numpy as np
import pytest

from spadwarp.viz.result import merged_edges, merged_means, shared_edges, typical_weight


@pytest.mark.parametrize("seed", range(3))
def test_groups_keep_the_light_and_are_known_to_a_third(seed):
    random = np.random.default_rng(seed)
    counts = random.poisson(300 * np.exp(-np.arange(400) / 40.0)) * 1.0
    edges = merged_edges(counts, counts)
    assert edges[0] == 0 and edges[-1] == 400 and (np.diff(edges) > 0).all()
    sums = merged_means(counts, edges) * np.diff(edges)
    assert sums.sum() == counts.sum()
    some = sums > 0
    assert (sums[some] >= 9).mean() > 0.85  # 9 counts are known to a third; a bin between two such bins may hold fewer
    assert (np.diff(edges)[:80] == 1).all() and np.diff(edges)[some][-2:].max() > 20


def test_light_stays_in_its_time_and_a_peak_in_its_bin():
    light = np.zeros(100)
    light[40], light[60] = 1000.0, 1.0
    edges = merged_edges(light, light)
    assert {40, 41, 61} <= set(edges) and not set(range(1, 40)) & set(edges)


@pytest.mark.parametrize("weight", [1e-3, 5.0])
def test_the_weight_of_a_photon_is_found_on_a_slope(weight):
    counts = np.random.default_rng(2).poisson(np.geomspace(2000.0, 20.0, 300))
    # The median of the square of a normal variable is 0.45 of its mean.
    assert np.median(typical_weight(weight * counts)) == pytest.approx(0.45 * weight, rel=0.25)


def test_nothing_is_one_group_of_nothing():
    edges = merged_edges(np.zeros(8), np.zeros(8))
    assert merged_means(np.zeros(8), edges).sum() == 0 and edges[-1] == 8


def test_the_larger_component_has_the_bins_of_the_sum_and_none_begins_before_its_light():
    random, bins = np.random.default_rng(4), np.arange(300)
    water = random.poisson(200 * np.exp(-bins / 30.0)) * 1.0
    target = np.where(bins < 150, 0.0, random.poisson(80 * np.exp(-(bins - 150) / 20.0)))
    parts = np.stack([water, target])
    edges, (of_water, of_target) = shared_edges(parts, parts.sum(axis=0))
    known = np.add.reduceat(target, edges[:-1]) > 0.5 * np.add.reduceat(parts.sum(axis=0), edges[:-1])
    assert known.sum() > 20 and set(edges[:-1][known]) <= set(of_target) and set(edges[1:][known]) <= set(of_target)
    assert 150 in edges and 150 in of_target
    assert set(edges[edges <= 60]) <= set(of_water)
    assert (np.diff(of_water)[-3:] > 1).any()  # beneath the target's light, its own wide groups
