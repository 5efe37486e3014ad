"""Meshes of OpenUSD files: their transforms, units and instances applied."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import MeshError

if TYPE_CHECKING:
    import trimesh

__all__ = ["USD_ENDINGS", "read_usd"]

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")

_MOST_FACES = 1 << 27
_PURPOSES = ("default", "render")  # guides and proxies are not what a camera sees

Part = tuple[NDArray[np.float64], NDArray[np.int64]]


def read_usd(path: Path, name: str) -> trimesh.Trimesh:
    """All visible meshes and simple shapes of a USD stage at its first time as one mesh [m], in the stage's own axes.

    Transforms of the prims, instances, point instancers and `metersPerUnit` are applied; polygons are divided into
    triangles. Layers and payloads that the file refers to are read, too.

    Args:
        path: Ends in one of `USD_ENDINGS`.
        name: How errors name the target.

    Raises:
        MeshError: No readable stage, nothing to see in it, or usd-core is not installed.
    """
    import trimesh

    try:
        from pxr import Tf, Usd, UsdGeom
    except ModuleNotFoundError as error:
        raise MeshError(f"{name}: USD needs usd-core: pip install 'spadwarp[usd]'") from error
    try:
        stage = Usd.Stage.Open(str(path))
        time = Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.Default()
        parts = list(_parts(stage.GetPseudoRoot(), UsdGeom.XformCache(time), time))
    except Tf.ErrorException as error:
        raise MeshError(f"{name}: not a readable USD stage: {' '.join(str(error).split())}") from error
    faces = sum(len(part) for _, part in parts)
    if not faces:
        raise MeshError(f"{name}: the USD stage holds no visible mesh")
    if faces > _MOST_FACES:
        raise MeshError(f"{name}: the USD stage holds {faces} triangles; at most {_MOST_FACES} are allowed")
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    points = np.concatenate([points for points, _ in parts]) * UsdGeom.GetStageMetersPerUnit(stage)
    triangles = np.concatenate([part + start for (_, part), start in zip(parts, starts, strict=False)])
    return trimesh.Trimesh(points, triangles, process=False)


def _parts(root: Any, cache: Any, time: Any, within: Any = None) -> Iterator[Part]:
    """Points in the frame of `within` (None: of the stage) and triangles of each visible prim below `root`."""
    from pxr import Usd, UsdGeom

    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
    for prim in prims:
        shape = UsdGeom.Imageable(prim)
        if shape and (
            shape.ComputeVisibility(time) == UsdGeom.Tokens.invisible or shape.ComputePurpose() not in _PURPOSES
        ):
            prims.PruneChildren()
            continue
        placed = cache.GetLocalToWorldTransform(prim) if within is None else _relative(cache, prim, within)
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
            yield from _instances(UsdGeom.PointInstancer(prim), placed, cache, time)
        elif (part := _mesh(prim, time)) is not None:
            matrix = np.array(placed)  # of row vectors
            yield part[0] @ matrix[:3, :3] + matrix[3, :3], part[1]


def _relative(cache: Any, prim: Any, within: Any) -> Any:
    return cache.ComputeRelativeTransform(prim, within)[0]


def _instances(instancer: Any, placed: Any, cache: Any, time: Any) -> Iterator[Part]:
    """The prototypes of an instancer at each of their places."""
    stage = instancer.GetPrim().GetStage()
    prims = [stage.GetPrimAtPath(path) for path in instancer.GetPrototypesRel().GetTargets()]
    prototypes = [list(_parts(prim, cache, time, within=prim)) for prim in prims]
    which = instancer.GetProtoIndicesAttr().Get(time) or []
    for index, transform in zip(which, instancer.ComputeInstanceTransformsAtTime(time, time), strict=False):
        matrix = np.array(transform * placed)
        for points, triangles in prototypes[index]:
            yield points @ matrix[:3, :3] + matrix[3, :3], triangles


def _mesh(prim: Any, time: Any) -> Part | None:
    """Points and triangles of a prim in its own frame; None for what has no surface."""
    from pxr import UsdGeom

    if not prim.IsA(UsdGeom.Mesh):
        return _simple(prim, time)
    mesh = UsdGeom.Mesh(prim)
    points = np.array(mesh.GetPointsAttr().Get(time) or [], np.float64).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int64)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    if counts.sum() != len(indices) or (counts < 0).any():
        raise MeshError(f"{prim.GetPath()}: its faces do not divide its {len(indices)} indices")
    first = np.cumsum(counts) - counts
    # Fans: corner 0 with each pair of the corners that follow.
    fan = np.maximum(counts - 2, 0)
    face = np.repeat(np.arange(len(counts)), fan)
    step = np.arange(len(face)) - (np.cumsum(fan) - fan)[face]
    corners = first[face][:, None] + np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)
    return points, indices[corners].reshape(-1, 3)


def _simple(prim: Any, time: Any) -> Part | None:
    """A cube, sphere, cylinder, cone, capsule or plane as triangles."""
    import trimesh
    from pxr import UsdGeom

    def value(name: str) -> Any:
        return prim.GetAttribute(name).Get(time)

    if prim.IsA(UsdGeom.Cube):
        made = trimesh.creation.box(extents=[value("size")] * 3)
    elif prim.IsA(UsdGeom.Sphere):
        made = trimesh.creation.icosphere(subdivisions=4, radius=value("radius"))
    elif prim.IsA(UsdGeom.Cylinder):
        made = trimesh.creation.cylinder(radius=value("radius"), height=value("height"), sections=64)
    elif prim.IsA(UsdGeom.Cone):
        made = trimesh.creation.cone(radius=value("radius"), height=value("height"), sections=64)
        made.apply_translation([0, 0, -0.5 * value("height")])
    elif prim.IsA(UsdGeom.Capsule):
        made = trimesh.creation.capsule(radius=value("radius"), height=value("height"), count=[64, 64])
    elif prim.IsA(UsdGeom.Plane):
        made = trimesh.creation.box(extents=[value("width"), value("length"), 0.0])
        made.update_faces(made.face_normals[:, 2] > 0.5)
    else:
        return None
    axis = value("axis") if prim.HasAttribute("axis") else "Z"
    points = np.roll(made.vertices, {"X": 1, "Y": 2, "Z": 0}[str(axis)], axis=1)
    return np.asarray(points, np.float64), np.asarray(made.faces, np.int64)
