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

__all__ = ["Cell", "Equations", "Law", "Means", "equations", "means_of", "planned_pulses"]

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
        weights: w, the mean of both halves', float32 `[pixel, unknown, bin]`; whatever the unknowns' units are, they
            are those of the scene.
    """

    score: Floats
    slope: Floats
    noise: Floats
    simulation: list[Floats]
    weights: Rows

    def times(self, scales: Floats) -> Equations:
        """The equations for unknowns in other units: each unknown is `scales` `[pixel, unknown]` times the new one."""
        left, right = scales[:, :, None], scales[:, None, :]
        return Equations(
            self.score * scales,
            self.slope * left * right,
            self.noise * left * right,
            [part * scales for part in self.simulation],
            self.weights,
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
    means: Means | None = None,
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
        means: From `means_of` with the same arguments, for several equations of one rendering.
    """
    pixels, unknowns = halves[0].rates.shape[0], halves[0].slopes.shape[0]
    score, slope = np.zeros((pixels, unknowns)), np.zeros((pixels, unknowns, unknowns))
    noise = np.zeros_like(slope)
    simulation = [np.zeros((len(half.batches), pixels, unknowns)) for half in halves]
    mean_weights = np.empty((pixels, unknowns, law.recorded), np.float32)
    cells = [(1, 1, 1)] * unknowns if cells is None else cells
    own = means_of(law, halves, trials, counts, pulses=pulses) if means is None else means
    with ThreadPoolExecutor(core_count()) as pool:
        weights = [_weights(law, half, i, own, image, cells, pool) for i, half in enumerate(halves)]

        def part(chosen: slice) -> None:
            for i, weight in enumerate(one[chosen] for one in weights):
                slope[chosen] += 0.5 * np.matmul(weight, own.slopes[1 - i][chosen].transpose(0, 2, 1))
                if own.rest is not None:
                    score[chosen] += 0.5 * np.matmul(weight, own.rest[1 - i][chosen, :, None])[..., 0]
                for batch, mean in enumerate(own.batches[1 - i]):
                    simulation[1 - i][batch, chosen] = np.matmul(weight, mean[chosen, :, None])[..., 0]
            both = mean_weights[chosen]
            np.multiply(weights[0][chosen] + weights[1][chosen], np.float32(0.5), out=both)
            noise[chosen] = np.matmul(both * own.variance[chosen, None], both.transpose(0, 2, 1))

        list(pool.map(part, _parts(pixels)))
    return Equations(score, slope, noise, [one - one.mean(axis=0) for one in simulation], mean_weights)


class Means(NamedTuple):
    """What the equations take of a rendering whatever their cells are, float32.

    Attributes:
        trials: Pulses that can still count in each bin.
        slopes: Derivatives of the mean counts by each half, `[half][pixel, unknown, bin]`.
        rest: Counts less their mean by each half, `[half][pixel, bin]`; None without counts.
        batches: Mean counts by each batch of photons, `[half][batch][pixel, bin]`.
        variance: Of the counts, by both halves.
    """

    trials: Rows
    slopes: list[Rows]
    rest: list[Rows] | None
    batches: list[list[Rows]]
    variance: Rows


def means_of(
    law: Law, halves: list[Half], trials: Rows | None, counts: NDArray[np.integer] | None, *, pulses: float
) -> Means:
    """Of a rendering, for several `equations` of it; arguments are theirs."""
    a, b = halves
    left = planned_pulses(law, 0.5 * (a.rates + b.rates), pulses) if trials is None else trials
    pixels, unknowns = a.rates.shape[0], a.slopes.shape[0]

    def rows() -> Rows:
        return np.empty((pixels, law.recorded), np.float32)

    slopes = [np.empty((pixels, unknowns, law.recorded), np.float32) for _ in halves]
    batches, variance = [[rows() for _ in half.batches] for half in halves], rows()
    rest = None if counts is None else [rows(), rows()]

    def part(chosen: slice) -> None:
        trials = left[chosen]
        for i, half in enumerate(halves):
            own = np.ascontiguousarray(half.slopes[:, chosen].transpose(1, 0, 2))
            slopes[i][chosen] = law.slopes(half.first[chosen], own, trials)
            for mean, rates in zip(batches[i], half.batches, strict=True):
                mean[chosen] = law.mean(rates[chosen], trials)
            if rest is not None and counts is not None:
                rest[i][chosen] = counts[chosen] - law.mean(half.rates[chosen], trials)
        mean_rates = 0.5 * (a.rates[chosen] + b.rates[chosen])
        variance[chosen] = law.variance(law.mean(mean_rates, trials), trials)

    with ThreadPoolExecutor(core_count()) as pool:
        list(pool.map(part, _parts(pixels)))
    return Means(left, slopes, rest, batches, variance)


def _parts(pixels: int) -> list[slice]:
    return [slice(first, min(first + _PIXELS, pixels)) for first in range(0, pixels, _PIXELS)]


def _weights(
    law: Law,
    half: Half,
    number: int,
    means: Means,
    image: tuple[int, int],
    cells: Sequence[Cell],
    pool: ThreadPoolExecutor,
) -> Rows:
    """Derivatives of the mean over the variance, both added up in cells, `[pixel, unknown, bin]`."""
    slopes = means.slopes[number]
    variance = law.variance(means.batches[number][0], means.trials)
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
