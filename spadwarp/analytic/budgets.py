"""Photon budgets: a pixel on the optical axis over range and water, before anything is simulated.

Built on the analytic model (`spadwarp.analytic.model`), whose limits hold here too: light scattered more than once is
left out, which in turbid water is most of the backscatter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spadwarp.analytic.model import false_peaks, pixel_maps, response_sigma, warn_of_model
from spadwarp.arrays import Floats
from spadwarp.result import Truth
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.sight import LinesOfSight, lines_of_sight
from spadwarp.transport import truth_maps
from spadwarp.values import ArgumentError, ConfigError, check_integer, check_real, shown

__all__ = ["OUTLIERS", "TOLERANCE", "BudgetRow", "budget"]

TOLERANCE = 0.01
"""Depth error of `pulses_for_1cm` [m]."""
OUTLIERS = 0.01
"""Largest probability of a false peak at which a bound counts as reached."""

_RANGES = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 50.0)
LONGEST = 10_000  # most values of a budget or a sweep
_FROM_MAPS = ("arrival", "signal", "alpha", "signal_to_backscatter", "sigma_time", "sigma_depth", "outlier_probability")


@dataclass(frozen=True, kw_only=True)
class BudgetRow:
    """A pixel on the optical axis and a face square to it."""

    medium: str  # name of the water
    extinction: float  # [1/m]
    range: float  # distance of the face, behind a port the length of the bent ray [m]
    optical_depth: float  # attenuation lengths of the way in the water, one way
    gate_start: float  # [s]; the scene's gate where all ranges fall into it, else one as long around the return
    gate_stop: float  # [s]
    gate_moved: bool  # whether it is not the scene's
    pulses: float
    """Of one depth frame, for which the bound holds: `Scene.pulses_per_depth_frame`, or those of `analytic.frames`
    detector frames with a count law per frame."""
    arrival: float  # of the return [s]
    signal: float  # S, detections of the return per pulse
    background: float  # detections of backscatter, dark counts and ambient light per pulse within the gate
    alpha: float  # all detections per pulse within the gate
    signal_to_backscatter: float  # both per pulse within the gate
    sigma_time: float  # Cramér–Rao bound of a depth frame [s]; NaN: no estimate
    sigma_depth: float  # the same in depth [m]
    outlier_probability: float  # of a false peak
    pulses_for_1cm: float  # until the bound is 1 cm and less than 1 % of the fits are outliers; infinite beyond 1e18


def budget(
    scene: SceneLike,
    ranges: Iterable[float] | None = None,
    media: Iterable[str] | Mapping[str, Mapping[str, Any]] | None = None,
    *,
    reflectance: float | None = None,
    device: str | None = None,
) -> list[BudgetRow]:
    """Signal, background, depth error and pulses needed for 1 cm, over water and range.

    Args:
        scene: Laser, camera, detector, gate and `[analytic]` settings are taken from it; the target's shape is not.
        ranges: Distances on the optical axis [m], 1e-6 to 1e6; default 1 to 50 m. Behind a port they are lengths of
            the ray that it bends, and must be beyond it.
        media: Names of presets, or name → fields of `[medium]`; default: the scene's water alone.
        reflectance: Of the face, in [0, 1]; default: the number that the scene's first target has, else 0.5.
        device: Warp device; default: the first GPU, else the CPU.

    Returns a row for each water and range, in this order. A warning says where light is polarised, which the model
    leaves out. Raises `ConfigError`: a water or scene that the model does not cover; `ArgumentError`: ranges or
    reflectance out of range.
    """
    scene = as_scene(scene)
    distances = _distances(scene, ranges)
    reflectance = check_real("reflectance", face_reflectance(scene) if reflectance is None else reflectance, "[0, 1]")
    if scene.analytic.backscatter == "monte_carlo":
        raise ConfigError("analytic.backscatter = 'monte_carlo' belongs to one range; a budget takes 'single_scatter'")
    warn_of_model(scene)
    scenes: list[tuple[str | None, Scene]] = [(None, scene)]
    if media is not None:
        names = [media] if isinstance(media, str) else media
        waters = media if isinstance(media, Mapping) else {name: {"preset": name} for name in names}
        scenes = [(name, scene.with_overrides(medium=fields)) for name, fields in waters.items()]
    return [row for name, water in scenes for row in axis_rows(water, name, distances, reflectance, device)]


def axis_line(scene: Scene) -> LinesOfSight:
    """The line of sight of the optical axis, `[1]`."""
    return lines_of_sight(scene, np.array([[0.0, 0.0, 1.0]]))


def face_reflectance(scene: Scene) -> float:
    """The number that the scene's first target has as its reflectance, else 0.5."""
    reflectance = scene.targets[0].reflectance if scene.targets else 0.5
    return 0.5 if isinstance(reflectance, str) else reflectance


def central_pixel(scene: Scene, truth: Truth) -> tuple[Any, ...]:
    """Row and column of the target pixel nearest to the optical axis. Raises `ConfigError` without any."""
    hit = ~np.isnan(truth.depth)
    if not hit.any():
        raise ConfigError("no target is in view", source=scene.source)
    off_axis = np.where(hit, -pixel_directions(scene.camera)[..., 2], np.inf)
    return np.unravel_index(np.argmin(off_axis), off_axis.shape)


