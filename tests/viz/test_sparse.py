"""Bins that are added up where light is sparse."""

import numpy as np
import pytest

from spadwarp.viz.result import merged_edges, merged_means


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
    edges = merged_edges(0.0 * light, 0.0 * light)  # nothing is one group of nothing
    assert merged_means(0.0 * light, edges).sum() == 0 and edges[-1] == 100


def test_no_group_of_the_sum_goes_across_the_first_light_of_a_component():
    random, bins = np.random.default_rng(4), np.arange(300)
    water = random.poisson(200 * np.exp(-bins / 30.0)) * 1.0
    target = np.where(bins < 150, 0.0, random.poisson(2 * np.exp(-(bins - 150) / 20.0)))
    total, first = water + target, int((target > 0).argmax())
    edges, of_water = merged_edges(total, total, [first]), merged_edges(water, water)
    assert first in edges and first in merged_edges(target, target)
    assert (np.diff(of_water)[-3:] > 1).any()  # beneath the target's light, its own wide groups
