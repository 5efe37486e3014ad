"""MATLAB files, versions 5 and 7.3: what they hold, and dense arrays, sparse matrices and cells of numbers in them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import FileError, SpadwarpError
from spadwarp.io.hdf5 import read_hdf5
from spadwarp.io.hdf5_file import Hdf5File

__all__ = ["MatEntry", "SparseMatrix", "mat_entries", "read_mat"]

Kind = Literal["dense", "sparse", "cell"]

_NUMERIC = ("double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
_KINDS: dict[str, Kind] = {"sparse": "sparse", "cell": "cell", **dict.fromkeys(_NUMERIC, "dense")}


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
    from scipy.io import whosmat

    with _reading(path):
        found = whosmat(path)
    return {name: MatEntry(_KINDS[kind], tuple(shape)) for name, shape, kind in found if kind in _KINDS}


def read_mat(path: Path, name: str, entry: MatEntry) -> NDArray[Any] | SparseMatrix:
    """A variable from `mat_entries`: an array; a `SparseMatrix`; or for cells an object array of arrays, one
    dimension each. Raises `FileError`."""
    if _is_hdf5(path):
        return _read_hdf5(path, name, entry)
    from scipy.io import loadmat

    with _reading(path):
        value = loadmat(path, variable_names=[name], spmatrix=False)[name]
    if entry.kind == "sparse":
        found = value.tocoo()
        return SparseMatrix(value.shape, found.row.astype(np.int64), found.col.astype(np.int64), found.data)
    if entry.kind == "cell":
        cells = np.empty(value.shape, object)
        for index, cell in enumerate(value.flat):
            cells.flat[index] = np.ravel(cell)
        return cells
    return np.asarray(value)


def _is_hdf5(path: Path) -> bool:
    import h5py

    return h5py.is_hdf5(path)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Errors of scipy, whose kinds depend on where a file is damaged, become a `FileError`."""
    try:
        yield
    except (SpadwarpError, MemoryError):
        raise
    except Exception as error:
        raise FileError(f"{path}: damaged or not readable: {error}") from error


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
