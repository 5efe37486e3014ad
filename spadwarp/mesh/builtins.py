"""Built-in targets by name: the geometric ones, which stand here, and the objects of `spadwarp.mesh.shapes`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from spadwarp.errors import ArgumentError
from spadwarp.limits import suggestion

if TYPE_CHECKING:
    import trimesh

__all__ = ["BUILTINS", "SIZED_BUILTINS", "builtin_names", "make_builtin"]

SIZED_BUILTINS = ("plane", "box", "sphere")
"""Built-ins of 1 m that `size` stretches; the others have sizes of their own."""


def builtin_names() -> tuple[str, ...]:
    """Names that `builtin` can take."""
    from spadwarp.mesh.shapes import SHAPES

    return (*BUILTINS, *SHAPES)


def make_builtin(name: str) -> trimesh.Trimesh:
    """The built-in `name` as a mesh in its own frame [m], built once and copied for each caller.

    Raises `ArgumentError` for a name that is not among `builtin_names()`.
    """
    if name not in (known := builtin_names()):
        raise ArgumentError(f"builtin = {name!r} is not one of {', '.join(map(repr, known))}{suggestion(name, known)}")
    return _built(name).copy()


@cache
def _built(name: str) -> trimesh.Trimesh:
    if name in BUILTINS:
        return BUILTINS[name]()
    from spadwarp.mesh.shapes import SHAPES
    from spadwarp.mesh.shapes.solids import to_trimesh

    return to_trimesh(SHAPES[name]())


def _staircase() -> trimesh.Trimesh:
    """The paper's staircase (a 4 m plate with nine bars): one closed mesh, face at z = 0, bars towards −z.

    Seen from the camera. Left half: three vertical bars over the full height. Upper right quarter: three horizontal
    bars, the lowest ending at mid-height. Lower right quarter: three vertical bars. Where the bars leave 3 cm of a half
    free, the strip is at the middle of the plate, as in the depth maps that the paper's authors published.
    """
    plate = ((-2.0, -2.0, 0.0), (2.0, 2.0, 0.1))
    left = [((x, -2.0, -proud), (x + 0.63, 2.0, 0.1)) for x, proud in ((-2.0, 0.6), (-1.33, 0.5), (-0.66, 0.4))]
    upper = [((0.0, y, -proud), (2.0, y + 0.6, 0.1)) for y, proud in ((-2.0, 0.3), (-1.3, 0.2), (-0.6, 0.1))]
    lower = [((x, 0.0, -proud), (x + 0.63, 2.0, 0.1)) for x, proud in ((0.03, 0.3), (0.7, 0.2), (1.37, 0.1))]
    return _union([plate, *left, *upper, *lower])


def _union(boxes: Sequence[tuple[Sequence[float], Sequence[float]]]) -> trimesh.Trimesh:
    """One closed mesh of axis-aligned boxes, each given by its lowest and its highest corner."""
    import trimesh

    mesh = trimesh.boolean.union([trimesh.creation.box(bounds=bounds) for bounds in boxes], engine="manifold")
    mesh.vertices = np.round(mesh.vertices, 6)  # the union came back in float32
    return mesh


def _plane() -> trimesh.Trimesh:
    """A square of side 1 m at z = 0 that faces −z, two triangles."""
    import trimesh

    corners = [(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0)]
    return trimesh.Trimesh(corners, [(0, 2, 1), (0, 3, 2)], process=False)


def _box() -> trimesh.Trimesh:
    """A cube of side 1 m about the origin, twelve triangles."""
    import trimesh

    return trimesh.creation.box(extents=(1.0, 1.0, 1.0))


def _sphere() -> trimesh.Trimesh:
    """A ball of diameter 1 m about the origin: an icosahedron subdivided three times, 1280 triangles, corners on it."""
    import trimesh

    return trimesh.creation.icosphere(subdivisions=3, radius=0.5)


BUILTINS: dict[str, Callable[[], trimesh.Trimesh]] = {
    "staircase": _staircase,
    "plane": _plane,
    "box": _box,
    "sphere": _sphere,
}
"""The geometric built-ins: functions without arguments that make a new mesh in its own frame [m]."""
