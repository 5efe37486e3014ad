"""Photon budgets: what a lidar gets back over range and water, before anything is simulated.

Built on the analytic model (`spadwarp.analytic.model`), whose limits hold here too: light scattered more than once is
left out, which in turbid water is most of the backscatter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spadwarp.analytic.model import Map, pixel_maps, response_sigma, warn_of_model
from spadwarp.device import pick_device
from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.limits import check_integer, check_real, shown
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.sight import LinesOfSight, lines_of_sight

__all__ = ["LONGEST", "OUTLIERS", "TOLERANCE", "BudgetRow", "axis_rows", "budget"]

RANGES = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 50.0)
LONGEST = 10_000
"""Most values of a budget or a sweep."""
TOLERANCE = 0.01
"""Depth error of `pulses_for_1cm` [m]."""
OUTLIERS = 0.01
"""Largest probability of a false peak at which a bound counts as reached."""


@dataclass(frozen=True, kw_only=True)
class BudgetRow:
    """A pixel on the optical axis and a face square to it.

    Attributes:
        medium: Name of the water.
        extinction: [1/m].
        range: Distance of the face, behind a port the length of the bent ray [m].
        optical_depth: Attenuation lengths of the way in the water, one way.
        gate_start, gate_stop: The gate [s]: the scene's where all ranges fall into it, else one of the same length
            around the return.
        gate_moved: Whether it is not the scene's.
        pulses: Of one depth frame, for which the bound holds: `Scene.pulses_per_depth_frame`, or those of
            `analytic.frames` detector frames with a count law per frame.
        arrival: Of the return [s].
        signal: S, detections of the return per pulse.
        background: Detections of backscatter, dark counts and ambient light per pulse within the gate.
        alpha: All detections per pulse within the gate.
        signal_to_backscatter: Both per pulse within the gate.
        sigma_time: Cramér–Rao bound of a depth frame [s]; NaN: no estimate.
        sigma_depth: The same in depth [m].
        outlier_probability: Of a false peak.
        pulses_for_1cm: Pulses until the bound is 1 cm and less than 1 % of the fits are outliers; infinite beyond 1e18.
    """

    medium: str
    extinction: float
    range: float
    optical_depth: float
    gate_start: float
    gate_stop: float
    gate_moved: bool
    pulses: float
    arrival: float
    signal: float
    background: float
    alpha: float
    signal_to_backscatter: float
    sigma_time: float
    sigma_depth: float
    outlier_probability: float
    pulses_for_1cm: float


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

    Returns:
        A row for each water and range, in this order. A warning says where light is polarised, which the model leaves
        out.

    Raises:
        ConfigError: A water or scene that the model does not cover.
        ArgumentError: Ranges or reflectance out of range.
    """
    scene = as_scene(scene)
    distances = _distances(scene, ranges)
    if reflectance is None:
        given = scene.targets[0].reflectance if scene.targets else 0.5
        reflectance = 0.5 if given == "from_file" else given
    reflectance = check_real("reflectance", reflectance, "[0, 1]")
    if scene.analytic.backscatter == "monte_carlo":
        raise ConfigError("analytic.backscatter = 'monte_carlo' belongs to one range; a budget takes 'single_scatter'")
    warn_of_model(scene)
    rows: list[BudgetRow] = []
    for name, changed in _waters(scene, media):
        rows += axis_rows(changed, name, distances, reflectance, device)
    return rows


def _distances(scene: Scene, ranges: Any) -> Map:
    lead = float(axis_line(scene).lead[0])
    if ranges is None:
        return np.array([one for one in RANGES if one > lead] or [lead + one for one in RANGES])
    if isinstance(ranges, str | bytes) or not isinstance(ranges, Iterable):
        raise ArgumentError(f"ranges = {shown(ranges)} is not a list of distances [m]")
    distances = sorted(check_real("ranges: an item", one, "[1e-6, 1e6] m") for one in ranges)
    check_integer("number of ranges", len(distances), f"[1, {LONGEST}]")
    if distances[0] <= lead:
        raise ArgumentError(f"ranges: {distances[0]:g} m is not beyond the camera's port, which ends at {lead:g} m")
    return np.array(distances)


