"""Photon budgets: what a lidar gets back over range, water and any field of the scene, before anything is simulated.

Built on the analytic model (`spadwarp.analytic.model`), whose limits hold here too: light scattered more than once is
left out, which in turbid water is most of the backscatter.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.model import pixel_maps, simulate_analytic
from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.scene.geometry import path_from_range, pixel_directions

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["BudgetRow", "DepthErrorRow", "Sweep", "budget", "parse_vary", "plot_budget", "plot_sweep", "sweep"]

RANGES = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 50.0)
TOLERANCE = 0.01  # [m], the depth error that `pulses_for_1cm` is about
OUTLIERS = 0.01  # of the fits may lock on background there


@dataclass(frozen=True, kw_only=True)
class BudgetRow:
    """A pixel on the optical axis and a face square to it.

    Attributes:
        medium: Name of the water.
        extinction: [1/m].
        range: Distance of the face [m].
        optical_depth: Attenuation lengths, one way.
        gate_start, gate_stop: The gate [s]: the scene's where all ranges fall into it, else one of the same length
            around the return.
        arrival: Of the return [s].
        signal: S, detections of the return per pulse.
        background: Detections of backscatter, dark counts and ambient light per pulse within the gate.
        alpha: All detections per pulse within the gate.
        signal_to_backscatter: Signal over backscatter.
        sigma_time: Cramér–Rao bound of a depth frame [s]; NaN: no estimate.
        sigma_depth: The same in depth [m].
        outlier_probability: That a fit locks on background instead.
        pulses_for_1cm: Pulses until the bound is 1 cm and less than 1 % of the fits are outliers; infinite beyond 1e18.
    """

    medium: str
    extinction: float
    range: float
    optical_depth: float
    gate_start: float
    gate_stop: float
    arrival: float
    signal: float
    background: float
    alpha: float
    signal_to_backscatter: float
    sigma_time: float
    sigma_depth: float
    outlier_probability: float
    pulses_for_1cm: float


@dataclass(frozen=True, kw_only=True)
class DepthErrorRow:
    """Depth frames of a scene in short; statistics run over the pixels that have an estimate.

    Attributes:
        sigma_depth: Median bound of depth [m].
        sigma_depth_p90: What 90 % of the pixels stay below [m].
        outlier_probability: Mean over pixels.
        estimate_fraction: Pixels with an estimate over pixels that see a target.
        signal_to_backscatter: Median signal over backscatter.
    """

    sigma_depth: float
    sigma_depth_p90: float
    outlier_probability: float
    estimate_fraction: float
    signal_to_backscatter: float


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Curves over one field: `rows[i]` belongs to `values[i]`."""

    field: str
    values: tuple[Any, ...]
    rows: tuple[BudgetRow, ...] | tuple[DepthErrorRow, ...]

    def column(self, name: str) -> NDArray[np.float64]:
        """One attribute of all rows."""
        return np.array([getattr(row, name) for row in self.rows], dtype=np.float64)


def budget(
    scene: Scene,
    ranges: Iterable[float] | None = None,
    media: Iterable[str] | Mapping[str, Mapping[str, Any]] | None = None,
    *,
    reflectance: float | None = None,
    device: str | None = None,
) -> list[BudgetRow]:
    """Signal, background, depth error and pulses needed for 1 cm, over water and range.

    Args:
        scene: Laser, camera, detector, gate and `[analytic]` settings are taken from it; the target's shape is not.
        ranges: Distances on the optical axis [m], > 0; default 1 to 50 m.
        media: Names of presets, or name → fields of `[medium]`; default: the scene's water alone.
        reflectance: Of the face, in [0, 1]; default: the number that the scene's first target has, else 0.5.
        device: Warp device; default: the first GPU, else the CPU.

    Returns:
        A row for each water and range, in this order.

    Raises:
        ConfigError: A water or scene that the model does not cover.
        ArgumentError: Ranges or reflectance out of range.
    """
    distances = np.array(sorted(RANGES if ranges is None else ranges), np.float64)
    if distances.size == 0 or not ((distances > 0) & np.isfinite(distances)).all():
        raise ArgumentError(f"ranges = {distances.tolist()} are not all in (0, inf)")
    if reflectance is None:
        given = scene.targets[0].reflectance if scene.targets else 0.5
        reflectance = 0.5 if given == "from_file" else given
    if not 0 <= reflectance <= 1:
        raise ArgumentError(f"reflectance = {reflectance} is outside [0, 1]")
    if scene.analytic.backscatter == "monte_carlo":
        raise ConfigError("analytic.backscatter = 'monte_carlo' belongs to one range; a budget takes 'single_scatter'")
    rows: list[BudgetRow] = []
    for name, wet in _waters(scene, media):
        rows += _axis_rows(wet, name, distances, reflectance, device)
    return rows


