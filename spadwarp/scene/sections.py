"""Sections of a scene and documents of sections: strict, frozen tables, read from TOML, overridden, written.

A range stands once, on its field: messages, functions that take the same number, and the JSON schema read it there. So
does the unit, in brackets in the field's docstring; a number of real value without one takes `%` alone:
`pulse_energy = "150 nJ"`, `translation = [0, "20 cm", 9]`. Errors are lines that name field, value and range.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import os
import re
import sys
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, ValidationInfo
from pydantic.fields import FieldInfo
from pydantic.functional_validators import AfterValidator, BeforeValidator, field_validator, model_validator

from spadwarp.io.paths import sha256
from spadwarp.io.text import parse_toml, read_columns, read_toml
from spadwarp.values import (
    UNITS,
    ConfigError,
    FileError,
    Interval,
    bounds,
    check_choice,
    parse_number,
    quantity,
    shown,
    suggestion,
)

__all__ = ["Preset", "parse_override", "presets"]

Key = tuple[str | int, ...]
Overrides = Mapping[str, Any] | Sequence[str]
FileName = str | os.PathLike[str]

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


def from_one(count: int) -> BeforeValidator:
    """One number stands for as many."""
    return BeforeValidator(lambda value: (value,) * count if type(value) in (int, float) else value)


def _with_length(vector: tuple[float, ...]) -> tuple[float, ...]:
    if math.hypot(*vector) < 1e-9:
        raise ValueError("has no length")
    return vector


# TOML writes 2e9 as a float; a whole one is as good as an integer.
Whole = Annotated[int, BeforeValidator(lambda x: int(x) if isinstance(x, float) and x.is_integer() else x)]
# Every number has a range in which products of several stay within single precision.
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Direction = Annotated[Vector, AfterValidator(_with_length)]
Infinite = BeforeValidator(lambda value: math.inf if value == "infinity" else value)
Bound = Annotated[float, Field(ge=-math.inf, le=math.inf, allow_inf_nan=True)]
Corner = Annotated[tuple[Bound, Bound, Bound], from_one(3)]
Scale = Annotated[Vector, from_one(3)]
_UP_TO_THREE = from_one(1), Field(min_length=1, max_length=3)
Size = Annotated[tuple[Annotated[float, Field(ge=1e-9, le=1e9)], ...], *_UP_TO_THREE]
Counts = Annotated[tuple[Annotated[int, Field(ge=1, le=1024)], ...], *_UP_TO_THREE]
File = Annotated[str | None, FilePath()]
CsvFile = Annotated[str | None, FilePath(".csv")]


@dataclass(frozen=True)
class Preset:
    """Fields of one section of a scene, `values`, and where they come from, `source`."""

    section: str
    name: str
    values: Mapping[str, Any]
    source: str


def _read_presets() -> dict[str, dict[str, Preset]]:
    tables = read_toml(Path(__file__).with_name("presets.toml"))
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

    Raises `ArgumentError` for a section without presets.
    """
    if section is not None:
        return dict(PRESETS[check_choice("section", section, list(PRESETS))])
    return {f"{section}.{name}": preset for section, rows in PRESETS.items() for name, preset in rows.items()}


if TYPE_CHECKING:
    _Model = BaseModel
else:

    class _Refusing(type(BaseModel)):
        """Fields given in Python are refused as those of a file are."""

        def __call__(cls, /, *arguments: Any, **fields: Any) -> Any:
            try:
                return super().__call__(*arguments, **fields)
            except ValidationError as error:
                raise ConfigError(describe(error, cls, {})) from None

    class _Model(BaseModel, metaclass=_Refusing):
        pass


@cache
def _texts_of(module: str) -> dict[str, dict[str, str]]:
    """Docstrings below the fields of a module's classes. Pydantic's own way reads the file again for each class, a
    third of the time in which scenes are loaded."""
    return {
        model.name: {
            field.target.id: inspect.cleandoc(text.value.value)
            for field, text in itertools.pairwise(model.body)
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
            if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str)
        }
        for model in ast.parse(inspect.getsource(sys.modules[module])).body
        if isinstance(model, ast.ClassDef)
    }


