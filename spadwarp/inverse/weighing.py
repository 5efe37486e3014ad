"""How coarse the weights of the score are: fine ones are sharp but noisy, coarse ones know little of edges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.inverse.equations import Cell, Equations, equations
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
    """The equations with the cells of a level, or of that with the least standard errors.

    Args:
        unknowns: In the order of the slopes.
        scales: Their units, `[pixel, unknown]`.
        level: Of `LEVELS`; None: all are tried.
        image: (height, width).
        prior: Score and information, see `solve`.
        given: Other arguments of `spadwarp.inverse.equations.equations`.
    """
    is_own = np.array([one.per_pixel for one in unknowns])
    pull, information = prior
    best, least = None, np.inf
    for size in _levels(unknowns, image) if level is None else (level,):
        own = equations(image=image, cells=[_cell(one, size) for one in unknowns], **given).times(scales)
        solution = solve(own, is_own, prior=information, pull=pull)
        variances = np.diag(solution.covariance)
        total = float(np.log(np.maximum(variances, 1e-300)).sum()) if (variances > 0).all() else np.inf
        if best is None or total < least:
            best, least = Solved(size, own, solution), total
    assert best is not None
    return best


def _levels(unknowns: Sequence[Unknown], image: tuple[int, int]) -> tuple[int, ...]:
    if all(one.per_pixel for one in unknowns):
        return (1,)
    return tuple(size for size in LEVELS if size <= max(image))


def _cell(one: Unknown, size: int) -> Cell:
    """A pixel's own unknown has weights of its own; a shift in time needs every bin."""
    if one.per_pixel:
        return (1, 1, 1)
    return (size, size, 1 if one.name == DEPTH else min(size, _MOST_BINS))
