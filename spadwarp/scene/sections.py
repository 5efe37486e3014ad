"""Sections of a scene: strict, frozen tables with presets, types of fields, ranges, and numbers with a unit.

A range stands once, on its field: messages, functions that take the same number, and the JSON schema read it there. So
does the unit, in brackets in the field's docstring; a number of real value without one takes `%` alone:
`pulse_energy = "150 nJ"`, `translation = [0, "20 cm", 9]`.
"""

from __future__ import annotations

import math
import re
import tomllib
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo

from spadwarp.io.text import read_columns
from spadwarp.values import UNITS, ConfigError, FileError, Interval, bounds, quantity, shown

__all__ = ["Preset", "presets"]

_NUMBER = re.compile(r"\s*[+-]?\.?\d")


class FilePath(NamedTuple):
    """Metadata of a field with the path of a file: its ending ("": any), and words that the field takes beside it."""

    ending: str = ""
    words: tuple[str, ...] = ()

    def holds(self, value: Any) -> bool:
        """Whether a value is a path, to be taken from the folder of the scene file."""
        return isinstance(value, str) and value not in self.words and value.lower().endswith(self.ending)


def file_path(info: FieldInfo) -> FilePath | None:
    """The metadata of a field with the path of a file."""
    return next((item for item in info.metadata if isinstance(item, FilePath)), None)


def field(default: Any, text: str, within: str | None = None) -> Any:
    """A field, what it is, and its range, such as "(0, 1]"; a longer text stands in a docstring below the field."""
    if within is None:
        return Field(default, description=text)
    limits = bounds(within)
    return Field(default, description=text, allow_inf_nan=math.inf in limits.values() or None, **limits)


def listed(value: Any) -> Any:
    """TOML has lists; what is frozen holds tuples."""
    return tuple(value) if isinstance(value, list) else value


