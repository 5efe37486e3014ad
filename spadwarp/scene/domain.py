"""The section `domain`."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from spadwarp.scene.sections import Corner, Section, Whole

Index = Annotated[float, Field(ge=1, le=1e9)]


class OutsideIndex(Section):
    """Faces of the domain that reflect as the boundary of two media: walls of a tank, the surface seen from below.

    A face that has no index lets all light out.
    """

    section: ClassVar[str] = "outside_index"
    x_low: Index | None = None
    """phase index behind the face at the lower bound in x"""
    x_high: Index | None = None
    """the same at the upper bound in x"""
    y_low: Index | None = None
    """the same at the lower bound in y"""
    y_high: Index | None = None
    """the same at the upper bound in y"""
    z_low: Index | None = None
    """the same at the lower bound in z"""
    z_high: Index | None = None
    """the same at the upper bound in z"""


class Domain(Section):
    """Where the water is, in the world; camera and laser must be inside. A photon that comes to a face leaves, and is
    gone, unless the face has an `outside_index`: there it is reflected, by Fresnel's formulas for unpolarised light."""

    section: ClassVar[str] = "domain"
    shape: Literal["unbounded", "slab", "box"] = "unbounded"
    """slab: bounded in z; box: in x, y and z"""
    lower: Corner = (-math.inf,) * 3
    """lower corner [m]; one number for all three; a slab uses z"""
    upper: Corner = (math.inf,) * 3
    """upper corner [m]; one number for all three; a slab uses z"""
    outside_index: OutsideIndex | None = None
    """phase index behind the faces that reflect, such as `{y_low = 1.0}`: 1 is air, a very large number a mirror"""
    max_reflections: Whole = Field(2, ge=0, le=8)
    """longest chain of reflections on the way from a scattering to the lens; light by longer ones is left out"""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for axis, low, high in zip("xyz", *self.bounds, strict=True):
            if not low < high:
                raise ValueError(f"lower = {low} is outside (-inf, {high}), {high} being upper in {axis}")
        for name in self.reflecting:
            bound = self.bounds[name.endswith("high")]["xyz".index(name[0])]
            if math.isinf(bound):
                raise ValueError(
                    f"outside_index.{name}: the domain has no such face with shape = {self.shape!r}; a slab has z_low "
                    "and z_high, a box all six, each where lower or upper is finite"
                )
        return self

    @property
    def reflecting(self) -> dict[str, float]:
        """Phase index behind each face that reflects, by the face's name."""
        return {} if self.outside_index is None else self.outside_index.to_dict()

    @property
    def bounds(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Lower and upper corner as they act [m]; infinite where the shape has no bound."""
        free = {"unbounded": 3, "slab": 2, "box": 0}[self.shape]
        low, high = (-math.inf,) * free + self.lower[free:], (math.inf,) * free + self.upper[free:]
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])