class Section(_Model):
    """One table of a scene: frozen, strict about types, unknown keys refused.

    A preset, `preset = "uwoc-harbour"`, lies under the section's own fields; it need not fill its section.
    """

    model_config = ConfigDict(
        defer_build=True, frozen=True, extra="forbid", strict=True, allow_inf_nan=False, protected_namespaces=()
    )
    section: ClassVar[str] = ""
    """Whose presets it takes."""
    alternatives: ClassVar[tuple[str, ...]] = ()
    """Fields of which some are given; the others follow from them."""
    displaces: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Fields that drop others, which they exclude, from what they are laid over."""

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        for name, text in _texts_of(cls.__module__).get(cls.__name__, {}).items():
            if name in cls.model_fields:
                cls.model_fields[name].description = text

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_"):
            return super().__setattr__(name, value)
        raise AttributeError(
            f"{name} cannot be assigned: a scene does not change; scene.with_overrides makes another one"
        )

    @model_validator(mode="before")
    @classmethod
    def _over_preset(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping):
            return fields
        if cls._preset(fields) is not None:
            return cls.merged({}, fields)
        return {name: value for name, value in fields.items() if value is not None}

    @field_validator("*", mode="before")
    @classmethod
    def _read(cls, value: Any, info: ValidationInfo) -> Any:
        """Numbers with a unit as numbers, TOML's lists as tuples; names of presets and endings of files are checked."""
        name = info.field_name or ""
        value = in_field_unit(value, field := cls.model_fields[name])
        if not isinstance(value, str):
            return tuple(value) if isinstance(value, list) else value
        if name == "preset" and value not in PRESETS[cls.section]:
            raise ValueError("preset", tuple(PRESETS[cls.section]))
        path = file_path(field)
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
            over = table_of(cls, name), base.get(name), layer[name], f"{at}.{name}".lstrip(".")
            merged[name] = _over(*over) if name in cls.model_fields else layer[name]
        merged = {name: value for name, value in merged.items() if name not in dropped}
        preset = cls._preset(merged)
        if preset is not None and any(name in preset.values for name in dropped):
            del merged["preset"]  # no longer that preset
        return merged

    @classmethod
    def _kept(cls, base: Mapping[str, Any], layer: Mapping[str, Any]) -> dict[str, Any]:
        """What a layer leaves of the fields that it is laid over."""
        new = [name for name, value in layer.items() if value is not None]
        displaced = {other for name in new for other in cls.displaces.get(name, ())}
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
        """Why fields exclude each other; where they do not, sets what follows from those that were given."""
        yield from ()

    def _that(self, name: str, reason: str) -> str:
        """A problem of a field: `half_angle_deg = 95.0 is outside (0, 90) °`."""
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
            raise ConfigError(f"{name}[{index}] does not exist; {name} ends at {name}[{len(items) - 1}]")
        items[index : index + 1] = [_over(model, dict(enumerate(items)).get(index), item, f"{name}[{index}]")]
    return items


# Ranges, units, tables and paths of fields


@cache
def field_range(model: type[BaseModel], name: str) -> Interval:
    """The range of a numeric field with its unit, such as `(0, 1e6] 1/m`, for `check_real` and `check_integer`."""
    return interval_of(model.model_fields[name])


def interval_of(info: FieldInfo) -> Interval:
    """The same of a field."""
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


def table_in(annotation: Any) -> type[Section] | None:
    """The model of the table, or of the tables of the list, that an annotation names."""
    parts = parts_of(annotation)
    return next((part for part in parts if isinstance(part, type) and issubclass(part, Section)), None)


@cache
def table_of(model: type[BaseModel], name: str) -> type[Section] | None:
    """The same of a field."""
    return table_in(model.model_fields.get(name))


def field_unit(info: FieldInfo) -> str | None:
    """The unit of a field's numbers, "1" for a ratio; None where it takes no real numbers."""
    if not any(part is float or getattr(part, "numeric", False) for part in parts_of(info)):
        return None
    bracketed = re.findall(r"\[([^\]]+)\]", info.description or "")
    return next((unit for unit in bracketed if unit in UNITS), None if bracketed else "1")