def sweep(
    scene: Scene,
    *,
    vary: str | tuple[str, Sequence[Any]],
    of: Literal["budget", "depth-error"] = "budget",
    device: str | None = None,
) -> Sweep:
    """The budget, or the error of depth frames, over any field of the scene.

    Args:
        scene: The scene.
        vary: `"medium.extinction=0.1:2:20"` (from, to, number of values), the same with `:log` at the end for a
            geometric progression, `"laser.pulse_energy=1e-9,4e-9"`, or (field, values).
        of: `"budget"`: `BudgetRow` at the range of the target pixel nearest to the optical axis. `"depth-error"`:
            `DepthErrorRow` over all pixels.
        device: Warp device; default: the first GPU, else the CPU.

    Raises:
        ConfigError: An unknown field, a value out of its range, a scene that the model does not cover.
        ArgumentError: `vary` or `of` not of the form above.
    """
    if of not in ("budget", "depth-error"):
        raise ArgumentError(f"of = {of!r} is not one of 'budget', 'depth-error'")
    field, values = parse_vary(vary) if isinstance(vary, str) else (vary[0], list(vary[1]))
    if not values:
        raise ArgumentError(f"vary = {vary!r} holds no value")
    rows: list[Any] = []
    for value in values:
        changed = scene.with_overrides({field: value})
        rows.append(_central_row(changed, device) if of == "budget" else _depth_error(changed, device))
    return Sweep(field=field, values=tuple(values), rows=tuple(rows))


def parse_vary(text: str) -> tuple[str, list[Any]]:
    """Field and values of `field=from:to:count`, `field=from:to:count:log` or `field=a,b,c`; raises `ArgumentError`."""
    from spadwarp.scene import parse_override

    field, equals, spec = (part.strip() for part in text.partition("="))
    if not field or not equals or not spec:
        raise ArgumentError(f"vary = {text!r} is not of the form section.field=from:to:count")
    if ":" not in spec:
        try:
            return field, tomllib.loads(f"values = [{spec}]")["values"]
        except tomllib.TOMLDecodeError:  # bare words
            return field, [parse_override(f"{field}={one}")[1] for one in spec.split(",")]
    parts = spec.split(":")
    try:
        low, high, count = float(parts[0]), float(parts[1]), int(parts[2])
        geometric = len(parts) == 4 and parts[3] == "log"
        if count < 1 or len(parts) > 3 + geometric or not (math.isfinite(low) and math.isfinite(high)):
            raise ValueError
        if geometric and not (low > 0 and high > 0):
            raise ValueError
    except (ValueError, IndexError):
        raise ArgumentError(
            f"vary = {text!r} is not of the form section.field=from:to:count, with :log only for positive ends"
        ) from None
    return field, [float(one) for one in (np.geomspace if geometric else np.linspace)(low, high, count)]


# Rows


def _waters(scene: Scene, media: Iterable[str] | Mapping[str, Mapping[str, Any]] | None) -> Iterable[tuple[str, Scene]]:
    if media is None:
        yield scene.medium.preset or "scene", scene
    elif isinstance(media, Mapping):
        for name, fields in media.items():
            yield name, scene.with_overrides(medium=fields)
    else:
        for name in [media] if isinstance(media, str) else media:
            yield name, scene.with_overrides(medium={"preset": name})


