"""HDF5 files: opened for writing so that they appear whole or not at all, and for reading with checks."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spadwarp.errors import FileError, SpadwarpError
from spadwarp.io.atomic import atomic_path
from spadwarp.io.hdf5_file import Hdf5File
from spadwarp.io.paths import existing_file, used

if TYPE_CHECKING:
    import h5py

__all__ = ["hdf5_format", "open_hdf5", "read_hdf5", "write_hdf5"]


class _Patient(io.RawIOBase):
    """A new file for HDF5, which brings the whole process down when it meets a full disk: every write succeeds, and the
    first that did not is kept in `error`."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b", buffering=0)
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        done = 0
        try:
            while self.error is None and done < len(view):
                done += self._file.write(view[done:])
        except OSError as error:
            self.error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        try:
            return self._file.truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0

    def readinto(self, buffer: Any) -> int:
        return self._file.readinto(buffer)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def close(self) -> None:
        self._file.close()
        super().close()


@contextmanager
def write_hdf5(path: str | Path, **options: Any) -> Iterator[h5py.File]:
    """An HDF5 file to write to, which is at `path` when the block ends well; see `atomic_path`."""
    import h5py

    with atomic_path(path) as temporary, closing(_Patient(temporary)) as patient:
        try:
            with h5py.File(patient, "w", **options) as file:
                yield file
        except (OSError, RuntimeError):
            if patient.error is None:
                raise
        if patient.error is not None:
            raise patient.error


@contextmanager
def read_hdf5(path: str | Path, format: str | None = None, *, version: int | None = None) -> Iterator[Hdf5File]:
    """An HDF5 file to read from, for the length of a block that does nothing else.

    Args:
        path: The file.
        format: What its attribute `format` has to be, such as "spadwarp result"; None: anything.
        version: The newest `format_version` that can be read; None: any.

    Raises:
        FileError: No such file, not HDF5, of another format or a newer version, damaged, or without something that the
            block looked for (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, SpadwarpError); says
            which.
    """
    file = open_hdf5(path, format, version=version)
    try:
        yield file
    except FileError:
        raise
    except (OSError, RuntimeError) as error:
        raise FileError(f"{path}: damaged or not readable: {error}") from error
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, SpadwarpError) as error:
        raise FileError(f"{path}: not a whole {file.kind}: {error}") from error
    finally:
        file.close()


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
        found = file.attribute("format", "unknown")
        if format is not None and not (isinstance(found, str) and found == format):
            hint = "; give the directory of a run of `spadwarp simulate`" if format == "spadwarp result" else ""
            raise FileError(f"{path}: an HDF5 file, but not a {format}: its format is {found!r}, not {format!r}{hint}")
        if version is not None and (newer := file.integer("format_version")) > version:
            raise FileError(f"{path}: format version {newer} is newer than {version}, the newest that can be read")
    except BaseException:
        file.close()
        raise
    return file


def hdf5_format(path: str | Path) -> str | None:
    """The attribute `format` of an HDF5 file, such as "spadwarp frames"; None without one.

    Raises:
        FileError: No such file, or not HDF5.
    """
    with read_hdf5(path) as file:
        found = file.attribute("format", None)
        return found if isinstance(found, str) else None
