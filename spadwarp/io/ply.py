"""Point clouds from depth frames, as binary PLY."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ArgumentError
from spadwarp.io.atomic import atomic_path

__all__ = ["point_cloud", "point_normals", "write_ply"]

_KINDS = {"f4": "float", "f8": "double", "i4": "int", "u4": "uint", "u1": "uchar"}


def point_cloud(distance: ArrayLike, directions: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Points of a range image in the camera frame (+x right, +y down, +z forward) [m].

    Args:
        distance: Along the lines of sight `[H, W]` [m]; NaN where there is nothing.
        directions: Unit vectors `[H, W, 3]`, such as `spadwarp.scene.sight.pixel_directions` gives.

    Returns:
        float32 `[P, 3]`, row after row of the pixels that have a range, and their mask, bool `[H, W]`.
    """
    along = np.asarray(distance, np.float64)
    view = np.asarray(directions, np.float64)
    if along.ndim != 2 or view.shape != (*along.shape, 3):
        raise ArgumentError(f"distance {along.shape} and directions {view.shape} are not [H, W] and [H, W, 3]")
    returned = np.isfinite(along)
    return (along[returned][:, None] * view[returned]).astype(np.float32), returned


def point_normals(distance: ArrayLike, directions: ArrayLike) -> NDArray[np.float32]:
    """Unit normals of the points of `point_cloud`, towards the camera: float32 `[P, 3]`.

    By the cross product of the steps to a neighbour in the row and to one in the column, of both the one whose range is
    nearer; where a pixel has no neighbour in one of them, the direction to the camera.
    """
    along = np.asarray(distance, np.float64)
    view = np.asarray(directions, np.float64)
    image = along[..., None] * view

    def step(axis: int) -> NDArray[np.float64]:
        ahead = np.full_like(image, np.nan)
        there = [slice(None)] * 3
        there[axis] = slice(None, -1)
        ahead[tuple(there)] = np.diff(image, axis=axis)
        behind = np.roll(ahead, 1, axis=axis)  # the last row and column are NaN, and so is what comes round
        one, other = (np.abs((part * view).sum(axis=-1)) for part in (ahead, behind))
        use_behind = ~(one <= other) & ~np.isnan(other)
        return np.where(use_behind[..., None], behind, ahead)

    normal = np.cross(step(1), step(0))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= length
    normal *= np.where((normal * view).sum(axis=-1) > 0, -1.0, 1.0)[..., None]
    normal = np.where(np.isfinite(normal), normal, -view)
    return normal[np.isfinite(along)].astype(np.float32)


def write_ply(
    path: str | Path, points: ArrayLike, properties: Mapping[str, ArrayLike] | None = None, *, comment: str = ""
) -> Path:
    """Writes points as a binary little-endian PLY file, whole or not at all; returns its path.

    Args:
        path: The file.
        points: `[P, 3]`, written as float32 x, y, z.
        properties: Name → `[P]`: float32, float64, int32, uint32 or uint8 as they are, other real numbers as float32.
        comment: One line for the header.

    Raises:
        ArgumentError: Points or properties of another shape, or a name that PLY cannot have.
        FileError: The file cannot be written.
    """
    xyz = np.asarray(points, np.float32)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ArgumentError(f"points have shape {xyz.shape}; [P, 3] is needed")
    columns = {name: xyz[:, axis] for axis, name in enumerate("xyz")}
    for name, given in (properties or {}).items():
        values = np.asarray(given)
        if values.shape != (len(xyz),):
            raise ArgumentError(f"property {name!r} has shape {values.shape}; ({len(xyz)},) is needed")
        if not name.isidentifier() or name in columns:
            raise ArgumentError(f"property name {name!r} is not a new single word")
        known = values.dtype.kind + str(values.dtype.itemsize) in _KINDS
        columns[name] = values if known else values.astype(np.float32)
    kinds = {name: values.dtype.kind + str(values.dtype.itemsize) for name, values in columns.items()}
    table = np.empty(len(xyz), [(name, "<" + kind) for name, kind in kinds.items()])
    for name, values in columns.items():
        table[name] = values
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {' '.join(comment.split())}"] if comment else []
    header += [f"element vertex {len(xyz)}"]
    header += [f"property {_KINDS[kind]} {name}" for name, kind in kinds.items()]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join([*header, "end_header", ""]).encode("ascii", "replace") + table.tobytes())
    return Path(path)