def in_field_unit(value: Any, info: FieldInfo) -> Any:
    """A text, or those of a list or table, as numbers of the field's unit; NumPy's values as Python's; others stay.

    Raises `ValueError` for a text that begins like a number and is none of the field's unit.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple) and any(isinstance(item, str) for item in value):
        numbers = []
        for item in value:
            try:
                numbers.append(in_field_unit(item, info))
            except ValueError as error:
                raise ValueError(f"holds {item!r}, which {error}") from None
        return type(value)(numbers)
    if isinstance(value, Mapping):
        return {name: in_field_unit(item, info) for name, item in value.items()}
    unit = field_unit(info) if isinstance(value, str) and _NUMBER.match(value) else None
    if unit is None:
        return value
    try:
        return quantity(value, unit)
    except ValueError as error:
        if unit == "1" and "did you mean" not in str(error):
            raise ValueError("is text; a number without quotes is needed, or a percentage") from None
        raise error from None


def with_units(model: type[BaseModel], fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a table with texts as numbers; what cannot be read stays, for its validation to report."""
    changed = dict(fields)
    for name in changed.keys() & model.model_fields.keys():
        with suppress(ValueError):
            changed[name] = in_field_unit(changed[name], model.model_fields[name])
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


@contextmanager
def file_of(field: str) -> Iterator[None]:
    """Errors of a file that is read in the block name the field that names the file."""
    try:
        yield
    except FileError as error:
        raise FileError(f"{field} = {error}") from None
    except ConfigError as error:
        raise ConfigError(f"{field}: {error}") from None


def read_table(field: str, path: str | Path, columns: Mapping[str, str]) -> NDArray[np.float64]:
    """Columns of the .csv file that a field names, `[columns, rows]`; raises what `read_columns` raises."""
    with file_of(field):
        return read_columns(path, columns).T


# Documents

# Field that one kind of file has: the kind, and how `spadwarp list` calls its examples.
_FILES = {
    "camera": ("a scene", "scenes"),
    "scene": ("a recipe of a dataset", "datasets"),
    "model": ("a recipe of a training", "training"),
}


