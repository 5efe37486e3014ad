"""What a mesh file holds, before it stands in a scene: size, unit, orientation, and whether it is closed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spadwarp.mesh.targets import load_target
from spadwarp.scene import Target

if TYPE_CHECKING:
    import trimesh

__all__ = ["MeshSummary", "describe_mesh", "guess_unit"]

# Units of mesh files in the order of likelihood, and the longest sides of things under water [m].
_UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "µm": 1e-6}
_SIDES = (0.03, 30.0)


@dataclass(frozen=True, kw_only=True)
class MeshSummary:
    """A mesh file.

    Attributes:
        path: The file.
        faces: Triangles with an area.
        extent: Size along x, y, z, in the file's unit.
        centre: Centre of the bounding box, in the file's unit.
        unit: The unit in which it has the size of a thing under water: m, mm, cm or µm; None if there is none.
        scale: For `targets.scale`: this unit in metres; 1 without one.
        longest: Longest side with this scale [m].
        is_watertight: Whether every edge belongs to two faces, so that there is an inside.
        is_inside_out: Whether the faces of a closed mesh are wound inwards. It makes no difference here.
        bodies: Parts that do not touch.
    """

    path: Path
    faces: int
    extent: tuple[float, float, float]
    centre: tuple[float, float, float]
    unit: str | None
    scale: float
    longest: float
    is_watertight: bool
    is_inside_out: bool
    bodies: int

    @property
    def hints(self) -> tuple[str, ...]:
        """What its target in a scene needs, in words."""
        found = []
        if self.scale != 1.0:
            found.append(f"scale = {self.scale:g} if the unit is {self.unit}: {self.longest:.3g} m long")
        if self.unit is None:
            found.append(f"{max(self.extent):.3g} long: neither m, mm nor cm makes it the size of a thing under water")
        offset = max(abs(place) for place in self.centre)
        if offset > 0.5 * max(self.extent):
            place = ", ".join(f"{self.scale * x:.3g}" for x in self.centre)
            found.append(f"its centre is at ({place}) m, not at the origin: translation has to allow for that")
        if self.extent[2] > 1.5 * max(self.extent[:2]):
            found.append(
                "longest along z, the direction of view: rotation_deg = [90, 0, 0] stands a mesh upright whose z is "
                "up, [0, 90, 0] shows its side"
            )
        if not self.is_watertight:
            found.append("not closed: light may pass through gaps; faces reflect on both sides")
        return tuple(found)


def describe_mesh(path: str | Path) -> MeshSummary:
    """Size, unit, orientation and closedness of a mesh file (STL, OBJ, PLY, OFF, GLB, USD). Raises `MeshError`."""
    mesh = load_target(Target(mesh=str(path)), field="")
    low, high = np.asarray(mesh.bounds, np.float64)
    extent, centre = high - low, 0.5 * (low + high)
    guess = guess_unit(float(extent.max()))
    closed = bool(mesh.is_watertight)
    return MeshSummary(
        path=Path(path),
        faces=len(mesh.faces),
        extent=(float(extent[0]), float(extent[1]), float(extent[2])),
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
        unit=None if guess is None else guess[0],
        scale=1.0 if guess is None else guess[1],
        longest=float(extent.max()) * (1.0 if guess is None else guess[1]),
        is_watertight=closed,
        is_inside_out=closed and float(mesh.volume) < 0.0,
        bodies=_bodies(mesh),
    )


def guess_unit(longest: float) -> tuple[str, float] | None:
    """Name and metres of the likeliest unit of a mesh whose longest side is `longest`; None if none fits."""
    fitting = [(name, metres) for name, metres in _UNITS.items() if _SIDES[0] <= longest * metres <= _SIDES[1]]
    return fitting[0] if fitting else None


def _bodies(mesh: trimesh.Trimesh) -> int:
    import trimesh

    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    return int(labels.max()) + 1 if len(labels) else 0
