"""Sections of what is around camera and laser: `targets`, `domain` and `daylight`."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from spadwarp.limits import bounds
from spadwarp.scene.sections import AnyFile, Corner, Direction, Scale, Section, Size, Vector, Whole, unit_vector
from spadwarp.water.daylight import refracted_cosine
from spadwarp.water.seawater import RANGES

__all__ = ["Daylight", "Domain", "Target"]


class Target(Section):
    """One mesh: sized and scaled, then rotated, then moved."""

    section: ClassVar[str] = "targets"
    builtin: str | None = Field(None, min_length=1)
    """a built-in mesh, such as "staircase"; see `spadwarp list targets`"""
    mesh: AnyFile = None
    """path of a mesh file, relative to the scene file"""
    size: Size | None = None
    """extent of plane, box, sphere; one number, two for x and y, or three [m]"""
    subdivisions: Whole = Field(0, ge=0, le=12)
    """times that every face is split into four"""
    scale: Scale = (1.0, 1.0, 1.0)
    """factor, one or three; mesh units to metres"""
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    """rotations about the target's own x, then its new y, then its new z [°]"""
    translation: Vector = (0.0, 0.0, 0.0)
    """shift in the world [m], the camera's frame if it has no pose"""
    reflectance: Annotated[float, Field(ge=0, le=1)] | Literal["from_file"] = 0.5
    """Lambertian reflectance of both sides; "from_file": colours and textures of the mesh file"""
    reflectance_scale: float = Field(1.0, ge=1e-9, le=1e9)
    """factor on a reflectance that is "from_file", the file's"""
    colour_encoding: Literal["srgb", "linear"] = "srgb"
    """how the file's colours and images stand for reflectance; "linear" is proportional"""
    specular: float = Field(0.0, ge=0, le=1)
    """reflectance of the facets of a rough specular lobe; 0 is none"""
    roughness: float = Field(0.2, ge=0.01, le=1)
    """width of that lobe: GGX parameter α"""
    specular_index: float = Field(1.5, ge=1, le=10)
    """phase index of its facets, by which they polarise light; polarised light alone"""

    @model_validator(mode="after")
    def _one_mesh(self) -> Self:
        if (self.builtin is None) == (self.mesh is None):
            raise ValueError("needs either builtin or mesh")
        if not all(self.scale):
            self._refuse("scale", "holds a zero")
        if self.size is not None and self.builtin is None:
            self._refuse("size", "goes with builtin only; a mesh file takes scale")
        if self.reflectance == "from_file":
            if self.mesh is None:
                self._refuse("reflectance", "goes with mesh only; a builtin takes a number")
        elif self.reflectance + self.specular > 1:
            raise ValueError(
                f"specular = {self.specular:g} and reflectance = {self.reflectance:g} reflect more than arrives:"
                " their sum is outside [0, 1]"
            )
        self._only_with("reflectance = 'from_file'", self.reflectance == "from_file", "reflectance_scale")
        return self


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


class Daylight(Section):
    """Sun and clear sky over calm water, from which the ambient light of each pixel follows, on top of
    `detector.ambient_rate`."""

    section: ClassVar[str] = "daylight"
    sun_elevation_deg: float = Field(..., **bounds(RANGES["sun_elevation_deg"]))
    """height of the sun above the horizon, 90 less its zenith angle [°]"""
    depth: float = Field(..., ge=0, le=1e4)
    """of the lens below the surface [m]"""
    sun_azimuth_deg: float = Field(90.0, ge=-360, le=360)
    """horizontal angle from the world's z axis, or without one from its x axis, to below the sun, towards +x [°]"""
    up: Direction = (0.0, -1.0, 0.0)
    """direction of the surface in the world; any length but 0"""
    aerosol_optical_depth: float = Field(0.084, **bounds(RANGES["aerosol_optical_depth"]))
    """vertical optical depth of the aerosol at 500 nm: 0.05 very clear air, 0.3 haze"""
    cloud_factor: float = Field(1.0, ge=0, le=2)
    """irradiance over that of a clear sky"""

    @property
    def down(self) -> NDArray[np.float64]:
        """Unit vector away from the surface, in the world."""
        return -np.asarray(unit_vector(self.up))

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