class Document(Section):
    """What a TOML file holds. Documents are equal in every field; where they came from does not matter."""

    overrides_beside_file: ClassVar[bool] = False
    """Whether relative paths in overrides start at the file's folder too, not at the working directory."""
    _source: Path | None = PrivateAttr(None)

    @classmethod
    def from_dict(
        cls, tables: Mapping[str, Any], *, source: FileName | None = None, overrides: Overrides | None = None
    ) -> Self:
        """From tables as TOML gives them, and what lies over them; relative paths start at `source`'s folder.

        Raises `ConfigError` with a line for each problem.
        """
        file = None if source is None else Path(source)
        folder = None if file is None else file.absolute().parent
        own, (kind, examples) = next(item for item in _FILES.items() if item[0] in cls.model_fields)
        for mark, (other, _) in _FILES.items():
            if mark in tables and own not in tables:
                raise ConfigError(f"{other}; {kind} is needed, see `spadwarp list {examples}`", source=file)
        here = folder if cls.overrides_beside_file else Path.cwd()
        layer, items = dict[str, Any](), dict[str, Any]()
        try:
            tables = _absolute(cls, tables, folder)
            for key, value in override_pairs(overrides or {}):
                # Items of lists that may be defaults, or follow from other fields, are set in what is complete.
                _insert(cls, items if any(isinstance(part, int) for part in key[2:]) else layer, key, value)
            if layer:
                tables = cls.merged(tables, _absolute(cls, layer, here))
            made = cls.model_validate(tables)
            if items:
                layer = items
                made = cls.model_validate(cls.merged(made.to_dict(), _absolute(cls, items, here)))
            made._check()
        except ConfigError as error:
            raise ConfigError(error.problems, source=file) from None
        except ValidationError as error:
            raise ConfigError(describe(error, cls, layer), source=file) from None
        made._source = file
        return made

    @classmethod
    def from_toml(cls, text: str, *, source: FileName | None = None) -> Self:
        """From the text that `to_toml` made, in a file of results or frames. Raises `ConfigError`."""
        return cls.from_dict(parse_toml(text), source=source)

    def _check(self) -> None:
        """Raises `ConfigError` for what its tables cannot show."""

    @property
    def source(self) -> Path | None:
        """The file that it came from."""
        return self._source

    @property
    def files(self) -> list[Path]:
        """Files that it refers to: meshes, tables and images, all that `to_dict` names."""
        found: list[Path] = []

        def noted(path: str) -> str:
            found.append(Path(path))
            return path

        with_paths(type(self), self.to_dict(), noted)
        return [path for path in found if path.suffix]

    def file_hashes(self) -> tuple[str, ...]:
        """SHA-256 of each of `files` as it is now. Raises `FileError`."""
        return tuple(map(sha256, self.files))

    def to_toml(self, *, folder: FileName | None = None) -> str:
        """The full text that is read back to an equal document.

        `folder`: of the file that the text is for. Paths of files in it or in the folder above it, with the folders in
        these, are then relative to it: they still hold where all were moved together. Others stay absolute.
        """
        import tomli_w

        tables = self.to_dict()
        text = tomli_w.dumps(tables if folder is None else _relative(type(self), tables, folder))
        # Each array on one line. Strings are escaped to one line: a line that begins with a space, or with ] after a
        # comma, belongs to an array.
        return re.sub(r"\n +", " ", re.sub(r",\n *(?=\])|(?<=\[)\n +", "", text))

    def with_overrides(self, overrides: Overrides | None = None, /, **sections: Any) -> Self:
        """A changed copy: `with_overrides({"medium.extinction": 0.9})`, `with_overrides(medium={"extinction": 0.9})`.

        Overrides act as in `load_scene`. Raises `ConfigError`.
        """
        changed = self
        for layer in (overrides, sections):
            if layer:
                changed = self.from_dict(changed.to_dict(), overrides=layer, source=self.source)
        return changed

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self.__dict__ == other.__dict__


def _absolute(model: type[BaseModel], tables: Mapping[str, Any], folder: Path | None) -> dict[str, Any]:
    """The tables with paths that are relative to a folder made absolute."""
    if folder is None:
        return dict(tables)

    def placed(name: str) -> str:
        path = folder / os.path.expanduser(name)
        short = os.path.normpath(path)
        return short if ".." in path.parts and _is_same(short, path) else str(path)

    return with_paths(model, tables, placed)


def _relative(model: type[BaseModel], tables: Mapping[str, Any], folder: str | os.PathLike[str]) -> dict[str, Any]:
    """The tables with the paths that a file in a folder has, see `Document.to_toml`."""
    here = os.path.abspath(folder)
    above = os.path.dirname(here)
    root = above if os.path.dirname(above) != above else here  # that of a disk holds all files

    def shortened(value: str) -> str:
        place = os.path.abspath(value)
        if not Path(place).is_relative_to(root):
            return place
        relative = os.path.relpath(place, here)
        return Path(relative).as_posix() if _is_same(os.path.join(here, relative), place) else place

    return with_paths(model, tables, shortened)


def _is_same(one: str | Path, other: str | Path) -> bool:
    """Whether two paths lead to one place; links may make a difference of `..`."""
    try:
        return os.path.realpath(one) == os.path.realpath(other)
    except (OSError, ValueError):  # no path at all
        return False


# Overrides


def parse_override(text: str) -> tuple[Key, Any]:
    """The key and the value of one `section.field=value`.

    The value is in TOML syntax; what is not TOML is taken as a bare string. Targets are written
    `targets[0].reflectance` or `targets.0.reflectance`. `parse_override("medium.extinction=0.9")` is
    `(("medium", "extinction"), 0.9)`. Raises `ConfigError`.
    """
    name, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not value:
        raise ConfigError(f"override {shown(text)} is not of the form section.field=value")
    return parse_key(name), _parse_value(value, text)


