"""An HDF5 file open for reading, of which nothing is read that was not checked.

HDF5 can refer to other files (external links, external storage, virtual datasets), load programs (filters), and declare
terabytes in a few bytes. Whoever wrote a file is not trusted: a dataset is read only where it lies in this file, is
packed by gzip at most, has the type and the shape that are expected, and can be as large as it says.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import FileError, SpadwarpError
from spadwarp.io.hdf5_heap import heap_problem
from spadwarp.io.parsing import parse_json
from spadwarp.limits import check_integer, check_real

__all__ = ["Hdf5File", "Stored"]

_DEFLATE, _SMALL = 1100, 1 << 16  # gzip makes data smaller by no more than this; bytes that need no comparison
_LARGEST_ATTRIBUTE = 1 << 20  # bytes
_LARGEST_CHUNK = 1 << 26  # bytes that may be larger than the array itself
_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}
_MOST_ARRAYS, _DEEPEST = 10_000, 32  # that are listed; groups in each other
_REQUIRED: Any = object()


class Stored:
    """A checked array of an open file; what is asked for is read when it is asked for.

    Attributes:
        shape, dtype: Of the array.
    """

    def __init__(self, dataset: Any, where: str) -> None:
        self._dataset, self._where = dataset, where
        self.shape: tuple[int, ...] = dataset.shape
        self.dtype: np.dtype[Any] = dataset.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> Any:
        with _damage(self._where):
            return self._dataset[key]

    def mapped(self) -> Any:
        """The same values without a copy where they lie in one piece in the file, else itself."""
        offset = self._dataset.id.get_offset()
        if offset is None:
            return self
        with _damage(self._where):
            path = self._dataset.file.filename
            return np.memmap(path, self.dtype, "r", offset, self.shape).view(np.ndarray)


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

    def __contains__(self, name: str) -> bool:
        with _damage(f"{self.path}: {name}"):
            return name in self._file

    def names(self, group: str = "/") -> list[str]:
        """Names in a group; empty where there is none of that name."""
        import h5py

        with _damage(f"{self.path}: {group}"):
            if group not in self._file:
                return []
            found = self._object(group)
            return list(found) if isinstance(found, h5py.Group) else self.refuse(group, "is not a group")

    def arrays(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Shape and dtype of the arrays in the file and its groups, by name; links are passed over."""
        import h5py

        found: dict[str, tuple[tuple[int, ...], np.dtype[Any]]] = {}
        left = [""]
        while left and len(found) < _MOST_ARRAYS:
            group = left.pop()
            with _damage(f"{self.path}: {group or '/'}"):
                place = self._file[group] if group else self._file
                for name in place:
                    if not isinstance(place.get(name, getlink=True), h5py.HardLink):
                        continue
                    item, full = place[name], f"{group}/{name}".lstrip("/")
                    if isinstance(item, h5py.Group) and full.count("/") < _DEEPEST:
                        left.append(full)
                    elif isinstance(item, h5py.Dataset) and item.shape is not None:
                        found[full] = item.shape, item.dtype
        return found

    def referenced(self, name: str) -> NDArray[Any]:
        """The arrays to which a dataset of references refers, as cells of MATLAB do: an object array of one dimension,
        each of its arrays flat; empty where MATLAB marks it so."""
        import h5py

        references = self.array(name, h5py.ref_dtype, (None,) * len(self._object(name).shape)).ravel()
        cells = np.empty(references.size, object)
        with _damage(f"{self.path}: {name}"):
            for index, reference in enumerate(references):
                item = self._file[reference]
                if not isinstance(item, h5py.Dataset):
                    self.refuse(name, "refers to what is no array")
                _check_storage(item, lambda problem: self.refuse(name, problem))
                _check_size(item, lambda problem: self.refuse(name, problem))
                cells[index] = np.empty(0) if "MATLAB_empty" in item.attrs else np.ravel(item[...])
        return cells

    # Attributes

    def attribute(self, name: str, default: Any = _REQUIRED, *, of: str = "/") -> Any:
        """An attribute of the file, or of a dataset in it: text, a number, an array; `default` where it is missing."""
        from h5py import h5a, h5t

        with _damage(f"{self.path}: {name}"):
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

    def _number(self, name: str, value: Any, check: Any, within: str) -> Any:
        with self._whole(name):
            if isinstance(value, str):
                value = int(value) if value.lstrip("-").isdecimal() and len(value) < 40 else value
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

    def stored(self, name: str, kind: Any, shape: Sequence[int | None]) -> Stored:
        """A dataset, checked and not yet read.

        Args:
            name: Where it is, such as "truth/depth".
            kind: Its dtype, or several that it may have; "S" for text of any length.
            shape: Its shape; None for a side of any length.
        """
        import h5py

        with _damage(f"{self.path}: {name}"):
            found = self._object(name)
            if not isinstance(found, h5py.Dataset):
                self.refuse(name, "is not an array")
            _check_storage(found, lambda problem: self.refuse(name, problem))
            kinds = kind if isinstance(kind, tuple) else (kind,)
            fits = len(found.shape or ()) == len(shape) and found.shape is not None
            fits = fits and all(b in (a, None) for a, b in zip(found.shape, shape, strict=True))
            if not fits or not any(found.dtype.kind == "S" if one == "S" else found.dtype == one for one in kinds):
                wanted = " or ".join("text" if one == "S" else str(np.dtype(one)) for one in kinds)
                sides = ", ".join("any" if side is None else str(side) for side in shape)
                self.refuse(name, f"is {found.dtype} {found.shape}; {wanted} ({sides}) is needed")
            _check_size(found, lambda problem: self.refuse(name, problem))
            return Stored(found, f"{self.path}: {name}")

    def array(self, name: str, kind: Any, shape: Sequence[int | None]) -> NDArray[Any]:
        """A dataset as an array; arguments as of `stored`."""
        return np.asarray(self.stored(name, kind, shape)[...])

    def text(self, name: str) -> str:
        """A dataset that is one text."""
        import h5py

        with _damage(f"{self.path}: {name}"):
            found = self._object(name)
            if not isinstance(found, h5py.Dataset):
                self.refuse(name, "is not text")
            _check_storage(found, lambda problem: self.refuse(name, problem))
            self._check_text(name)
            if h5py.check_string_dtype(found.dtype) is None or found.shape != ():
                self.refuse(name, f"is {found.dtype} {found.shape}; one text is needed")
            _check_size(found, lambda problem: self.refuse(name, problem))
            return found.asstr()[()]

    def table(self, name: str) -> dict[str, Any]:
        """A dataset that is the text of a JSON object."""
        with self._whole(name):
            value = parse_json(self.text(name))
            return value if isinstance(value, dict) else self.refuse(name, "is not a table")

    def integers(self, name: str, *, bits: int = 128) -> dict[str, int]:
        """A dataset that is the text of a JSON object of integers, of less than so many bits."""
        table = self.table(name)
        for entry, value in table.items():
            if not isinstance(value, int) or isinstance(value, bool) or abs(value) >> (bits - 1):
                self.refuse(f"{name}, {entry}", f"is not an integer of less than {bits} bits")
        return table

    def numbers(self, name: str) -> dict[str, float]:
        """A dataset that is the text of a JSON object of finite numbers."""
        table = self.table(name)
        for entry, value in table.items():
            if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e300:
                self.refuse(f"{name}, {entry}", "is not a finite number")
        return table

    # Checks

    def _object(self, name: str) -> Any:
        """What a name stands for, if the way there stays in this file."""
        import h5py

        place = self._file
        for part in name.strip("/").split("/"):
            link = place.get(part, getlink=True) if part and isinstance(place, h5py.Group) else None
            if part and link is None:
                self.refuse(name, "is missing")
            if part and not isinstance(link, h5py.HardLink):
                self.refuse(name, "is a link; only what is in the file itself is read")
            place = place[part] if part else place
        return place

    def _check_text(self, name: str) -> None:
        if (problem := heap_problem(self.path)) is not None:
            raise FileError(f"{self.path}: damaged: the file {problem}, so that {name} cannot be read")

    @contextmanager
    def _whole(self, name: str) -> Iterator[None]:
        try:
            yield
        except FileError:
            raise
        except (ValueError, SpadwarpError) as error:
            self.refuse(name, f"cannot be used: {error}")

    def refuse(self, name: str, problem: str) -> NoReturn:
        """Raises the `FileError` of something in the file that is not as it should be."""
        raise FileError(f"{self.path}: not a whole {self.kind}: {name} {problem}")


