"""Runs over many seeds, and whether the estimators share one expectation."""

import itertools
import math

import numpy as np

import spadwarp
from helpers.statistics_of_samples import equal_means_p

PHOTONS = {"analog": 60_000, "next_event": 30_000, "guided": 30_000}


def cells(one, device, photons, seeds=32, pixels=False):
    """Fractions of emitted photons `[seeds, cells]`: each component's bins over all pixels; with `pixels` also each
    pixel over all bins."""
    rows = []
    for seed in range(seeds):
        result = spadwarp.simulate(one, photons=photons, seed=seed, device=device)
        assert result.counters["invalid"] == 0 and result.counters["clipped"] == 0
        assert result.ledger_report()["exact"]
        parts = [result.tallies.sum(axis=(1, 2)), result.tallies.sum(axis=(0, 3))][: 2 if pixels else 1]
        rows.append(np.concatenate([part.ravel() for part in parts]) * (result.unit / photons))
    return np.array(rows)


def agreeing_cells(one, device, *, photons=PHOTONS, seeds=32, pixels=False, converged=0.2):
    """Cells of each estimator, after each two of them were found to have the same mean wherever both have converged.

    The comparison has teeth: guided knows its total to 1 %.
    """
    found = {
        estimator: cells(one.with_overrides({"transport.estimator": estimator}), device, count, seeds, pixels)
        for estimator, count in photons.items()
    }
    for (one_name, one_cells), (other_name, other_cells) in itertools.combinations(found.items(), 2):
        assert equal_means_p(one_cells, other_cells, converged) > 1e-3, f"{one_name} and {other_name} differ"
    total = found["guided"].sum(axis=1)
    assert total.std() / total.mean() / math.sqrt(seeds) < 0.01
    return found