def parse_key(name: str) -> Key:
    """`("targets", 0, "reflectance")` from `targets[0].reflectance` or `targets.0.reflectance`.

    Raises `ConfigError`.
    """
    parts = re.sub(r"\[([0-9]+)\]", r".\1", name).split(".")
    if _is_index(parts[0]) or not all(re.fullmatch(r"[0-9]{1,9}|[a-zA-Z_]\w*", part, re.ASCII) for part in parts):
        raise ConfigError(f"override {shown(name)} does not name a field; write section.field or targets[0].field")
    return tuple(int(part) if _is_index(part) else part for part in parts)


def _is_index(name: Any) -> bool:
    return re.fullmatch(r"[0-9]{1,9}", str(name)) is not None


def _parse_value(value: str, text: str) -> Any:
    try:
        table = parse_toml(f"value = {value}")
    except ConfigError as error:
        if value[0] in "\"'[{":
            hint = "; TOML writes a table as {name = value}" if re.search(r"[\"'\w]\s*:", value) else ""
            raise ConfigError(f"override {shown(text)}: {error}{hint}") from None
        try:
            return parse_number(value)  # .9 and 5. are not TOML, but mean numbers
        except ValueError:
            if re.fullmatch(r"[-+.\d]+(\s*,\s*[-+.\d]+)+", value):
                raise ConfigError(f"override {shown(text)} is a list: write [{value}]") from None
            return value
    return table["value"] if len(table) == 1 else value


def override_pairs(overrides: Overrides) -> list[tuple[Key, Any]]:
    """Keys and values of `["medium.extinction=0.9"]`, `{"medium.extinction": 0.9}` or nested mappings.

    Raises `ConfigError`.
    """
    if isinstance(overrides, Mapping):
        return [(parse_key(str(name)), value) for name, value in overrides.items()]
    texts = [overrides] if isinstance(overrides, str) else overrides
    if not (isinstance(texts, Sequence) and all(isinstance(text, str) for text in texts)):
        raise ConfigError(f"overrides = {shown(overrides)} are neither a dict nor texts such as 'section.field=value'")
    return [parse_override(text) for text in texts]


def _insert(model: type[BaseModel], layer: dict[Any, Any], key: Key, value: Any) -> None:
    """Sets in a layer for `Section.merged` what an override names: a field, an item of a list, or a table's fields."""
    whole, is_known, is_list = f"override {shown(key_text(key))}", True, False
    unfit = ConfigError(f"{whole} does not name a field; write section.field or targets[0].field")
    table: type[BaseModel] | None = model
    key, value = (key[:-1], None) if key[1:] and (key[-1], value) == ("preset", "none") else (key, value)  # no port
    for part in key:
        if is_known and isinstance(part, int) == (table is not None and not is_list):
            raise unfit
        if table is not None and isinstance(part, str):
            origins = [typing.get_origin(one) for one in parts_of(table.model_fields.get(part))]
            is_known = part in table.model_fields and dict not in origins
            table = table_of(table, part)
            is_list = table is not None and tuple in origins
        else:
            is_list = False
    if isinstance(value, Mapping) and table is not None:
        for name, inner in value.items():
            _insert(model, layer, (*key, int(name) if _is_index(name) else str(name)), inner)
        return
    if table is not None and isinstance(key[-1], int):
        raise unfit
    for depth, part in enumerate(key[:-1], 1):
        layer = layer.setdefault(part, {})
        if not isinstance(layer, dict):
            raise ConfigError(f"{whole}: {key_text(key[:depth])} = {shown(layer)} is not a table")
    layer[key[-1]] = value


