"""What is at a path: a file, the only one of some names in a folder, a pipe or a device."""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from spadwarp.errors import FileError
from spadwarp.io.examples import examples
from spadwarp.limits import suggestion

__all__ = [
    "MESH_ENDINGS",
    "check_apart",
    "existing_file",
    "file_problem",
    "file_within",
    "is_stream",
    "similar",
    "used",
]

MESH_ENDINGS = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz")
"""Of files that are meshes."""

_STANDARD = ("/dev/stdin", "/dev/stdout", "/dev/stderr")


def similar(path: str | os.PathLike[str]) -> str:
    """What to add to an error about a missing file: `; did you mean 'planned.toml'?`, if one of that ending is beside
    it."""
    place = Path(path)
    try:
        beside = [one for one in os.listdir(place.parent) if one.endswith(place.suffix)]
    except (OSError, ValueError):
        return ""
    return suggestion(place.name, beside)


def used(path: str | os.PathLike[str]) -> str:
    """What to add to an error about a file of another kind: how a scene, a mesh or a result is used."""
    ending = Path(path).suffix.lower()
    if ending == ".toml":
        return f"; if it is a scene, `spadwarp simulate {path} --out DIR` makes a result of it"
    if ending in MESH_ENDINGS:
        return f"; a mesh goes into a scene: `spadwarp simulate SCENE --mesh {path} --out DIR`"
    if ending in (".h5", ".hdf5"):
        return "; HDF5 files hold results, and a scene is a .toml file"
    return ""


def file_problem(path: str | os.PathLike[str]) -> str | None:
    """Why there is no file to read at a path: "no such file", "is not a file", …; None where there is one."""
    try:  # not Path.is_file, which from Python 3.14 on says no where it cannot tell
        return None if stat.S_ISREG(os.stat(path).st_mode) else "is not a file"
    except (FileNotFoundError, NotADirectoryError, ValueError):  # of a NUL in it
        return "no such file"
    except OSError as error:  # a name that is too long, a folder without permission
        return f"cannot be read: {error.strerror}"


def existing_file(path: str | Path) -> Path:
    """The path of a file that exists. Raises `FileError`, also for folders, pipes and names that no file can have."""
    if (problem := file_problem(path)) is not None:
        scene = str(path) in examples("scenes")
        hint = f"; `spadwarp simulate {path} --out DIR` makes a result of this scene" if scene else similar(path)
        raise FileError(f"{path}: {problem}{hint}")
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


def check_apart(output: str | Path, source: Any) -> None:
    """Raises `FileError` where a file would be written over the one that it is made from, or over one beside it that
    holds data, if `source` is their directory; any other `source` than a path passes."""
    if not isinstance(source, str | os.PathLike) or not (os.path.exists(output) and os.path.exists(source)):
        return
    inside = os.path.isdir(source) and Path(output).suffix == ".h5" and os.path.samefile(Path(output).parent, source)
    if inside or os.path.samefile(output, source):
        raise FileError(f"{output}: is what the output is made from; it is not replaced")


def is_stream(path: str | Path) -> bool:
    """Whether a path is a pipe or a device, such as /dev/stdout: it is written to and never replaced."""
    place = Path(path)
    if not os.path.exists(place):
        return False
    # Also where the shell has opened a file for it, such as that of `--json /dev/stdout > file`.
    opened = place.parts[1:2] == ("proc",) or place.parts[:3] == ("/", "dev", "fd") or str(place) in _STANDARD
    return opened or not (os.path.isfile(place) or os.path.isdir(place))
