"""HDF5 files: written whole or not at all, with named dimensions; and read so that nothing is read unchecked.

HDF5 can refer to other files (external links, external storage, virtual datasets), load programs (filters), and declare
terabytes in a few bytes. Whoever wrote a file is not trusted: a dataset is read only where it lies in this file, is
packed by gzip at most, has the type and the shape that are expected, and can be as large as it says.
"""

from __future__ import annotations

import functools
import io
import itertools
import math
import mmap
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from spadwarp.io.paths import atomic_path, existing_file, used
from spadwarp.io.text import parse_json
from spadwarp.values import FileError, check_integer, check_real

if TYPE_CHECKING:
    import h5py

_DEFLATE, _SMALL = 1100, 1 << 16  # gzip makes data smaller by no more than this; bytes that need no comparison
_LARGEST_ATTRIBUTE = 1 << 20  # bytes
_LARGEST_CHUNK = 1 << 26  # bytes that may be larger than the array itself
_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}
_MOST_ARRAYS, _DEEPEST = 10_000, 32  # that are listed; groups in each other
_REQUIRED: Any = object()
PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}

Method = TypeVar("Method", bound=Callable[..., Any])


# Reading


@contextmanager
def read_hdf5(path: str | Path, format: str | None = None, *, version: int | None = None) -> Iterator[Hdf5File]:
    """An HDF5 file to read from, for the length of a block that does nothing else.

    `format`: what its attribute of this name has to be, such as "spadwarp result"; `version`: the newest
    `format_version` that can be read; None: any. Raises `FileError`: no such file, not HDF5, of another format or a
    newer version, damaged, or without something that the block looked for (whatever error it raised); says which.
    """
    with closing(open_hdf5(path, format, version=version)) as file:
        try:
            yield file
        except (FileError, MemoryError):
            raise
        except Exception as error:
            raise FileError(f"{path}: not a whole {file.kind}: {error}") from error


def open_hdf5(path: str | Path, format: str | None = None, *, version: int | None = None) -> Hdf5File:
    """A file to read from until its `close`; arguments and errors of `read_hdf5`."""
    import h5py

    existing_file(path)
    try:
        opened = h5py.File(path, "r")
    except (OSError, RuntimeError) as error:
        problem = f"damaged or not readable: {error}" if h5py.is_hdf5(path) else f"not an HDF5 file{used(path)}"
        raise FileError(f"{path}: {problem}") from error
    file = Hdf5File(opened, path, format or "HDF5 file of this kind")
    try:
        stored = file.attribute("format", "unknown")
        if format is not None and not (isinstance(stored, str) and stored == format):
            hint = "; give the directory of a run of `spadwarp simulate`" if format == "spadwarp result" else ""
            raise FileError(f"{path}: an HDF5 file, but not a {format}: its format is {stored!r}, not {format!r}{hint}")
        if version is not None and (newer := file.integer("format_version")) > version:
            raise FileError(f"{path}: format version {newer} is newer than {version}, the newest that can be read")
    except BaseException:
        file.close()
        raise
    return file


def hdf5_format(path: str | Path) -> str | None:
    """The attribute `format` of an HDF5 file, such as "spadwarp frames", or None. Raises `FileError`."""
    with read_hdf5(path) as file:
        value = file.attribute("format", None)
        return value if isinstance(value, str) else None


def _checked(method: Method) -> Method:
    """A method whose errors name the file and its first argument, whatever h5py raises for a damaged file."""

    @functools.wraps(method)
    def checked(self: Any, name: str, /, *args: Any, **options: Any) -> Any:
        try:
            return method(self, name, *args, **options)
        except (FileError, MemoryError):
            raise
        except Exception as error:  # OSError, RuntimeError, KeyError, ValueError, TypeError, ... by the kind of damage
            self.refuse(name, f"is damaged or not readable: {error}")

    return cast(Method, checked)


class Stored:
    """A checked array of an open file, with its `shape` and `dtype`; what is asked for is read when it is asked for."""

    def __init__(self, dataset: Any, name: str, file: Hdf5File) -> None:
        self._dataset, self._name, self._file = dataset, name, file
        self.shape: tuple[int, ...] = dataset.shape
        self.dtype: np.dtype[Any] = dataset.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> Any:
        return self._file.part(self._name, self._dataset, key)

    def mapped(self) -> Any:
        """The same values without a copy where they lie in one piece in the file, else itself."""
        offset = self._dataset.id.get_offset()
        if offset is None:
            return self
        try:
            return np.memmap(self._file.path, self.dtype, "r", offset, self.shape).view(np.ndarray)
        except (OSError, ValueError) as error:
            self._file.refuse(self._name, f"is damaged or not readable: {error}")


