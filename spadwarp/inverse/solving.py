"""Solution of the equations of unknowns that all pixels share and of those that each pixel has for itself.

The matrix has the shape of an arrow: pixels know of each other through what they share alone. Their own unknowns are
eliminated (Schur's complement), so that the cost grows with the pixels and not with their cube.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spadwarp.inverse.equations import Equations

__all__ = ["Solution", "solve"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solution:
    """A step towards the solution and its covariance; in the unit of the equations.

    Attributes:
        shared: Step of what all pixels share, `[S]`.
        own: Steps of the pixels' own unknowns, `[pixel, Q]`; NaN where a pixel knows nothing of them.
        information: Fisher information of the shared unknowns when the own ones are unknown too, `[S, S]`.
        covariance: Of the shared, counts and simulation together, `[S, S]`.
        simulation: The part of it that is noise of the simulation.
        own_covariance: `[pixel, Q, Q]`.
        own_simulation: The part of it that is noise of the simulation.
        own_bound: Their Cramér–Rao bound, `[pixel, Q, Q]`.
        simulation_share: Largest variance by the simulation over that by the counts, of the shared unknowns;
            without any, of the median pixel.
        gain: What the step adds to the log-likelihood, of the shared unknowns in their covariance.
    """

    shared: Floats
    own: Floats
    information: Floats
    covariance: Floats
    simulation: Floats
    own_covariance: Floats
    own_simulation: Floats
    own_bound: Floats
    simulation_share: float
    gain: float


def solve(
    equations: Equations, is_own: NDArray[np.bool_], *, prior: Floats | None = None, pull: Floats | None = None
) -> Solution:
    """The Newton step of the equations.

    Args:
        equations: From `spadwarp.inverse.equations`.
        is_own: Which unknowns each pixel has for itself, `[unknown]`.
        prior, pull: Information on the shared unknowns from elsewhere, and its score, `[S]` both.
    """
    s, q = np.flatnonzero(~is_own), np.flatnonzero(is_own)
    slope, score = equations.slope, equations.score
    # What a pixel's own unknowns take of the shared ones: left and right of the inverse of their block.
    inverse, known = _inverse(slope[:, q[:, None], q])
    left = -slope[:, s[:, None], q] @ inverse
    right = inverse @ slope[:, q[:, None], s]
    matrix = (slope[:, s[:, None], s] + left @ slope[:, q[:, None], s]).sum(axis=0)
    right_side = (score[:, s] + np.einsum("psq,pq->ps", left, score[:, q])).sum(axis=0)
    matrix = matrix if prior is None else matrix + np.diag(prior)
    right_side = right_side if pull is None else right_side + pull
    inverse_matrix = _pseudo_inverse(matrix)
    shared = inverse_matrix @ right_side
    # Each pixel's part of the reduced score is `mixing` times its score.
    mixing = np.zeros((len(slope), s.size, is_own.size))
    mixing[:, np.arange(s.size), s] = 1.0
    mixing[:, :, q] = left
    by_counts = np.einsum("psi,pij,ptj->st", mixing, equations.noise, mixing, optimize=True)
    by_counts = by_counts if prior is None else by_counts + np.diag(prior)
    by_simulation = _spread([np.einsum("psi,bpi->bs", mixing, part) for part in equations.simulation])
    own = np.einsum("pij,pj->pi", inverse, score[:, q]) - right @ shared
    own_simulation = _own_spread([part[..., q] for part in equations.simulation], inverse)
    own_noise = inverse @ equations.noise[:, q[:, None], q] @ inverse.transpose(0, 2, 1) + own_simulation
    covariance = inverse_matrix @ (by_counts + by_simulation) @ inverse_matrix.T
    own_covariance = own_noise + right @ covariance @ right.transpose(0, 2, 1)
    simulation = inverse_matrix @ by_simulation @ inverse_matrix.T
    share = _largest_ratio(np.diag(simulation), np.diag(covariance - simulation))
    if not s.size:
        share = _largest_ratio(*(_median(part) for part in (own_simulation, own_covariance - own_simulation)))
    gain = (
        0.5 * float(shared @ np.linalg.pinv(covariance, rcond=1e-12) @ shared)
        if s.size
        else _own_gain(own, own_covariance)
    )
    bound = 0.5 * (inverse_matrix + inverse_matrix.T)
    own_bound = 0.5 * (inverse + inverse.transpose(0, 2, 1)) + right @ bound @ right.transpose(0, 2, 1)
    own_bound[~known] = np.nan
    own[~known], own_covariance[~known], own_simulation[~known] = np.nan, np.nan, np.nan
    return Solution(
        shared=shared,
        own=own,
        information=0.5 * (matrix + matrix.T),
        covariance=covariance,
        simulation=simulation,
        own_covariance=own_covariance,
        own_simulation=own_simulation,
        own_bound=own_bound,
        simulation_share=share,
        gain=gain,
    )


def _inverse(blocks: Floats) -> tuple[Floats, NDArray[np.bool_]]:
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


def _pseudo_inverse(matrix: Floats) -> Floats:
    """The inverse of a matrix whose rows and columns may have very different units."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    return np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-9) / np.outer(scale, scale)


def _spread(halves: list[Floats]) -> Floats:
    """Covariance of the score by the simulation, of batches `[batch, unknown]` of both halves less their means."""
    total = np.zeros((halves[0].shape[1],) * 2)
    for part in halves:
        batches = len(part)
        if batches > 1:  # the score has half of each half's mean
            total += 0.25 * part.T @ part / (batches * (batches - 1))
    return total


def _own_spread(halves: list[Floats], inverse: Floats) -> Floats:
    """The same for the pixels' own unknowns, as a covariance of these, `[pixel, Q, Q]`."""
    total = np.zeros_like(inverse)
    for part in halves:
        batches = len(part)
        if batches > 1:
            total += 0.25 * np.einsum("bpi,bpj->pij", part, part) / (batches * (batches - 1))
    return inverse @ total @ inverse.transpose(0, 2, 1)


def _median(blocks: Floats) -> Floats:
    """Median over the pixels of the variances."""
    return np.nanmedian(np.einsum("pii->pi", blocks), axis=0)


def _largest_ratio(parts: Floats, wholes: Floats) -> float:
    return float(np.max(np.divide(parts, wholes, out=np.zeros_like(parts), where=wholes > 0), initial=0.0))


def _own_gain(own: Floats, covariance: Floats) -> float:
    """Mean of the gain of the pixels."""
    variance = np.einsum("pii->pi", covariance)
    gains = np.divide(own**2, variance, out=np.zeros_like(own), where=variance > 0)
    return 0.5 * float(gains.sum(axis=1).mean())
