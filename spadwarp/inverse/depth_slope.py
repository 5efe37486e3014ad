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
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.inverse.equations import Equations, Law
from spadwarp.inverse.estimates import NORMAL_95
from spadwarp.inverse.rendering import Half, Renderer, Values
from spadwarp.inverse.solving import Solution
from spadwarp.inverse.unknowns import DEPTH

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["Local", "locally_solved"]

Floats = NDArray[np.float64]

_WIDE = 0.7  # of the renderer's step: an interval of this size has the slope that is known already
_CONSISTENT = 1.5  # ratio of the interval that was found to that of the difference
_LARGEST = 3.0  # ratio of one difference to that before
_TRIES = 6
_LEAST = 1e-5  # of the range of the last bin: positions are float32
_STRAIGHT = 0.75  # ratio of two slopes; below, a warning
_BATCHES = 4  # of photons of a difference
_SURE = 3.0  # standard errors by which a slope has to differ from the wide one
_ONE_SIDED = 0.5  # ratio of the slopes of both sides: below, the flatter one decides


@dataclass(frozen=True, eq=False)
class Local:
    """A solution with the slope by the depth where the depth is looked for.

    Attributes:
        solution: The step and its covariance.
        ratio: The depth's slope over that of the renderer's wide difference; 1 where no difference was seen; 0 where
            it is not known how far the depth can move without a change of the counts.
    """

    solution: Solution
    ratio: float

    @property
    def bend(self) -> float:
        """How much of the step may be wrong because the slope changes."""
        return abs(1.0 - 1.0 / self.ratio) if self.ratio > 0.0 else 1.0

    def warnings(self, scene: Scene) -> list[str]:
        """Sentences on light that lies in few bins."""
        if _STRAIGHT < self.ratio < 1.0 / _STRAIGHT:
            return []
        bin_width, depth = scene.gate.bin_width_ps, 1e3 * bin_depth(scene)
        error = (
            ""
            if self.ratio > 0.0
            else f", and its standard error is that of a place anywhere in a bin of {depth:.2g} mm"
        )
        return [
            f"depth: before the instrument response, most light of a pixel lies in one or two bins of {bin_width:.4g} "
            f"ps; the counts follow the depth only as this light crosses the edges of bins{error}. The depth of "
            f"measured counts may be off by a part of {depth:.2g} mm: choose narrower bins"
        ]


def bin_depth(scene: Scene) -> float:
    """How much deeper a target is whose light comes a bin later [m]."""
    return 0.5 * scene.medium.pulse_speed * scene.gate.bin_width


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
    least = _LEAST * 0.5 * render.scene.medium.pulse_speed * render.scene.gate.stop

    def interval(found: Solution) -> float:
        return max(NORMAL_95 * math.sqrt(max(found.covariance[row, row], 0.0)), least)

    def slopes(shift: float, step: float) -> Floats:
        each = max(photons // _BATCHES, 1)
        found = np.empty((_BATCHES, *scales.shape))
        batches = render.depth_slopes(values, shift=shift, step=step, photons=each, batches=_BATCHES)
        for batch, rows in zip(found, batches, strict=True):
            counts = law.slopes(rates, rows[:, None], trials)
            batch[:] = np.matmul(equations.weights, counts.transpose(0, 2, 1))[..., 0] * scales
        return found * scales[:, column, None]

    def share(slope: Floats) -> Floats:
        shares: Floats = slope[..., column].sum(axis=-1) / wide
        return shares

    wide, step = equations.slope[:, column, column].sum(), interval(solution)
    if not step < _WIDE * render.depth_step:
        return Local(solution, 1.0)
    for _ in range(_TRIES):
        batches = slopes(0.0, step)
        shares = share(batches)
        if abs(shares.mean() - 1.0) < _SURE * shares.std(ddof=1) / math.sqrt(_BATCHES):
            return Local(solution, 1.0)
        flat, steep = sorted((slopes(side * step / 2, step / 2).mean(axis=0) for side in (-1.0, 1.0)), key=share)
        slope = equations.slope.copy()
        slope[:, :, column] = flat if share(flat) < _ONE_SIDED * share(steep) else batches.mean(axis=0)
        ratio = float(slope[:, column, column].sum() / wide)
        local = Local(solve(replace(equations, slope=slope)), ratio) if ratio > 0.0 else None
        needed = math.inf if local is None else interval(local.solution)
        if local is not None and (step / _CONSISTENT < needed < step * _CONSISTENT or needed == step == least):
            return local
        step = min(needed, _LARGEST * step)
        if not step < _WIDE * render.depth_step:
            break
    covariance = solution.covariance.copy()
    covariance[row, row] += bin_depth(render.scene) ** 2 / 6.0
    return Local(replace(solution, covariance=covariance), 0.0)
