"""The built-in targets: watertight procedural meshes of things that lie, or might lie, under water.

Each is 3.3 to 3.9 m in its larger side, so that it fills the height or most of the width that a camera of 20° sees at
15 m, and shows its good side to a camera that looks along +z. The local frame is the camera's: +x right, +y down (the
top of an upright object is at −y), metres, the bounding box centred at the origin. Sizes in the docstrings are width ×
height × depth (x, y, z). No randomness and no files: the same bits come out of every call.
"""

from __future__ import annotations

from collections.abc import Callable

from manifold3d import Manifold

from spadwarp.mesh.shapes import gear, home, life, sea

__all__ = ["SHAPES"]

SHAPES: dict[str, Callable[[], Manifold]] = {
    model.__name__: model
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
"""Every object by name: functions without arguments that build the solid anew; their docstrings give sizes.

One more is a function in one of the files here, and its name in this list.
"""
