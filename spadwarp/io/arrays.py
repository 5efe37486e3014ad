"""Arrays in the files of others: images (EXR), NumPy's files, point clouds (PLY)."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.io.paths import existing_file, reading, write_file
from spadwarp.values import ArgumentError, FileError

__all__ = ["point_cloud", "read_exr", "read_npy", "read_npz", "write_array", "write_exr", "write_ply"]

# Names in an EXR's header that are its own.
_STRUCTURE = {"channels", "compression", "dataWindow", "displayWindow", "lineOrder", "pixelAspectRatio"}
_STRUCTURE |= {"screenWindowCenter", "screenWindowWidth", "type"}
_LARGEST_IMAGE = 1 << 28  # values that are read
_DEFLATE, _SMALL = 1100, 1 << 16  # no compression of EXR makes an image smaller by more than this, its header aside


def write_exr(
    path: str | Path, channels: Mapping[str, ArrayLike], metadata: Mapping[str, str | int | float] | None = None
) -> Path:
    """Writes an EXR image, losslessly compressed, whole or not at all; returns its path.

    Args:
        path: The file.
        channels: Name → `[H, W]`, all of one shape; float16, float32 and uint32 as they are, float64 as float32.
        metadata: Name → value. Stored as text, because EXR's own numbers have 32 bits.

    Raises `ArgumentError`: no channels, another type or shape, or a metadata name that EXR uses itself; `FileError`:
    the file cannot be written.
    """
    import OpenEXR

    pixels = {name: _exr_pixels(name, array) for name, array in channels.items()}
    shapes = {name: array.shape for name, array in pixels.items()}
    if len(set(shapes.values())) != 1:
        raise ArgumentError(f"channels have shapes {shapes}; one shape for all, and at least one channel, is needed")
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for name, value in (metadata or {}).items():
        if name in _STRUCTURE:
            raise ArgumentError(f"metadata name {name!r} is one that EXR uses itself")
        header[name] = str(value)
    content = io.BytesIO()  # OpenEXR takes no names that are not Unicode
    with OpenEXR.File(header, pixels) as file:
        file.write(content)
    return write_file(path, lambda file: file.write(content.getvalue()))


def _exr_pixels(name: str, array: ArrayLike) -> NDArray[Any]:
    """Pixels as OpenEXR takes them; it writes wrong ones for arrays that are not contiguous."""
    pixels = np.asarray(array)
    if pixels.ndim != 2 or pixels.size == 0:
        raise ArgumentError(f"channel {name!r} has shape {pixels.shape}; [height, width] is needed")
    if pixels.dtype == np.float64:
        pixels = pixels.astype(np.float32)
    if pixels.dtype not in (np.float16, np.float32, np.uint32):
        raise ArgumentError(f"channel {name!r} is {pixels.dtype}; float16, float32, float64 or uint32 is needed")
    return np.ascontiguousarray(pixels)


def read_exr(path: str | Path, *, largest: int = _LARGEST_IMAGE) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Channels (name → `[H, W]`, float16, float32 or uint32 as stored) and metadata of an EXR image's first part.

    `largest`: allowed number of values, of all channels and parts. Raises `FileError`: no such file, not an EXR,
    damaged, or larger than allowed.
    """
    import OpenEXR

    existing_file(path)
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            values = sum(map(_value_count, file.parts))
        if values > largest:
            raise FileError(f"{path}: an image of {values} values; at most {largest} are read")
        if 2 * values > _DEFLATE * Path(path).stat().st_size + _SMALL:
            raise FileError(f"{path}: {values} values cannot be in a file of {Path(path).stat().st_size} bytes")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            metadata = {name: value for name, value in file.header().items() if name not in _STRUCTURE}
    except (OSError, RuntimeError, ValueError, TypeError, KeyError, MemoryError) as error:
        raise FileError(f"{path}: not an EXR image, or damaged: {error}") from error
    return channels, metadata


def _value_count(part: Any) -> int:
    """Values of all channels, as an image's header has them."""
    low, high = (corner.astype(np.int64) for corner in part.header["dataWindow"])
    return math.prod(int(side) for side in np.maximum(high - low + 1, 0)) * len(part.header["channels"])


# NumPy's files


def write_array(path: str | Path, array: ArrayLike) -> Path:
    """Writes a `.npy` file, whole or not at all; returns its path. Raises `FileError`."""
    return write_file(path, lambda file: np.save(file, array))


