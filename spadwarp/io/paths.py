"""What is at a path: a file, the only one of some names in a folder, a pipe or a device."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from spadwarp.errors import FileError

__all__ = ["existing_file", "file_problem", "file_within", "is_stream"]

_STANDARD = ("/dev/stdin", "/dev/stdout", "/dev/stderr")


def file_problem(path: str | os.PathLike[str]) -> str | None:
    """Why there is no file to read at a path: "no such file", "is not a file", …; None where there is one."""
    try:
        if Path(path).is_file():
            return None
        return "is not a file" if Path(path).exists() else "no such file"
    except OSError as error:  # a name that is too long, a folder without permission
        return f"cannot be read: {error.strerror}"


def existing_file(path: str | Path) -> Path:
    """The path of a file that exists. Raises `FileError`, also for folders, pipes and names that no file can have."""
    if (problem := file_problem(path)) is not None:
        raise FileError(f"{path}: {problem}")
    return Path(path)


def file_within(path: str | Path, names: Sequence[str]) -> Path:
    """A file itself, or the only one of `names` in a directory. Raises `FileError` where there are none or several."""
    folder = Path(path)
    if not os.path.isdir(folder):
        return folder
    found = [folder / name for name in names if (folder / name).is_file()]
    if len(found) != 1:
        held = " and ".join(path.name for path in found) if found else f"no {' and no '.join(names)}"
        raise FileError(f"{path}: holds {held}; name the file")
    return found[0]


def is_stream(path: str | Path) -> bool:
    """Whether a path is a pipe or a device, such as /dev/stdout: it is written to and never replaced."""
    place = Path(path)
    if not os.path.exists(place):
        return False
    # Also where the shell has opened a file for it, such as that of `--json /dev/stdout > file`.
    opened = place.parts[1:2] == ("proc",) or place.parts[:3] == ("/", "dev", "fd") or str(place) in _STANDARD
    return opened or not (os.path.isfile(place) or os.path.isdir(place))
