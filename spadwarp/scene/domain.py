"""The section `domain`."""

from __future__ import annotations

import math
from typing import ClassVar, Literal, Self

from pydantic import model_validator

from spadwarp.scene.sections import Corner, Section


class Domain(Section):
    """Where the water is, in the world. A photon that leaves it is gone; camera and laser must be inside."""

    section: ClassVar[str] = "domain"
    shape: Literal["unbounded", "slab", "box"] = "unbounded"
    """slab: bounded in z; box: in x, y and z"""
    lower: Corner = (-math.inf,) * 3
    """lower corner [m]; one number for all three; a slab uses z"""
    upper: Corner = (math.inf,) * 3
    """upper corner [m]; one number for all three; a slab uses z"""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for axis, low, high in zip("xyz", *self.bounds, strict=True):
            if not low < high:
                raise ValueError(f"lower = {low} is outside (-inf, {high}), {high} being upper in {axis}")
        return self

    @property
    def bounds(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Lower and upper corner as they act [m]; infinite where the shape has no bound."""
        free = {"unbounded": 3, "slab": 2, "box": 0}[self.shape]
        low, high = (-math.inf,) * free + self.lower[free:], (math.inf,) * free + self.upper[free:]
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])