def _whole(value: Any) -> Any:
    """TOML writes 2e9 as a float; a whole one is as good as an integer."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _repeated(value: Any) -> Any:
    """One number stands for three."""
    return (value,) * 3 if isinstance(value, int | float) and not isinstance(value, bool) else listed(value)


def _single(value: Any) -> Any:
    """One number stands for a list of it."""
    return (value,) if isinstance(value, int | float) and not isinstance(value, bool) else listed(value)


def _with_length(vector: tuple[float, ...]) -> tuple[float, ...]:
    if math.hypot(*vector) < 1e-9:
        raise ValueError("has no length")
    return vector


def unit_vector(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    """A vector over its length."""
    x, y, z = vector
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length)


Whole = Annotated[int, BeforeValidator(_whole)]
# Every number has a range in which products of several stay within single precision.
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
Vector = Annotated[tuple[Coordinate, Coordinate, Coordinate], BeforeValidator(listed)]
Direction = Annotated[Vector, AfterValidator(_with_length)]
Infinite = BeforeValidator(lambda value: math.inf if value == "infinity" else value)
Bound = Annotated[float, Field(ge=-math.inf, le=math.inf, allow_inf_nan=True)]
Corner = Annotated[tuple[Bound, Bound, Bound], BeforeValidator(_repeated)]
Scale = Annotated[tuple[Coordinate, Coordinate, Coordinate], BeforeValidator(_repeated)]
_UP_TO_THREE = BeforeValidator(_single), Field(min_length=1, max_length=3)
Size = Annotated[tuple[Annotated[float, Field(ge=1e-9, le=1e9)], ...], *_UP_TO_THREE]
Counts = Annotated[tuple[Annotated[int, Field(ge=1, le=1024)], ...], *_UP_TO_THREE]
AnyFile = Annotated[str | None, FilePath()]
CsvFile = Annotated[str | None, FilePath(".csv")]


@dataclass(frozen=True)
class Preset:
    """Fields of one section of a scene, `values`, and where they come from, `source`."""

    section: str
    name: str
    values: Mapping[str, Any]
    source: str


def _read_presets() -> dict[str, dict[str, Preset]]:
    tables = tomllib.loads((files("spadwarp.scene") / "presets.toml").read_text(encoding="utf-8"))
    sources: dict[str, str] = tables.pop("sources")
    found: dict[str, dict[str, Preset]] = {section: {} for section in tables}
    for section, entries in tables.items():
        for name, entry in entries.items():
            source = sources.get(entry["source"], entry["source"])
            source += f"; {entry['note']}" if "note" in entry else ""
            found[section][name] = Preset(section, name, entry["values"], source)
    return found


PRESETS = _read_presets()


def presets(section: str | None = None) -> dict[str, Preset]:
    """The presets of one section by name, or of all sections by `section.name`.

    Raises `KeyError` for a section without presets.
    """
    if section is not None:
        return dict(PRESETS[section])
    return {f"{section}.{name}": preset for section, rows in PRESETS.items() for name, preset in rows.items()}


class Section(BaseModel):
    """One table of a scene: frozen, strict about types, unknown keys refused.

    A preset, `preset = "uwoc-harbour"`, lies under the section's own fields; it need not fill its section.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        protected_namespaces=(),
        use_attribute_docstrings=True,
    )
    section: ClassVar[str] = ""
    """Whose presets it takes."""
    alternatives: ClassVar[tuple[str, ...]] = ()
    """Fields of which some are given; the others follow from them."""
    displaces: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Fields that drop others, which they exclude, from what they are laid over."""

    @model_validator(mode="before")
    @classmethod
    def _over_preset(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping):
            return fields
        if cls._preset(fields) is not None:
            return cls.merged({}, fields)
        return {name: value for name, value in with_units(cls, fields).items() if value is not None}

    @field_validator("*", mode="before")
    @classmethod
    def _read(cls, value: Any, info: ValidationInfo) -> Any:
        """Numbers with a unit as numbers; names of presets and endings of files are checked."""
        name = info.field_name or ""
        value = in_field_unit(value, field := cls.model_fields[name])
        if isinstance(value, str) and name == "preset" and value not in PRESETS[cls.section]:
            raise ValueError("preset", tuple(PRESETS[cls.section]))
        path = file_path(field) if isinstance(value, str) else None
        if path is not None and value not in path.words and not path.holds(value):
            text = f"the path of a {path.ending} file"
            raise ValueError("choice", path.words, text) if path.words else ValueError(f"is not {text}")
        return value

    @classmethod
    def _preset(cls, fields: Mapping[str, Any]) -> Preset | None:
        name = fields.get("preset")
        return PRESETS.get(cls.section, {}).get(name) if isinstance(name, str) else None

    @classmethod
    def merged(cls, base: Mapping[str, Any], layer: Mapping[str, Any], *, at: str = "") -> dict[str, Any]:
        """Fields of a layer over those of a base, neither of them validated, table by table.

        A preset of the layer lies between both. None takes a field back to its default; `{index: item}` replaces items
        of a list, or adds the next table. `at` is where the fields are, for errors: `ConfigError` for an item that does
        not exist.
        """
        base, layer = with_units(cls, base), with_units(cls, layer)
        if cls._preset(base) is not None:
            base = cls.merged({}, base, at=at)
        if (preset := cls._preset(layer)) is not None:
            values = {name: value for name, value in preset.values.items() if name in cls.model_fields}
            base = {**cls.merged(base, values, at=at), "preset": preset.name}
        merged = cls._kept(base, layer)
        dropped = [name for name, value in layer.items() if value is None]
        for name in layer:
            merged[name] = _over(table_of(cls, name), base.get(name), layer[name], f"{at}.{name}".lstrip("."))
        for name in dropped:
            del merged[name]
        preset = cls._preset(merged)
        if preset is not None and any(name in preset.values for name in dropped):
            del merged["preset"]  # no longer that preset
        return merged

    @classmethod
    def _kept(cls, base: Mapping[str, Any], layer: Mapping[str, Any]) -> dict[str, Any]:
        """What a layer leaves of the fields that it is laid over."""
        displaced = {
            other for name, value in layer.items() if value is not None for other in cls.displaces.get(name, ())
        }
        return {name: value for name, value in base.items() if name not in displaced}

    @property
    def given(self) -> tuple[str, ...]:
        """Alternatives that were given."""
        return tuple(name for name in self.alternatives if name in self.model_fields_set)

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal table again, without those that are None, empty, or follow from others."""
        hidden = set(self.alternatives) - set(self.given)
        return {name: plain(value) for name, value in self if value not in (None, ()) and name not in hidden}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for problem in self._problems():
            raise ValueError(problem)
        return self

    def _problems(self) -> Iterator[str]:
        """Why fields exclude each other."""
        yield from ()

    def _that(self, name: str, reason: str) -> str:
        """A problem of a field: `half_angle_deg = 95.0 is outside (0, 90)`."""
        value = getattr(self, name)
        return f"{name} = {list(value) if isinstance(value, tuple) else value!r} {reason}"

    def _only_with(self, other: str, holds: bool, *names: str) -> Iterator[str]:
        """Problems of fields off their defaults where what they need does not hold, such as `shape = 'dome'`."""
        for name in names:
            if not holds and getattr(self, name) != type(self).model_fields[name].default:
                yield self._that(name, f"goes with {other} only")


def plain(value: Any) -> Any:
    """The value of a field as TOML has it: tables and lists."""
    if isinstance(value, tuple) and value and isinstance(value[0], Section):
        return [item.to_dict() for item in value]
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items()}
    return value.to_dict() if isinstance(value, Section) else value


def _over(model: type[Section] | None, old: Any, value: Any, name: str) -> Any:
    """The value of a field, whose tables have a model, over an earlier one."""
    if not isinstance(value, Mapping):
        return value
    if not value or not all(isinstance(key, int) for key in value):
        return value if model is None else model.merged(old if isinstance(old, Mapping) else {}, value, at=name)
    items = [] if old is None and model is not None else list(old) if isinstance(old, list | tuple) else None
    if items is None:
        raise ConfigError(f"{name}[{min(value)}] does not exist: {name} = {shown(old)} is not a list")
    for index, item in sorted(value.items()):
        if index > len(items) - (model is None):
            raise ConfigError(f"{name}[{index}] does not exist; {name} has {len(items)} values, from 0 on")
        items[index : index + 1] = [_over(model, dict(enumerate(items)).get(index), item, f"{name}[{index}]")]
    return items


