"""Cramér–Rao bounds of everything that is unknown in a scene, from one exposure, with correlations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.inverse.equations import planned_pulses
from spadwarp.inverse.estimates import correlations, not_identifiable
from spadwarp.inverse.exposure import Exposure
from spadwarp.inverse.fitting import BATCHES, PHOTONS, SIMULATION, checked_prior, detector_law
from spadwarp.inverse.rendering import Renderer
from spadwarp.inverse.solving import Solution
from spadwarp.inverse.unknowns import BACKGROUND, DEPTH, read_unknowns, start_value
from spadwarp.inverse.weighing import solved
from spadwarp.limits import SEED, check_integer
from spadwarp.scene import SceneLike, as_scene
from spadwarp.units import percent

if TYPE_CHECKING:
    from spadwarp.inverse.equations import Equations
    from spadwarp.inverse.unknowns import Unknown

__all__ = ["Bound", "Bounds", "bounds"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Bound:
    """Bound of one unknown; of an unknown of each pixel, the median of the pixels that see a target.

    Attributes:
        name, value, unit: The unknown and its value in the scene; depth counts from where the targets are.
        standard_error: Least standard deviation of an unbiased estimate when all unknowns are unknown.
        alone: The same when all others are known.
        relative: `standard_error` over the value; NaN for depth.
        per_pixel: Whether each pixel has a value of its own. The median of the background is that of all pixels.
    """

    name: str
    value: float
    standard_error: float
    alone: float
    relative: float
    per_pixel: bool
    unit: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Bounds:
    """Cramér–Rao bounds of unknowns together.

    Attributes:
        bounds: By name.
        names, covariance: Of the unknowns of the whole exposure, `[S, S]`: the inverse of their Fisher information when
            those of the pixels are unknown too; on the scale of the logarithm for positive values.
        maps: By name the bound of each pixel `[H, W]`, NaN where the counts say nothing of it.
        alone_maps: The same when all other unknowns are known.
        counts: Expected in the exposure.
        pulses, photons: Of the exposure; traced.
        simulation: Variance that the noise of the simulation would add to a fit with these photons, over that of the
            counts; the bounds are right within about its half.
        warnings: What may mislead, in words.
    """

    bounds: Mapping[str, Bound]
    names: Sequence[str]
    covariance: Floats
    maps: Mapping[str, Floats]
    alone_maps: Mapping[str, Floats]
    counts: float
    pulses: int
    photons: int
    simulation: float
    warnings: Sequence[str]

    @property
    def correlation(self) -> Floats:
        """Correlations in the order of `names`."""
        return correlations(self.covariance)

    def to_dict(self) -> dict[str, Any]:
        """The numbers without maps, for JSON."""
        return {
            "bounds": {name: vars(one) for name, one in self.bounds.items()},
            "names": list(self.names),
            "covariance": self.covariance.tolist(),
            "correlation": self.correlation.tolist(),
            "counts": self.counts,
            "pulses": self.pulses,
            "photons": self.photons,
            "simulation": self.simulation,
            "warnings": list(self.warnings),
        }


def bounds(
    scene: SceneLike,
    *,
    unknown: str | Sequence[str],
    pulses: int | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
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
    from spadwarp.device import pick_device

    scene = as_scene(scene)
    unknowns = read_unknowns(scene, unknown)
    pulses = scene.detector.pulses_per_frame if pulses is None else check_integer("pulses", pulses, "[1, 1e15]")
    most = PHOTONS["cuda" if pick_device(device).is_cuda else "cpu"]
    most = most if photons is None else check_integer("photons", photons, "[1000, 1e12]")
    exposure = Exposure(counts=None, pulses=pulses, window=(scene.gate.start, scene.gate.bins))
    render = Renderer(scene, unknowns, exposure, device=device, seed=check_integer("seed", seed, SEED))
    law = detector_law(scene.detector, render.window)
    values: dict[str, Any] = {one.name: start_value(scene, one) for one in unknowns}
    given = checked_prior(prior or {}, unknowns)
    in_logarithm = [one.is_positive and values[one.name] > 0 for one in unknowns]
    scales = np.array([values[one.name] if log else 1.0 for one, log in zip(unknowns, in_logarithm, strict=True)])
    shared = [one for one in unknowns if not one.per_pixel]
    information = np.array([_known(one, given, values) for one in shared])
    number, level, image = max(most // 8, 8000), None, (scene.camera.height, scene.camera.width)
    while True:
        halves = render(values, photons=max(number // (2 * BATCHES), 1), batches=BATCHES)
        level, own, solution = solved(
            unknowns,
            np.broadcast_to(scales, (image[0] * image[1], len(unknowns))),
            level=level,
            image=image,
            prior=(np.zeros_like(information), information),
            law=law,
            halves=halves,
            trials=None,
            counts=None,
            pulses=pulses,
        )
        if solution.simulation_share <= SIMULATION or 2 * number > most:
            break
        number = min(most, int(number * max(2.0, min(solution.simulation_share / (0.8 * SIMULATION), 16.0))))
    mean = law.mean(halves[0].rates, planned_pulses(law, halves[0].rates, pulses))
    assert render.truth is not None
    found, maps, alone_maps = _table(unknowns, values, scales, own, solution, np.isfinite(render.truth.depth))
    covariance = _inverse(solution.information)
    names = [one.name for one in shared]
    warnings = render.warnings() + not_identifiable(
        names, covariance, [values[name] > 0 and name != DEPTH for name in names]
    )
    if solution.simulation_share > SIMULATION:
        share = percent(solution.simulation_share)
        warnings.append(f"the noise of the simulation is {share} % of that of the counts, above 10 %: more photons")
    return Bounds(
        bounds=found,
        names=names,
        covariance=covariance,
        maps=maps,
        alone_maps=alone_maps,
        counts=float(mean.sum()),
        pulses=pulses,
        photons=render.photons,
        simulation=solution.simulation_share,
        warnings=tuple(warnings),
    )


def _known(one: Unknown, prior: Mapping[str, tuple[float, float]], values: Mapping[str, Any]) -> float:
    """Information of a prior on the scale of the covariance."""
    if one.name not in prior:
        return 0.0
    return (float(values[one.name] if one.is_positive and values[one.name] > 0 else 1.0) / prior[one.name][1]) ** 2


def _inverse(information: Floats) -> Floats:
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    return np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-9) / np.outer(scale, scale)


def _table(
    unknowns: Sequence[Unknown],
    values: Mapping[str, Any],
    scales: Floats,
    own: Equations,
    solution: Solution,
    seen: NDArray[np.bool_],
) -> tuple[dict[str, Bound], dict[str, Floats], dict[str, Floats]]:
    """Bounds by name, and maps of those of the pixels: with all unknown, and with all others known.

    `seen` `[H, W]`: where a target is. Other pixels have light of the targets that the water has scattered, and so a
    bound, but it is not what one asks for.
    """
    covariance = _inverse(solution.information)
    blocks = np.einsum("pii->pi", own.slope)
    bounds, maps, alone_maps = {}, {}, {}
    row = column = 0
    for i, one in enumerate(unknowns):
        if one.per_pixel:
            with np.errstate(divide="ignore", invalid="ignore"):
                together = np.sqrt(solution.own_bound[:, column, column]) * scales[i]
                alone_map = scales[i] / np.sqrt(np.where(blocks[:, i] > 0, blocks[:, i], np.nan))
            maps[one.name], alone_maps[one.name] = together.reshape(seen.shape), alone_map.reshape(seen.shape)
            rows = slice(None) if one.name == BACKGROUND or not seen.any() else seen.reshape(-1)
            error, alone = (float(np.nanmedian(part[rows])) for part in (together, alone_map))
            column += 1
        else:
            total = float(blocks[:, i].sum())
            error = math.sqrt(max(float(covariance[row, row]), 0.0)) * scales[i]
            alone = scales[i] / math.sqrt(total) if total > 0 else math.inf
            row += 1
        value = float(values[one.name])
        bounds[one.name] = Bound(
            name=one.name,
            value=value,
            standard_error=float(error),
            alone=float(alone),
            relative=float(error) / value if one.name != DEPTH and value else math.nan,
            per_pixel=one.per_pixel,
            unit=one.unit,
        )
    return bounds, maps, alone_maps