class Hdf5File:
    """An open file; methods raise `FileError`, which names the file and what is wrong in it.

    Attributes:
        path: The file.
        kind: What it should be, such as "spadwarp result", for errors.
    """

    def __init__(self, file: Any, path: str | Path, kind: str) -> None:
        self._file, self.path, self.kind = file, path, kind

    def close(self) -> None:
        """Closes the file; arrays that were not read cannot be read any more."""
        self._file.close()

    def refuse(self, name: str, problem: str) -> NoReturn:
        """Raises the `FileError` of something in the file that is not as it should be."""
        raise FileError(f"{self.path}: not a whole {self.kind}: {name} {problem}")

    @_checked
    def __contains__(self, name: str) -> bool:
        return name in self._file

    @_checked
    def names(self, group: str) -> list[str]:
        """Names in a group; empty where there is none of that name."""
        import h5py

        if group not in self._file:
            return []
        item = self._object(group)
        return list(item) if isinstance(item, h5py.Group) else self.refuse(group, "is not a group")

    def arrays(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Shape and dtype of the arrays in the file and its groups, by name; links are passed over."""
        arrays: dict[str, tuple[tuple[int, ...], np.dtype[Any]]] = {}
        groups = ["/"]
        while groups and len(arrays) < _MOST_ARRAYS:
            groups += self._list_arrays(groups.pop(), arrays)
        return arrays

    @_checked
    def _list_arrays(self, group: str, arrays: dict[str, tuple[tuple[int, ...], np.dtype[Any]]]) -> list[str]:
        """Adds the arrays of a group; returns the groups in it."""
        import h5py

        groups, place = [], self._file[group]
        for name in place:
            if not isinstance(place.get(name, getlink=True), h5py.HardLink):
                continue
            item, full = place[name], f"{group}/{name}".lstrip("/")
            if isinstance(item, h5py.Group) and full.count("/") < _DEEPEST:
                groups.append(full)
            elif isinstance(item, h5py.Dataset) and item.shape is not None:
                arrays[full] = item.shape, item.dtype
        return groups

    @_checked
    def referenced(self, name: str) -> NDArray[Any]:
        """The arrays to which a dataset of references refers, as cells of MATLAB do: an object array of one dimension,
        each of its arrays flat; empty where MATLAB marks it so."""
        import h5py

        references = self.array(name, h5py.ref_dtype, (None,) * len(self._object(name).shape)).ravel()
        cells = np.empty(references.size, object)
        for index, reference in enumerate(references):
            item = self._dataset(name, self._file[reference])
            cells[index] = np.empty(0) if "MATLAB_empty" in item.attrs else np.ravel(item[...])
        return cells

    # Attributes

    @_checked
    def attribute(self, name: str, default: Any = _REQUIRED, *, of: str = "/") -> Any:
        """An attribute of the file, or of a dataset in it: text, a number, an array; `default` where it is missing."""
        from h5py import h5a, h5t

        place = self._object(of)
        if not h5a.exists(place.id, name.encode()):
            return self.refuse(name, "is missing") if default is _REQUIRED else default
        stored = h5a.open(place.id, name.encode())
        kind = stored.get_type().get_class()
        if kind not in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM, h5t.STRING):
            self.refuse(name, "is neither text nor numbers")
        if kind == h5t.STRING:
            self._check_text(name)
        if math.prod(stored.shape) * max(stored.dtype.itemsize, 1) > _LARGEST_ATTRIBUTE:
            self.refuse(name, f"is an attribute of shape {stored.shape}, which is too large")
        return place.attrs[name]

    def real(self, name: str, within: str = "(-inf, inf)", *, of: str = "/") -> float:
        """An attribute that is a number in a range such as "(0, inf)"."""
        return self._number(name, self.attribute(name, of=of), check_real, within)

    def integer(self, name: str, within: str = "[0, 18446744073709551615]", default: Any = _REQUIRED) -> int:
        """An attribute that is an integer in a range, or the text of one, as seeds are."""
        return self._number(name, self.attribute(name, default), check_integer, within)

    @_checked
    def _number(self, name: str, value: Any, check: Any, within: str) -> Any:
        if isinstance(value, str) and value.lstrip("-").isdecimal() and len(value) < 40:
            value = int(value)
        return check(name, value.item() if isinstance(value, np.generic) else value, within)

    def flag(self, name: str) -> bool:
        """An attribute that is true or false."""
        value = self.attribute(name)
        return bool(value) if isinstance(value, bool | np.bool_) else self.refuse(name, "is neither true nor false")

    def text_attribute(self, name: str, default: Any = _REQUIRED) -> str:
        """An attribute that is text."""
        value = self.attribute(name, default)
        return value if isinstance(value, str) or value is default else self.refuse(name, "is not text")

    # Datasets

    @_checked
    def stored(self, name: str, kind: Any, shape: Sequence[int | None]) -> Stored:
        """A dataset such as "truth/depth", checked and not yet read.

        `kind`: its dtype, or several that it may have, "S" for text; `shape`: None for a side of any length.
        """
        dataset = self._dataset(name, self._object(name))
        kinds = kind if isinstance(kind, tuple) else (kind,)
        fits = dataset.shape is not None and len(dataset.shape) == len(shape)
        fits = fits and all(b in (a, None) for a, b in zip(dataset.shape, shape, strict=True))
        if not fits or not any(dataset.dtype.kind == "S" if one == "S" else dataset.dtype == one for one in kinds):
            needed = " or ".join("text" if one == "S" else str(np.dtype(one)) for one in kinds)
            sides = ", ".join("any" if side is None else str(side) for side in shape)
            self.refuse(name, f"is {dataset.dtype} {dataset.shape}; {needed} ({sides}) is needed")
        return Stored(dataset, name, self)

    @_checked
    def part(self, name: str, dataset: Any, key: Any) -> Any:
        """A part of a dataset of h5py that was checked."""
        return dataset[key]

    def array(self, name: str, kind: Any, shape: Sequence[int | None]) -> NDArray[Any]:
        """A dataset as an array; arguments as of `stored`."""
        return np.asarray(self.stored(name, kind, shape)[...])

    @_checked
    def text(self, name: str) -> str:
        """A dataset that is one text."""
        import h5py

        dataset = self._dataset(name, self._object(name))
        self._check_text(name)
        if h5py.check_string_dtype(dataset.dtype) is None or dataset.shape != ():
            self.refuse(name, f"is {dataset.dtype} {dataset.shape}; one text is needed")
        return dataset.asstr()[()]

    @_checked
    def table(self, name: str) -> dict[str, Any]:
        """A dataset that is the text of a JSON object."""
        value = parse_json(self.text(name))
        return value if isinstance(value, dict) else self.refuse(name, "is not a table")

    def integers(self, name: str, *, bits: int = 128) -> dict[str, int]:
        """A dataset that is the text of a JSON object of integers, of less than so many bits."""
        needed = f"an integer of less than {bits} bits"
        return self._entries(name, lambda value: type(value) is int and not abs(value) >> (bits - 1), needed)

    def numbers(self, name: str) -> dict[str, float]:
        """A dataset that is the text of a JSON object of finite numbers."""
        return self._entries(name, lambda value: type(value) in (int, float) and abs(value) < 1e300, "a finite number")

    def _entries(self, name: str, fits: Callable[[Any], bool], needed: str) -> dict[str, Any]:
        table = self.table(name)
        for entry, value in table.items():
            if not fits(value):
                self.refuse(f"{name}, {entry}", f"is not {needed}")
        return table

    # Checks

    def _object(self, name: str) -> Any:
        """The object of a name, if the way there stays in this file."""
        import h5py

        place = self._file
        for part in filter(None, name.split("/")):
            link = place.get(part, getlink=True) if isinstance(place, h5py.Group) else None
            if link is None:
                self.refuse(name, "is missing")
            if not isinstance(link, h5py.HardLink):
                self.refuse(name, "is a link; only what is in the file itself is read")
            place = place[part]
        return place

    def _dataset(self, name: str, item: Any) -> Any:
        """An object, if it is a dataset of this file, packed as HDF5 itself does, that can be as large as it says."""
        import h5py

        if not isinstance(item, h5py.Dataset):
            self.refuse(name, "is not an array")
        created = item.id.get_create_plist()
        if created.get_external_count() or created.get_layout() == h5py.h5d.VIRTUAL:
            self.refuse(name, "lies in other files; only what is in the file itself is read")
        for index in range(created.get_nfilters()):
            number, _, _, title = created.get_filter(index)
            if number not in _FILTERS:
                text = title.decode(errors="replace") or number
                self.refuse(name, f"is packed by the filter {text}; {', '.join(_FILTERS.values())} are known")
        declared, stored = 0 if item.shape is None else item.nbytes, item.id.get_storage_size()
        if declared > _SMALL and declared > stored * (_DEFLATE if item.compression is not None else 1):
            self.refuse(name, f"has shape {item.shape}, {declared} bytes, of which the file holds {stored}")
        if stored > item.file.id.get_filesize():
            self.refuse(name, f"takes {stored} bytes, more than the file has")
        if item.chunks and math.prod(item.chunks) * item.dtype.itemsize > max(_LARGEST_CHUNK, declared):
            self.refuse(name, f"has chunks of shape {item.chunks}, larger than itself")
        return item

    def _check_text(self, name: str) -> None:
        """Refuses text with which HDF5 would come to no end; each state of a file is looked at once."""
        state = os.stat(self.path)
        problem = _text_problem(str(self.path), state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns)
        if problem is not None:
            raise FileError(f"{self.path}: damaged: the file {problem}, so that {name} cannot be read")


# HDF5 walks through a "global heap collection", in which it keeps text of any length, from object to object by sizes
# that stand in the file; wrong ones make it walk for ever, or out of its memory. HDF5 File Format Specification, III.E.
_MARK = b"GCOL\x01"  # with the version, since the letters alone also occur by chance in packed numbers
_SUPERBLOCK = b"\x89HDF\r\n\x1a\n"
_HEADER = 16  # bytes, of a collection and of each object in it
_WHOLE, _ENDS = 1 << 30, 1 << 26  # of larger files the first and the last part: text stands before and behind arrays


@functools.lru_cache(maxsize=4096)
def _text_problem(path: str, *state: int) -> str | None:
    """Damage in the places of a file that hold text of any length; None if they can be read."""
    size = state[2]
    if size == 0:
        return "is empty"
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if not _has_long_sizes(content):
            return "has sizes of another width than 8 bytes"
        for start, stop in [(0, size)] if size <= _WHOLE else [(0, _ENDS), (size - _ENDS, size)]:
            place = content.find(_MARK, start, stop)
            while place >= 0:
                if not _is_whole(content, place):
                    return f"has damaged text at byte {place}"
                place = content.find(_MARK, place + 1, stop)
    return None


def _has_long_sizes(content: mmap.mmap) -> bool:
    """Whether addresses and sizes take 8 bytes each, as in all files that are not tiny by choice."""
    place = 0
    while place < len(content) and content[place : place + 8] != _SUPERBLOCK:
        place = max(2 * place, 512)  # where the format allows a superblock
    if place + 16 > len(content):
        return False
    first = place + (13 if content[place + 8] < 2 else 9)
    return content[first] == content[first + 1] == 8


def _is_whole(content: mmap.mmap, place: int) -> bool:
    """Whether the objects of a collection fill it, none beyond its end."""
    if place + _HEADER > len(content):
        return False
    (size,) = struct.unpack_from("<Q", content, place + 8)
    end = place + size
    if size < _HEADER or end > len(content):
        return False
    place += _HEADER
    while end - place >= _HEADER:
        index, length = struct.unpack_from("<H6xQ", content, place)
        needed = _HEADER + -(-length // 8) * 8 if index else length
        if not _HEADER <= needed <= end - place:
            return False
        place += needed
    return True


# Writing


class _Patient(io.FileIO):
    """A new file for HDF5, which brings the whole process down when it meets a full disk: every write succeeds, and the
    first that did not is kept in `error`."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        done = 0
        try:
            while self.error is None and done < len(view):
                done += super().write(view[done:])
        except OSError as error:
            self.error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0


@contextmanager
def write_hdf5(path: str | Path, **options: Any) -> Iterator[h5py.File]:
    """An HDF5 file to write to, which is at `path` when the block ends well; see `atomic_path`."""
    import h5py

    with atomic_path(path) as temporary, closing(_Patient(temporary, "w+")) as patient:
        try:
            with h5py.File(patient, "w", **options) as file:
                yield file
        except (OSError, RuntimeError):
            if patient.error is None:
                raise
        if patient.error is not None:
            raise patient.error


PIXELS = ("y", "x")

Coordinate = tuple[Any, str, str]
"""Values of a coordinate, or the name of an array of the file that holds them; unit; meaning."""

_NO_COORDINATE = "This is a netCDF dimension but not a netCDF variable.{:10d}"  # what netCDF-4 calls its scale


def name_dimensions(
    file: Any, coordinates: Mapping[str, Coordinate | int | None], arrays: Mapping[str, tuple[Sequence[str], str, str]]
) -> None:
    """Writes dimension scales, as netCDF-4 has them, to an open file and attaches them to its arrays.

    `coordinates`: dimension → its coordinate, or its size alone; None: a size of 0 that grows with its arrays, which
    the caller resizes. `arrays`: name → its dimensions, unit and meaning; those that the file does not hold are passed
    over. Dimensions that no array has are not written, but arrays that are coordinates of themselves are marked so.
    """
    held = {name: described for name, described in arrays.items() if name in file}
    needed = {dimension for dimensions, _, _ in held.values() for dimension in dimensions}
    for name, coordinate in coordinates.items():
        if name in needed or (isinstance(coordinate, tuple) and isinstance(coordinate[0], str)):
            _write_scale(file, name, coordinate)
    for name, (dimensions, unit, meaning) in held.items():
        file[name].attrs.update({"units": unit, "long_name": meaning})
        for axis, dimension in enumerate(dimensions):
            file[name].dims[axis].attach_scale(file[dimension])


def image_coordinates(height: int, width: int) -> dict[str, Coordinate]:
    """Of `PIXELS`, and of the axes of vectors in the camera frame."""
    return {
        "y": (np.arange(height), "1", "row of pixels, downwards"),
        "x": (np.arange(width), "1", "column of pixels, to the right"),
        "axis": (["x", "y", "z"], "1", "of the camera frame: right, down, away"),
    }


def _write_scale(file: Any, name: str, coordinate: Coordinate | int | None) -> None:
    if coordinate is None or isinstance(coordinate, int):
        size = coordinate or 0
        grows: dict[str, Any] = {"maxshape": (None,), "chunks": (1 << 16,)} if coordinate is None else {}
        file.create_dataset(name, (size,), ">f4", **grows).make_scale(_NO_COORDINATE.format(size))
        return
    values, unit, meaning = coordinate
    if not isinstance(values, str):
        file.create_dataset(name, data=values if isinstance(values, np.ndarray) else list(values))
    stored = file[name if not isinstance(values, str) else values]
    stored.attrs.update({"units": unit, "long_name": meaning})
    stored.make_scale(name)


_CHUNK_BYTES = 1 << 20  # HDF5's default chunk cache


def image_chunks(shape: Sequence[int], item_bytes: int) -> tuple[int, ...]:
    """Chunks of an array `[H, W, ...]` that HDF5's cache holds."""
    height, width, *rest = shape
    row = item_bytes * math.prod(rest)
    columns = max(1, min(width, _CHUNK_BYTES // row))
    return max(1, min(height, _CHUNK_BYTES // (row * columns))), columns, *rest


# Large arrays are compressed by all cores; HDF5 itself compresses with one.
_THREADS = 16
_LARGE = 1 << 22  # bytes from which threads are worth their start


def write_packed(file: Any, name: str, array: NDArray[Any], *, chunks: Sequence[int], compression: int) -> Any:
    """Writes an array of numbers to an open file with HDF5's filters shuffle and gzip (and its checksum); returns the
    dataset. `chunks`: shape of a chunk, about 1 MB; `compression`: level of gzip, 1 to 9."""
    options = {"compression": "gzip", "compression_opts": compression, "shuffle": True}
    if array.nbytes < _LARGE:
        return file.create_dataset(name, data=array, chunks=tuple(chunks), **options)
    made = file.create_dataset(name, array.shape, array.dtype, chunks=tuple(chunks), **options)

    def packed(part: NDArray[Any]) -> bytes:
        beyond = [(0, size - side) for size, side in zip(chunks, part.shape, strict=True)]  # at the edges
        numbers = np.ascontiguousarray(np.pad(part, beyond))
        return zlib.compress(numbers.view(np.uint8).reshape(-1, array.itemsize).T.tobytes(), compression)

    empty = packed(np.zeros(chunks, array.dtype))

    def pack(start: tuple[int, ...]) -> bytes:
        part = array[tuple(slice(first, first + size) for first, size in zip(start, chunks, strict=True))]
        return packed(part) if part.any() else empty

    starts = itertools.product(*(range(0, size, step) for size, step in zip(array.shape, chunks, strict=True)))
    threads = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, _THREADS)
    with ThreadPoolExecutor(threads) as pool:
        while some := list(itertools.islice(starts, 8 * threads)):  # so that memory stays small
            for start, data in zip(some, pool.map(pack, some), strict=True):
                made.id.write_direct_chunk(start, data)
    return made
