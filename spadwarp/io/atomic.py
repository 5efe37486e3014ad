"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from spadwarp.errors import FileError, SpadwarpError
from spadwarp.io.paths import is_stream

__all__ = ["atomic_path", "remove_temporaries"]

_LONGEST_PREFIX = 100  # bytes of a file's name in that of its temporary file; file systems allow 255 in all


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A new empty file beside `path` that takes its name when the block ends well, and is removed when it does not.

    What was at `path` stays untouched until then; a symbolic link is replaced, not what it leads to. No other process,
    on this machine or another, gets the same temporary name. A pipe or a device is written to at the end. Raises
    `FileError` where the folder or the file cannot be written.
    """
    target = Path(path)
    if is_stream(target):
        with _stream(target) as temporary:
            yield temporary
        return
    if not target.name:
        raise FileError(f"{target}: is no name of a file")
    temporary = target.with_name(f"{_prefix(target)}{secrets.token_hex(8)}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch(exist_ok=False)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except SpadwarpError:
        raise
    except (OSError, RuntimeError) as error:  # h5py and OpenEXR report a full disk as either
        raise FileError(f"{target}: cannot be written: {error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def _stream(target: Path) -> Iterator[Path]:
    """A temporary file whose content goes to a pipe or a device when the block ends well."""
    try:
        with tempfile.TemporaryDirectory() as folder:
            temporary = Path(folder) / target.name
            temporary.touch()
            yield temporary
            sys.stdout.flush()  # what was printed before comes first
            with temporary.open("rb") as source, target.open("ab") as stream:
                shutil.copyfileobj(source, stream)
    except SpadwarpError:
        raise
    except (OSError, RuntimeError) as error:
        raise FileError(f"{target}: cannot be written: {error}") from error


def remove_temporaries(path: str | Path) -> None:
    """Removes the temporary files of `path` that killed processes have left; nobody may be writing it."""
    target = Path(path)
    with suppress(OSError):
        for other in list(target.parent.iterdir()):
            if other.name.startswith(_prefix(target)) and other.suffix == ".tmp":
                other.unlink(missing_ok=True)


def _prefix(target: Path) -> str:
    return f".{os.fsdecode(os.fsencode(target.name)[:_LONGEST_PREFIX])}."
