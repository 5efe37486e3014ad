"""Files of depth: images, EXR, NumPy, point clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from spadwarp.errors import ArgumentError, FileError
from spadwarp.frames.depth import Reduction
from spadwarp.io.atomic import atomic_path
from spadwarp.io.exr import write_exr
from spadwarp.io.ply import point_cloud, point_normals, write_ply
from spadwarp.limits import check_choice
from spadwarp.scene.camera import to_world
from spadwarp.scene.pose import rotation_matrix

__all__ = ["write_depth"]

_FRAMES = {
    "camera": "camera: origin in the lens, +x right, +y down, +z forward",
    "world": "world: the axes of a camera without a pose",
}


def write_depth(
    reduction: Reduction,
    directory: str | Path,
    *,
    ply: str | Path | None = None,
    ply_frame: Literal["camera", "world"] = "camera",
    comment: str = "",
) -> list[Path]:
    """Writes `depth.npy` (all frames, float32), `depth.exr` and `depth.png` (the first); returns the paths.

    Without a field of view the names begin with `range`. `ply`: the points of the first frame, with normals and
    intensity, in the frame `ply_frame`, which a comment of the file names.

    Raises:
        ArgumentError: A point cloud was asked for and the field of view is not known, or in the world where the
            camera's pose is not known.
        FileError: A file cannot be written.
    """
    from spadwarp.viz import draw_depth

    if ply is not None and reduction.lines is None:
        raise ArgumentError("a point cloud needs the horizontal field of view")
    check_choice("ply_frame", ply_frame, tuple(_FRAMES))
    if ply is not None and ply_frame == "world" and reduction.camera is None:
        raise ArgumentError("points in the world need the pose of the camera: those of a measurement are in its frame")
    folder, name = Path(directory), reduction.quantity
    array = reduction.values.astype(np.float32)
    with atomic_path(folder / f"{name}.npy") as temporary, temporary.open("wb") as file:
        np.save(file, array if reduction.frames > 1 else array[0])
    channels = {"range": reduction.range[0], "intensity": reduction.intensity[0].astype(np.float32)}
    if name == "depth":
        channels["Z"] = reduction.first
    metadata = {"content": "measured depth", "method": reduction.method, "frame": "+x right, +y down, +z forward"}
    label = "depth z [m]" if name == "depth" else "range [m]"
    written = [
        folder / f"{name}.npy",
        write_exr(folder / f"{name}.exr", channels, metadata),
        draw_depth(
            reduction.first,
            reduction.intensity[0],
            folder / f"{name}.png",
            label=label,
            title=f"{name.capitalize()} ({reduction.method})",
        ),
    ]
    if ply is not None:
        assert reduction.lines is not None
        distance = reduction.range[0]
        view = reduction.lines.directions_to(distance)
        points, valid = point_cloud(distance, view)
        normals = point_normals(distance, view)
        if not len(points):
            raise FileError(f"{ply}: nothing returned in any pixel: there are no points to write")
        intensity = reduction.intensity[0][valid].astype(np.float32)
        if ply_frame == "world":
            assert reduction.camera is not None
            points = to_world(reduction.camera, points).astype(np.float32)
            normals = (normals @ rotation_matrix(reduction.camera.rotation_deg).T).astype(np.float32)
        properties = {f"n{axis}": normals[:, index] for index, axis in enumerate("xyz")} | {"intensity": intensity}
        written.append(write_ply(ply, points, properties, comment=f"{comment}; frame {_FRAMES[ply_frame]}"))
    return written
