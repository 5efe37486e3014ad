"""NumPy's files of one array, whose header is compared with the file before anything is allocated."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import FileError
from spadwarp.io.paths import existing_file

__all__ = ["read_npy"]


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


def _header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(file)
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(file)
    raise ValueError(f"format version {version}")