def read_npy(path: str | Path, *, largest: int | None = None) -> NDArray[Any]:
    """The array of a `.npy` file: real or complex numbers or booleans; pickles are never loaded.

    `largest`: allowed number of values; None: any. Raises `FileError`: no such file, not a `.npy` file, shorter than
    its header says, of another type, or too large.
    """
    place = existing_file(path)
    with reading(path), place.open("rb") as file:
        if file.read(4)[:2] == b"PK":
            raise FileError(f"{path}: a .npz archive, not a .npy file; write one array with numpy.save")
        return _array(file, f"{path}:", place.stat().st_size, "biufc", largest)


def read_npz(path: str | Path, *, names: Collection[str] | None = None, largest: int) -> dict[str, NDArray[Any]]:
    """Arrays of numbers of a `.npz` archive: all, or those that have one of the names; pickles are never loaded.

    `largest`: allowed number of values of an array. Raises `FileError` as `read_npy` does.
    """
    place = existing_file(path)
    arrays: dict[str, NDArray[Any]] = {}
    with reading(path, "damaged or not a .npz archive"), zipfile.ZipFile(place) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            if names is None or name in names:
                with archive.open(info) as file:
                    if names is not None or _header(file)[2].kind in "biuf":
                        arrays[name] = _array(file, f"{path}: {name}", info.file_size, "biuf", largest)
    return arrays


def _array(file: Any, where: str, size: int, kinds: str, largest: int | None) -> NDArray[Any]:
    """The array of an open file of so many bytes, whose header is compared with them before anything is allocated."""
    shape, _, kind = _header(file)
    values, available = math.prod(shape), size - file.tell()
    if kind.kind not in kinds:
        raise FileError(f"{where} holds {kind}; numbers are needed")
    if largest is not None and values > largest:
        raise FileError(f"{where} {shape} are {values} values; at most {largest} are allowed")
    if values * kind.itemsize > available:
        raise FileError(f"{where} cut: {kind} {shape} takes {values * kind.itemsize} bytes, and {available} are there")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def _header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type of the array of an open file."""
    file.seek(0)
    first = np.lib.format.read_magic(file) == (1, 0)  # of the versions; 3.0 is as 2.0, but for names of columns
    return np.lib.format.read_array_header_1_0(file) if first else np.lib.format.read_array_header_2_0(file)


# Point clouds


def point_cloud(distance: ArrayLike, directions: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points of a range image in the camera frame (+x right, +y down, +z forward) [m], and their unit normals towards
    the camera: two of float32 `[P, 3]`, row after row of the pixels that have a range.

    A normal is the cross product of the steps to a neighbour in the row and to one in the column, of both the one whose
    range is nearer; where a pixel has no neighbour in one of them, the direction to the camera.

    Args:
        distance: Along the lines of sight `[H, W]` [m]; NaN where there is nothing.
        directions: Unit vectors `[H, W, 3]`, such as `spadwarp.scene.camera.pixel_directions` gives.
    """
    along, view = np.asarray(distance, np.float64), np.asarray(directions, np.float64)
    if along.ndim != 2 or view.shape != (*along.shape, 3):
        raise ArgumentError(f"distance {along.shape} and directions {view.shape} are not [H, W] and [H, W, 3]")
    image = along[..., None] * view

    def step(axis: int) -> NDArray[np.float64]:
        ahead = np.full_like(image, np.nan)
        inner = [slice(None)] * 3
        inner[axis] = slice(None, -1)
        ahead[tuple(inner)] = np.diff(image, axis=axis)
        behind = np.roll(ahead, 1, axis=axis)  # the last row and column are NaN, and so is what comes round
        cost_ahead, cost_behind = (np.abs((part * view).sum(axis=-1)) for part in (ahead, behind))
        use_behind = ~(cost_ahead <= cost_behind) & ~np.isnan(cost_behind)
        return np.where(use_behind[..., None], behind, ahead)

    normal = np.cross(step(1), step(0))
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal *= np.where((normal * view).sum(axis=-1) > 0, -1.0, 1.0)[..., None]
    normal = np.where(np.isfinite(normal), normal, -view)
    returned = np.isfinite(along)
    return image[returned].astype(np.float32), normal[returned].astype(np.float32)


def write_ply(path: str | Path, columns: Mapping[str, ArrayLike], *, comment: str = "") -> Path:
    """Writes points as a binary little-endian PLY file of float32, whole or not at all; returns its path.

    Args:
        path: The file.
        columns: Name → `[P]`: x, y, z and properties of the points.
        comment: One line for the header.

    Raises `FileError`.
    """
    table = np.column_stack([np.asarray(column, "<f4") for column in columns.values()])
    header = ["ply", "format binary_little_endian 1.0", f"comment {' '.join(comment.split())}"]
    header += [f"element vertex {len(table)}", *(f"property float {name}" for name in columns), "end_header", ""]
    return write_file(path, lambda file: file.write("\n".join(header).encode("ascii", "replace") + table.tobytes()))
