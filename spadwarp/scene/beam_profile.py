"""Measured beam profiles: an image of the irradiance across the beam."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import FileError, SpadwarpError
from spadwarp.io.arrays import read_exr, read_npy
from spadwarp.io.paths import existing_file

if TYPE_CHECKING:
    from spadwarp.scene import Laser

_LARGEST = 1 << 25  # pixels: more than cameras for beams have, and little beside a computer's memory

__all__ = ["load_profile", "profile_axes", "profile_extent"]


def load_profile(laser: Laser) -> NDArray[np.float64]:
    """The image of `laser.profile_image`: irradiance on a plane across the beam, `[H, W]`, any unit.

    `.npy` as it is; `.exr` and `.png` with the mean of their colours, taken as linear; alpha is left out.

    Raises:
        FileError: The file cannot be read, or holds no image of finite values ≥ 0 with light in it.
    """
    path = Path(laser.profile_image or "")
    where = f"laser.profile_image = {str(path)!r}"
    readers = {".npy": _read_npy, ".exr": _read_exr, ".png": _read_png}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise FileError(f"{where}: ending {path.suffix!r} is not one of {', '.join(readers)}")
    try:
        image = reader(existing_file(path))
    except SpadwarpError as error:
        raise FileError(f"{where}: {error}") from error
    except Exception as error:  # what a reader raises depends on the format
        raise FileError(f"{where}: damaged or not readable: {error}") from error
    if image.ndim != 2 or image.size == 0 or image.dtype.kind not in "biuf":
        raise FileError(f"{where}: {image.dtype} {image.shape}; real numbers [height, width] are needed")
    values = image.astype(np.float64)
    if not (np.isfinite(values).all() and values.min() >= 0.0 and values.max() > 0.0):
        raise FileError(f"{where}: holds {values.min()} to {values.max()}; finite values >= 0 with light are needed")
    return values


def profile_extent(laser: Laser) -> tuple[float, float]:
    """Tangents of half the width and half the height of a measured beam; its image has square pixels."""
    height, width = load_profile(laser).shape
    wide = math.tan(laser.half_angle)
    return wide, wide * height / width


def profile_axes(axis: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions of a measured beam's columns (to the right) and rows (down) for the unit vector of its axis.

    Those of the camera for a beam along z; "right" has no y component.
    """
    x, _, z = forward = np.asarray(axis, np.float64)
    level = math.hypot(x, z)
    right = np.array([z, 0.0, -x]) / level if level > 1e-6 else np.array([1.0, 0.0, 0.0])
    return right, np.cross(forward, right)


def _read_npy(path: Path) -> NDArray[np.generic]:
    return read_npy(path, largest=_LARGEST)


def _read_exr(path: Path) -> NDArray[np.generic]:
    channels, _ = read_exr(path, largest=4 * _LARGEST)
    colours = [pixels.astype(np.float64) for name, pixels in channels.items() if name.rsplit(".", 1)[-1] != "A"]
    return np.mean(colours, axis=0)


def _read_png(path: Path) -> NDArray[np.generic]:
    from matplotlib.image import imread
    from PIL import Image

    with warnings.catch_warnings(), Image.open(path, formats=("PNG",)) as image:
        warnings.simplefilter("ignore")  # of Pillow's own limit
        width, height = image.size
    if width * height > _LARGEST:
        raise FileError(f"{width} x {height} pixels; at most {_LARGEST} are read")
    pixels = np.asarray(imread(path))
    colours = {2: 1, 4: 3}.get(pixels.shape[-1], pixels.shape[-1])  # without alpha
    return pixels if pixels.ndim == 2 else pixels[..., :colours].mean(axis=-1)
