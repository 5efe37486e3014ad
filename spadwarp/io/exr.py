"""EXR images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ArgumentError, FileError
from spadwarp.io.atomic import atomic_path

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
        file.write(str(temporary))
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


def read_exr(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Channels (name → `[H, W]`, float16, float32 or uint32 as stored) and metadata of an EXR image's first part.

    Raises:
        FileError: No such file, not an EXR, or damaged.
    """
    import OpenEXR

    if not Path(path).is_file():
        raise FileError(f"{path}: {'is not a file' if Path(path).exists() else 'no such file'}")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            metadata = {name: value for name, value in file.header().items() if name not in _STRUCTURE}
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise FileError(f"{path}: not an EXR image, or damaged: {error}") from error
    return channels, metadata
