"""pydantic's errors as lines that name field, value and allowed range."""

from __future__ import annotations

import typing
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from spadwarp.limits import shown, suggestion
from spadwarp.scene.sections import field_unit, interval_of, models_of, parts_of
from spadwarp.scene.tables import Key, key_text, preset_hint
from spadwarp.units import quantity

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


def describe(error: ValidationError, model: type[BaseModel], overrides: Mapping[str, Any]) -> list[str]:
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


def _line(key: Key, info: FieldInfo | None, problem: Any, model: type[BaseModel], overridden: bool) -> str:
    name = key_text(key)
    name = name if len(name) <= 200 else f"{name[:200]}..."
    kind, value = problem["type"], problem["input"]
    if kind == "extra_forbidden":
        siblings = _fields(model, key[:-1])
        hint = _suggest(str(key[-1]), siblings) or f"; known are {', '.join(siblings)}"
        return f"{name} is not a known {'field' if len(key) > 1 else 'section'}{hint}"
    if kind == "missing" and not isinstance(key[-1], int):
        return f"{name} is missing" + (f" ({info.description})" if info is not None and info.description else "")
    cause = problem.get("ctx", {}).get("error")
    if kind in ("missing", "too_short", "too_long"):  # of a list
        name = key_text(key[: max(i for i, part in enumerate(key) if isinstance(part, str)) + 1])
        hint = "" if (size := _size(info)) is None else f"; {size} are needed"
        return f"{name} = {shown(value)} has the wrong number of values{hint}"
    entry = f"{name} = {shown(value)}" + (" (an override)" if overridden else "")
    if isinstance(cause, ValueError) and isinstance(cause.args[0], str) and len(cause.args) == 1:
        whole_table = isinstance(value, (Mapping, BaseModel))
        text = cause.args[0]
        if not key:  # of the scene as a whole
            return text
        if not whole_table:
            return f"{entry} {text}{_factor(key, value)}"
        return f"{name} {text}" if text.startswith(("needs", "holds", "is ")) else f"{name}.{text}"
    choices = _choices(info, cause)
    if kind in _LIMITS and info is not None:
        words = "".join(f" and not {word!r}" for word in choices)
        return f"{entry} is outside {interval_of(info)}{words}{_percentage(info, value)}"
    if choices and kind in _KINDS and isinstance(value, str):
        words = " nor ".join(map(repr, choices))
        return f"{entry} is neither {_KINDS[kind]} nor {words}{_instead(key, info, kind, value)}"
    if choices:
        others = [cause.args[2]] if cause is not None and len(cause.args) > 2 else []
        listed = ", ".join([*map(repr, choices), *others]) if len(choices) < 9 else "the known presets"
        return f"{entry} is not one of {listed}{_suggest(value, choices)}"
    if kind in _KINDS:
        size = _size(info) if kind == "tuple_type" else None
        what = "" if size is None else f" of {size} values"
        return f"{entry} is not {_KINDS[kind]}{what}{_instead(key, info, kind, value)}"
    message = problem["msg"]
    return f"{entry}: {message[0].lower()}{message[1:]}"


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
    if kind in ("model_type", "model_attributes_type") and isinstance(value, str) and info is not None:
        return "".join(preset_hint(getattr(one, "section", ""), value) for one in models_of(info)[:1])
    if kind in ("model_type", "model_attributes_type") and info is not None:
        fields = [name for one in models_of(info)[:1] for name in one.model_fields]
        return f" of {', '.join(fields[:8])}{', ...' if len(fields) > 8 else ''}"
    return _factor(key, value)


def _size(info: FieldInfo | None) -> int | None:
    """How many values the list of a field has."""
    sizes = (typing.get_args(part) for part in parts_of(info) if typing.get_origin(part) is tuple)
    return next((len(items) for items in sizes if ... not in items), None)


def _fields(model: type[BaseModel], key: Key) -> list[str]:
    """Names of the fields of the table at `key`."""
    for part in key:
        if isinstance(part, str):
            model = models_of(model.model_fields[part])[0]
    return list(model.model_fields)


def _suggest(name: Any, known: Sequence[str]) -> str:
    synonym = _SYNONYMS.get(name) if isinstance(name, str) else None
    return f"; did you mean {synonym!r}?" if synonym in known else suggestion(name, known)


def _choices(info: FieldInfo | None, cause: Any) -> tuple[str, ...]:
    """The words that a field takes: those of its literal type, or those that a validator names."""
    if isinstance(cause, ValueError) and len(cause.args) > 1:
        return tuple(cause.args[1])
    literals = (part for part in parts_of(info) if typing.get_origin(part) is typing.Literal)
    return tuple(word for part in literals for word in typing.get_args(part))


def _is_overridden(key: Key, layer: Mapping[str, Any]) -> bool:
    place: Any = layer
    if not key:
        return False
    for part in key[: 3 if key[0] == "targets" else 2]:
        if not isinstance(place, Mapping) or part not in place:
            return False
        place = place[part]
    return True
