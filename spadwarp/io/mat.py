"""MATLAB files, versions 4 to 7.3: what they hold, and dense arrays, sparse matrices and cells of numbers in them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.io.hdf5 import read_hdf5
from spadwarp.io.hdf5_file import Hdf5File
from spadwarp.io.mat5 import Kind, open_variables

__all__ = ["MatEntry", "SparseMatrix", "mat_entries", "read_mat"]


class MatEntry(NamedTuple):
    """A variable of a file: "dense", "sparse" or "cell", and its shape as MATLAB shows it."""

    kind: Kind
    shape: tuple[int, ...]


class SparseMatrix(NamedTuple):
    """A sparse matrix by its entries, which are not zero."""

    shape: tuple[int, int]
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    value: NDArray[Any]


def mat_entries(path: Path) -> dict[str, MatEntry]:
    """The numeric variables of a file by name; text and structures are left out. Raises `FileError`."""
    if _is_hdf5(path):
        with read_hdf5(path) as file:
            return dict(_hdf5_entries(file))
    with open_variables(path) as found:
        return {name: MatEntry(variable.kind, variable.shape) for name, variable in found.items()}


def read_mat(path: Path, name: str, entry: MatEntry) -> NDArray[Any] | SparseMatrix:
    """A variable from `mat_entries`: an array; a `SparseMatrix`; or for cells an object array of arrays, one
    dimension each. Raises `FileError`."""
    if _is_hdf5(path):
        return _read_hdf5(path, name, entry)
    with open_variables(path) as found:
        value = found[name].read()
    return SparseMatrix((entry.shape[0], entry.shape[1]), *value) if entry.kind == "sparse" else value


def _is_hdf5(path: Path) -> bool:
    import h5py

    return h5py.is_hdf5(path)


# Version 7.3, which is HDF5: dimensions are reversed, cells are references, sparse matrices groups


def _hdf5_entries(file: Hdf5File) -> Iterator[tuple[str, MatEntry]]:
    arrays = {name: found for name, found in file.arrays().items() if not name.startswith("#")}
    for name, (shape, dtype) in arrays.items():
        if "/" not in name and file.attribute("MATLAB_class", b"", of=name) == b"cell":
            yield name, MatEntry("cell", shape[::-1])
        elif "/" not in name and dtype.kind in "biuf":
            yield name, MatEntry("dense", shape[::-1])
        elif name.endswith("/jc") and f"{name[:-3]}/ir" in arrays:
            rows = int(file.attribute("MATLAB_sparse", of=name[:-3]))
            yield name[:-3], MatEntry("sparse", (rows, shape[0] - 1))


def _read_hdf5(path: Path, name: str, entry: MatEntry) -> NDArray[Any] | SparseMatrix:
    with read_hdf5(path) as file:
        if entry.kind == "cell":
            return file.referenced(name).reshape(entry.shape[::-1]).T
        dtype = file.arrays()[name if entry.kind == "dense" else f"{name}/jc"][1]
        if entry.kind == "dense":
            return file.array(name, dtype, entry.shape[::-1]).T
        starts = file.array(f"{name}/jc", dtype, (entry.shape[1] + 1,)).astype(np.int64)
        row = file.array(f"{name}/ir", dtype, (None,)).astype(np.int64)
        value = file.array(f"{name}/data", file.arrays()[f"{name}/data"][1], (row.size,))
        if starts[0] != 0 or starts[-1] != row.size or (np.diff(starts) < 0).any() or (row >= entry.shape[0]).any():
            file.refuse(name, "is no sparse matrix: its rows and columns do not fit each other")
        column = np.repeat(np.arange(entry.shape[1]), np.diff(starts))
        return SparseMatrix((entry.shape[0], entry.shape[1]), row, column, value)
