"""The section `daylight`."""

from __future__ import annotations

import math
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from spadwarp.scene.sections import Section, Vector
from spadwarp.water.daylight import refracted_cosine


class Daylight(Section):
    """Sun and clear sky over calm water, from which the ambient light of each pixel follows, on top of
    `detector.ambient_rate`."""

    section: ClassVar[str] = "daylight"
    sun_elevation_deg: float = Field(..., gt=0, le=90)
    """height of the sun above the horizon, 90 less its zenith angle [°]"""
    depth: float = Field(..., ge=0, le=1e4)
    """of the lens below the surface [m]"""
    sun_azimuth_deg: float = Field(90.0, ge=-360, le=360)
    """horizontal angle from the world's z axis, or without one from its x axis, to below the sun, towards +x [°]"""
    up: Vector = (0.0, -1.0, 0.0)
    """direction of the surface in the world; any length but 0"""
    aerosol_optical_depth: float = Field(0.084, ge=0, le=5)
    """vertical optical depth of the aerosol at 500 nm: 0.05 very clear air, 0.3 haze"""
    cloud_factor: float = Field(1.0, ge=0, le=2)
    """irradiance over that of a clear sky"""

    @model_validator(mode="after")
    def _has_a_surface(self) -> Self:
        if math.hypot(*self.up) < 1e-9:
            raise ValueError(f"up = {list(self.up)} has no length")
        return self

    @property
    def down(self) -> NDArray[np.float64]:
        """Unit vector away from the surface, in the world."""
        return -np.asarray(self.up) / math.hypot(*self.up)

    def sun_direction(self, index: float) -> NDArray[np.float64]:
        """Unit vector in which the sun's light goes in water of a refractive index, in the world."""
        down = self.down
        ahead = np.array([0.0, 0.0, 1.0]) - down[2] * down
        if np.linalg.norm(ahead) < 1e-6:
            ahead = np.array([1.0, 0.0, 0.0]) - down[0] * down
        ahead /= np.linalg.norm(ahead)
        azimuth = math.radians(self.sun_azimuth_deg)
        towards_sun = math.cos(azimuth) * ahead + math.sin(azimuth) * np.cross(down, ahead)
        cosine = refracted_cosine(self.sun_elevation_deg, index)
        return cosine * down - math.sqrt(1.0 - cosine**2) * towards_sun