@contextmanager
def _damage(where: str) -> Iterator[None]:
    """Whatever h5py raises for a damaged file is an error that names the place."""
    try:
        yield
    except (SpadwarpError, MemoryError):
        raise
    except Exception as error:  # OSError, RuntimeError, KeyError, ValueError, TypeError, ... by the kind of damage
        raise FileError(f"{where}: damaged or not readable: {error}") from error


def _check_storage(dataset: Any, refuse: Callable[[str], NoReturn]) -> None:
    from h5py import h5d

    created = dataset.id.get_create_plist()
    if created.get_external_count() or created.get_layout() == h5d.VIRTUAL:
        refuse("lies in other files; only what is in the file itself is read")
    for index in range(created.get_nfilters()):
        number, _, _, name = created.get_filter(index)
        if number not in _FILTERS:
            text = name.decode(errors="replace") or number
            refuse(f"is packed by the filter {text}; {', '.join(_FILTERS.values())} are known")


def _check_size(dataset: Any, refuse: Callable[[str], NoReturn]) -> None:
    """Compares what a dataset declares with what is stored of it."""
    declared, stored = dataset.nbytes, dataset.id.get_storage_size()
    packed = dataset.compression is not None
    if declared > _SMALL and declared > stored * (_DEFLATE if packed else 1):
        refuse(f"has shape {dataset.shape}, {declared} bytes, of which the file holds {stored}")
    if stored > dataset.file.id.get_filesize():
        refuse(f"takes {stored} bytes, more than the file has")
    if dataset.chunks and math.prod(dataset.chunks) * dataset.dtype.itemsize > max(_LARGEST_CHUNK, declared):
        refuse(f"has chunks of shape {dataset.chunks}, larger than itself")
