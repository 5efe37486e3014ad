"""The table `medium.grid`: water that varies from place to place, in a box."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from spadwarp.scene.sections import Counts, Scale, Section, Size, Vector, Whole

GRID_ENDINGS = (".npz", ".h5", ".hdf5", ".nvdb")


class Grid(Section):
    """Cells of water in a box, from a file or a shape; outside the box the medium.

    A shape, or a file with `density`, adds suspended matter to the medium: `extinction` and `albedo` are those of
    density 1. A file with coefficients gives the water itself.
    """

    section: ClassVar[str] = "grid"
    file: str | None = None
    """path of a .npz, .h5 or .nvdb file with cells, relative to the scene file"""
    shape: Literal["cloud", "plume", "sediment", "gradient"] | None = None
    """in place of a file: a round cloud, a plume that rises, matter stirred up from the bottom, a rise from top to
    bottom; the box's y points down"""
    size: Size | None = None
    """edges of the box, one or three; default: those of the file [m]"""
    cells: Counts = (64,)
    """shape: number of cells along the edges; one number: along the longest"""
    extinction: float = Field(1.0, ge=0, le=1e6)
    """what density 1 adds to the medium's extinction [1/m]"""
    albedo: float = Field(0.8, ge=0, le=1)
    """single-scattering albedo of what is added"""
    anisotropy: float | None = Field(None, gt=-1, lt=1)
    """henyey_greenstein: mean cosine of the scattering by what is added; default: the medium's"""
    turbulence: float = Field(0.0, ge=0, le=3)
    """shape: standard deviation of the logarithm of the density about the shape, by eddies of von Kármán's spectrum"""
    eddy_size: float | None = Field(None, ge=1e-6, le=1e9)
    """shape: size of the largest eddies; default: a third of the box's shortest edge [m]"""
    seed: Whole = Field(0, ge=0, le=2**63 - 1)
    """shape: of the turbulence"""
    frame: float = Field(0.0, ge=0, le=1e9)
    """time, for what moves: in a file's frames, between which cells are interpolated; in turnovers of a shape's largest
    eddies"""
    scale: Scale = (1.0, 1.0, 1.0)
    """factor on the size, one or three"""
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    """rotations about the box's own x, then its new y, then its new z [°]"""
    translation: Vector = (0.0, 0.0, 0.0)
    """shift in the world [m], the camera's frame if it has no pose"""
    tracking: Literal["auto", "regular", "delta"] = "auto"
    """how photons fly through cells: "regular" from cell to cell, exact; "delta" by chance and without bias, faster
    where cells are many; "auto": the latter for more than 32 768 cells"""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.file is None) == (self.shape is None):
            raise ValueError("needs either file or shape")
        if self.file is not None and Path(self.file).suffix.lower() not in GRID_ENDINGS:
            hint = (
                "; `nanovdb_convert` of OpenVDB makes a .nvdb file of it" if self.file.lower().endswith(".vdb") else ""
            )
            raise ValueError(f"file = {self.file!r} does not end in {', '.join(GRID_ENDINGS)}{hint}")
        if self.shape is not None and self.size is None:
            raise ValueError(f"needs size with shape = {self.shape!r}")
        if self.size is not None and len(self.size) == 2:
            raise ValueError(f"size = {list(self.size)} has two numbers; one or three are needed")
        if len(self.cells) == 2:
            raise ValueError(f"cells = {list(self.cells)} has two numbers; one or three are needed")
        if min(self.scale) <= 0.0:
            raise ValueError(f"scale = {list(self.scale)} is not positive")
        given = self.model_fields_set
        for name in ("cells", "turbulence", "eddy_size", "seed"):
            if self.file is not None and name in given and getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(f"{name} = {getattr(self, name)!r} goes with shape only; a file has its cells")
        return self

    @property
    def edges(self) -> tuple[float, float, float] | None:
        """`size` as three numbers [m]."""
        if self.size is None:
            return None
        x, y, z = self.size * 3 if len(self.size) == 1 else self.size
        return x, y, z

    @property
    def cell_counts(self) -> tuple[int, int, int]:
        """`cells` as three numbers: with one, cells are about as long as wide."""
        if len(self.cells) == 3:
            x, y, z = self.cells
            return x, y, z
        edges = self.edges or (1.0, 1.0, 1.0)
        x, y, z = (max(1, round(self.cells[0] * edge / max(edges))) for edge in edges)
        return x, y, z

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal table again."""
        fields = super().to_dict()
        if self.file is not None:
            for name in ("cells", "turbulence", "seed"):
                fields.pop(name, None)
        return fields