def _waters(scene: Scene, media: Iterable[str] | Mapping[str, Mapping[str, Any]] | None) -> Iterable[tuple[str, Scene]]:
    if media is None:
        yield scene.medium.preset or "scene", scene
    elif isinstance(media, Mapping):
        for name, fields in media.items():
            yield name, scene.with_overrides(medium=fields)
    else:
        for name in [media] if isinstance(media, str) else media:
            yield name, scene.with_overrides(medium={"preset": name})


def axis_line(scene: Scene) -> LinesOfSight:
    """The line of sight of the optical axis, `[1]`."""
    return lines_of_sight(scene, np.array([[0.0, 0.0, 1.0]]))


def axis_rows(scene: Scene, name: str, distances: Map, reflectance: float, device: str | None) -> list[BudgetRow]:
    """A row for each distance on the optical axis [m], for the scene's water of that name."""
    gate = (scene.gate.start, scene.gate.stop)
    line = axis_line(scene)
    arrival = np.array([line.path_from_range(one)[0] for one in distances]) / scene.medium.pulse_speed
    if gate[0] <= arrival.min() and arrival.max() <= gate[1]:
        gates = [(gate, distances)]
    else:
        length = gate[1] - gate[0]
        starts = np.maximum(arrival - 0.5 * length, 0.0)
        gates = [((start, start + length), distances[i : i + 1]) for i, start in enumerate(starts)]
    chosen = scene.analytic
    pulses = float(scene.pulses_per_depth_frame)
    if chosen.count_law != "per_pulse":
        pulses = chosen.frames * chosen.exposure * scene.laser.repetition_rate
    rows: list[BudgetRow] = []
    for (start, stop), inside in gates:
        axis = np.tile([0.0, 0.0, 1.0], (inside.size, 1))
        maps, _ = pixel_maps(
            scene,
            view=axis,
            distance=inside,
            normal=-np.tile(line.direction, (inside.size, 1)),
            reflectance=np.full(inside.size, reflectance),
            device=device,
            gate=(start, stop),
        )
        background = maps["backscatter"] + (scene.detector.noise_rate + maps["daylight"]) * (stop - start)
        needed = _pulses_needed(scene, maps, background, stop - start, device)
        for i, distance in enumerate(inside):
            rows.append(
                BudgetRow(
                    medium=name,
                    extinction=scene.medium.extinction,
                    range=float(distance),
                    optical_depth=_optical_depth(scene, line, float(distance)),
                    gate_start=start,
                    gate_stop=stop,
                    gate_moved=(start, stop) != gate,
                    pulses=pulses,
                    background=float(background[i]),
                    pulses_for_1cm=float(needed[i]),
                    **{field: float(maps[field][i]) for field in _FROM_MAPS},
                )
            )
    return rows


def _optical_depth(scene: Scene, line: LinesOfSight, distance: float) -> float:
    """Up to a distance on the axis, one way."""
    if scene.medium.grid is not None:
        return scene.optical_depth(line.start[0].tolist(), line.points([distance])[0].tolist())
    return float((distance - line.lead[0]) * scene.medium.extinction)


_FROM_MAPS = ("arrival", "signal", "alpha", "signal_to_backscatter", "sigma_time", "sigma_depth", "outlier_probability")


def _pulses_needed(scene: Scene, maps: Mapping[str, Map], background: Map, gate: float, device: str | None) -> Map:
    """Pulses until the bound of depth is within `TOLERANCE` and outliers are rarer than `OUTLIERS`; bisects ln N."""
    import warp as wp

    from spadwarp_kernels.analytic import outlier_probabilities

    target = pick_device(device)
    chosen = scene.analytic
    alpha, sigma = maps["alpha"], response_sigma(scene)
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

    def outliers(photons: Map) -> Map:
        arrays = (photons * share, photons * level, np.full_like(photons, gate / sigma))
        values: list[Any] = [wp.array(np.nan_to_num(array), dtype=wp.float64, device=target) for array in arrays]
        return outlier_probabilities(*values).numpy()

    low, high = np.zeros_like(alpha), np.full_like(alpha, math.log(1e18))
    for _ in range(40):
        middle = 0.5 * (low + high)
        photons = np.exp(middle) * recorded
        reached = (photons >= enough) & (outliers(photons) <= OUTLIERS)
        low, high = np.where(reached, low, middle), np.where(reached, middle, high)
    pulses = np.exp(high) * per_acquisition
    return np.where((maps["fisher"] > 0) & (high < math.log(1e18) * (1 - 1e-9)), pulses, np.inf)
