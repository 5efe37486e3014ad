"""EXR images."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ArgumentError, FileError
from spadwarp.io.atomic import atomic_path
from spadwarp.io.paths import existing_file

_STRUCTURE = (
    "channels",
    "compression",
    "dataWindow",
    "displayWindow",
    "lineOrder",
    "pixelAspectRatio",
    "screenWindowCenter",
    "screenWindowWidth",
    "type",
)


_LARGEST_IMAGE = 1 << 28  # values that are read
_DEFLATE, _SMALL = 1100, 1 << 16  # no compression of EXR makes an image smaller by more than this, its header aside


def write_exr(
    path: str | Path, channels: Mapping[str, ArrayLike], metadata: Mapping[str, str | int | float] | None = None
) -> Path:
    """Writes an EXR image, losslessly compressed; returns its path.

    Args:
        path: The file; an existing one is replaced when the new one is whole.
        channels: Name → `[H, W]`, all of one shape; float16, float32 and uint32 as they are, float64 as float32.
        metadata: Name → value. Stored as text, because EXR's own numbers have 32 bits.

    Raises:
        ArgumentError: No channels, another type or shape, or a metadata name that EXR uses itself.
        FileError: The file cannot be written.
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
    with atomic_path(path) as temporary, OpenEXR.File(header, pixels) as file:
        content = io.BytesIO()  # OpenEXR takes no names that are not Unicode
        file.write(content)
        temporary.write_bytes(content.getvalue())
    return Path(path)


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

    Args:
        path: The file.
        largest: Allowed number of values, of all channels and parts.

    Raises:
        FileError: No such file, not an EXR, damaged, or larger than allowed.
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
