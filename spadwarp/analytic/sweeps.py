"""Photon budgets over range and water, and sweeps over any field of a scene: numbers before anything is simulated.

Built on the analytic model (`spadwarp.analytic.model`), whose limits hold here too: light scattered more than once is
left out, which in turbid water is most of the backscatter.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.model import Map, false_peaks, pixel_maps, response_sigma, warn_of_model
from spadwarp.analytic.result import simulate_analytic
from spadwarp.io.text import parse_toml
from spadwarp.result import Truth
from spadwarp.scene import Scene, SceneLike, as_scene, parse_override
from spadwarp.scene.sections import field_unit, locate, parse_key, takes_integers
from spadwarp.scene.sight import LinesOfSight, lines_of_sight, pixel_directions
from spadwarp.transport import truth_maps
from spadwarp.values import (
    ArgumentError,
    ConfigError,
    SpadwarpWarning,
    check_choice,
    check_integer,
    check_real,
    parse_number,
    quantity,
    shown,
)

__all__ = [
    "OUTLIERS",
    "TOLERANCE",
    "BudgetRow",
    "DepthErrorRow",
    "Sweep",
    "budget",
    "parse_values",
    "parse_vary",
    "sweep",
]

TOLERANCE = 0.01
"""Depth error of `pulses_for_1cm` [m]."""
OUTLIERS = 0.01
"""Largest probability of a false peak at which a bound counts as reached."""

_RANGES = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 50.0)
_LONGEST = 10_000  # most values of a budget or a sweep
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


@dataclass(frozen=True, kw_only=True)
class DepthErrorRow:
    """Summary of the depth frames of a scene; statistics run over the pixels that have an estimate."""

    sigma_depth: float  # median bound of depth [m]
    sigma_depth_p90: float  # 90th percentile of the bound [m]
    outlier_probability: float  # mean over pixels
    estimate_fraction: float  # pixels with an estimate over pixels with a target
    signal_to_backscatter: float  # median


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Curves over one field: `rows[i]` belongs to `values[i]`."""

    field: str
    values: tuple[Any, ...]
    rows: tuple[BudgetRow, ...] | tuple[DepthErrorRow, ...]

    @property
    def is_flat(self) -> bool:
        """Whether different values gave the same numbers throughout."""
        return len({repr(value) for value in self.values}) > 1 and len({repr(row) for row in self.rows}) == 1

    def column(self, name: str) -> NDArray[np.float64]:
        """One attribute of all rows."""
        return np.array([getattr(row, name) for row in self.rows], dtype=np.float64)


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


def sweep(
    scene: SceneLike,
    *,
    vary: str | tuple[str, Sequence[Any]],
    of: Literal["budget", "depth-error"] = "budget",
    device: str | None = None,
) -> Sweep:
    """The budget, or the error of depth frames, over any field of the scene.

    Args:
        scene: The scene.
        vary: `"medium.extinction=0.1:2:20"` (from, to, number of values), the same with `:log` at the end for a
            geometric progression, `"laser.pulse_energy=1 nJ,4 nJ"`, `"targets[0].translation[2]=5:15:11"`, or (field,
            values).
        of: `"budget"`: `BudgetRow` at the range of the target pixel nearest to the optical axis. `"depth-error"`:
            `DepthErrorRow` over all pixels.
        device: Warp device; default: the first GPU, else the CPU.

    Where no number depends on the field, or where light is polarised, which the model leaves out, a warning says so.

    Raises `ConfigError`: an unknown field, a value out of its range, a scene that the model does not cover;
    `ArgumentError`: `vary` or `of` not of the form above.
    """
    scene = as_scene(scene)
    row: Callable[[Scene, str | None], Any] = _central_row
    if check_choice("of", of, ("budget", "depth-error")) == "depth-error":
        row = _depth_error
    if isinstance(vary, str):
        field, values = parse_vary(vary)
    elif isinstance(vary, tuple | list) and len(vary) == 2 and isinstance(vary[1], Iterable):
        field, values = str(vary[0]), list(vary[1])
    else:
        raise ArgumentError(f"vary = {shown(vary)} is neither 'section.field=from:to:count' nor (field, values)")
    check_integer("number of values to vary", len(values), f"[1, {_LONGEST}]")
    rows = tuple(row(scene.with_overrides({field: value}), device) for value in values)
    curves = Sweep(field=field, values=tuple(values), rows=rows)
    if curves.is_flat:
        hint = ""
        if field == "detector.pulses_per_frame":
            hint = "; analytic.pulses_per_depth_frame or a count law per frame takes its place in this scene"
        warnings.warn(
            f"no number depends on {field}: the analytic model does not use it{hint}", SpadwarpWarning, stacklevel=2
        )
    return curves


