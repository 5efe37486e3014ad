"""What all sections of a scene have in common: strictness, presets, and types of fields."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from spadwarp.scene.load import merge_section
from spadwarp.scene.preset import PRESETS
from spadwarp.scene.quantities import in_field_unit, with_units


def _whole(value: Any) -> Any:
    """TOML writes 2e9 as a float; a whole one is as good as an integer."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def listed(value: Any) -> Any:
    """TOML has lists; what is frozen holds tuples."""
    return tuple(value) if isinstance(value, list) else value


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


Whole = Annotated[int, BeforeValidator(_whole)]
# Every number has a range in which products of several stay within single precision.
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
Vector = Annotated[tuple[Coordinate, Coordinate, Coordinate], BeforeValidator(listed)]
Brown = Annotated[tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate], BeforeValidator(_padded)]
Bound = Annotated[float, Field(ge=-math.inf, le=math.inf, allow_inf_nan=True)]
Corner = Annotated[tuple[Bound, Bound, Bound], _repeated(3)]
Size = Annotated[tuple[Annotated[float, Field(ge=1e-9, le=1e9)], ...], _repeated(1), Field(min_length=1, max_length=3)]
Counts = Annotated[tuple[Annotated[int, Field(ge=1, le=1024)], ...], _repeated(1), Field(min_length=1, max_length=3)]
Scale = Annotated[tuple[Coordinate, Coordinate, Coordinate], _repeated(3)]


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

    @model_validator(mode="before")
    @classmethod
    def _expand_preset(cls, fields: Any) -> Any:
        return merge_section(cls.section, {}, with_units(cls, fields)) if isinstance(fields, Mapping) else fields

    @field_validator("*", mode="before")
    @classmethod
    def _with_unit(cls, value: Any, info: ValidationInfo) -> Any:
        return in_field_unit(value, cls.model_fields[info.field_name or ""])

    @field_validator("preset", check_fields=False)
    @classmethod
    def _known_preset(cls, name: str | None) -> str | None:
        if name is not None and name not in PRESETS[cls.section]:
            raise ValueError("preset", tuple(PRESETS[cls.section]))
        return name

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal section again, without those that are None."""
        return {
            name: value.to_dict() if isinstance(value, Section) else value for name, value in self if value is not None
        }
