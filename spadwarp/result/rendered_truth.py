"""Truth maps from the EXR files that a game engine or Blender writes."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.io.arrays import read_exr
from spadwarp.result.result import Truth
from spadwarp.scene.camera import pixel_directions
from spadwarp.values import ArgumentError, FileError, check_choice, check_real

__all__ = ["load_truth_exr"]


_HALF_MAX = 65504.0  # the largest float16, which stands for infinity in files of float16
_PRESETS = tomllib.loads((files("spadwarp.result") / "exr_presets.toml").read_text(encoding="utf-8"))


def load_truth_exr(
    *,
    depth: str | Path,
    camera: Any,
    preset: Literal["unreal", "blender"] = "unreal",
    depth_channel: str | None = None,
    depth_scale: float | None = None,
    radial: bool = False,
    normal: str | Path | None = None,
    albedo: str | Path | float = 0.5,
    albedo_channel: str | None = None,
    axes: ArrayLike | None = None,
) -> Truth:
    """Truth maps from a program's EXR export, in the camera frame (+x right, +y down, +z forward) and in metres.

    Args:
        depth: File with the depth; float16 and float32 are read as they are.
        camera: The camera that the images were rendered with (`scene.camera`).
        preset: Which program's channels, units and axes hold.
        depth_channel: Name of the depth channel, or the last parts of it (`Depth.Z` finds `ViewLayer.Depth.Z`).
        depth_scale: Metres per unit of depth, > 0.
        radial: Whether depth is the distance from the camera instead of planar depth.
        normal: File with world normals; without, every surface faces the camera.
        albedo: File with the diffuse reflectance, or one number in [0, 1].
        albedo_channel: Its channel.
        axes: `[3, 3]`, the camera's right, down and forward as unit vectors of the program's world; the preset's are
            those of a camera without rotation.

    Returns Truth; NaN where the file has NaN, infinity, 0 or the sky's value. Raises `FileError`: a file that cannot be
    read, without the channel (the message names those it has), of another size than the camera's image, with negative
    depth or albedo outside [0, 1], or with nothing in view; `ArgumentError`: an argument out of range.
    """
    check_choice("preset", preset, [*_PRESETS])
    if camera.port is not None:
        raise ArgumentError("camera.port: rendered truth is of cameras that see along straight lines")
    how, shape, view = _PRESETS[preset], (camera.height, camera.width), pixel_directions(camera)
    scale = check_real("depth_scale", how["depth_scale"] if depth_scale is None else depth_scale, "[1e-9, 1e9]")

    stored = _channel(depth, (depth_channel,) if depth_channel else how["depth_channels"], shape)
    sky = min(how["sky"], _HALF_MAX) if stored.dtype == np.float16 else how["sky"]
    raw = stored.astype(np.float64)
    raw[~np.isfinite(raw) | (raw >= sky) | (raw == 0)] = np.nan
    hit = ~np.isnan(raw)
    if not hit.any():
        raise FileError(f"{depth}: no pixel has a depth: everything is sky, 0 or NaN")
    if (raw[hit] < 0).any():
        raise FileError(f"{depth}: depth {raw[hit].min():g} is outside (0, inf)")
    distance = raw * scale if radial else raw * scale / view[..., 2]

    if isinstance(albedo, (str, Path)):
        wanted = (albedo_channel,) if albedo_channel else how["albedo_channels"]
        reflectance = _channel(albedo, wanted, shape).astype(np.float64)
        wrong = hit & ~((reflectance >= 0) & (reflectance <= 1))
        if wrong.any():
            raise FileError(f"{albedo}: albedo {reflectance[wrong][0]:g} is outside [0, 1]")
    else:
        reflectance = np.full(shape, check_real("albedo", albedo, "[0, 1]"))

    normals = -view if normal is None else _normals(normal, how, axes, view, hit)
    return Truth(
        depth=(distance * view[..., 2]).astype(np.float32),
        range=distance.astype(np.float32),
        normal=np.where(hit[..., None], normals, np.nan).astype(np.float32),
        reflectance=np.where(hit, reflectance, np.nan).astype(np.float32),
    )


def _normals(
    path: str | Path, how: dict[str, Any], axes: ArrayLike | None, view: NDArray[np.float64], hit: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Unit normals in the camera frame, on the camera's side."""
    rows = np.asarray(how["axes"] if axes is None else axes, np.float64)
    if rows.shape != (3, 3) or not np.allclose(rows @ rows.T, np.eye(3), atol=1e-4):
        raise ArgumentError(f"axes = {rows.tolist()} are not three orthogonal unit vectors")
    components = [_channel(path, names, hit.shape) for names in zip(*how["normal_channels"], strict=True)]
    normals = np.stack(components, axis=-1).astype(np.float64) @ rows.T
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    if (missing := hit & ~(length[..., 0] > 0.1)).any():
        row, column = np.argwhere(missing)[0]
        raise FileError(f"{path}: no normal at pixel ({row}, {column}), which has a depth")
    with np.errstate(invalid="ignore", divide="ignore"):
        normals = normals / length
    return np.where(((normals * view).sum(axis=-1) > 0)[..., None], -normals, normals)


def _channel(path: str | Path, names: Sequence[str], shape: tuple[int, ...]) -> NDArray[Any]:
    """The first of the named channels, or the only one that ends in `.name`; float, `[H, W]`."""
    path = Path(path)
    other = path.with_suffix(path.suffix.swapcase())  # engines write `.EXR`
    channels, _ = read_exr(other if other.exists() and not path.exists() else path)
    for name in names:
        found = [key for key in channels if key == name] or [key for key in channels if key.endswith(f".{name}")]
        if len(found) > 1:
            raise FileError(f"{path}: channel {name!r} could be {' or '.join(found)}; name one of them in full")
        if found:
            values = channels[found[0]]
            if values.shape != shape:
                sizes = f"{values.shape[1]} x {values.shape[0]} pixels; the camera has {shape[1]} x {shape[0]}"
                raise FileError(f"{path}: {sizes}")
            return values
    raise FileError(f"{path}: no channel {' or '.join(map(repr, names))}; it has {', '.join(channels)}")
