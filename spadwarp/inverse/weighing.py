"""How coarse the weights of the score are: fine ones are sharp but noisy, coarse ones know little of edges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.inverse.equations import Cell, Equations, equations, means_of
from spadwarp.inverse.solving import Solution, solve
from spadwarp.inverse.unknowns import DEPTH, Unknown

__all__ = ["LEVELS", "Solved", "solved"]

Floats = NDArray[np.float64]

LEVELS = (1, 2, 4, 8, 16)
"""Pixels along the side of a cell."""
_MOST_BINS = 4


class Solved(NamedTuple):
    """Equations and their solution, with cells of `level` pixels on a side."""

    level: int
    equations: Equations
    solution: Solution


def solved(
    unknowns: Sequence[Unknown],
    scales: Floats,
    *,
    level: int | None,
    image: tuple[int, int],
    prior: tuple[Floats, Floats],
    **given: Any,
) -> Solved:
    """The equations with the cells that have the least standard errors, from coarse to fine.

    Args:
        unknowns: In the order of the slopes.
        scales: Their units, `[pixel, unknown]`.
        level: The coarsest that is tried, of `LEVELS`, as one of an earlier rendering; None: the coarsest of all.
        image: (height, width).
        prior: Score and information, see `solve`.
        given: Other arguments of `spadwarp.inverse.equations.equations`.
    """
    is_own = np.array([one.per_pixel for one in unknowns])
    pull, information = prior
    arguments = (given["law"], given["halves"], given["trials"], given["counts"])
    means = means_of(*arguments, pulses=given["pulses"])
    best, least, worse = None, np.inf, 0
    for size in reversed(_levels(unknowns, image, level)):
        cells = [_cell(one, size) for one in unknowns]
        own = equations(image=image, cells=cells, means=means, **given).times(scales)
        solution = solve(own, is_own, prior=information, pull=pull)
        variances = np.diag(solution.covariance)
        total = float(np.log(np.maximum(variances, 1e-300)).sum()) if (variances > 0).all() else np.inf
        if best is None or total < least:
            best, least, worse = Solved(size, own, solution), total, 0
        elif np.isfinite(least):
            worse += 1
        if worse == 2:  # the noise of the errors can hide one better level behind a worse one
            break
    assert best is not None
    return best


def _levels(unknowns: Sequence[Unknown], image: tuple[int, int], coarsest: int | None) -> tuple[int, ...]:
    if all(one.per_pixel for one in unknowns):
        return (1,)
    return tuple(size for size in LEVELS if size <= (max(image) if coarsest is None else coarsest))


def _cell(one: Unknown, size: int) -> Cell:
    """A pixel's own unknown has weights of its own; a shift in time needs every bin."""
    if one.per_pixel:
        return (1, 1, 1)
    return (size, size, 1 if one.name == DEPTH else min(size, _MOST_BINS))
