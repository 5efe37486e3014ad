"""One very dense cell among clear ones: the mean free path falls to the rounding of a coordinate."""

import math

import numpy as np
import pytest

from helpers.estimators import cells
from helpers.scenes import scene

pytestmark = [pytest.mark.physics, pytest.mark.slow]

SEEDS = 16
WAYS = (("guided", "delta"), ("next_event", "regular"), ("analog", "regular"))


def components(extinction, path, device, estimator, tracking):
    """Mean and standard error of each component's fraction of the emitted photons."""
    values = np.full((4, 4, 4), 0.1)
    values[2, 2, 1] = extinction
    np.savez(path, extinction=values, albedo=np.full((4, 4, 4), 0.8), size=[1.2, 1.2, 1.2])
    grid = {"file": str(path), "translation": [0.0, 0.0, 1.2], "tracking": tracking}
    one = scene(medium={"extinction": 0.01, "grid": grid}, transport={"estimator": estimator, "max_collisions": 30})
    parts = cells(one, device, 100_000 if estimator == "analog" else 20_000, SEEDS).reshape(SEEDS, 3, -1).sum(axis=2)
    return parts.mean(axis=0), parts.std(axis=0, ddof=1) / math.sqrt(SEEDS)


@pytest.mark.parametrize("extinction", [1e2, 1e6])
def test_guided_by_regular_tracking_is_every_other_way(extinction, device, tmp_path):
    """Within 4 standard errors; backscatter, half of which is the dense cell's, to 5 %."""
    mean, error = components(extinction, tmp_path / "cell.npz", device, "guided", "regular")
    assert (error < 0.05 * mean).all()
    for way in WAYS:
        other, deviation = components(extinction, tmp_path / "cell.npz", device, *way)
        assert (np.abs(other - mean) < 4.0 * np.hypot(error, deviation)).all(), (way, other / mean)
