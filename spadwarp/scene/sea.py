"""The table `surface`: the surface of the sea between air and water, by the statistics of its slopes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from spadwarp.scene.port import air_indices
from spadwarp.scene.pose import unit_vector
from spadwarp.scene.sections import Direction, Section, Vector, field

__all__: list[str] = []

_LEAST_VARIANCE = 1e-9


class Surface(Section):
    """The surface of the sea: a mean plane with air above and water below; camera, laser and targets on either side."""

    section: ClassVar[str] = "surface"
    displaces: ClassVar = {"wind": ("mean_square_slope",), "mean_square_slope": ("wind", "direction")}
    preset: str | None = field(None, "a named state of the sea, see `spadwarp list presets surface`")
    point: Vector = field((0.0, 0.0, 0.0), "a point of the mean plane, in the world [m]")
    up: Direction = field((0.0, -1.0, 0.0), "direction out of the water in the world; any length but 0")
    wind: float | None = field(None, "speed of the wind 12.5 m above the sea, after Cox and Munk [m/s]", "[0, 30]")
    mean_square_slope: float | None = field(None, "of both axes together, in place of wind; 0 is flat", "[0, 0.2]")
    direction: Direction | None = None
    """in which the wind blows, in the world: slopes are steeper along it; without it they are the same all around"""
    air_index: float | None = field(None, "phase index of the air; default: that of dry air", "[1, 1.2]")
    air_group_index: float | None = field(None, "group index of the air; default: dry air's, or air_index", "[1, 1.2]")
    air_extinction: float = field(0.0, "of the air, whose scattered light is lost [1/m]", "[0, 100]")

    def _problems(self) -> Iterator[str]:
        if (self.wind is None) == (self.mean_square_slope is None):
            yield "needs either wind or mean_square_slope"
        yield from self._only_with("wind", self.wind is not None, "direction")
        yield from self._only_with("air_index", self.air_index is not None, "air_group_index")
        if self.direction is not None:
            cosine = np.dot(unit_vector(self.direction), unit_vector(self.up))
            if abs(cosine) > 0.999:
                yield self._that("direction", "is that of up: a wind blows along the sea")

    @property
    def normal(self) -> tuple[float, float, float]:
        """`up` as a unit vector."""
        return unit_vector(self.up)

    @property
    def slope_variances(self) -> tuple[float, float]:
        """Of the slopes along and across `direction`; equal without one."""
        if self.mean_square_slope is not None:
            even = 0.5 * self.mean_square_slope
            return even, even
        from spadwarp_kernels import slope_variances  # which imports Warp

        along, across = slope_variances(self.wind or 0.0, by_direction=self.direction is not None)
        return max(along, _LEAST_VARIANCE), across

    @property
    def is_flat(self) -> bool:
        """Whether there are no waves."""
        return not any(self.slope_variances)

    def air(self, wavelength_nm: float) -> tuple[float, float]:
        """Phase and group index of the air."""
        if self.air_index is not None:
            return self.air_index, self.air_group_index or self.air_index
        return air_indices(wavelength_nm)

    def height_of(self, point: tuple[float, float, float]) -> float:
        """Height of a point of the world above the mean plane [m]."""
        return math.fsum(n * (x - p) for n, x, p in zip(self.normal, point, self.point, strict=True))
