"""The slope of the score by the depth, over the interval that is stated for the depth.

Light lies in bins until the instrument response spreads it. Where most of a pixel's light lies in one or two bins, the
expected counts follow the depth only as light crosses the edges of these bins: hardly at all while it stays inside one,
fast while it crosses. The difference over about half of the response, which makes smooth weights, gives the mean slope
over several millimetres; the slope within the depth's error can be a part of it, or a multiple. Any weights give right
equations, but the step and the covariance need the slope where the depth is looked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spadwarp.inverse.equations import Equations, Law
from spadwarp.inverse.estimates import NORMAL_95
from spadwarp.inverse.rendering import Half, Renderer, Values
from spadwarp.inverse.solving import Solution
from spadwarp.inverse.unknowns import DEPTH

__all__ = ["Local", "locally_solved"]

Floats = NDArray[np.float64]

_WIDE = 0.7  # of the renderer's step: an interval of this size has the slope that is known already
_CONSISTENT = 1.5  # ratio of the interval that was found to that of the difference
_LARGEST = 3.0  # ratio of one difference to that before
_TRIES = 6
_LEAST = 1e-5  # of the range of the last bin: positions are float32
_STRAIGHT = 0.75  # ratio of two slopes that are taken for the same
_ONE_SIDED = 0.5  # ratio of the slopes of both sides: below, the flatter one decides


@dataclass(frozen=True, eq=False)
class Local:
    """A solution with the slope by the depth where the depth is looked for.

    Attributes:
        solution: The step and its covariance.
        ratio: The depth's slope over that of the renderer's wide difference; 0 where it is not known how far the
            depth can move without a change of the counts.
    """

    solution: Solution
    ratio: float

    @property
    def bend(self) -> float:
        """How much of the step may be wrong because the slope changes."""
        return abs(1.0 - 1.0 / self.ratio) if self.ratio > 0.0 else 1.0

    @property
    def is_straight(self) -> bool:
        """Whether the slope is that of the wide difference, as far as the noise of the simulation shows it."""
        return _STRAIGHT < self.ratio < 1.0 / _STRAIGHT


def locally_solved(
    equations: Equations,
    solution: Solution,
    solve: Callable[[Equations], Solution],
    *,
    render: Renderer,
    values: Values,
    law: Law,
    halves: list[Half],
    trials: NDArray[np.float32],
    scales: Floats,
    photons: int,
) -> Local:
    """Solves again with the slope by the common depth between the ends of its 95 % interval.

    Where no interval shorter than the wide difference has a slope that belongs to it, the light can move inside a bin:
    the depth's variance then is that of two places anywhere in the same bin.

    Args:
        equations, solution: With the renderer's wide difference, in the units `scales` `[pixel, unknown]`.
        solve: Solves equations with another slope.
        render, values, law, halves, trials: What the equations are made of.
        photons: Of a difference.
    """
    column = next((i for i, one in enumerate(render.unknowns) if one.name == DEPTH and not one.per_pixel), None)
    if column is None:
        return Local(solution, 1.0)
    row = sum(not one.per_pixel for one in render.unknowns[:column])
    rates = 0.5 * (halves[0].rates + halves[1].rates)
    medium, gate = render.scene.medium, render.scene.gate
    least = _LEAST * 0.5 * medium.pulse_speed * gate.stop

    def interval(found: Solution) -> float:
        return max(NORMAL_95 * math.sqrt(max(found.covariance[row, row], 0.0)), least)

    def slopes(shift: float, step: float) -> Floats:
        rows = render.depth_slope(values, shift=shift, step=step, photons=photons)
        counts = law.slopes(rates, rows[:, None], trials)
        found: Floats = np.matmul(equations.weights, counts.transpose(0, 2, 1))[..., 0] * scales
        return found * scales[:, column, None]

    def share(slope: Floats) -> float:
        return float(slope[:, column].sum() / wide)

    wide, step = equations.slope[:, column, column].sum(), interval(solution)
    if not step < _WIDE * render.depth_step:
        return Local(solution, 1.0)
    for _ in range(_TRIES):
        found = slopes(0.0, step)
        if not _STRAIGHT < share(found) < 1.0 / _STRAIGHT:
            flat, steep = sorted((slopes(side * step / 2, step / 2) for side in (-1.0, 1.0)), key=share)
            found = flat if share(flat) < _ONE_SIDED * share(steep) else 0.5 * (flat + steep)
        slope, ratio = equations.slope.copy(), share(found)
        slope[:, :, column] = found
        local = Local(solve(replace(equations, slope=slope)), ratio) if ratio > 0.0 else None
        needed = math.inf if local is None else interval(local.solution)
        if local is not None and (step / _CONSISTENT < needed < step * _CONSISTENT or needed == step == least):
            return local
        step = min(needed, _LARGEST * step)
        if not step < _WIDE * render.depth_step:
            break
    covariance = solution.covariance.copy()
    covariance[row, row] += (0.5 * medium.pulse_speed * gate.bin_width) ** 2 / 6.0
    return Local(replace(solution, covariance=covariance), 0.0)
