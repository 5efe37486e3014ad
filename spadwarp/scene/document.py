"""TOML files as models: read, overridden, written; and their errors as lines that name field, value and range."""

from __future__ import annotations

import os
import re
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import BaseModel, PrivateAttr, ValidationError
from pydantic.fields import FieldInfo

from spadwarp.io.text import parse_toml
from spadwarp.scene.sections import (
    PRESETS,
    Section,
    field_unit,
    interval_of,
    models_of,
    parts_of,
    table_of,
    takes_any_table,
    with_paths,
)
from spadwarp.values import ConfigError, parse_number, quantity, shown, suggestion

__all__ = ["parse_override"]

Key = tuple[str | int, ...]
Overrides = Mapping[str, Any] | Sequence[str]
FileName = str | os.PathLike[str]


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
        here = folder if cls.overrides_beside_file else Path.cwd()
        layer: dict[str, Any] = {}
        items: dict[str, Any] = {}
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

    def to_toml(self, *, folder: FileName | None = None) -> str:
        """The full text that is read back to an equal document.

        `folder`: of the file that the text is for. Paths of files in it or in the folder above it, with the folders in
        these, are then relative to it: they still hold where all were moved together. Others stay absolute.
        """
        tables = self.to_dict()
        return toml_text(tables if folder is None else _relative(type(self), tables, folder))

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


def toml_text(tables: Mapping[str, Any]) -> str:
    """TOML of a document's tables, each array on one line."""
    import tomli_w

    # Strings are escaped to one line: a line that begins with a space, or with ] after a comma, belongs to an array.
    return re.sub(r"\n +", " ", re.sub(r",\n *(?=\])|(?<=\[)\n +", "", tomli_w.dumps(tables)))


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
    if not all(_is_index(part) or re.fullmatch(r"[a-zA-Z_]\w*", part, re.ASCII) for part in parts) or _is_index(
        parts[0]
    ):
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
    whole, is_known = f"override {shown(key_text(key))}", True
    table: type[BaseModel] | None = model
    is_list = False
    for part in key:
        if is_known and isinstance(part, int) == (table is not None and not is_list):
            raise ConfigError(f"{whole} does not name a field; write section.field or targets[0].field")
        if table is not None and isinstance(part, str):
            origins = [typing.get_origin(one) for one in parts_of(table.model_fields.get(part))]
            is_known = part in table.model_fields and not takes_any_table(table, part)
            table = table_of(table, part)
            is_list = table is not None and tuple in origins
        else:
            is_list = False
    if isinstance(value, Mapping) and table is not None:
        for name, inner in value.items():
            _insert(model, layer, (*key, int(name) if _is_index(name) else str(name)), inner)
        return
    if table is not None and isinstance(key[-1], int):
        raise ConfigError(f"{whole} does not name a field; write section.field or targets[0].field")
    for depth, part in enumerate(key[:-1], 1):
        layer = layer.setdefault(part, {})
        if not isinstance(layer, dict):
            raise ConfigError(f"{whole}: {key_text(key[:depth])} = {shown(layer)} is not a table")
    layer[key[-1]] = value


def key_text(key: Sequence[str | int]) -> str:
    """`targets[0].reflectance` from `("targets", 0, "reflectance")`."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).removeprefix(".")


# Messages

# What people write for a field's name, beyond misspellings.
_SYNONYMS = {
    "g": "anisotropy",
    "a": "absorption",
    "b": "scattering",
    "c": "extinction",
    "omega": "albedo",
    "fov": "horizontal_fov_deg",
}

_KINDS = {
    "float_type": "a number",
    "int_type": "an integer",
    "int_from_float": "an integer",
    "bool_type": "true or false",
    "string_type": "a string",
    "tuple_type": "a list",
    "model_type": "a table",
    "model_attributes_type": "a table",
}

_MOST = 50  # lines

_LIMITS = ("greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number")


def describe(error: ValidationError, model: type[BaseModel], overrides: Mapping[Any, Any]) -> list[str]:
    """One line for each field that `error` complains about; `overrides` is the layer set from outside the file."""
    lines: dict[Key, str] = {}
    problems = error.errors(include_url=False)
    located = [(*locate(model, problem["loc"]), problem) for problem in problems[:_MOST]]
    values = {key for key, _, problem in located if problem["type"] != "literal_error"}
    for key, info, problem in located:
        if problem["type"] != "literal_error" or key not in values:  # of a word or a value the value counts
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
            inner = next(iter(models_of(info)), None) if info is not None else None
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
    kind, value = problem["type"], problem["input"]
    if kind == "extra_forbidden":
        for part in (part for part in key[:-1] if isinstance(part, str)):
            model = models_of(model.model_fields[part])[0]
        word, siblings = str(key[-1]), list(model.model_fields)
        meant = _SYNONYMS.get(word)
        hint = f"; did you mean {meant!r}?" if meant in siblings else suggestion(word, siblings)
        hint = hint or f"; known are {', '.join(siblings)}"
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
        return f"{entry} is outside {interval_of(info)}{_also(' and not', choices)}{_percentage(info, value)}"
    if choices and not (kind in _KINDS and isinstance(value, str)):
        listed = ", ".join([*map(repr, choices), *texts[2:]]) if len(choices) < 9 else "the known presets"
        return f"{entry} is not one of {listed}{suggestion(value, choices)}"
    if kind in _KINDS:
        values = f" of {size} values" if kind == "tuple_type" and size is not None else ""
        words = f" neither {_KINDS[kind]}{_also(' nor', choices)}" if choices else f" not {_KINDS[kind]}{values}"
        return f"{entry} is{words}{_instead(key, info, kind, value)}"
    message = problem["msg"]
    return f"{entry}: {message[0].lower()}{message[1:]}"


def _also(before: str, words: Sequence[str]) -> str:
    return "".join(f"{before} {word!r}" for word in words)


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
    models = models_of(info) if kind.startswith("model") else []
    if not models:
        return _factor(key, value)
    if not isinstance(value, str):
        fields = list(models[0].model_fields)
        return f" of {', '.join(fields[:8])}{', ...' if len(fields) > 8 else ''}"
    known = list(PRESETS.get(getattr(models[0], "section", ""), {}))
    if value in known:
        return f'; a preset is taken by {{preset = "{value}"}}'
    return suggestion(value, known) or ("" if len(known) > 8 else f"; presets are {', '.join(map(repr, known))}")