# Rows


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
    scene: Scene, name: str | None, distances: Map, reflectance: float, device: str | None
) -> list[BudgetRow]:
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
    rows: list[BudgetRow] = []
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
            rows.append(
                BudgetRow(
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
            )
    return rows


def _central_row(scene: Scene, device: str | None) -> BudgetRow:
    warn_of_model(scene, stacklevel=4)
    truth = truth_maps(scene)
    pixel = central_pixel(scene, truth)
    return axis_rows(scene, None, np.array([float(truth.range[pixel])]), float(truth.reflectance[pixel]), device)[0]


def _depth_error(scene: Scene, device: str | None) -> DepthErrorRow:
    result = simulate_analytic(scene, frames=0, device=device)
    estimated = result.fisher > 0
    count, targets = np.count_nonzero(estimated), np.count_nonzero(~np.isnan(result.truth.depth))

    def over_pixels(values: Map, statistic: Callable[[Map], Any]) -> float:
        return float(statistic(values[estimated])) if count else math.nan

    return DepthErrorRow(
        sigma_depth=over_pixels(result.sigma_depth, np.median),
        sigma_depth_p90=over_pixels(result.sigma_depth, lambda values: np.quantile(values, 0.9)),
        outlier_probability=over_pixels(result.outlier_probability, np.mean),
        estimate_fraction=float(count / targets),
        signal_to_backscatter=over_pixels(result.signal_to_backscatter, np.median),
    )


def _distances(scene: Scene, ranges: Any) -> Map:
    lead = float(axis_line(scene).lead[0])
    if ranges is None:
        return np.array([x for x in _RANGES if x > lead] or [lead + x for x in _RANGES])
    if isinstance(ranges, str | bytes) or not isinstance(ranges, Iterable):
        raise ArgumentError(f"ranges = {shown(ranges)} is not a list of distances [m]")
    distances = sorted(check_real("ranges: an item", item, "[1e-6, 1e6] m") for item in ranges)
    check_integer("number of ranges", len(distances), f"[1, {_LONGEST}]")
    if distances[0] <= lead:
        raise ArgumentError(f"ranges: {distances[0]:g} m is not beyond the camera's port, which ends at {lead:g} m")
    return np.array(distances)


def _pulses_needed(scene: Scene, maps: Mapping[str, Map], background: Map, gate: float, device: str | None) -> Map:
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


# Values to vary


def parse_vary(text: str) -> tuple[str, list[Any]]:
    """Field and values of `field=from:to:count`, `field=from:to:count:log` or `field=a,b,c`; raises `ArgumentError`.

    Values may have units, such as `laser.pulse_energy=1 nJ:1 µJ:7:log`, and become numbers of the field's own unit. Of
    a field of integers they are whole, each once.
    """
    field, equals, spec = (part.strip() for part in text.partition("="))
    if not field or not equals or not spec:
        raise ArgumentError(f"vary = {shown(text)} is not of the form section.field=from:to:count")
    info = locate(Scene, parse_key(field))[1]
    unit = field_unit(info) if info is not None else None
    values = parse_values(spec, unit, name=f"vary: {field}")
    if ":" in spec and info is not None and takes_integers(info):
        values = list(dict.fromkeys(round(value) for value in values))
    return field, values


def parse_values(text: str, unit: str | None, *, name: str) -> list[Any]:
    """Values of `from:to:count`, `from:to:count:log` or `a,b,c`, of which those with units become numbers of `unit`.

    Raises `ArgumentError`, which begins with `name`.
    """
    if ":" not in text:
        try:
            values = parse_toml(f"values = [{text}]")["values"]
        except ConfigError:  # bare words
            values = [parse_override(f"a.b={value}")[1] if value.strip() else "" for value in text.split(",")]
        if not values or "" in values:
            raise ArgumentError(f"{name} = {shown(text)} lacks a value")
        return [_number(value, unit, name) for value in values]
    parts = text.split(":")
    geometric = len(parts) == 4 and parts[3] == "log"
    try:
        low, high = (float(_number(part.strip(), unit, name)) for part in parts[:2])
        count = parse_number(parts[2])
        if len(parts) > 3 + geometric or not math.isfinite(high - low) or (geometric and not min(low, high) > 0):
            raise ValueError
    except ArgumentError:
        raise
    except (ValueError, IndexError):
        raise ArgumentError(
            f"{name} = {shown(text)} is not of the form from:to:count, with :log only for positive ends"
        ) from None
    whole = int(count) if float(count).is_integer() and abs(count) < 1e15 else count
    fewest = 1 if low == high else 2
    count = check_integer(f"{name} = {shown(text)}: the number of values", whole, f"[{fewest}, {_LONGEST}]")
    return [float(value) for value in (np.geomspace if geometric else np.linspace)(low, high, count)]


def _number(value: Any, unit: str | None, name: str) -> Any:
    """A text that is a number, or begins like one with a unit, as a number of that unit; all else as it is."""
    if not isinstance(value, str):
        return value
    try:
        return parse_number(value)
    except ValueError:
        if unit is None or not value.lstrip("+-.")[:1].isdigit():
            return value
    try:
        return quantity(value, unit)
    except ValueError as error:
        raise ArgumentError(f"{name}: {shown(value)} {error}") from None