def key_text(key: Sequence[str | int]) -> str:
    """`parse_key` undone: `targets[0].reflectance`."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).removeprefix(".")


# Messages

# What people write for a field's name, beyond misspellings.
_SYNONYMS = {"g": "anisotropy", "a": "absorption", "b": "scattering", "c": "extinction", "omega": "albedo"}
_SYNONYMS |= {"fov": "horizontal_fov_deg", "water": "medium", "light": "laser", "sensor": "camera", "spad": "detector"}
_SYNONYMS |= {"min": "low", "max": "high"}

_KINDS = {"float_type": "a number", "int_type": "an integer", "int_from_float": "an integer", "tuple_type": "a list"}
_KINDS |= {"bool_type": "true or false", "string_type": "a string"}
_KINDS |= {"model_type": "a table", "model_attributes_type": "a table"}

_MOST = 50  # lines

_LIMITS = ("greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number")


def describe(error: ValidationError, model: type[BaseModel], overrides: Mapping[Any, Any]) -> list[str]:
    """One line for each field that `error` complains about; `overrides` is the layer set from outside the file."""
    lines: dict[Key, str] = {}
    problems = error.errors(include_url=False)
    located = [(*locate(model, problem["loc"]), problem) for problem in problems[:_MOST]]
    values = [key for key, _, problem in located if problem["type"] != "literal_error"]  # which count, not the words
    lists = {key[:-1] for key, _, _ in located}  # without their wrong items they may seem too short
    for key, info, problem in located:
        if problem["type"] == "too_short" and key in lists:
            continue
        if problem["type"] != "literal_error" or not any(one[: len(key)] == key for one in values):
            lines.setdefault(key, _line(key, info, problem, model, _is_overridden(key, overrides)))
    more = [f"{len(problems) - _MOST} more problems"] if len(problems) > _MOST else []
    return [*dict.fromkeys(lines.values()), *more]  # a list that is too short misses each item


def locate(model: type[BaseModel], loc: Sequence[str | int]) -> tuple[Key, FieldInfo | None]:
    """The part of `loc` that names a field or a list's item, without pydantic's branch names, and the field."""
    key: list[str | int] = []
    info: FieldInfo | None = None
    inner: type[BaseModel] | None = model
    for part in loc:
        if isinstance(part, int):
            key.append(part)
        elif inner is not None and not part.startswith(("literal[", "function-")):
            key.append(part)
            info = inner.model_fields.get(part)
            inner = table_of(inner, part)
    return tuple(key), info


def _is_overridden(key: Key, layer: Any) -> bool:
    """Whether a layer sets what a key names."""
    for part in key:
        if not isinstance(layer, Mapping):
            return True
        if part not in layer:
            return False
        layer = layer[part]
    return bool(key)


def _line(key: Key, info: FieldInfo | None, problem: Any, model: type[BaseModel], overridden: bool) -> str:
    name = key_text(key)
    name = name if len(name) <= 200 else f"{name[:200]}..."
    kind, value, whole = problem["type"], problem["input"], model
    if kind == "extra_forbidden":
        for part in (part for part in key[:-1] if isinstance(part, str)):
            model = table_of(model, part) or model
        word, siblings = str(key[-1]), list(model.model_fields)
        meant = _SYNONYMS.get(word)
        near = f"; did you mean {meant!r}?" if meant in siblings else suggestion(word, siblings)
        near = "; it is pdp · fill_factor, which are fields" if word == "pde" and "pdp" in siblings else near
        homes = [home for home in whole.model_fields if word in getattr(table_of(whole, home), "model_fields", ())]
        homes = [] if isinstance(key[-2:][0], int) else homes  # an item of a list is not confused with a section
        hint = f"; did you mean {' or '.join(f'{home}.{word}' for home in homes[:2])}?" if homes else ""
        hint = (near or hint if len(key) == 1 else hint or near) or f"; known are {', '.join(siblings)}"
        return f"{name} is not a known {'field' if len(key) > 1 else 'section'}{hint}"
    if kind == "missing" and not isinstance(key[-1], int):
        return f"{name} is missing" + (f" ({info.description})" if info is not None and info.description else "")
    tuples = (typing.get_args(part) for part in parts_of(info) if typing.get_origin(part) is tuple)
    size = next((len(items) for items in tuples if ... not in items), None)
    if kind in ("missing", "too_short", "too_long"):  # of a list
        name = key_text(key[: max(i for i, part in enumerate(key) if isinstance(part, str)) + 1])
        hint = "" if size is None else f"; {size} are needed"
        return f"{name} = {shown(value)} has the wrong number of values{hint}"
    entry = f"{name} = {shown(value)}" + (" (an override)" if overridden else "")
    cause = problem.get("ctx", {}).get("error")
    texts = cause.args if isinstance(cause, ValueError) else ()
    if len(texts) == 1 and isinstance(text := texts[0], str):  # of a validator
        if not key:  # of the document as a whole
            return text
        if not isinstance(value, Mapping | BaseModel):
            return f"{entry} {text}{_factor(key, value)}"
        return f"{name} {text}" if text.startswith(("needs", "holds", "is ")) else f"{name}.{text}"
    # The words that a field takes: those that a validator names, or those of its literal type.
    literals = (part for part in parts_of(info) if typing.get_origin(part) is typing.Literal)
    choices = tuple(texts[1]) if len(texts) > 1 else tuple(w for part in literals for w in typing.get_args(part))
    if kind in _LIMITS and info is not None:
        others = "" if isinstance(key[-1], int) else "".join(f" and not {word!r}" for word in choices)
        return f"{entry} is outside {interval_of(info)}{others}{_percentage(info, value)}"
    if choices and kind not in _KINDS:
        listed = ", ".join([*map(repr, choices), *texts[2:]])
        listed = listed if len(choices) < 9 else f"those of `spadwarp list presets {key[0]}`"
        return f"{entry} is not one of {listed}{suggestion(value, choices)}"
    if kind in _KINDS:
        values = f" of {size} values" if kind == "tuple_type" and size is not None else ""
        values = f" in {interval_of(info)}" if kind.startswith("int_") and info is not None else values
        words = f" not {_KINDS[kind]}{values}"
        if choices:
            words = f" neither {' nor '.join([_KINDS[kind], *map(repr, choices)])}"
        return f"{entry} is{words}{_instead(key, info, kind, value)}"
    if kind == "string_pattern_mismatch" and info is not None:
        return f"{entry} is no {info.description}"
    return f"{entry}: {problem['msg'][0].lower()}{problem['msg'][1:]}"


def _factor(key: Key, value: Any) -> str:
    """A hint where a mesh's scale is given as a length."""
    try:
        metres = quantity(value if any(map(str.isdigit, value)) else f"1 {value}", "m") if key[-1] == "scale" else None
    except (TypeError, ValueError):
        return ""
    return "" if metres is None else f"; for a mesh in units of {value.strip()} write {metres:g}"


