"""NumPy's files of one array, and archives of some, whose headers are compared with the file before anything is
allocated."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import FileError
from spadwarp.io.paths import existing_file

__all__ = ["read_npy", "read_npz"]


def read_npy(path: str | Path, *, largest: int | None = None) -> NDArray[Any]:
    """The array of a `.npy` file: real or complex numbers or booleans; pickles are never loaded.

    Args:
        path: The file.
        largest: Allowed number of values; None: any.

    Raises:
        FileError: No such file, not a `.npy` file, shorter than its header says, of another type, or too large.
    """
    place = existing_file(path)
    try:
        with place.open("rb") as file:
            start = file.read(4)
            if start[:2] == b"PK":
                raise FileError(f"{path}: a .npz archive, not a .npy file; write one array with numpy.save")
            file.seek(0)
            shape, _, kind = _header(file)
            size, begin = math.prod(shape), file.tell()
            if kind.kind not in "biufc":
                raise FileError(f"{path}: holds {kind}; numbers are needed")
            if largest is not None and size > largest:
                raise FileError(f"{path}: {shape} are {size} values; at most {largest} are allowed")
            if (needed := size * kind.itemsize) > (there := place.stat().st_size - begin):
                raise FileError(f"{path}: cut: {kind} {shape} takes {needed} bytes, and {there} are there")
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)
    except FileError:
        raise
    except Exception as error:  # a damaged header is parsed by Python's own parser
        raise FileError(f"{path}: damaged or not readable: {error}") from error


def read_npz(path: str | Path, *, names: Collection[str], largest: int) -> dict[str, NDArray[Any]]:
    """Those arrays of a `.npz` archive that have one of the names; real numbers or booleans; pickles are never loaded.

    Args:
        path: The file.
        names: What to read; anything else in the archive is passed over.
        largest: Allowed number of values of an array.

    Raises:
        FileError: No such file, not a `.npz` archive, shorter than a header says, of another type, or too large.
    """
    place = existing_file(path)
    found: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(place) as archive:
            for info in archive.infolist():
                name = info.filename.removesuffix(".npy")
                if name not in names:
                    continue
                with archive.open(info) as file:
                    shape, _, kind = _header(file)
                    needed = math.prod(shape) * kind.itemsize
                    if kind.kind not in "biuf":
                        raise FileError(f"{path}: {name} holds {kind}; numbers are needed")
                    if math.prod(shape) > largest or needed > info.file_size:
                        raise FileError(f"{path}: {name} {shape} is larger than the file, or than {largest} values")
                with archive.open(info) as file:
                    found[name] = np.lib.format.read_array(file, allow_pickle=False)
    except FileError:
        raise
    except Exception as error:  # a damaged header is parsed by Python's own parser
        raise FileError(f"{path}: damaged or not a .npz archive: {error}") from error
    return found


def _header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(file)
    raise ValueError(f"format version {version}")