def _axis_rows(
    scene: Scene, name: str, distances: NDArray[np.float64], reflectance: float, device: str | None
) -> list[BudgetRow]:
    gate = (scene.gate.start, scene.gate.stop)
    path = path_from_range(distances, np.array([0.0, 0.0, 1.0]), scene.beam.position)
    arrival = path / scene.medium.pulse_speed
    if gate[0] <= arrival.min() and arrival.max() <= gate[1]:
        gates = [(gate, distances)]
    else:
        length = gate[1] - gate[0]
        starts = np.maximum(arrival - 0.5 * length, 0.0)
        gates = [((start, start + length), distances[i : i + 1]) for i, start in enumerate(starts)]
    rows: list[BudgetRow] = []
    for (start, stop), some in gates:
        axis = np.tile([0.0, 0.0, 1.0], (some.size, 1))
        maps, _ = pixel_maps(
            scene,
            view=axis,
            distance=some,
            normal=-axis,
            reflectance=np.full(some.size, reflectance),
            device=device,
            gate=(start, stop),
        )
        background = maps["backscatter"] + scene.detector.noise_rate * (stop - start)
        needed = _pulses_needed(scene, maps, background, stop - start, device)
        for i, distance in enumerate(some):
            rows.append(
                BudgetRow(
                    medium=name,
                    extinction=scene.medium.extinction,
                    range=float(distance),
                    optical_depth=float(distance * scene.medium.extinction),
                    gate_start=start,
                    gate_stop=stop,
                    background=float(background[i]),
                    pulses_for_1cm=float(needed[i]),
                    **{key: float(maps[key][i]) for key in _FROM_MAPS},
                )
            )
    return rows


_FROM_MAPS = ("arrival", "signal", "alpha", "signal_to_backscatter", "sigma_time", "sigma_depth", "outlier_probability")


def _pulses_needed(
    scene: Scene, maps: Mapping[str, NDArray[np.float64]], background: Any, gate: float, device: str | None
) -> NDArray[np.float64]:
    """Pulses until the bound of depth is within `TOLERANCE` and outliers are rarer than `OUTLIERS`; bisects ln N."""
    import warp as wp

    from spadwarp.analytic.model import response_sigma
    from spadwarp.transport.model import pick_device
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

    def outliers(photons: NDArray[np.float64]) -> NDArray[np.float64]:
        arrays = (photons * share, photons * level, np.full_like(photons, gate / sigma))
        values: list[Any] = [wp.array(np.nan_to_num(one), dtype=wp.float64, device=target) for one in arrays]
        return outlier_probabilities(*values).numpy()

    low, high = np.zeros_like(alpha), np.full_like(alpha, math.log(1e18))
    for _ in range(40):
        middle = 0.5 * (low + high)
        photons = np.exp(middle) * recorded
        reached = (photons >= enough) & (outliers(photons) <= OUTLIERS)
        low, high = np.where(reached, low, middle), np.where(reached, middle, high)
    pulses = np.exp(high) * per_acquisition
    return np.where((maps["fisher"] > 0) & (high < math.log(1e18) * (1 - 1e-9)), pulses, np.inf)


def _central_row(scene: Scene, device: str | None) -> BudgetRow:
    from spadwarp.transport.model import truth_maps

    truth = truth_maps(scene)
    seen = ~np.isnan(truth.depth)
    if not seen.any():
        raise ConfigError("no target is in view", source=str(scene.source) if scene.source else None)
    off_axis = np.where(seen, -pixel_directions(scene.camera)[..., 2], np.inf)
    place = np.unravel_index(np.argmin(off_axis), off_axis.shape)
    name = scene.medium.preset or "scene"
    distance = np.array([float(truth.range[place])])
    return _axis_rows(scene, name, distance, float(truth.reflectance[place]), device)[0]


