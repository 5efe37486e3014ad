"""The section `medium.layers`, and what a layer has in common with the medium."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from spadwarp.scene.coefficients import COEFFICIENTS, complete_coefficients
from spadwarp.scene.load import merge_section
from spadwarp.scene.quantities import with_units
from spadwarp.scene.sections import Coordinate, Section


class Water(Section):
    """What water does to light: two of four coefficients, or chlorophyll, from which they follow."""

    section: ClassVar[str] = "medium"
    preset: str | None = None
    """a named water, see `spadwarp list presets medium`"""
    absorption: float = Field(0.0, ge=0, le=1e6)
    """absorption coefficient a [1/m]"""
    scattering: float = Field(0.0, ge=0, le=1e6)
    """scattering coefficient b [1/m]"""
    extinction: float = Field(0.0, ge=1e-12, le=1e6)
    """extinction (beam attenuation) coefficient c = a + b [1/m]"""
    albedo: Annotated[float, Field(ge=0, le=1)] | Literal["lu2024"] = 0.0
    """single-scattering albedo b/c, or "lu2024": uniform in (0, 0.97) at each collision"""
    chlorophyll: float | None = Field(None, ge=0, le=30)
    """chlorophyll of the open ocean, in place of coefficients [mg/m³]"""

    @model_validator(mode="after")
    def _complete(self) -> Self:
        # What was given stays in model_fields_set, from where to_dict() knows it.
        if self.chlorophyll is None:
            self.__dict__.update(complete_coefficients({name: getattr(self, name) for name in self.given}))
        elif self.given or self.preset is not None:
            raise ValueError(f"chlorophyll = {self.chlorophyll} goes without {', '.join(self.given or ['preset'])}")
        return self

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the two coefficients that define the water, none with chlorophyll; the others follow."""
        return tuple(name for name in COEFFICIENTS if name in self.model_fields_set)

    @property
    def attenuation_length(self) -> float:
        """1/c [m]."""
        return 1.0 / self.extinction

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal section again: of the coefficients the given ones."""
        hidden = set(COEFFICIENTS) - set(self.given)
        return {name: value for name, value in super().to_dict().items() if name not in hidden}


class Layer(Water):
    """Water from a plane on, up to the next layer; given as a medium is."""

    start: Coordinate
    """where it begins along `layer_axis`, the world's z if not given [m]"""
    anisotropy: float | None = Field(None, gt=-1, lt=1)
    """henyey_greenstein: mean cosine of the scattering angle; default: the medium's"""

    @model_validator(mode="before")
    @classmethod
    def _expand_preset(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping):
            return fields
        whole = merge_section(cls.section, {}, with_units(cls, fields))
        # A preset has indices, but one pair of them holds for all layers: the medium's.
        return {name: value for name, value in whole.items() if name in fields or name in cls.model_fields}
