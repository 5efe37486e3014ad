"""The built-in targets: watertight procedural meshes of things that lie, or might lie, under water.

Each is 3.3 to 3.9 m in its larger side, so that it fills the height or most of the width that a camera of 20° sees at
15 m, and shows its good side to a camera that looks along +z. The local frame is the camera's: +x right, +y down (the
top of an upright object is at −y), metres, the bounding box centred at the origin. Sizes in the docstrings are width ×
height × depth (x, y, z). No randomness and no files: the same bits come out of every call.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import TYPE_CHECKING

from spadwarp.errors import ArgumentError
from spadwarp.mesh.shapes import gear, home, life, sea
from spadwarp.mesh.shapes.solids import to_trimesh

if TYPE_CHECKING:
    import trimesh
    from manifold3d import Manifold

__all__ = ["SHAPES", "make_shape"]


def _mesh_maker(model: Callable[[], Manifold]) -> Callable[[], trimesh.Trimesh]:
    @wraps(model)
    def make() -> trimesh.Trimesh:
        return to_trimesh(model())

    return make


SHAPES: dict[str, Callable[[], trimesh.Trimesh]] = {
    model.__name__: _mesh_maker(model)
    for model in (
        sea.submarine,
        sea.anchor,
        home.amphora,
        home.chair,
        home.sofa,
        home.television,
        gear.camera,
        sea.cannon,
        home.car,
        life.mushroom,
        sea.propeller,
        gear.pipe_valve,
        sea.naval_mine,
        life.fish,
        life.starfish,
        gear.diver_helmet,
        sea.shipwreck,
        sea.torpedo,
        life.bust,
    )
}
"""Every built-in target by name: functions without arguments that build the mesh anew; their docstrings give sizes."""


def make_shape(name: str) -> trimesh.Trimesh:
    """The built-in target `name` as a mesh [m], built once and copied for each caller.

    Raises ValueError for a name that is not in `SHAPES`.
    """
    if name not in SHAPES:
        raise ArgumentError(f"target shape = {name!r} is not one of {', '.join(SHAPES)}")
    return _built(name).copy()


@cache
def _built(name: str) -> trimesh.Trimesh:
    return SHAPES[name]()
