"""HDF5 files to write to."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spadwarp.io.atomic import atomic_path

if TYPE_CHECKING:
    import h5py


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
def hdf5_file(path: str | Path, **options: Any) -> Iterator[h5py.File]:
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
