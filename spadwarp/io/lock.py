"""Locks between processes that share a file system."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from spadwarp.errors import FileError

__all__ = ["lock"]

_PAUSE = 0.1  # seconds between two attempts


@contextmanager
def lock(path: str | Path, *, wait: Callable[[], bool] = lambda: False) -> Iterator[bool]:
    """Holds a lock for the length of a block; yields whether it was obtained.

    The system releases the lock of a process that ends, however it ends: none is left behind. Where the file system or
    the system knows no locks, every process obtains it.

    Args:
        path: The lock's file, made in a folder that exists and removed at the end.
        wait: Asked again and again, while another process holds the lock, whether to wait for it.

    Raises:
        FileError: The file cannot be made.
    """
    place = Path(path)
    descriptor = _attempt(place)
    while descriptor is None and wait():
        time.sleep(_PAUSE)
        descriptor = _attempt(place)
    if descriptor is None:
        yield False
        return
    try:
        yield True
    finally:
        with suppress(OSError):
            place.unlink()
        os.close(descriptor)


def _attempt(path: Path) -> int | None:
    """The locked file's descriptor; None where another process holds the lock."""
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise FileError(f"{path.parent}: cannot be written: {error.strerror}") from error
        try:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        except (ImportError, OSError):  # a system or a file system without locks
            return descriptor
        with suppress(OSError):
            if os.path.samestat(os.stat(path), os.fstat(descriptor)):
                return descriptor
        os.close(descriptor)  # its holder removed the file between the two calls
