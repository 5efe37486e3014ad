"""The likelihood's equations for unknowns: score, information and covariance, from two independent halves of photons.

An expected histogram λ and its derivatives are Monte Carlo estimates. A square of one estimate is too large by its
variance; a product of two independent estimates is right in the mean. So the weights of the score come from one half,
what they weigh from the other, and both ways are averaged. Whatever the noise of the weights, the score's mean is 0 at
the truth; what it costs is precision, and the covariance, which is that of the equations that were solved, has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.device import core_count
from spadwarp.inverse.rendering import Half

__all__ = ["Cell", "Equations", "Law", "equations", "planned_pulses"]

Floats = NDArray[np.float64]
Rows = NDArray[np.float32]

Cell = tuple[int, int, int]
"""Rows, columns and bins."""

_PIXELS = 256  # of a part that a thread works on


class Law(NamedTuple):
    """How a detector counts.

    Attributes:
        first_photon: One count a pulse at most: in each bin a binomial of the pulses that no earlier bin has counted
            in. Otherwise counts of all detections, Poisson.
        dead_share: Dead time over the period between windows, for free-running counts.
        recorded: Bins that are counted; later ones are there for the dead time alone.
    """

    first_photon: bool
    dead_share: float
    recorded: int

    def mean(self, rates: Rows, trials: Rows) -> Rows:
        """Expected counts `[pixel, bin]` for λ `[pixel, bin]`; `trials`: pulses that can still count in each bin."""
        if self.first_photon:
            return -trials * np.expm1(-rates)
        ready = 1.0 / (1.0 + self.dead_share * rates.sum(axis=1, keepdims=True))
        return trials * (rates * ready)[:, : self.recorded]

    def slopes(self, rates: Rows, slopes: Rows, trials: Rows) -> Rows:
        """Derivatives of the mean by what changes λ by `slopes`, `[pixel, unknown, bin]` both."""
        if self.first_photon:
            return slopes * (trials * np.exp(-rates))[:, None]
        ready: Any = 1.0 / (1.0 + self.dead_share * rates.sum(axis=1))[:, None, None]
        lost = self.dead_share * slopes.sum(axis=2, keepdims=True)
        return trials[:, None] * (ready * (slopes - ready * lost * rates[:, None]))[..., : self.recorded]

    def variance(self, mean: Rows, trials: Rows) -> Rows:
        """Variance of the counts."""
        if not self.first_photon:
            return mean
        share: Any = np.divide(mean, trials, out=np.zeros_like(mean), where=trials > 0)
        return mean * (np.float32(1.0) - share)


def planned_pulses(law: Law, rates: Rows, pulses: float) -> Rows:
    """Mean of the pulses that no earlier bin has counted in, `[pixel, bin]`, where there are no counts to know it."""
    if not law.first_photon:
        return np.full((rates.shape[0], law.recorded), pulses, np.float32)
    before = np.cumsum(rates, axis=1, dtype=np.float64) - rates
    return (pulses * np.exp(-before)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Equations:
    """Sums over the bins of each pixel, float64.

    Attributes:
        score: Σ w (n − m), `[pixel, unknown]`; 0 without counts.
        slope: Σ w dm, `[pixel, unknown, unknown]`: minus the derivative of the score by the unknowns (last axis).
        noise: Σ w w v, its covariance by the counts, `[pixel, unknown, unknown]`.
        simulation: Σ w m of each batch of photons less their mean, of the two halves: `[half][batch, pixel, unknown]`.
    """

    score: Floats
    slope: Floats
    noise: Floats
    simulation: list[Floats]

    def times(self, scales: Floats) -> Equations:
        """The equations for unknowns in other units: each unknown is `scales` `[pixel, unknown]` times the new one."""
        left, right = scales[:, :, None], scales[:, None, :]
        return Equations(
            self.score * scales,
            self.slope * left * right,
            self.noise * left * right,
            [part * scales for part in self.simulation],
        )


def equations(
    law: Law,
    halves: list[Half],
    trials: Rows | None,
    counts: NDArray[np.integer] | None,
    *,
    pulses: float,
    image: tuple[int, int],
    cells: Sequence[Cell] | None = None,
) -> Equations:
    """The equations of counts `[pixel, bin]`, or of a plan of so many `pulses`, from two halves of photons.

    Args:
        law, halves: The detector; what the photons say.
        trials: Pulses that can still count in each bin; None: their mean.
        counts: None for a plan.
        pulses: In all.
        image: (height, width).
        cells: Of each unknown: rows, columns and bins over which its weights are averaged. Any weights give equations
            that are right in the mean; noisy ones are less precise.
    """
    a, b = halves
    pixels, unknowns = a.rates.shape[0], a.slopes.shape[0]
    score, slope = np.zeros((pixels, unknowns)), np.zeros((pixels, unknowns, unknowns))
    noise = np.zeros_like(slope)
    simulation = [np.zeros((len(half.batches), pixels, unknowns)) for half in halves]
    if trials is None:
        trials = planned_pulses(law, 0.5 * (a.rates + b.rates), pulses)
    cells = [(1, 1, 1)] * unknowns if cells is None else cells
    parts = [slice(first, min(first + _PIXELS, pixels)) for first in range(0, pixels, _PIXELS)]
    with ThreadPoolExecutor(core_count()) as pool:
        slopes = [_mean_slopes(law, half, trials, parts, pool) for half in halves]
        weights = [_weights(law, *pair, trials, image, cells, pool) for pair in zip(halves, slopes, strict=True)]

        def part(chosen: slice) -> None:
            left = trials[chosen]
            for i, other in enumerate(reversed(halves)):
                weight = weights[i][chosen]
                slope[chosen] += 0.5 * np.matmul(weight, slopes[1 - i][chosen].transpose(0, 2, 1))
                if counts is not None:
                    rest = counts[chosen] - law.mean(other.rates[chosen], left)
                    score[chosen] += 0.5 * np.matmul(weight, rest[..., None])[..., 0]
                for batch, rates in enumerate(other.batches):
                    mean = law.mean(rates[chosen], left)
                    simulation[1 - i][batch, chosen] = np.matmul(weight, mean[..., None])[..., 0]
            both = 0.5 * (weights[0][chosen] + weights[1][chosen])
            mean_rates = 0.5 * (a.rates[chosen] + b.rates[chosen])
            variance = law.variance(law.mean(mean_rates, left), left)
            noise[chosen] = np.matmul(both * variance[:, None], both.transpose(0, 2, 1))

        list(pool.map(part, parts))
    return Equations(score, slope, noise, [one - one.mean(axis=0) for one in simulation])


def _mean_slopes(law: Law, half: Half, trials: Rows, parts: list[slice], pool: ThreadPoolExecutor) -> Rows:
    """Derivatives of the mean counts, `[pixel, unknown, bin]`."""
    found = np.empty((len(half.first), len(half.slopes), law.recorded), np.float32)

    def part(chosen: slice) -> None:
        own = np.ascontiguousarray(half.slopes[:, chosen].transpose(1, 0, 2))
        found[chosen] = law.slopes(half.first[chosen], own, trials[chosen])

    list(pool.map(part, parts))
    return found


def _weights(
    law: Law,
    half: Half,
    slopes: Rows,
    trials: Rows,
    image: tuple[int, int],
    cells: Sequence[Cell],
    pool: ThreadPoolExecutor,
) -> Rows:
    """Derivatives of the mean over the variance, both added up in cells, `[pixel, unknown, bin]`."""
    mean = law.mean(half.first, trials)
    variance = law.variance(mean, trials)
    below = {cell: _in_cells(variance, image, cell) for cell in set(cells)}
    found = np.empty_like(slopes)

    def unknown(i: int) -> None:
        cell, limit = cells[i], half.limits[i]
        under = below[cell]
        above = _in_cells(slopes[:, i], image, cell)
        weight = np.divide(above, under, out=np.zeros_like(above), where=under > 0)
        np.clip(weight, -limit, limit, out=weight)
        found[:, i] = _expanded(weight, image, cell, slopes.shape[2])

    list(pool.map(unknown, range(len(cells))))
    return found


def _in_cells(rows: Rows, image: tuple[int, int], cell: Cell) -> Rows:
    """Sums over cells, `[row, column, bin]` of cells."""
    cube = rows.reshape(*image, -1)
    for axis in (2, 1, 0):
        if cell[axis] > 1:
            cube = np.add.reduceat(cube, np.arange(0, cube.shape[axis], cell[axis]), axis=axis)
    return cube


def _expanded(cube: Rows, image: tuple[int, int], cell: Cell, bins: int) -> Rows:
    """The value of its cell for each pixel and bin."""
    for axis, size in enumerate((*image, bins)):
        if cell[axis] > 1:
            cube = np.repeat(cube, cell[axis], axis=axis).take(range(size), axis=axis)
    return cube.reshape(-1, bins)