def _depth_error(scene: Scene, device: str | None) -> DepthErrorRow:
    result = simulate_analytic(scene, frames=0, device=device)
    there = result.fisher > 0
    targets = np.count_nonzero(~np.isnan(result.truth.depth))
    if not there.any():
        return DepthErrorRow(
            sigma_depth=math.nan,
            sigma_depth_p90=math.nan,
            outlier_probability=math.nan,
            estimate_fraction=0.0,
            signal_to_backscatter=math.nan,
        )
    return DepthErrorRow(
        sigma_depth=float(np.median(result.sigma_depth[there])),
        sigma_depth_p90=float(np.quantile(result.sigma_depth[there], 0.9)),
        outlier_probability=float(result.outlier_probability[there].mean()),
        estimate_fraction=float(there.sum() / targets),
        signal_to_backscatter=float(np.median(result.signal_to_backscatter[there])),
    )


# Pictures

# Okabe and Ito's colours, told apart with every common colour-blindness.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000", "#F0E442")
# Label, factor, and what of the axis is worth looking at.
_PANELS: dict[str, tuple[str, float, tuple[float, float]]] = {
    "signal": ("signal [detections per pulse]", 1.0, (1e-10, 1e3)),
    "sigma_depth": ("depth error, Cramér–Rao [mm]", 1e3, (1e-3, 1e4)),
    "signal_to_backscatter": ("signal / backscatter", 1.0, (1e-6, 1e6)),
    "pulses_for_1cm": ("pulses for 1 cm", 1.0, (1.0, 1e12)),
}
_ERROR_PANELS = ("sigma_depth", "outlier_probability", "estimate_fraction", "signal_to_backscatter")
_LABELS: dict[str, tuple[str, float]] = {
    **{name: (label, scale) for name, (label, scale, _) in _PANELS.items()},
    "alpha": ("detections per pulse α", 1.0),
    "background": ("background [detections per pulse]", 1.0),
    "sigma_time": ("timing error, Cramér–Rao [ps]", 1e12),
    "sigma_depth_p90": ("depth error, 90th percentile [mm]", 1e3),
    "outlier_probability": ("outlier probability", 1.0),
    "estimate_fraction": ("pixels with an estimate", 1.0),
}


def plot_budget(rows: Sequence[BudgetRow], path: str | Path | None = None) -> Any:
    """Four panels over range, a line for each water: signal, depth error, signal to backscatter, pulses for 1 cm.

    Where more than 1 % of the fits would be outliers, the bound is dashed: it is not reached. Returns the matplotlib
    figure, and writes it where `path` is given.
    """
    waters = list(dict.fromkeys(row.medium for row in rows))
    figure, axes = _grid(len(_PANELS))
    for number, name in enumerate(waters):
        own = [row for row in rows if row.medium == name]
        x = np.array([row.range for row in own])
        for axis, (field, (_, scale, worth)) in zip(axes, _PANELS.items(), strict=True):
            y = np.array([getattr(row, field) for row in own]) * scale
            y[~(np.isfinite(y) & (y > 0.01 * worth[0]) & (y < 100 * worth[1]))] = np.nan
            colour = _COLOURS[number % len(_COLOURS)]
            label = f"{name} ({own[0].extinction:.3g}/m)"
            if field == "sigma_depth":
                sure = np.array([row.outlier_probability <= OUTLIERS for row in own])
                axis.plot(x, y, "--", color=colour, linewidth=1.0)
                y = np.where(sure, y, np.nan)
            axis.plot(x, y, "o-", color=colour, markersize=3.5, linewidth=1.6, label=label)
    for axis, (label, _, worth) in zip(axes, _PANELS.values(), strict=True):
        axis.set(xlabel="range [m]", ylabel=label, xscale="log", yscale="log")
        low, high = axis.get_ylim()
        low, high = max(low, worth[0]), min(high, worth[1])
        axis.set(yscale="log" if high > 20 * low else "linear", ylim=(low, high))
        _plain_range_ticks(axis, [row.range for row in rows])
    axes[1].axhline(TOLERANCE * 1e3, color="0.5", linewidth=0.8, linestyle=":")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(3, len(labels)), frameon=False, fontsize=9)
    return _finish(figure, path)


