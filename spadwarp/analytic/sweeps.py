"""The photon budget, or the error of depth frames, over any field of the scene."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.model import source_name, warn_of_model
from spadwarp.analytic.photon_budget import LONGEST, BudgetRow, axis_rows
from spadwarp.analytic.simulate import simulate_analytic
from spadwarp.errors import ArgumentError, ConfigError, SpadwarpWarning
from spadwarp.io.text import parse_toml
from spadwarp.limits import check_choice, check_integer, parse_number, shown
from spadwarp.scene import Scene, SceneLike, as_scene, parse_override
from spadwarp.scene.messages import locate
from spadwarp.scene.sections import field_unit, takes_integers
from spadwarp.scene.sight import pixel_directions
from spadwarp.scene.tables import parse_key
from spadwarp.transport import truth_maps
from spadwarp.units import quantity

__all__ = ["DepthErrorRow", "Sweep", "parse_values", "parse_vary", "sweep"]


@dataclass(frozen=True, kw_only=True)
class DepthErrorRow:
    """Summary of the depth frames of a scene; statistics run over the pixels that have an estimate.

    Attributes:
        sigma_depth: Median bound of depth [m].
        sigma_depth_p90: 90th percentile of the bound [m].
        outlier_probability: Mean over pixels.
        estimate_fraction: Pixels with an estimate over pixels with a target.
        signal_to_backscatter: Median.
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

    @property
    def is_flat(self) -> bool:
        """Whether different values gave the same numbers throughout."""
        return len({repr(value) for value in self.values}) > 1 and len({repr(row) for row in self.rows}) == 1

    def column(self, name: str) -> NDArray[np.float64]:
        """One attribute of all rows."""
        return np.array([getattr(row, name) for row in self.rows], dtype=np.float64)


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

    Raises:
        ConfigError: An unknown field, a value out of its range, a scene that the model does not cover.
        ArgumentError: `vary` or `of` not of the form above.
    """
    scene = as_scene(scene)
    check_choice("of", of, ("budget", "depth-error"))
    if isinstance(vary, str):
        field, values = parse_vary(vary)
    elif isinstance(vary, tuple | list) and len(vary) == 2 and isinstance(vary[1], Iterable):
        field, values = str(vary[0]), list(vary[1])
    else:
        raise ArgumentError(f"vary = {shown(vary)} is neither 'section.field=from:to:count' nor (field, values)")
    check_integer("number of values to vary", len(values), f"[1, {LONGEST}]")
    rows: list[Any] = []
    for value in values:
        changed = scene.with_overrides({field: value})
        if of == "budget":
            warn_of_model(changed)
        rows.append(_central_row(changed, device) if of == "budget" else _depth_error(changed, device))
    found = Sweep(field=field, values=tuple(values), rows=tuple(rows))
    if found.is_flat:
        hint = ""
        if field == "detector.pulses_per_frame":
            hint = "; analytic.pulses_per_depth_frame or a count law per frame takes its place in this scene"
        warnings.warn(
            f"no number depends on {field}: the analytic model does not use it{hint}", SpadwarpWarning, stacklevel=2
        )
    return found


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
        low, high = (float(_number(_bare(part), unit, name)) for part in parts[:2])
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
    count = check_integer(f"{name} = {shown(text)}: the number of values", whole, f"[{fewest}, {LONGEST}]")
    return [float(value) for value in (np.geomspace if geometric else np.linspace)(low, high, count)]


def _bare(text: str) -> Any:
    """The number that a text is, else the text."""
    try:
        return parse_number(text)
    except ValueError:
        return text.strip()


def _number(value: Any, unit: str | None, name: str) -> Any:
    """A text that begins like a number as a number of the unit; all else as it is."""
    if unit is None or not isinstance(value, str) or not value.lstrip("+-.")[:1].isdigit():
        return value
    try:
        return quantity(value, unit)
    except ValueError as error:
        raise ArgumentError(f"{name}: {shown(value)} {error}") from None


def _central_row(scene: Scene, device: str | None) -> BudgetRow:
    truth = truth_maps(scene)
    hit = ~np.isnan(truth.depth)
    if not hit.any():
        raise ConfigError("no target is in view", source=source_name(scene))
    off_axis = np.where(hit, -pixel_directions(scene.camera)[..., 2], np.inf)
    pixel = np.unravel_index(np.argmin(off_axis), off_axis.shape)
    distance = np.array([float(truth.range[pixel])])
    return axis_rows(scene, scene.medium.preset or "scene", distance, float(truth.reflectance[pixel]), device)[0]


def _depth_error(scene: Scene, device: str | None) -> DepthErrorRow:
    result = simulate_analytic(scene, frames=0, device=device)
    estimated = result.fisher > 0
    count, targets = np.count_nonzero(estimated), np.count_nonzero(~np.isnan(result.truth.depth))

    def over_pixels(values: NDArray[np.float64], statistic: Callable[[NDArray[np.float64]], Any]) -> float:
        return float(statistic(values[estimated])) if count else math.nan

    return DepthErrorRow(
        sigma_depth=over_pixels(result.sigma_depth, np.median),
        sigma_depth_p90=over_pixels(result.sigma_depth, lambda values: np.quantile(values, 0.9)),
        outlier_probability=over_pixels(result.outlier_probability, np.mean),
        estimate_fraction=float(count / targets),
        signal_to_backscatter=over_pixels(result.signal_to_backscatter, np.median),
    )
