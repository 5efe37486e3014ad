"""Files that appear whole or not at all, and the file of a given name in a folder."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from spadwarp.errors import FileError, SpadwarpError

_LONGEST_PREFIX = 100  # bytes of a file's name in that of its temporary file; file systems allow 255 in all


def file_within(path: str | Path, names: Sequence[str]) -> Path:
    """A file itself, or the only one of `names` in a directory. Raises `FileError` where there are none or several."""
    folder = Path(path)
    if not folder.is_dir():
        return folder
    found = [folder / name for name in names if (folder / name).is_file()]
    if len(found) != 1:
        held = " and ".join(path.name for path in found) if found else f"no {' and no '.join(names)}"
        raise FileError(f"{path}: holds {held}; name the file")
    return found[0]


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A new empty file beside `path` that takes its name when the block ends well, and is removed when it does not.

    What was at `path` stays untouched until then; a symbolic link is replaced, not what it leads to. No other process,
    on this machine or another, gets the same temporary name. Raises `FileError` where the folder or the file cannot be
    written.
    """
    target = Path(path)
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


def remove_temporaries(path: str | Path) -> None:
    """Removes the temporary files of `path` that killed processes have left; nobody may be writing it."""
    target = Path(path)
    with suppress(OSError):
        for other in list(target.parent.iterdir()):
            if other.name.startswith(_prefix(target)) and other.suffix == ".tmp":
                other.unlink(missing_ok=True)


def _prefix(target: Path) -> str:
    return f".{os.fsdecode(os.fsencode(target.name)[:_LONGEST_PREFIX])}."
