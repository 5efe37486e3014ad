"""The rule by which a run with a relative error as its goal ends, on batches of invented scores of mean 1."""

import math
from functools import partial

import numpy as np
import pytest

from spadwarp.transport.simulation import FIRST_LOOK, StoppingRule

RUNS, BATCHES = 1000, 1024


class Ends:
    """Where the runs whose batches are the rows end: batches, mean, standard error, and where first at the goal."""

    def __init__(self, values, goal):
        count = np.arange(1, values.shape[1] + 1)
        mean = values.cumsum(axis=1) / count
        spread = np.maximum((values**2).cumsum(axis=1) - count * mean**2, 0.0)
        furthest = np.maximum(np.maximum.accumulate(values, 1) - mean, mean - np.minimum.accumulate(values, 1)) ** 2
        with np.errstate(all="ignore"):
            error = np.sqrt(spread / (count - 1) / count)
            share = furthest / spread
        found = [self._ends(error[i] / mean[i], share[i], goal) for i in range(len(values))]
        self.searched, self.batches = np.array(found).T
        rows = np.arange(len(values))
        self.mean, self.error = mean[rows, self.batches - 1], error[rows, self.batches - 1]
        self.early = mean[rows, self.searched - 1]
        self.held = (abs(self.mean - 1.0) < 2.0 * self.error).mean()
        # The same numbers of batches, of other runs: what numbers that are fixed beforehand give.
        other = np.roll(rows, 1)
        fixed, its_error = mean[other, self.batches - 1], error[other, self.batches - 1]
        self.held_of_fixed = (abs(fixed - 1.0) < 2.0 * its_error).mean()

    @staticmethod
    def _ends(error, share, goal):
        rule, batches, searched = StoppingRule(goal), FIRST_LOOK, None
        while True:
            known = float(error[batches - 1])
            searched = batches if searched is None and known <= goal else searched
            wanted = rule.next_look(batches, known, partial(float, share[batches - 1]))
            if wanted is None or batches == len(error):
                return searched or batches, batches
            batches = min(wanted, len(error))


def test_many_equal_photons_cost_little_more_and_reach_the_goal():
    rng = np.random.default_rng(3)
    ends = Ends(rng.gamma(2.0, 0.5, (RUNS, BATCHES)), 0.05)  # 200 batches
    assert 1.0 <= ends.batches.mean() / ends.searched.mean() < 1.45
    assert np.quantile(ends.error / ends.mean, 0.99) < 0.05
    assert ends.mean.mean() == pytest.approx(1.0, abs=4 * 0.05 / math.sqrt(RUNS))
    assert ends.held == pytest.approx(0.95, abs=0.03)


def test_rare_bright_photons_are_waited_for():
    """Light of a next event whose distance r is even in r^3 goes as r^-2: a tail of exponent 3/2, no variance."""
    rng = np.random.default_rng(3)
    photons = rng.poisson(8.0, (RUNS, BATCHES))
    bright = np.zeros((RUNS, BATCHES))
    for k in range(int(photons.max())):
        bright += np.where(k < photons, rng.random((RUNS, BATCHES)) ** (-1 / 1.5) / 3.0, 0.0)  # mean 1
    ends = Ends(bright / 8.0, 0.05)
    assert ends.batches.max() <= BATCHES and (ends.batches <= 2 * ends.searched).all()
    # Ending where the goal is first met is too dark by more than half of the error; going on halves that.
    early, late = ends.early.mean() - 1.0, ends.mean.mean() - 1.0
    assert early < -0.02
    assert late > 0.7 * early
    assert ends.held > ends.held_of_fixed - 0.08


def test_looks_are_neither_too_many_nor_too_far_apart():
    rule = StoppingRule(0.01)
    assert rule.next_look(32, math.inf, lambda: 1.0) == 256
    assert rule.next_look(100, 0.0101, lambda: 1.0) == 108
    assert rule.next_look(100, 0.02, lambda: 1.0) == 420
    assert rule.next_look(160, 0.009, lambda: 0.05) == 192
    assert rule.next_look(192, 0.02, lambda: 0.05) is None
    assert StoppingRule(0.01).next_look(40, 0.005, lambda: 0.9) == 80