def axis_rows(
    scene: Scene, name: str | None, distances: Floats, reflectance: float, device: str | None
) -> Iterator[BudgetRow]:
    """A row for each distance on the optical axis [m], for the scene's water of that name."""
    gate = (scene.gate.start, scene.gate.stop)
    line, length = axis_line(scene), gate[1] - gate[0]
    arrival = np.array([line.path_from_range(distance)[0] for distance in distances]) / scene.medium.pulse_speed
    gates = [(gate, distances)]
    if not (gate[0] <= arrival.min() and arrival.max() <= gate[1]):
        starts = np.maximum(arrival - 0.5 * length, 0.0)
        gates = [((start, start + length), distances[i : i + 1]) for i, start in enumerate(starts)]
    chosen, pulses = scene.analytic, float(scene.pulses_per_depth_frame)
    if chosen.count_law != "per_pulse":
        pulses = chosen.frames * chosen.exposure * scene.laser.repetition_rate
    for (start, stop), inside in gates:
        maps, _ = pixel_maps(
            scene,
            view=np.tile([0.0, 0.0, 1.0], (inside.size, 1)),
            distance=inside,
            normal=-np.tile(line.direction, (inside.size, 1)),
            reflectance=np.full(inside.size, reflectance),
            device=device,
            gate=(start, stop),
        )
        background = maps["backscatter"] + (scene.detector.noise_rate + maps["daylight"]) * (stop - start)
        needed = _pulses_needed(scene, maps, background, stop - start, device)
        depths = (inside - line.lead[0]) * scene.medium.extinction
        if scene.medium.grid is not None:
            start_point = line.start[0].tolist()
            depths = np.array([scene.optical_depth(start_point, line.points([x])[0].tolist()) for x in inside])
        for i, (distance, depth) in enumerate(zip(inside, depths, strict=True)):
            yield BudgetRow(
                medium=name or scene.medium.preset or "scene",
                extinction=scene.medium.extinction,
                range=float(distance),
                optical_depth=float(depth),
                gate_start=start,
                gate_stop=stop,
                gate_moved=(start, stop) != gate,
                pulses=pulses,
                background=float(background[i]),
                pulses_for_1cm=float(needed[i]),
                **{field: float(maps[field][i]) for field in _FROM_MAPS},
            )


def central_row(scene: Scene, device: str | None) -> BudgetRow:
    warn_of_model(scene, stacklevel=4)
    truth = truth_maps(scene)
    pixel = central_pixel(scene, truth)
    distances, reflectance = np.array([float(truth.range[pixel])]), float(truth.reflectance[pixel])
    return next(axis_rows(scene, None, distances, reflectance, device))


def _distances(scene: Scene, ranges: Any) -> Floats:
    lead = float(axis_line(scene).lead[0])
    if ranges is None:
        return np.array([x for x in _RANGES if x > lead] or [lead + x for x in _RANGES])
    if isinstance(ranges, str | bytes) or not isinstance(ranges, Iterable):
        raise ArgumentError(f"ranges = {shown(ranges)} is not a list of distances [m]")
    distances = sorted(check_real("ranges: an item", item, "[1e-6, 1e6] m") for item in ranges)
    check_integer("number of ranges", len(distances), f"[1, {LONGEST}]")
    if distances[0] <= lead:
        raise ArgumentError(f"ranges: {distances[0]:g} m is not beyond the camera's port, which ends at {lead:g} m")
    return np.array(distances)


def _pulses_needed(scene: Scene, maps: Mapping[str, Floats], background: Floats, gate: float, device: Any) -> Floats:
    """Pulses until the bound of depth is within `TOLERANCE` and outliers are rarer than `OUTLIERS`; bisects ln N."""
    chosen, alpha = scene.analytic, maps["alpha"]
    per_acquisition = 1.0 if chosen.count_law == "per_pulse" else chosen.exposure * scene.laser.repetition_rate
    if chosen.count_law == "per_frame_lu2024":
        recorded = -np.expm1(per_acquisition * np.log1p(-np.minimum(alpha, 1 - 1e-16)))
    else:
        recorded = -np.expm1(-alpha * per_acquisition)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_per_time = maps["sigma_depth"] / maps["sigma_time"]
        enough = (depth_per_time / TOLERANCE) ** 2 / maps["fisher"]  # recorded photons
        share = np.maximum(alpha - background, 0.0) / alpha
        level = maps["background_level"] / alpha
    lengths = np.full_like(alpha, gate / response_sigma(scene))
    low, high = np.zeros_like(alpha), np.full_like(alpha, math.log(1e18))
    for _ in range(40):
        middle = 0.5 * (low + high)
        photons = np.exp(middle) * recorded
        reached = (photons >= enough) & (false_peaks(photons * share, photons * level, lengths, device) <= OUTLIERS)
        low, high = np.where(reached, low, middle), np.where(reached, middle, high)
    pulses = np.exp(high) * per_acquisition
    return np.where((maps["fisher"] > 0) & (high < math.log(1e18) * (1 - 1e-9)), pulses, np.inf)
