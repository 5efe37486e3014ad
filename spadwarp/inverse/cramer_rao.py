"""Cramér–Rao bounds of everything that is unknown in a scene, from one exposure, with correlations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spadwarp.arrays import Floats
from spadwarp.inverse.equations import pseudo_inverse
from spadwarp.inverse.exposure import Exposure
from spadwarp.inverse.fitting import BATCHES, SIMULATION, Fitter, Joint, Prior, State
from spadwarp.inverse.unknowns import BACKGROUND, DEPTH, scene_value
from spadwarp.scene import SceneLike, as_scene
from spadwarp.values import check_integer, percent

__all__ = ["Bound", "Bounds", "bounds"]


@dataclass(frozen=True, kw_only=True)
class Bound:
    """Bound of one unknown; of an unknown of each pixel, the median of the pixels that see a target."""

    name: str  # of the unknown
    value: float  # in the scene; depth counts from where the targets are
    standard_error: float  # least standard deviation of an unbiased estimate when all unknowns are unknown
    alone: float  # the same when all others are known
    relative: float  # `standard_error` over the value; NaN for depth
    per_pixel: bool  # whether each pixel has a value of its own. The median of the background is that of all pixels.
    unit: str  # of the value


@dataclass(frozen=True, eq=False, kw_only=True)
class Bounds(Joint):
    """Cramér–Rao bounds of unknowns together.

    Attributes:
        names, covariance: Of the unknowns of the whole exposure, `[S, S]`: the inverse of their Fisher information when
            those of the pixels are unknown too; on the scale of the logarithm for positive values.
        pulses, photons: Of the exposure; traced.
        warnings: What may mislead, in words.
    """

    bounds: Mapping[str, Bound]  # by name
    maps: Mapping[str, Floats]  # by name the bound of each pixel `[H, W]`, NaN where the counts say nothing of it
    alone_maps: Mapping[str, Floats]  # the same when all other unknowns are known
    counts: float  # expected in the exposure
    simulation: float
    """Variance that the noise of the simulation would add to a fit with these photons, over that of the counts; the
    bounds are right within about its half."""

    def to_dict(self) -> dict[str, Any]:
        """The numbers without maps, for JSON."""
        bounds = {name: vars(item) for name, item in self.bounds.items()}
        return {"bounds": bounds, **super().to_dict(), "counts": self.counts, "simulation": self.simulation}


def bounds(
    scene: SceneLike,
    *,
    unknown: str | Sequence[str],
    pulses: int | None = None,
    prior: Prior | None = None,
    photons: int | None = None,
    seed: int = 0,
    device: str | None = None,
) -> Bounds:
    """Cramér–Rao bounds of unknowns of a scene from one exposure, all of them together.

    F = Σ dm dmᵀ / var over pixels and bins, m the mean counts with instrument response, noise and pile-up or dead time.
    Products are of two independent halves of the photons: the noise of the simulation does not count as information.
    The photons are doubled until it is below a tenth of the counts' variance, or there are no more.

    Args:
        scene: With values for everything.
        unknown: Names, as `spadwarp.inverse.read_unknowns` takes them: "absorption,scattering,depth:pixel".
        pulses: Of the exposure; by default the scene's `detector.pulses_per_frame`.
        prior: By name what is known from elsewhere: mean (not used) and standard deviation.
        photons: To trace at most; by default 2e7 on the CPU, 4e8 on a GPU.
        seed: 64 bits.
        device: As in `simulate`.

    Raises:
        ArgumentError: Unknowns or numbers that do not fit.
        ConfigError: A scene or a detector that the model does not cover.
    """
    scene = as_scene(scene)
    pulses = scene.detector.pulses_per_frame if pulses is None else check_integer("pulses", pulses, "[1, 1e15]")
    plan = Exposure(counts=None, pulses=pulses, window=(scene.gate.start, scene.gate.bins))
    fitter = Fitter(scene, unknown, plan, prior=prior, photons=photons, seed=seed, device=device)
    render, law, most = fitter.render, fitter.law, fitter.photons
    state = State({item.name: scene_value(scene, item) for item in fitter.unknowns}, [])
    number, level = max(most // 8, 8000), None
    while True:
        halves = render(state.values, photons=max(number // (2 * BATCHES), 1), batches=BATCHES)
        level, equations, solution = fitter.solve(state, halves, None, level)
        share = solution.simulation_share
        if share <= SIMULATION or 2 * number > most:
            break
        number = min(most, int(number * max(2.0, min(share / (0.8 * SIMULATION), 16.0))))
    assert render.truth is not None
    seen = np.isfinite(render.truth.depth)  # others have light that water has scattered: a bound that nobody asks for
    covariance = pseudo_inverse(solution.information)
    information = np.einsum("pii->pi", equations.slope)
    rows: dict[str, Bound] = {}
    maps, alone_maps = {}, {}
    for i, item in enumerate(fitter.unknowns):
        scale, value = float(state.scale(item)), float(state.values[item.name])
        if item.per_pixel:
            column = fitter.own.index(item)
            with np.errstate(divide="ignore", invalid="ignore"):
                together = np.sqrt(solution.pixel_bound[:, column, column]) * scale
                alone_map = scale / np.sqrt(np.where(information[:, i] > 0, information[:, i], np.nan))
            maps[item.name], alone_maps[item.name] = together.reshape(seen.shape), alone_map.reshape(seen.shape)
            counted = slice(None) if item.name == BACKGROUND or not seen.any() else seen.reshape(-1)
            error, alone = (float(np.nanmedian(part[counted])) for part in (together, alone_map))
        else:
            row, total = fitter.shared.index(item), float(information[:, i].sum())
            error = math.sqrt(max(float(covariance[row, row]), 0.0)) * scale
            alone = scale / math.sqrt(total) if total > 0 else math.inf
        rows[item.name] = Bound(
            name=item.name,
            value=value,
            standard_error=error,
            alone=alone,
            relative=error / value if item.name != DEPTH and value else math.nan,
            per_pixel=item.per_pixel,
            unit=item.unit,
        )
    found = Bounds(
        bounds=rows,
        names=[item.name for item in fitter.shared],
        covariance=covariance,
        maps=maps,
        alone_maps=alone_maps,
        counts=float(law.mean(halves[0].rates, law.planned(halves[0].rates, pulses)).sum()),
        pulses=pulses,
        photons=render.photons,
        simulation=share,
        warnings=(),
    )
    in_logarithm = [state.values[name] > 0 and name != DEPTH for name in found.names]
    warnings = render.warnings() + found.not_identifiable(in_logarithm)
    if share > SIMULATION:
        warnings.append(
            f"the noise of the simulation is {percent(share)} % of that of the counts in the variances, above 10 %; "
            f"{render.photons * share / SIMULATION:.1e} photons would do"
        )
    return replace(found, warnings=tuple(warnings))
