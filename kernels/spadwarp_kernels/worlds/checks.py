"""What is read of shapes and poses on the host, once: values that kernels trust, and would crash or hang on."""

import gc
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError

from .closed_forms import MESH, SHAPE_KINDS

if TYPE_CHECKING:
    from .shapes import ShapeTable

# Components of a size that say something; those of a mesh may be negative, which mirrors it.
_COMPONENTS = {"plane": 2, "sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3, "cone": 2, "mesh": 0}


def check_poses(name: str, poses: wp.array, count: int | None = None) -> None:
    """Positions are finite and rotations unit quaternions; waits for the device. `count`: the first ones alone."""
    rows = poses.numpy()[:count]
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        k = int(finite.argmin())
        raise ArgumentError(f"{name}[{k}] = {rows[k].tolist()} is not finite")
    length = np.linalg.norm(rows[:, 3:].astype(np.float64), axis=1)
    if (wrong := abs(length - 1.0) > 0.01).any():
        k = int(wrong.argmax())
        raise ArgumentError(
            f"{name}[{k}] has the quaternion {rows[k, 3:].tolist()} (x, y, z, w) of length {length[k]:.3g}; one of "
            "length 1 is needed"
        )


def check_shapes(table: "ShapeTable", seen: np.ndarray, given: tuple[wp.Mesh, ...]) -> tuple[wp.Mesh, ...]:
    """Shapes that are in range; returns the meshes that they use, as far as they can be found by their ids."""
    kind, mesh, size = table.kind.numpy(), table.mesh.numpy(), table.size.numpy()
    if kind.min() < 0 or kind.max() >= len(SHAPE_KINDS):
        raise ArgumentError(f"kind holds {kind.min()} to {kind.max()}, outside [0, {len(SHAPE_KINDS) - 1}]")
    albedo = table.albedo.numpy()
    if not ((albedo >= 0.0) & (albedo <= 1.0)).all():
        raise ArgumentError(f"albedo holds {albedo.min()} to {albedo.max()}, outside [0, 1]")
    body = table.body.numpy()
    if body.min() < -1:
        raise ArgumentError(f"body[{body.argmin()}] = {body.min()} is outside [-1, 2147483647]")
    check_poses("local", table.local)
    needed = np.array([_COMPONENTS[name] for name in SHAPE_KINDS])[kind]
    wrong = ~np.isfinite(size) | ((size < 0.0) & (np.arange(3) < needed[:, None]))
    if (bad := seen[wrong[seen].any(axis=1)]).size:
        k = int(bad[0])
        raise ArgumentError(
            f"size[{k}] = {size[k].tolist()} of a {SHAPE_KINDS[kind[k]]} is not finite and 0 or more [m]"
        )
    meshed = np.flatnonzero(kind == MESH)
    without = meshed[mesh[meshed] == 0]
    if without.size:
        raise ArgumentError(f"kind[{without[0]}] is a mesh and mesh[{without[0]}] = 0 is none")
    known = {one.id: one for one in given}
    if not set(mesh[meshed].tolist()) <= set(known):
        known |= _live_meshes()
    for one in set(mesh[meshed].tolist()):
        _check_mesh(int(meshed[mesh[meshed] == one][0]), known.get(one))
    _check_faces(table, meshed, mesh, known)
    return tuple(known[one] for one in dict.fromkeys(mesh[meshed].tolist()) if one in known)


def _live_meshes() -> dict[int, wp.Mesh]:
    """All meshes of this process by id: an id of none is a pointer to anything."""
    return {one.id: one for one in gc.get_objects() if issubclass(type(one), wp.Mesh) and getattr(one, "id", None)}


def _check_mesh(k: int, mesh: wp.Mesh | None) -> None:
    if mesh is None:
        if gc.get_freeze_count():  # some objects are not listed
            return
        raise ArgumentError(f"mesh[{k}] is not the id of a wp.Mesh that exists; keep the wp.Mesh, or give it instead")
    indices = mesh.indices.numpy()
    if indices.size and not (indices.min() >= 0 and indices.max() < mesh.points.size):
        raise ArgumentError(
            f"mesh[{k}] has indices {indices.min()} to {indices.max()}, outside [0, {mesh.points.size - 1}]"
        )


def _check_faces(table: "ShapeTable", meshed: np.ndarray, mesh: np.ndarray, known: Mapping[int, wp.Mesh]) -> None:
    """Textured meshes have a row of the textures for each face."""
    first, rows = table.first_face.numpy(), table.textures.face.size
    for k in meshed[first[meshed] >= 0]:
        one = known.get(int(mesh[k]))
        faces = 1 if one is None else one.indices.size // 3
        if first[k] + faces > rows:
            raise ArgumentError(
                f"first_face[{k}] = {first[k]} and {faces} faces of mesh[{k}] reach beyond the {rows} faces of textures"
            )


def check_room(what: str, sizes: Mapping[str, int], item_bytes: int, device: wp.Device, *, rows: int = 1) -> None:
    """Arrays of so many items of so many bytes that the device can have; `rows`: how many of the sizes, from the first
    on, make an index of kernels."""
    values = list(sizes.values())
    if (count := int(np.prod(values[:rows], dtype=object))) > 2**31 - 1:
        names = " x ".join(list(sizes)[:rows])
        raise ArgumentError(f"{names} = {count} is outside [1, 2147483647]")
    needed = item_bytes * int(np.prod(values, dtype=object))
    if device.is_cuda:
        memory = device.total_memory
    else:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2**63
    if needed > memory:
        numbers = " x ".join(map(str, values))
        room = f"{needed / 1e9:.3g} GB, and {device} has {memory / 1e9:.3g} GB"
        raise ArgumentError(f"{' x '.join(sizes)} = {numbers}: {what} need {room}")