# Ranges, units, tables and paths of fields


@cache
def field_range(model: type[BaseModel], name: str) -> Interval:
    """The range of a numeric field with its unit, such as `(0, 1e6] 1/m`, for `check_real` and `check_integer`."""
    return interval_of(model.model_fields[name])


def interval_of(info: FieldInfo) -> Interval:
    """The range of a numeric field, with its unit."""
    interval = Interval(-math.inf, math.inf, False, False)
    for part in parts_of(info):
        for name, end in (("gt", "low"), ("ge", "low"), ("lt", "high"), ("le", "high")):
            if (bound := getattr(part, name, None)) is not None:
                interval = interval._replace(**{end: bound, f"includes_{end}": name[1] == "e"})
    unit = field_unit(info)
    return interval if unit in (None, "1") else interval._replace(unit=unit)


def parts_of(annotation: Any) -> Iterator[Any]:
    """An annotation, or that of a field, and all that it is made of: types, words, bounds."""
    yield annotation
    is_field = isinstance(annotation, FieldInfo)
    for part in (*annotation.metadata, annotation.annotation) if is_field else typing.get_args(annotation):
        yield from parts_of(part)


def models_of(annotation: Any) -> list[type[BaseModel]]:
    """Models of the tables that an annotation names."""
    return [part for part in parts_of(annotation) if isinstance(part, type) and issubclass(part, BaseModel)]


@cache
def table_of(model: type[BaseModel], name: str) -> type[Section] | None:
    """The model of a field's table, or of the tables of its list."""
    info = model.model_fields.get(name)
    return next((one for one in models_of(info) if issubclass(one, Section)), None)


@cache
def takes_any_table(model: type[BaseModel], name: str) -> bool:
    """Whether a field is a table without a model."""
    return any(typing.get_origin(part) is dict for part in parts_of(model.model_fields.get(name)))


def field_unit(info: FieldInfo) -> str | None:
    """The unit of a field's numbers, "1" for a ratio; None where it takes no real numbers."""
    if not any(part is float for part in parts_of(info)):
        return None
    bracketed = re.findall(r"\[([^\]]+)\]", info.description or "")
    return next((unit for unit in bracketed if unit in UNITS), None if bracketed else "1")


def takes_integers(info: FieldInfo) -> bool:
    """Whether a field's numbers are whole."""
    parts = list(parts_of(info))
    return any(part is int for part in parts) and not any(part is float for part in parts)


def in_field_unit(value: Any, info: FieldInfo) -> Any:
    """A text, or the texts of a list, as numbers of the field's unit; all else as it is.

    Raises `ValueError` for a text that begins like a number and is none of the field's unit.
    """
    if isinstance(value, list | tuple) and any(isinstance(item, str) for item in value):
        return type(value)(_item(item, info) for item in value)
    unit = field_unit(info) if isinstance(value, str) and _NUMBER.match(value) else None
    if unit is None:
        return value
    try:
        return quantity(value, unit)
    except ValueError as error:
        if unit == "1":
            raise ValueError("is text; a number without quotes is needed, or a percentage") from None
        raise error from None


def _item(item: Any, info: FieldInfo) -> Any:
    try:
        return in_field_unit(item, info)
    except ValueError as error:
        raise ValueError(f"holds {item!r}, which {error}") from None


def with_units(model: type[BaseModel], fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a table with texts as numbers; what cannot be read stays, for its validation to report."""
    changed = dict(fields)
    for name, info in model.model_fields.items():
        try:
            changed |= {name: in_field_unit(fields[name], info)} if name in fields else {}
        except ValueError:
            continue
    return changed


def with_paths(model: type[BaseModel], tables: Mapping[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """Tables of a model, not yet validated, with other paths of files."""

    def changed(value: Any, path: FilePath | None, inner: type[Section] | None) -> Any:
        if isinstance(value, list | tuple):
            return [changed(item, path, inner) for item in value]
        if inner is not None and isinstance(value, Mapping):
            if any(isinstance(key, int) for key in value):  # items of a list
                return {index: changed(item, path, inner) for index, item in value.items()}
            return with_paths(inner, value, change)
        return change(value) if path is not None and value and path.holds(value) else value

    places = {name: (file_path(info), table_of(model, name)) for name, info in model.model_fields.items()}
    return {name: value if name not in places else changed(value, *places[name]) for name, value in tables.items()}


def read_table(field: str, path: str | Path, columns: Mapping[str, str]) -> NDArray[np.float64]:
    """Columns of the .csv file that a field names, `[columns, rows]`.

    Raises what `read_columns` raises, with the name of the field.
    """
    try:
        return read_columns(path, columns).T
    except FileError as error:
        raise FileError(f"{field} = {error}") from None
    except ConfigError as error:
        raise ConfigError(f"{field}: {error}") from None
