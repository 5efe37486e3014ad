"""The section `targets`."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from spadwarp.scene.sections import Scale, Section, Size, Vector, Whole


class Target(Section):
    """One mesh: sized and scaled, then rotated, then moved."""

    section: ClassVar[str] = "targets"
    builtin: str | None = Field(None, min_length=1)
    """a built-in mesh, such as "staircase"; see `spadwarp list targets`"""
    mesh: str | None = None
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
            raise ValueError(f"scale = {list(self.scale)} holds a zero")
        if self.size is not None and self.builtin is None:
            raise ValueError(f"size = {list(self.size)} goes with builtin only; a mesh file takes scale")
        if self.reflectance == "from_file":
            if self.mesh is None:
                raise ValueError("reflectance = 'from_file' goes with mesh only; a builtin takes a number")
        elif self.reflectance + self.specular > 1:
            raise ValueError(
                f"specular = {self.specular:g} and reflectance = {self.reflectance:g} reflect more than arrives:"
                " their sum is outside [0, 1]"
            )
        elif self.reflectance_scale != 1:
            raise ValueError(f"reflectance_scale = {self.reflectance_scale:g} goes with reflectance = 'from_file' only")
        return self
