"""Numbers with a unit in scene files and overrides: `pulse_energy = "150 nJ"`, `translation = [0, "20 cm", 9]`.

A field's own unit stands in brackets in its docstring; a number of real value without one takes `%` alone.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from spadwarp.units import UNITS, quantity

__all__ = ["field_unit", "in_field_unit", "takes_integers", "with_units"]

_NUMBER = re.compile(r"\s*[+-]?\.?\d")


def field_unit(info: FieldInfo) -> str | None:
    """The unit of a field's numbers, "1" for a ratio; None where it takes no real numbers."""
    if float not in _types(info.annotation):
        return None
    bracketed = re.findall(r"\[([^\]]+)\]", info.description or "")
    return next((unit for unit in bracketed if unit in UNITS), None if bracketed else "1")


def takes_integers(info: FieldInfo) -> bool:
    """Whether a field's numbers are whole."""
    types = _types(info.annotation)
    return int in types and float not in types


def _types(annotation: Any) -> set[Any]:
    inner = typing.get_args(annotation)
    return set().union(*map(_types, inner)) if inner else {annotation}


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
    """Fields of a section with texts as numbers; what cannot be read stays, for the section's validation to report."""
    changed = dict(fields)
    for name, value in fields.items():
        if name in model.model_fields:
            try:
                changed[name] = in_field_unit(value, model.model_fields[name])
            except ValueError:
                continue
    return changed
