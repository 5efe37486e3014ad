"""Sweeps: the budget, or the plan of an experiment, over any fields of a scene."""

from __future__ import annotations

import itertools
import math
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.budgets import LONGEST, BudgetRow, central_row
from spadwarp.analytic.planning import plan
from spadwarp.frames.depth import Method
from spadwarp.io.text import parse_toml
from spadwarp.result import POLARISED
from spadwarp.scene import Scene, SceneLike, as_scene, parse_override
from spadwarp.scene.sections import field_unit, locate, parse_key, parts_of
from spadwarp.values import (
    ArgumentError,
    ConfigError,
    SpadwarpWarning,
    check_choice,
    check_integer,
    parse_number,
    quantity,
    read_real,
    shown,
    with_prefix,
)

__all__ = ["PlanRow", "Sweep", "combinations", "parse_values", "parse_vary", "sweep"]

_ANALYSER = "camera.analyser"


@dataclass(frozen=True, kw_only=True)
class PlanRow:
    """What `spadwarp.plan` finds for a scene."""

    pulses: float  # of a depth frame for the depth error; infinite: out of reach, NaN: not judged by the traced photons
    pulses_least: float  # by what the traced photons leave open
    pulses_most: float
    frame_time: float  # for these pulses [s]
    pulse_energy: float  # proposed [J]
    sigma_depth: float  # Cramér–Rao bound with the pulses of the scene's own depth frame [m]
    floor: float  # error that no number of pulses removes [m]
    largest_range: float  # of a plane with the depth error, within the time [m]; NaN: not sought or not judged
    limit: str  # largest part of the depth error


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Rows over the values of fields: `rows[i]` belongs to `values[i]`, which has a value for each of `fields`."""

    fields: tuple[str, ...]
    values: tuple[tuple[Any, ...], ...]
    rows: tuple[BudgetRow, ...] | tuple[PlanRow, ...]
    title: str  # scene, and what its numbers are of

    @property
    def unequal_energies(self) -> str:
        """Words where the pulses of plans have different energies, else ""."""
        found = {row.pulse_energy for row in self.rows if isinstance(row, PlanRow)}
        if len(found) < 2 or "laser.pulse_energy" in self.fields:
            return ""
        least, most = (with_prefix(end, "J") for end in (min(found), max(found)))
        return f"the pulses have different energies, {least} to {most}; laser.pulse_energy = '{least}' makes them equal"

    @property
    def is_flat(self) -> bool:
        """Whether different values gave the same numbers throughout."""
        judged = not any(isinstance(row, PlanRow) and math.isnan(row.pulses) for row in self.rows)
        return judged and len({repr(value) for value in self.values}) > 1 and len({repr(row) for row in self.rows}) == 1

    def column(self, name: str) -> NDArray[Any]:
        """One attribute of all rows, or the values of one field."""
        if name in self.fields:
            return np.array([value[self.fields.index(name)] for value in self.values])
        return np.array([getattr(row, name) for row in self.rows], dtype=np.float64)


def sweep(
    scene: SceneLike,
    *,
    vary: str | tuple[str, Sequence[Any]] | Sequence[Any],
    of: Literal["budget", "plan"] = "budget",
    depth_error: float | str = 0.01,
    time: float | str = 1.0,
    method: Method = "likelihood",
    photons: int | Literal["auto"] = "auto",
    seed: int = 0,
    largest_range: bool = True,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Sweep:
    """The budget, or the plan of the experiment, over any fields of the scene: in all combinations.

    Args:
        scene: The scene.
        vary: `"medium.extinction=0.1:2:20"` (from, to, number of values), the same with `:log` at the end for a
            geometric progression, `"laser.pulse_energy=1 nJ,4 nJ"`, `"camera.port.preset=none,flat-glass"`, or (field,
            values); or a list of these. A plan also varies `"range"`, that of a plane, and `"camera.analyser"`: "none",
            "co" or "cross" to the laser's polarisation.
        of: `"budget"`: `BudgetRow` by the analytic model, at the range of the target pixel nearest to the optical axis.
            `"plan"`: `PlanRow`, by a Monte Carlo run for each combination.
        depth_error, time, method, photons, seed, largest_range: Of a plan, as in `spadwarp.plan`.
        device: Warp device; default: the first GPU, else the CPU.
        progress: Called with (values of a combination, how many are done, how many there are).

    Where no number depends on the fields, or where light is polarised, which the analytic model leaves out, a warning
    says so.

    Raises `ConfigError`: an unknown field, a value out of its range, a wavelength that the water does not follow, a
    scene that the model does not cover; `ArgumentError`: `vary` or `of` not of the form above.
    """
    planned = check_choice("of", of, ("budget", "plan")) == "plan"
    fields, chosen = combinations(scene, vary, planned=planned)
    rows = list[Any]()
    for number, (values, changed, arguments) in enumerate(chosen):
        if progress is not None:
            progress(", ".join(map(str, values)), number, len(chosen))
        if not planned:
            rows.append(central_row(changed, device))
            continue
        options: Any = {"depth_error": depth_error, "time": time, "method": method, "photons": photons, "seed": seed}
        options |= arguments | {"largest_range": largest_range, "device": device}
        rows.append(_plan_row(changed, options))
    title, source = "unscattered light alone", as_scene(scene).source
    if planned:
        asked = with_prefix(read_real("depth_error", depth_error, "[1e-9, 1e9] m"), "m")
        title = f"pulses for a depth error of {asked} by {method}"
    title = f"{source.stem}: {title}" if source else title
    curves = Sweep(fields=fields, values=tuple(values for values, *_ in chosen), rows=tuple(rows), title=title)
    if curves.is_flat:
        text = f"no number depends on {' and '.join(fields)}: the model does not use it, or another field has its place"
        warnings.warn(text, SpadwarpWarning, stacklevel=2)
    return curves


def _plan_row(scene: Scene, options: dict[str, Any]) -> PlanRow:
    found = plan(scene, **options)
    told = 1.0 if found.judged else math.nan
    known = math.inf if found.pulses_for in ("floor", "out of reach") else told
    least, most = (known * pulses for pulses in found.pulses_range)
    return PlanRow(
        pulses=known * found.pulses,
        pulses_least=least,
        pulses_most=most,
        frame_time=known * found.frame_time,
        pulse_energy=found.scene.laser.pulse_energy,
        sigma_depth=told * found.pilot.bound / math.sqrt(scene.pulses_per_depth_frame),
        floor=told * math.hypot(found.pilot.floor[found.method], found.pilot.pile_up[found.method]),
        largest_range=found.largest_range if found.unjudged_ranges is None else math.nan,
        limit=found.limit if found.judged else f"not judged: {found.more_photons}",
    )


# Values to vary


def combinations(scene: SceneLike, vary: Any, *, planned: bool) -> tuple[tuple[str, ...], list[Any]]:
    """The fields that `sweep` varies; of each combination its values, its scene, and arguments of `plan`."""
    scene = as_scene(scene)
    pair = isinstance(vary, tuple | list) and len(vary) == 2 and isinstance(vary[0], str) and "=" not in vary[0]
    curves = []
    for one in [vary] if isinstance(vary, str) or pair or not isinstance(vary, tuple | list) else vary:
        if isinstance(one, str):
            curves.append(parse_vary(one))
        elif isinstance(one, tuple | list) and len(one) == 2 and isinstance(one[1], Iterable):
            curves.append((str(one[0]), list(one[1])))
        else:
            raise ArgumentError(f"vary = {shown(one)} is neither 'section.field=from:to:count' nor (field, values)")
    check_integer("number of values to vary", math.prod(len(values) for _, values in curves), f"[1, {LONGEST}]")
    fields = tuple(field for field, _ in curves)
    if twice := [field for field in fields if fields.count(field) > 1]:
        raise ArgumentError(f"vary: {twice[0]} is there twice; one list takes all of its values")
    if not planned and (own := [field for field in fields if field in ("range", _ANALYSER)]):
        text = "is no field of a budget: of = 'plan' varies it with others; `spadwarp.budget` is over range alone"
        raise ArgumentError(f"vary: {own[0]} {text}")
    if planned and (own := [field for field in fields if field in ("gate.start_ns", "gate.bins")]):
        raise ArgumentError(f"vary: {own[0]} is what a plan proposes: vary gate.bin_width_ps, or of = 'budget'")
    waves = dict(curves).get("laser.wavelength_nm", ())
    follows = scene.medium.chlorophyll is not None or any(field.startswith("medium.") for field in fields)
    if not follows and any(isinstance(wave, float | int) and abs(wave - 532.0) > 10.0 for wave in waves):
        raise ConfigError(
            f"laser.wavelength_nm = {', '.join(map(str, waves))}: each has its own water, and the coefficients of the "
            "medium would stay the same: give medium.chlorophyll [mg/m³] instead (0.05 clear ocean, 5 coast)",
            source=scene.source,
        )
    chosen = []
    for values in itertools.product(*(values for _, values in curves)):
        overrides, arguments = dict[str, Any](), dict[str, Any]()
        for field, value in zip(fields, values, strict=True):
            if field == "range":
                arguments["ranges"] = (value, value)
            elif field == _ANALYSER:
                word = check_choice(f"vary: {_ANALYSER}", value, ("none", *POLARISED))
                arguments["channel"] = "I" if word == "none" else word
                if value != "none" and not scene.camera.channels:
                    overrides["camera.polarisation"] = "analyser"
            else:
                overrides[field] = value
                if (field, value) == ("camera.port.preset", "none") and scene.laser.port == "camera":
                    overrides["laser.port"] = None  # which shines through it
        changed = scene.with_overrides(overrides)
        if arguments.get("channel", "I") != "I" and changed.laser.polarisation == "none":
            text = "is for polarised lasers: laser.polarisation = 'linear'"
            raise ConfigError(f"{_ANALYSER} = {arguments['channel']!r} {text}", source=scene.source)
        chosen.append((values, changed, arguments))
    return fields, chosen


def parse_vary(text: str) -> tuple[str, list[Any]]:
    """Field and values of `field=from:to:count`, `field=from:to:count:log` or `field=a,b,c`; raises `ArgumentError`.

    Values may have units, such as `laser.pulse_energy=1 nJ:1 µJ:7:log`, and become numbers of the field's own unit. Of
    a field of integers they are whole, each once.
    """
    field, equals, spec = (part.strip() for part in text.partition("="))
    if not field or not equals or not spec:
        raise ArgumentError(f"vary = {shown(text)} is not of the form section.field=from:to:count")
    info = locate(Scene, parse_key(field))[1]
    unit = "m" if field == "range" else field_unit(info) if info is not None else None
    lengths = re.findall(r"(?:^|[:,])\s*[-+.]?\d[^:,]*", spec)[: 2 if ":" in spec else None]
    if field == "range" and len({part.strip()[-1] in "0123456789." for part in lengths}) > 1:
        raise ArgumentError(f"vary: range = {shown(spec)} is ambiguous: write the unit of all lengths, or of none")
    values = parse_values(spec, unit, name=f"vary: {field}")
    if ":" in spec and int in (kinds := list(parts_of(info))) and float not in kinds:
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
    count = check_integer(f"{name} = {shown(text)}: the number of values", whole, f"[{fewest}, {LONGEST}]")
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
