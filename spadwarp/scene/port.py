"""The table `camera.port` or `laser.port`."""

from __future__ import annotations

import math
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from spadwarp.scene.materials import air_indices, window_indices
from spadwarp.scene.sections import Section, Vector


class Port(Section):
    """A flat or dome port between the air of a housing and the water; without thickness and material a calm surface."""

    section: ClassVar[str] = "port"
    preset: str | None = None
    """a named port, see `spadwarp list presets port`"""
    shape: Literal["flat", "dome"] = "flat"
    """a plane window, or a spherical one"""
    distance: float | None = Field(None, ge=1e-6, le=1e6)
    """flat: from the lens centre along `normal` to the window; above a calm surface the altitude [m]"""
    normal: Vector = (0.0, 0.0, 1.0)
    """flat: direction into the water, any length but 0; in the frame of the camera, or of the laser's direction"""
    radius: float | None = Field(None, ge=1e-6, le=1e6)
    """dome: of its inner face [m]"""
    offset: Vector = (0.0, 0.0, 0.0)
    """dome: from the lens centre to the dome's centre [m]"""
    thickness: float = Field(0.0, ge=0, le=1e3)
    """of the window [m]; 0: there is none"""
    material: Literal["BK7", "fused silica", "sapphire", "acrylic", "PMMA", "polycarbonate"] | None = None
    """of the window: its indices at the laser's wavelength"""
    index: float | None = Field(None, ge=1, le=4)
    """phase index of the window, in place of material"""
    group_index: float | None = Field(None, ge=1, le=4)
    """group index of the window; default: its phase index"""
    inside_index: float | None = Field(None, ge=1, le=4)
    """phase index inside the housing; default: that of air"""
    inside_group_index: float | None = Field(None, ge=1, le=4)
    """group index inside the housing; default: that of air, or inside_index"""

    @model_validator(mode="after")
    def _determined(self) -> Self:
        needed, other = ("distance", "radius") if self.shape == "flat" else ("radius", "distance")
        if getattr(self, needed) is None:
            raise ValueError(f"needs {needed} with shape = {self.shape!r}")
        if getattr(self, other) is not None:
            raise ValueError(
                f"{other} = {getattr(self, other)} does not go with shape = {self.shape!r}; a flat port has distance, "
                "a dome has radius"
            )
        if self.shape == "flat" and any(self.offset):
            raise ValueError(f"offset = {list(self.offset)} goes with shape = 'dome' only")
        if self.shape == "dome" and self.normal != (0.0, 0.0, 1.0):
            raise ValueError(f"normal = {list(self.normal)} goes with shape = 'flat' only")
        if math.hypot(*self.normal) < 1e-9:
            raise ValueError(f"normal = {list(self.normal)} has no length")
        if self.material is not None and self.index is not None:
            raise ValueError(f"needs either material or index; given: {self.material!r} and {self.index}")
        if (self.thickness > 0.0) != (self.material is not None or self.index is not None):
            raise ValueError(f"needs material or index and a thickness > 0, or neither; thickness = {self.thickness}")
        for name, of in (("group_index", "index"), ("inside_group_index", "inside_index")):
            if getattr(self, name) is not None and getattr(self, of) is None:
                raise ValueError(f"{name} = {getattr(self, name)} goes with {of} only")
        return self

    def indices(self, wavelength_nm: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """(phase, group) index of what is inside, and of the window.

        Raises `ValueError` for a wavelength at which the material is not known.
        """
        inside = air_indices(wavelength_nm)
        if self.inside_index is not None:
            inside = (self.inside_index, self.inside_group_index or self.inside_index)
        if self.material is not None:
            return inside, window_indices(self.material, wavelength_nm)
        return inside, inside if self.index is None else (self.index, self.group_index or self.index)

    @property
    def axis(self) -> tuple[float, float, float]:
        """`normal` as a unit vector."""
        x, y, z = self.normal
        length = math.hypot(x, y, z)
        return (x / length, y / length, z / length)
