"""The likelihood's equations for unknowns and their solution, from two independent halves of photons.

The weights of the score come from one half, what they weigh from the other, and both ways are averaged (eq I4).
Whatever the noise of the weights, the score's mean is 0 at the truth; what it costs is precision, and the covariance,
which is that of the equations that were solved, has it.

Pixels know of each other through the unknowns that they share alone: the matrix has the shape of an arrow. The pixels'
own unknowns are eliminated (Schur's complement), so that the cost grows with the pixels and not with their cube.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats, block_sums
from spadwarp.device import core_count
from spadwarp.inverse.rendering import Half
from spadwarp.inverse.unknowns import DEPTH, Unknown

Rows = NDArray[np.float32]

Cell = tuple[int, int, int]  # rows, columns and bins

_PIXELS = 256  # of a part that a thread works on
_LEVELS = (1, 2, 4, 8, 16)  # pixels along the side of a cell
_MOST_BINS = 4  # of a cell


class Law(NamedTuple):
    """How a detector counts."""

    first_photon: bool  # in each bin a binomial of the pulses that no earlier bin has counted in; else Poisson, of all
    dead_share: float  # dead time over the period between windows, for free-running counts
    recorded: int  # bins that are counted; later ones are there for the dead time alone

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

    def planned(self, rates: Rows, pulses: float) -> Rows:
        """Mean of the pulses that no earlier bin has counted in, `[pixel, bin]`: trials where there are no counts."""
        if not self.first_photon:
            return np.full((rates.shape[0], self.recorded), pulses, np.float32)
        before = np.cumsum(rates, axis=1, dtype=np.float64) - rates
        return (pulses * np.exp(-before)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Equations:
    """Sums over the bins of each pixel, float64; w are weights, m, n and v counts with their mean and variance."""

    score: Floats  # Σ w (n − m), [pixel, unknown]; 0 without counts
    slope: Floats  # Σ w dm, [pixel, unknown, unknown]: minus the derivative of the score by the unknowns (last axis)
    noise: Floats  # Σ w w v, its covariance by the counts, [pixel, unknown, unknown]
    simulation: list[Floats]  # Σ w m of batches of photons less their mean, of two halves [batch, pixel, unknown]
    weights: Rows  # the mean of both halves', float32 [pixel, unknown, bin], in units of the scene
    # Σ w dm of batches less their mean, of two halves [batch, pixel, unknown, unknown].
    slope_batches: Sequence[Floats] = ()


class Moments:
    """Means of the counts by two halves of photons, their derivatives and variance, float32: what equations are of.

    `limits` are the renderer's; without `trials`, the pulses that can still count in each bin `[pixel, bin]`, their
    mean is taken; without `counts` `[pixel, bin]` it is a plan of `pulses` in all.
    """

    def __init__(
        self,
        law: Law,
        halves: list[Half],
        limits: Rows,
        trials: Rows | None,
        counts: NDArray[np.integer] | None,
        pulses: float,
        image: tuple[int, int],
    ) -> None:
        self.law, self.limits, self.image = law, limits, image
        self.rates = 0.5 * (halves[0].rates + halves[1].rates)
        self.trials = law.planned(self.rates, pulses) if trials is None else trials
        pixels, unknowns = self.rates.shape[0], halves[0].slopes[0].shape[0]

        def rows() -> Rows:
            return np.empty((pixels, law.recorded), np.float32)

        self.variance = rows()
        self.slopes = [[np.empty((pixels, unknowns, law.recorded), np.float32) for _ in half.slopes] for half in halves]
        self.batches = [[rows() for _ in half.batches] for half in halves]
        self.rest = None if counts is None else [rows(), rows()]  # counts less their mean

        def part(chosen: slice) -> None:
            trials = self.trials[chosen]
            for i, half in enumerate(halves):
                for batch, rates, by_unknowns in zip(self.slopes[i], half.batches, half.slopes, strict=False):
                    slopes = np.ascontiguousarray(by_unknowns[:, chosen].transpose(1, 0, 2))
                    batch[chosen] = law.slopes(rates[chosen], slopes, trials)
                for mean, rates in zip(self.batches[i], half.batches, strict=True):
                    mean[chosen] = law.mean(rates[chosen], trials)
                if self.rest is not None and counts is not None:
                    self.rest[i][chosen] = counts[chosen] - law.mean(half.rates[chosen], trials)
            self.variance[chosen] = law.variance(law.mean(self.rates[chosen], trials), trials)

        _in_threads(part, _parts(pixels))

    def equations(self, cells: Sequence[Cell], scales: Floats) -> Equations:
        """The equations of the counts, or of a plan of them.

        `cells`: of each unknown the rows, columns and bins over which its weights are averaged. Any weights give
        equations that are right in the mean; noisy ones are less precise. `scales` `[pixel, unknown]`: its unit.
        """
        pixels, unknowns = self.slopes[0][0].shape[:2]
        score, noise = np.zeros((pixels, unknowns)), np.zeros((pixels, unknowns, unknowns))
        simulation = [np.zeros((len(batches), pixels, unknowns)) for batches in self.batches]
        slopes = [np.zeros((len(batches), pixels, unknowns, unknowns)) for batches in self.slopes]
        mean_weights = np.empty((pixels, unknowns, self.law.recorded), np.float32)
        weights = [self._weights(i, cells) for i in (0, 1)]

        def part(chosen: slice) -> None:
            for i, weight in enumerate(half[chosen] for half in weights):
                for batch, by_unknowns in enumerate(self.slopes[1 - i]):
                    slopes[1 - i][batch, chosen] = np.matmul(weight, by_unknowns[chosen].transpose(0, 2, 1))
                if self.rest is not None:
                    score[chosen] += 0.5 * np.matmul(weight, self.rest[1 - i][chosen, :, None])[..., 0]
                for batch, mean in enumerate(self.batches[1 - i]):
                    simulation[1 - i][batch, chosen] = np.matmul(weight, mean[chosen, :, None])[..., 0]
            both = mean_weights[chosen]
            np.multiply(weights[0][chosen] + weights[1][chosen], np.float32(0.5), out=both)
            noise[chosen] = np.matmul(both * self.variance[chosen, None], both.transpose(0, 2, 1))

        _in_threads(part, _parts(pixels))
        units = scales[:, :, None] * scales[:, None, :]
        slopes = [part * units for part in slopes]
        slope = 0.5 * (slopes[0].mean(axis=0) + slopes[1].mean(axis=0))
        simulation = [(part - part.mean(axis=0)) * scales for part in simulation]
        slopes = [part - part.mean(axis=0) for part in slopes]
        return Equations(score * scales, slope, noise * units, simulation, mean_weights, slopes)

    def _weights(self, number: int, cells: Sequence[Cell]) -> Rows:
        """By a half: derivatives of the mean over the variance, both added up in cells, `[pixel, unknown, bin]`."""
        # Mean and slopes by the same photons: what is rare in both does not show in the ratio.
        scored, limits = self.slopes[number], self.limits
        slopes: Rows = np.mean(scored, axis=0) if len(scored) > 1 else scored[0]
        mean: Rows = np.mean(self.batches[number][: len(scored)], axis=0)
        variance = self.law.variance(mean, self.trials)
        below = {cell: block_sums(variance.reshape(*self.image, -1), cell) for cell in set(cells)}
        weights = np.empty_like(slopes)

        def unknown(i: int) -> None:
            under, above = below[cells[i]], block_sums(slopes[:, i].reshape(*self.image, -1), cells[i])
            weight = np.divide(above, under, out=np.zeros_like(above), where=under > 0)
            np.clip(weight, -limits[i], limits[i], out=weight)
            weights[:, i] = _expanded(weight, self.image, cells[i], slopes.shape[2])

        _in_threads(unknown, range(len(cells)))
        return weights


def _in_threads(work: Callable[[Any], None], items: Sequence[Any]) -> None:
    with ThreadPoolExecutor(core_count()) as pool:
        list(pool.map(work, items))


def _parts(pixels: int) -> list[slice]:
    return [slice(first, min(first + _PIXELS, pixels)) for first in range(0, pixels, _PIXELS)]


def _expanded(cube: Rows, image: tuple[int, int], cell: Cell, bins: int) -> Rows:
    """The value of its cell for each pixel and bin."""
    for axis, size in enumerate((*image, bins)):
        if cell[axis] > 1:
            cube = np.repeat(cube, cell[axis], axis=axis).take(range(size), axis=axis)
    return cube.reshape(-1, bins)


# Solution


@dataclass(frozen=True, eq=False)
class Solution:
    """A step towards the solution and its covariance, in the unit of the equations.

    S unknowns are shared by all pixels, Q are a pixel's own; a pixel that knows nothing of its own has NaN.
    """

    shared: Floats  # step of the shared, [S]
    pixels: Floats  # steps of the own, [pixel, Q]
    information: Floats  # Fisher information of the shared when the own ones are unknown too, [S, S]
    covariance: Floats  # of the shared, by counts and simulation together, [S, S]
    simulation: Floats  # the part of it that is noise of the simulation
    pixel_covariance: Floats  # [pixel, Q, Q]
    pixel_bound: Floats  # Cramér–Rao bound of the own, [pixel, Q, Q]
    simulation_share: float  # largest variance by the simulation over that by the counts; without shared: median pixel
    gain: float  # what the step adds to the log-likelihood, of the shared in their covariance
    # The depth's slope over that of the renderer's wide difference; 1: no difference was seen; 0: it is not known how
    # far the depth can move without a change of the counts.
    slope_ratio: float = 1.0


def solve(
    equations: Equations, is_per_pixel: NDArray[np.bool_], prior: tuple[Floats, Floats] | None = None
) -> Solution:
    """The Newton step of equations; `prior`: score and information on the shared from elsewhere, `[S]` both."""
    s, q = np.flatnonzero(~is_per_pixel), np.flatnonzero(is_per_pixel)
    slope, score = equations.slope, equations.score
    pull, known_before = (np.zeros(s.size), np.zeros(s.size)) if prior is None else prior
    # What a pixel's own unknowns take of the shared ones: left and right of the inverse of their block.
    inverse, known = _inverses(slope[:, q[:, None], q])
    left = -slope[:, s[:, None], q] @ inverse
    right = inverse @ slope[:, q[:, None], s]
    matrix = (slope[:, s[:, None], s] + left @ slope[:, q[:, None], s]).sum(axis=0) + np.diag(known_before)
    inverse_matrix = pseudo_inverse(matrix)
    shared = inverse_matrix @ ((score[:, s] + np.einsum("psq,pq->ps", left, score[:, q])).sum(axis=0) + pull)
    # Each pixel's part of the reduced score is `mixing` times its score.
    mixing = np.zeros((len(slope), s.size, is_per_pixel.size))
    mixing[:, np.arange(s.size), s] = 1.0
    mixing[:, :, q] = left
    by_counts = np.einsum("psi,pij,ptj->st", mixing, equations.noise, mixing, optimize=True) + np.diag(known_before)
    pixels = np.einsum("pij,pj->pi", inverse, score[:, q]) - right @ shared
    steps = np.empty(score.shape)
    steps[:, s], steps[:, q] = shared, pixels
    by_simulation, pixel_simulation = _of_batches(equations.simulation, mixing, q)
    # Slopes of a batch are wrong, and the further the step goes, the more so is its end.
    changes = [np.einsum("bpij,pj->bpi", part, steps) for part in equations.slope_batches]
    by_slopes, pixel_slopes = _of_batches(changes, mixing, q)
    pixel_simulation = inverse @ (pixel_simulation + pixel_slopes) @ inverse.transpose(0, 2, 1)
    pixel_noise = inverse @ equations.noise[:, q[:, None], q] @ inverse.transpose(0, 2, 1) + pixel_simulation
    covariance = inverse_matrix @ (by_counts + by_simulation) @ inverse_matrix.T
    pixel_covariance = pixel_noise + right @ covariance @ right.transpose(0, 2, 1)
    simulation = inverse_matrix @ by_simulation @ inverse_matrix.T
    if s.size:
        share = _largest_ratio(np.diag(simulation), np.diag(covariance - simulation))
        gain = 0.5 * float(shared @ np.linalg.pinv(covariance, rcond=1e-12) @ shared)
        extra = inverse_matrix @ by_slopes @ inverse_matrix.T
        covariance, simulation = covariance + extra, simulation + extra
    else:
        variance, simulated = np.einsum("pii->pi", pixel_covariance), np.einsum("pii->pi", pixel_simulation)
        share = _largest_ratio(np.nanmedian(simulated, axis=0), np.nanmedian(variance - simulated, axis=0))
        gains = np.divide(pixels**2, variance, out=np.zeros_like(pixels), where=variance > 0)
        gain = 0.5 * float(gains.sum(axis=1).mean())
    bound = 0.5 * (inverse_matrix + inverse_matrix.T)
    pixel_bound = 0.5 * (inverse + inverse.transpose(0, 2, 1)) + right @ bound @ right.transpose(0, 2, 1)
    pixels[~known], pixel_bound[~known], pixel_covariance[~known] = np.nan, np.nan, np.nan
    return Solution(
        shared=shared,
        pixels=pixels,
        information=0.5 * (matrix + matrix.T),
        covariance=covariance,
        simulation=simulation,
        pixel_covariance=pixel_covariance,
        pixel_bound=pixel_bound,
        simulation_share=share,
        gain=gain,
    )


def _of_batches(parts: Sequence[Floats], mixing: Floats, own: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Covariance of the scores of the shared unknowns and of each pixel's own, from batches `[batch, pixel, unknown]`
    less their means, of two halves; the score has half of each one's mean."""
    shared, pixels = np.zeros((mixing.shape[1],) * 2), np.zeros((len(mixing), own.size, own.size))
    for part in parts:
        if (batches := len(part)) > 1:
            reduced, rest = np.einsum("psi,bpi->bs", mixing, part), part[..., own]
            shared += 0.25 * reduced.T @ reduced / (batches * (batches - 1))
            pixels += 0.25 * np.einsum("bpi,bpj->pij", rest, rest) / (batches * (batches - 1))
    return shared, pixels