def plot_sweep(curves: Sweep, path: str | Path | None = None, *, columns: Sequence[str] | None = None) -> Any:
    """One panel for each column over the values of the swept field; returns the matplotlib figure, writes it to `path`.

    `columns`: attributes of the rows; default: what matters most.
    """
    budgets = isinstance(curves.rows[0], BudgetRow)
    names = list(columns or (_PANELS if budgets else _ERROR_PANELS))
    figure, axes = _grid(len(names))
    numeric = all(isinstance(value, (int, float)) for value in curves.values)
    x: Any = np.array(curves.values, np.float64) if numeric else [str(value) for value in curves.values]
    for number, (axis, name) in enumerate(zip(axes, names, strict=False)):
        label, scale = _LABELS.get(name, (name, 1.0))
        y = curves.column(name) * scale
        positive = y[np.isfinite(y) & (y > 0)]
        axis.plot(
            x, np.where(np.isfinite(y), y, np.nan), "o-", color=_COLOURS[number % 5], markersize=3.5, label="median"
        )
        if name == "sigma_depth" and not budgets:
            p90 = curves.column("sigma_depth_p90") * scale
            axis.plot(x, p90, "--", color=_COLOURS[number % 5], linewidth=1.0, label="90 % of the pixels below")
            axis.legend(frameon=False, fontsize=9)
        axis.set(xlabel=f"{curves.field} {_unit(curves.field)}".rstrip(), ylabel=label)
        if name in ("outlier_probability", "estimate_fraction"):
            axis.set_ylim(-0.03, 1.03)
        elif positive.size and positive.max() > 20 * positive.min():
            axis.set_yscale("log")
        if numeric and x.min() > 0 and x.max() > 30 * x.min():
            axis.set_xscale("log")
    return _finish(figure, path)


def _unit(field: str) -> str:
    """`[1/m]` for `medium.extinction`: the unit at the end of the field's description, or nothing."""
    from spadwarp.scene import Scene

    section, _, name = field.partition(".")
    info = Scene.model_fields.get(section)
    fields = getattr(info.annotation, "model_fields", {}) if info else {}
    found = re.search(r"\[[^\]]+\]", getattr(fields.get(name), "description", None) or "")
    return found.group(0) if found else ""


def _grid(panels: int) -> tuple[Any, list[Any]]:
    from matplotlib.figure import Figure

    columns = 2 if panels in (2, 4) else min(panels, 3)
    lines = math.ceil(panels / columns)
    figure = Figure(figsize=(4.6 * columns, 3.3 * lines + 0.4), layout="constrained")
    axes = list(np.ravel(figure.subplots(lines, columns)))
    for axis in axes[panels:]:
        axis.remove()
    for axis in axes[:panels]:
        axis.grid(True, which="major", color="0.9", linewidth=0.8)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes[:panels]


def _plain_range_ticks(axis: Any, ranges: Sequence[float]) -> None:
    from matplotlib.ticker import FixedLocator, NullLocator

    low, high = min(ranges), max(ranges)
    ticks = sorted(set(ranges))
    if len(ticks) > 6:
        ticks = [m * 10.0**e for e in range(-2, 4) for m in (1, 2, 5) if low <= m * 10.0**e <= high]
    if len(ticks) > 1:
        axis.set_xlim(low * (low / high) ** 0.05, high * (high / low) ** 0.05)  # also where nothing comes back
        axis.xaxis.set_major_locator(FixedLocator(ticks))
        axis.xaxis.set_minor_locator(NullLocator())
        axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")


def _finish(figure: Any, path: str | Path | None) -> Any:
    if path is not None:
        from spadwarp.io.atomic import atomic_path

        kind = Path(path).suffix.lstrip(".") or "png"
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=150, format=kind)
    return figure
