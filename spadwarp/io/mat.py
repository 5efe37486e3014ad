"""MATLAB files, versions 5 and 7.3: arrays, sparse matrices and cells of numbers.

SciPy's reader follows types and sizes of a damaged file into memory that is not its own; here they are compared with
the file first, and what remains is a view of its bytes. Layout: MATLAB, "MAT-File Format" (R2023a).
"""

from __future__ import annotations

import math
import mmap
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.io.hdf5 import Hdf5File, open_hdf5
from spadwarp.io.paths import reading

_MATRIX, _COMPRESSED = 14, 15
_CELL, _SPARSE = 1, 5
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_COMPLEX, _LOGICAL = 0x0800, 0x0200
_HEAD = 1 << 16  # bytes of a compressed array that hold its name and shape


class SparseMatrix(NamedTuple):
    """A sparse matrix by its entries."""

    shape: tuple[int, int]
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    value: NDArray[Any]


@dataclass(frozen=True)
class Variable:
    """A variable whose numbers are not yet read, of a shape as MATLAB shows it; `read` gives the array, a
    `SparseMatrix`, or for cells an object array of arrays, one dimension each."""

    kind: Literal["dense", "sparse", "cell"]
    shape: tuple[int, ...]
    read: Callable[[], Any]


@contextmanager
def open_mat(path: Path) -> Iterator[dict[str, Variable]]:
    """The numeric variables of a file by name, which can be read within the block; text and structures are left out.

    Raises `FileError`, also within the block.
    """
    import h5py

    with reading(path):
        if h5py.is_hdf5(path):
            with closing(open_hdf5(path)) as file:
                yield dict(_version_7(file))
        else:
            with open(path, "rb") as source, mmap.mmap(source.fileno(), 0, access=mmap.ACCESS_READ) as content:
                yield dict(_version_5(content))


def _sparse(shape: tuple[int, ...], row: NDArray[Any], start: NDArray[Any], value: NDArray[Any]) -> SparseMatrix:
    """A matrix by the rows of its entries, column by column, and where each column begins among them."""
    count = int(start[-1])
    if len(shape) != 2 or start[0] != 0 or (np.diff(start) < 0).any() or count > min(row.size, value.size):
        raise ValueError("a sparse matrix whose columns do not fit its entries")
    row = row[:count].astype(np.int64)
    if count and not 0 <= row.min() <= row.max() < shape[0]:
        raise ValueError(f"a sparse matrix with entries outside its {shape[0]} rows")
    column = np.repeat(np.arange(shape[1]), np.diff(start))
    return SparseMatrix((shape[0], shape[1]), row, column, value[:count].copy())


# Version 7.3, which is HDF5: dimensions are reversed, cells are references, sparse matrices groups


def _version_7(file: Hdf5File) -> Iterator[tuple[str, Variable]]:
    arrays = {name: array for name, array in file.arrays().items() if not name.startswith("#")}
    for name, (shape, dtype) in arrays.items():
        if "/" not in name and file.attribute("MATLAB_class", b"", of=name) == b"cell":
            yield name, Variable("cell", shape[::-1], partial(_transposed, shape, file.referenced, name))
        elif "/" not in name and dtype.kind in "biuf":
            yield name, Variable("dense", shape[::-1], partial(_transposed, shape, file.array, name, dtype, shape))
        elif name.endswith("/jc") and {f"{name[:-2]}ir", f"{name[:-2]}data"} <= arrays.keys():
            sides = (int(file.attribute("MATLAB_sparse", of=name[:-3])), shape[0] - 1)
            parts = {part: arrays[name[:-2] + part] for part in ("ir", "jc", "data")}
            yield name[:-3], Variable("sparse", sides, partial(_sparse_7, file, name[:-2], sides, parts))


def _transposed(shape: tuple[int, ...], read: Callable[..., NDArray[Any]], *arguments: Any) -> NDArray[Any]:
    return read(*arguments).reshape(shape).T


def _sparse_7(file: Hdf5File, group: str, shape: tuple[int, int], parts: Mapping[str, Any]) -> SparseMatrix:
    row, start, value = (file.array(group + part, dtype, size) for part, (size, dtype) in parts.items())
    return _sparse(shape, row, start.astype(np.int64), value)


def _version_5(content: mmap.mmap) -> Iterator[tuple[str, Variable]]:
    if content[126:128] not in (b"IM", b"MI"):
        raise ValueError("not a file of MATLAB 5 or later")
    order = "<" if content[126:128] == b"IM" else ">"
    place = 128
    while place + 8 <= len(content):
        kind, size = struct.unpack_from(order + "II", content, place)
        start, stop = place + 8, place + 8 + size
        if stop > len(content):
            raise ValueError(f"cut: {size} bytes are missing at byte {place}")
        if kind not in (_COMPRESSED, _MATRIX):
            raise ValueError(f"type {kind} at byte {place}")
        if kind == _COMPRESSED:
            variable, place = _compressed(content[start:stop], order), stop
        else:
            variable, place = _matrix(content[start:stop], order, size), stop + -size % 8
        if variable is not None:
            yield variable