def _percentage(info: FieldInfo, value: Any) -> str:
    """A hint where a ratio within [0, 1] is given in per cent."""
    bounds, number = interval_of(info), isinstance(value, int | float) and not isinstance(value, bool)
    if not number or field_unit(info) != "1" or bounds.low < 0.0 or bounds.high != 1.0 or not 2 <= value <= 100:
        return ""
    return f'; did you mean "{value:g} %"?' if 0.01 * value in bounds else ""


def _instead(key: Key, info: FieldInfo | None, kind: str, value: Any) -> str:
    """A hint where a value is of another kind: how it is written."""
    if kind == "tuple_type" and isinstance(value, Mapping):
        return f" of tables; write [[{key_text(key)}]]"
    if kind == "tuple_type" and isinstance(value, str) and not {float, int} & set(parts_of(info)):
        return f"; write [{value!r}]"
    table = table_in(info) if kind.startswith("model") else None
    if table is None:
        return _factor(key, value)
    if not isinstance(value, str):
        fields, once = list(table.model_fields), f", of which there is one; write [{key_text(key)}]"
        return once if isinstance(value, list | tuple) else f" of {', '.join(fields[:8])}{', ...' * (len(fields) > 8)}"
    known = list(PRESETS.get(table.section, {}))
    if value in known:
        return f'; a preset is taken by {{preset = "{value}"}}'
    listed = f"; presets are {', '.join(map(repr, known))}" if 0 < len(known) < 9 else ""
    return suggestion(value, known) or listed
