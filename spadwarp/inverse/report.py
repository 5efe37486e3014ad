"""From the last step of a fit to what its user sees."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.frames.spad import LIMIT
from spadwarp.inverse.estimates import NORMAL_95, Estimate, EstimateMap, Fit, Iteration, not_identifiable
from spadwarp.inverse.unknowns import DEPTH, Unknown, with_values
from spadwarp.units import percent

if TYPE_CHECKING:
    from spadwarp.inverse.exposure import Exposure
    from spadwarp.inverse.solving import Solution
    from spadwarp.result import Truth
    from spadwarp.scene import Scene

__all__ = ["estimates_of", "middle_depth"]

Floats = NDArray[np.float64]


def middle_depth(depth: NDArray[np.floating]) -> float:
    """Depth in the pixel nearest to the middle of the image that sees a target [m]; 0 without any."""
    rows, columns = np.nonzero(np.isfinite(depth))
    if not rows.size:
        return 0.0
    height, width = depth.shape
    nearest = np.argmin((rows - 0.5 * (height - 1)) ** 2 + (columns - 0.5 * (width - 1)) ** 2)
    return float(depth[rows[nearest], columns[nearest]])


def estimates_of(
    *,
    scene: Scene,
    unknowns: Sequence[Unknown],
    values: Mapping[str, Any],
    start: Mapping[str, float],
    solution: Solution,
    scales: Floats,
    iterations: Sequence[Iteration],
    converged: bool,
    prior: Mapping[str, tuple[float, float]],
    exposure: Exposure,
    expected: NDArray[np.float32],
    truth: Truth,
    edges: Floats,
    photons: int,
    seconds: float,
    warnings: Sequence[str] = (),
) -> Fit:
    """The fit from its last values and the solution of its equations there; `warnings`: of the renderer."""
    image = (scene.camera.height, scene.camera.width)
    fitted = with_values(scene, {name: float(np.nanmean(value)) for name, value in values.items()})
    middle = middle_depth(truth.depth)
    shared = [one for one in unknowns if not one.per_pixel]
    estimates, maps = {}, {}
    for row, one in enumerate(shared):
        offset = middle if one.name == DEPTH else 0.0
        variance = solution.covariance[row, row]
        simulation = solution.simulation[row, row] / variance if variance > 0 else math.nan
        estimates[one.name] = _estimate(
            one, values[one.name] + offset, math.sqrt(max(variance, 0.0)), simulation, start[one.name] + offset
        )
    for column, one in enumerate([one for one in unknowns if one.per_pixel]):
        error = np.sqrt(np.maximum(solution.own_covariance[:, column, column], 0.0))
        unknown = np.isnan(solution.own[:, column])
        position = list(unknowns).index(one)
        value = np.where(unknown, np.nan, np.asarray(values[one.name], np.float64)).reshape(image)
        maps[one.name] = EstimateMap(
            name=one.name,
            value=value + truth.depth if one.name == DEPTH else value,
            standard_error=(error * scales[:, position]).reshape(image),
            unit=one.unit,
        )
    depth = None
    if DEPTH in estimates:
        depth = truth.depth + values[DEPTH]
    elif DEPTH in maps:
        depth = maps[DEPTH].value
    names = [one.name for one in shared]
    assert exposure.counts is not None
    return Fit(
        scene=fitted,
        estimates=estimates,
        maps=maps,
        names=names,
        covariance=solution.covariance,
        iterations=tuple(iterations),
        converged=converged,
        warnings=(*warnings, *_of_simulated(exposure), *_warnings(names, solution, shared, prior, converged)),
        depth=depth,
        counts=exposure.counts.reshape(*image, -1),
        expected=expected.reshape(*image, -1),
        edges=edges,
        pulses=exposure.pulses,
        photons=photons,
        seconds=seconds,
    )


def _estimate(one: Unknown, value: float, error: float, simulation: float, start: float) -> Estimate:
    """`error` is of the logarithm for positive values."""
    if one.is_positive:
        factor = math.exp(min(NORMAL_95 * error, 700.0))
        interval, error = (value / factor, value * factor), error * value
    else:
        interval = (value - NORMAL_95 * error, value + NORMAL_95 * error)
    return Estimate(
        name=one.name,
        value=value,
        standard_error=error,
        interval=interval,
        simulation=simulation,
        start=start,
        unit=one.unit,
    )


def _of_simulated(exposure: Exposure) -> tuple[str, ...]:
    """A warning where simulated counts hold more noise than their photons have."""
    noise = exposure.monte_carlo_noise
    if noise is None or noise <= LIMIT:
        return ()
    return (
        f"the counts are simulated, and the simulation traced too few photons for {exposure.pulses} pulses: its noise, "
        f"the same in every frame, is {noise:.2g} times the shot noise of the counts (95th percentile of the pixels); "
        f"the standard errors do not contain it. {math.ceil((noise / LIMIT) ** 2)} times the photons would make it "
        f"{LIMIT:g}",
    )


def _warnings(
    names: Sequence[str],
    solution: Solution,
    shared: Sequence[Unknown],
    prior: Mapping[str, tuple[float, float]],
    converged: bool,
) -> tuple[str, ...]:
    found = []
    if not converged:
        found.append("not converged: the last step still promised more likelihood than the noise of the counts")
    if solution.simulation_share > 0.1:
        found.append(
            f"the noise of the simulation is {percent(solution.simulation_share)} % of that of the counts in the "
            "variances, above 10 %: give more photons; the standard errors contain it"
        )
    free = [name not in prior for name in names]
    found += not_identifiable(names, solution.covariance, [one.is_positive for one in shared]) if any(free) else []
    return tuple(found)