def _inverses(blocks: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Inverses of the pixels' own blocks, 0 where a block is not positive, and where it is."""
    known = np.ones(len(blocks), bool)
    if blocks.shape[-1]:
        scale = np.sqrt(np.maximum(np.einsum("pii->pi", blocks), 0.0))
        known = (scale > 0).all(axis=1)
        unit = np.where(known[:, None], scale, 1.0)
        scaled = blocks / (unit[:, :, None] * unit[:, None, :])
        known &= np.linalg.eigvalsh(0.5 * (scaled + scaled.transpose(0, 2, 1)))[:, 0] > 1e-4
    result = np.zeros_like(blocks)
    result[known] = np.linalg.inv(blocks[known])
    return result, known


def pseudo_inverse(matrix: Floats) -> Floats:
    """The inverse of a matrix whose rows and columns may have very different units."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    return np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-9) / np.outer(scale, scale)


def _largest_ratio(parts: Floats, wholes: Floats) -> float:
    return float(np.max(np.divide(parts, wholes, out=np.zeros_like(parts), where=wholes > 0), initial=0.0))


def solve_pooled(
    unknowns: Sequence[Unknown],
    moments: Moments,
    scales: Floats,
    solve: Callable[[Equations], Solution],
    pooling_level: int | None,
) -> tuple[int, Equations, Solution]:
    """The equations with the cells, of so many pixels on a side, that have the least standard errors; their solution.

    From coarse to fine: fine weights of the score are sharp but noisy, coarse ones know little of edges. Sides are at
    most `pooling_level`, that of an earlier rendering. `solve` takes units of `scales` `[pixel, unknown]`.
    """

    def cell(unknown: Unknown, size: int) -> Cell:
        """A pixel's own unknown has weights of its own; a shift in time needs every bin."""
        if unknown.per_pixel:
            return (1, 1, 1)
        return (size, size, 1 if unknown.name == DEPTH else min(size, _MOST_BINS))

    coarsest = max(moments.image) if pooling_level is None else pooling_level
    levels = [size for size in _LEVELS if size <= coarsest]
    if all(unknown.per_pixel for unknown in unknowns):
        levels = [1]
    best, least, worse = None, np.inf, 0
    for size in reversed(levels):
        equations = moments.equations([cell(unknown, size) for unknown in unknowns], scales)
        solution = solve(equations)
        variances = np.diag(solution.covariance)
        total = float(np.log(np.maximum(variances, 1e-300)).sum()) if (variances > 0).all() else np.inf
        if best is None or total < least:
            best, least, worse = (size, equations, solution), total, 0
        elif np.isfinite(least):
            worse += 1
        if worse == 2:  # the noise of the errors can hide one better level behind a worse one
            break
    assert best is not None
    return best
