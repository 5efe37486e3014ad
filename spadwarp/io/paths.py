"""Files by their paths: examples that come with the package, files that are there, files written whole, locks."""

from __future__ import annotations

import difflib
import hashlib
import os
import secrets
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from spadwarp.values import FileError, SpadwarpError, suggestion

__all__ = ["MESH_ENDINGS", "atomic_path", "check_apart", "example_or_path", "examples", "existing_file", "file_problem"]
__all__ += ["file_within", "is_stream", "lock", "remove_temporaries", "sha256", "similar", "used", "write_file"]

KINDS = ("scenes", "datasets", "training")
"""Kinds of examples."""

MESH_ENDINGS = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz")
"""Of files that are meshes."""

_STANDARD = ("/dev/stdin", "/dev/stdout", "/dev/stderr")
_LONGEST_PREFIX = 100  # bytes of a file's name in that of its temporary file; file systems allow 255 in all
_PAUSE = 0.1  # seconds between two attempts to obtain a lock


def examples(kind: str) -> dict[str, Path]:
    """Files of one of `KINDS` by name: in a checkout those of `configs/`, else the copies in the package."""
    package = Path(__file__).parents[1]
    folder = next((place for place in (package / "configs", package.parent / "configs") if place.is_dir()), package)
    return {path.stem: path for path in sorted((folder / kind).glob("*.toml"))}


def example_or_path(path: str | os.PathLike[str], kind: str) -> Path:
    """A path as it is; a bare name for which there is no file is that of an example. Raises `FileError` for neither."""
    place = Path(path)
    if place.suffix or place.name != str(path) or os.path.exists(place):
        return place
    known = examples(kind)
    if place.name not in known:
        named = f"{place.name}.toml"
        close = [named] if os.path.exists(named) else difflib.get_close_matches(place.name, known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
        raise FileError(f"{place}: neither a file nor one of `spadwarp list {kind}`; {hint}")
    return known[place.name]


def similar(path: str | os.PathLike[str]) -> str:
    """Addition to an error about a missing file, `; did you mean 'planned.toml'?`: one beside it, of that ending if
    there are some, or that of its name in the current folder; of a folder what it holds."""
    place = Path(path)
    if place.is_absolute() and Path(place.name).is_file():
        return f"; there is a {place.name} in the current folder: the paths in a file begin at that file's folder"
    try:
        if os.path.isdir(place):
            return f"; it is a folder, which holds {', '.join(sorted(os.listdir(place))[:6]) or 'nothing'}"
        beside = os.listdir(place.parent)
    except (OSError, ValueError):
        return ""
    return suggestion(place.name, [name for name in beside if name.endswith(place.suffix)] or beside)


def used(path: str | os.PathLike[str]) -> str:
    """Addition to an error about a file of another kind: how a scene, a mesh, a picture, counts or a result is used."""
    texts = {
        (".toml",): f"if it is a scene, `spadwarp simulate {path} --out DIR` makes a result of it",
        MESH_ENDINGS: f"a mesh goes into a scene: `spadwarp simulate SCENE --mesh {path} --out DIR`",
        (".exr", ".png"): f"a picture holds no histograms; give its run, the folder {Path(path).parent}",
        (".npy", ".npz", ".mat", ".ptu"): f"if it holds counts, `spadwarp depth {path} --out DIR` makes depth of them",
        (".h5", ".hdf5"): "HDF5 files hold results, and a scene is a .toml file",
    }
    return next((f"; {text}" for endings, text in texts.items() if Path(path).suffix.lower() in endings), "")


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


@contextmanager
def reading(path: str | Path, problem: str = "damaged or not readable") -> Iterator[None]:
    """Makes a `FileError` of whatever a library raises of a file."""
    try:
        yield
    except (SpadwarpError, MemoryError, ModuleNotFoundError):
        raise
    except Exception as error:
        raise FileError(f"{path}: {problem}: {error}") from error


def file_within(path: str | Path, names: Sequence[str]) -> Path:
    """A file itself, or the only one of `names` in a directory. Raises `FileError` where there are none or several."""
    folder = Path(path)
    if not os.path.isdir(folder):
        return folder
    files = [folder / name for name in names if (folder / name).is_file()]
    if len(files) != 1:
        text = " and ".join(path.name for path in files) if files else f"no {' and no '.join(names)}"
        raise FileError(f"{path}: holds {text}; name the file")
    return files[0]


def sha256(path: str | Path) -> str:
    """Of a file's content, in hexadecimal digits. Raises `FileError`."""
    with existing_file(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A new empty file beside `path` that takes its name when the block ends well, and is removed when it does not.

    What was at `path` stays untouched until then; a symbolic link is replaced, not what it leads to. No other process,
    on this machine or another, gets the same temporary name. A pipe or a device is written to at the end. Raises
    `FileError` where the folder or the file cannot be written.
    """
    target = Path(path)
    if not target.name:
        raise FileError(f"{target}: is no name of a file")
    try:
        with (_stream if is_stream(target) else _beside)(target) as temporary:
            yield temporary
    except SpadwarpError:
        raise
    except (OSError, RuntimeError) as error:  # h5py and OpenEXR report a full disk as either
        raise FileError(f"{target}: cannot be written: {error}") from error


def write_file(path: str | Path, write: Callable[[IO[bytes]], Any]) -> Path:
    """A file by a function that writes to it once it is open; see `atomic_path`. Returns its path."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        write(file)
    return Path(path)


@contextmanager
def _beside(target: Path) -> Iterator[Path]:
    temporary = target.with_name(f"{_prefix(target)}{secrets.token_hex(8)}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch(exist_ok=False)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def _stream(target: Path) -> Iterator[Path]:
    """A temporary file whose content goes to a pipe or a device when the block ends well."""
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / target.name
        temporary.touch()
        yield temporary
        sys.stdout.flush()  # what was printed before comes first
        with temporary.open("rb") as source, target.open("ab") as stream:
            shutil.copyfileobj(source, stream)


def remove_temporaries(path: str | Path) -> None:
    """Removes the temporary files of `path` that killed processes have left; nobody may be writing it."""
    target = Path(path)
    with suppress(OSError):
        for other in list(target.parent.iterdir()):
            if other.name.startswith(_prefix(target)) and other.suffix == ".tmp":
                other.unlink(missing_ok=True)


def _prefix(target: Path) -> str:
    return f".{os.fsdecode(os.fsencode(target.name)[:_LONGEST_PREFIX])}."


@contextmanager
def lock(path: str | Path, *, wait: Callable[[], bool] = lambda: False) -> Iterator[bool]:
    """Holds a lock between processes that share a file system for the length of a block; yields whether it did so.

    The system releases the lock of a process that ends, however it ends: none is left behind. The lock's file is
    removed at the end. `wait` is asked again and again, while another process holds the lock, whether to wait for it.
    Raises `FileError`: the file cannot be made.
    """
    from filelock import FileLock, Timeout

    held = FileLock(path, mode=0o666)
    try:
        while not held.is_locked:
            try:
                held.acquire(timeout=0)
            except Timeout:
                if not wait():
                    break
                time.sleep(_PAUSE)
    except OSError as error:
        raise FileError(f"{Path(path).parent}: cannot be written: {error.strerror}") from error
    try:
        yield held.is_locked
    finally:
        with suppress(OSError):
            if held.is_locked:
                Path(path).unlink()
        held.release()