def _compressed(packed: bytes, order: str) -> tuple[str, Variable] | None:
    head = zlib.decompressobj().decompress(packed, _HEAD)
    kind, size = struct.unpack_from(order + "II", head)
    if kind != _MATRIX or size > 1100 * len(packed) + _HEAD:  # zlib makes nothing smaller than this
        raise ValueError(f"a compressed array of type {kind} and {size} bytes")
    variable = _matrix(head[8:], order, size)
    if variable is None:
        return None

    def read() -> Any:
        whole: Any = _matrix(zlib.decompressobj().decompress(packed, 8 + size)[8:], order, size)
        return whole[1].read()

    return variable[0], replace(variable[1], read=read)


def _matrix(content: bytes, order: str, size: int) -> tuple[str, Variable] | None:
    """Name and variable of a matrix of `size` bytes that begins with `content`; None for other than numbers."""
    (flags, _), place = _field(content, 0, order, {6: "u4"}, 2)
    (*shape,), place = _field(content, place, order, {5: "i4"})
    letters, place = _field(content, place, order, {1: "u1", 2: "u1", 16: "u1"})
    name = bytes(letters.astype(np.uint8)).decode("utf-8", "replace")
    class_, sides = int(flags) & 0xFF, tuple(map(int, shape))
    if len(sides) < 2 or min(sides) < 0:
        raise ValueError(f"array {name!r} has shape {sides}")
    if int(flags) & _COMPLEX or class_ not in (_CELL, _SPARSE, *_CLASSES):
        return None
    if class_ == _SPARSE:
        return name, Variable("sparse", sides, partial(_sparse_5, content, place, order, sides))
    # A cell takes at least a tag; numbers may be stored in fewer bytes than their class has, but not in less than one.
    if math.prod(sides) * (8 if class_ == _CELL else 1) > max(size - place, 4):
        raise ValueError(f"array {name!r} of shape {sides} is not in {size} bytes")
    if class_ == _CELL:
        return name, Variable("cell", sides, partial(_cells_5, content, place, order, sides))

    def dense() -> NDArray[Any]:
        values, _ = _field(content, place, order, _STORED, math.prod(sides))
        kind = "?" if int(flags) & _LOGICAL else _CLASSES[class_]
        return values.astype(kind).reshape(sides, order="F")

    return name, Variable("dense", sides, dense)


def _sparse_5(content: bytes, place: int, order: str, shape: tuple[int, ...]) -> SparseMatrix:
    rows, place = _field(content, place, order, {5: "i4"})
    starts, place = _field(content, place, order, {5: "i4"}, shape[1] + 1)
    return _sparse(shape, rows, starts, _field(content, place, order, _STORED)[0])


def _cells_5(content: bytes, place: int, order: str, shape: tuple[int, ...]) -> NDArray[Any]:
    cells = np.empty(math.prod(shape), object)
    for index in range(cells.size):
        kind, size = struct.unpack_from(order + "II", content, place)
        start, stop = place + 8, place + 8 + size
        cell = _matrix(content[start:stop], order, size) if kind == _MATRIX and stop <= len(content) and size else None
        if size and (cell is None or cell[1].kind != "dense"):
            raise ValueError(f"cell {index} holds no array of numbers")
        cells[index] = np.ravel(cell[1].read()) if cell is not None else np.zeros(0)
        place = stop + -size % 8
    return cells.reshape(shape, order="F")


def _field(
    content: bytes, place: int, order: str, kinds: Mapping[int, str], count: int | None = None
) -> tuple[NDArray[Any], int]:
    """The numbers of a data element, `count` of them if that is given, and where the next element begins."""
    kind, size = struct.unpack_from(order + "II", content, place)
    start, following = place + 8, place + 8 + size + -size % 8
    if kind >> 16:  # an element of at most four bytes in its own tag
        kind, size, start, following = kind & 0xFFFF, kind >> 16, place + 4, place + 8
    if kind not in kinds or start + size > len(content) or (start == place + 4 and size > 4):
        raise ValueError(f"an element of type {kind} and {size} bytes at byte {place}")
    dtype = np.dtype(order + kinds[kind])
    if size % dtype.itemsize or count not in (None, size // dtype.itemsize):
        raise ValueError(f"{size} bytes of {dtype} where {count} numbers are needed")
    return np.frombuffer(content, dtype, size // dtype.itemsize, start), following
