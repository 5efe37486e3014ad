"""Tables of a scene, and what they share: strictness, presets, types of fields, ranges, numbers with a unit.

A range stands once, on its field: messages, functions that take the same number, and the JSON schema read it there. So
does the unit, in brackets in the field's docstring; a number of real value without one takes `%` alone:
`pulse_energy = "150 nJ"`, `translation = [0, "20 cm", 9]`.
"""

from __future__ import annotations

import math
import re
import typing
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

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

from spadwarp.errors import ConfigError, FileError
from spadwarp.io.text import read_columns
from spadwarp.limits import Interval
from spadwarp.scene.tables import PRESETS, merge_section
from spadwarp.units import UNITS, quantity

_NUMBER = re.compile(r"\s*[+-]?\.?\d")


class FilePath(NamedTuple):
    """Metadata of a field with the path of a file, which is relative to the scene file.

    Attributes:
        ending: That makes a text a path; "": any.
        words: What else the field takes.
    """

    ending: str = ""
    words: tuple[str, ...] = ()


def file_path(info: FieldInfo) -> FilePath | None:
    """The metadata of a field with the path of a file."""
    return next((item for item in info.metadata if isinstance(item, FilePath)), None)


def listed(value: Any) -> Any:
    """TOML has lists; what is frozen holds tuples."""
    return tuple(value) if isinstance(value, list) else value


def _whole(value: Any) -> Any:
    """TOML writes 2e9 as a float; a whole one is as good as an integer."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _infinite(value: Any) -> Any:
    """The word for what TOML writes as inf."""
    return math.inf if value == "infinity" else value


def _padded(value: Any) -> Any:
    """Four coefficients of distortion lack k3, as OpenCV allows."""
    value = listed(value)
    return (*value, 0.0) if isinstance(value, tuple) and len(value) == 4 else value


def _repeated(count: int) -> BeforeValidator:
    """One number stands for `count` of them."""

    def repeat(value: Any) -> Any:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return (value,) * count if is_number else listed(value)

    return BeforeValidator(repeat)


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
Brown = Annotated[tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate], BeforeValidator(_padded)]
Infinite = BeforeValidator(_infinite)
Bound = Annotated[float, Field(ge=-math.inf, le=math.inf, allow_inf_nan=True)]
Corner = Annotated[tuple[Bound, Bound, Bound], _repeated(3)]
Size = Annotated[tuple[Annotated[float, Field(ge=1e-9, le=1e9)], ...], _repeated(1), Field(min_length=1, max_length=3)]
Counts = Annotated[tuple[Annotated[int, Field(ge=1, le=1024)], ...], _repeated(1), Field(min_length=1, max_length=3)]
Scale = Annotated[tuple[Coordinate, Coordinate, Coordinate], _repeated(3)]
AnyFile = Annotated[str | None, FilePath()]
CsvFile = Annotated[str | None, FilePath(".csv")]


def plain(value: Any) -> Any:
    """The value of a field as TOML has it: tables of sections."""
    if isinstance(value, tuple) and value and isinstance(value[0], Section):
        return [item.to_dict() for item in value]
    return value.to_dict() if isinstance(value, Section) else value


class Section(BaseModel):
    """One table of a scene: frozen, strict about types, unknown keys refused."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        protected_namespaces=(),
        use_attribute_docstrings=True,
    )
    section: ClassVar[str] = ""
    alternatives: ClassVar[tuple[str, ...]] = ()
    """Fields of which some are given; the others follow from them."""

    @model_validator(mode="before")
    @classmethod
    def _expand_preset(cls, fields: Any) -> Any:
        return merge_section(cls.section, {}, with_units(cls, fields)) if isinstance(fields, Mapping) else fields

    @field_validator("*", mode="before")
    @classmethod
    def _read(cls, value: Any, info: ValidationInfo) -> Any:
        """Numbers with a unit as numbers; names of presets and endings of files are checked."""
        name = info.field_name or ""
        value = in_field_unit(value, field := cls.model_fields[name])
        if not isinstance(value, str):
            return value
        if name == "preset" and value not in PRESETS[cls.section]:
            raise ValueError("preset", tuple(PRESETS[cls.section]))
        path = file_path(field)
        if path is not None and value not in path.words and not value.lower().endswith(path.ending):
            text = f"the path of a {path.ending} file"
            raise ValueError("choice", path.words, text) if path.words else ValueError(f"is not {text}")
        return value

    @property
    def given(self) -> tuple[str, ...]:
        """Alternatives that were given."""
        return tuple(name for name in self.alternatives if name in self.model_fields_set)

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal section again, without those that are None or follow from others."""
        hidden = set(self.alternatives) - set(self.given)
        return {name: plain(value) for name, value in self if value is not None and name not in hidden}

    def _refuse(self, name: str, reason: str) -> None:
        """Raises `ValueError` for a field of a value that others exclude."""
        value = getattr(self, name)
        raise ValueError(f"{name} = {list(value) if isinstance(value, tuple) else value!r} {reason}")

    def _only_with(self, other: str, holds: bool, *names: str) -> None:
        """Refuses fields off their defaults where what they need does not hold, such as `shape = 'dome'`."""
        for name in names:
            if not holds and getattr(self, name) != type(self).model_fields[name].default:
                self._refuse(name, f"goes with {other} only")


# Ranges, units and paths of fields


@cache
def field_range(model: type[BaseModel], name: str) -> Interval:
    """The range of a numeric field with its unit, such as `(0, 1e6] 1/m`, for `check_real` and `check_integer`."""
    return interval_of(model.model_fields[name])


def interval_of(info: FieldInfo) -> Interval:
    """The range of a numeric field, with its unit."""
    interval = Interval(-math.inf, math.inf, False, False)
    for part in parts_of(info):
        for name, includes in (("gt", False), ("ge", True)):
            if getattr(part, name, None) is not None:
                interval = interval._replace(low=getattr(part, name), includes_low=includes)
        for name, includes in (("lt", False), ("le", True)):
            if getattr(part, name, None) is not None:
                interval = interval._replace(high=getattr(part, name), includes_high=includes)
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


def with_paths(model: type[BaseModel], tables: Mapping[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """Tables of a model, not yet validated, with other paths of files."""
    changed = dict(tables)
    for name, info in model.model_fields.items():
        value, path = changed.get(name), file_path(info)
        inner = next(iter(models_of(info)), None)
        if path is not None and isinstance(value, str) and value.lower().endswith(path.ending):
            changed[name] = change(value)
        elif inner is not None:
            changed |= {name: _with_inner_paths(inner, value, change)} if name in changed else {}
    return changed


def _with_inner_paths(model: type[BaseModel], value: Any, change: Callable[[str], str]) -> Any:
    """A table, a list of tables, or some of its items by their index."""
    if isinstance(value, Mapping) and any(isinstance(key, int) for key in value):
        return {index: _with_inner_paths(model, item, change) for index, item in value.items()}
    if isinstance(value, list | tuple):
        return [_with_inner_paths(model, item, change) for item in value]
    return with_paths(model, value, change) if isinstance(value, Mapping) else value


def with_units(model: type[BaseModel], fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a section with texts as numbers; what cannot be read stays, for the section's validation to report."""
    changed = dict(fields)
    for name, value in fields.items():
        if name in model.model_fields:
            try:
                changed[name] = in_field_unit(value, model.model_fields[name])
            except ValueError:
                continue
    return changed
