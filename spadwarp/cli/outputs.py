"""What a command writes, checked before it works: one rule for all commands.

A file that exists is refused by name unless --overwrite is given, and so is a directory that is not empty. What a
command reads is never what it writes. Pipes and devices such as /dev/stdout are written to as they are.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import typer

import spadwarp
from spadwarp.cli.app import running, say, until_the_end
from spadwarp.cli.text import in_bytes, readable, written
from spadwarp.values import FileError

__all__ = ["answer", "check_outputs", "write_json"]

# Where an input is the directory of one of them.
_READ_IN_DIRECTORIES = ("result.h5", "frames.h5", "sequence.h5", "analytic.h5")


def answer(summary: Mapping[str, Any], hide: Iterable[str] = ()) -> None:
    """Prints a summary without the names in `hide`, and the files in it; and writes all of it as JSON."""
    hidden = {"files", "notes", "warnings", *hide}
    say(readable({name: value for name, value in summary.items() if name not in hidden}))
    if files := summary.get("files"):
        say(f"written: {written(files)}")
    write_json(summary)


def write_json(summary: Mapping[str, Any]) -> None:
    """The machine-readable twin of what a command prints, if --json asks for it; what is not finite becomes null."""
    path = running.json
    if path is None:
        return
    if not running.overwrite and os.path.lexists(path) and not spadwarp.io.is_stream(path):
        raise FileError(f"{path}: appeared while the command ran; it is not replaced")
    spadwarp.io.write_json(summary, path)


def check_outputs(
    out: Path | None = None,
    names: Iterable[str] = (),
    *,
    files: Mapping[str, Path | None] | None = None,
    inputs: Iterable[str | Path | None] = (),
    resume: bool = False,
    beside: bool = False,
    needed: int = 16 << 20,
    option: str = "--out",
) -> None:
    """Refuses outputs, the file of --json too, that would replace something else without --overwrite, and finds out now
    whether they can be written.

    The output directory is made, and locked until the command ends.

    Args:
        out: Directory of `option`.
        names: Files that the command may write in it; patterns such as `frames-*.mat` where `beside` is given.
        files: Option → file that the command writes.
        inputs: Files that the command reads, or directories of a result or frames.
        resume: Whether the command continues what is in the directory.
        beside: Whether the directory may hold other files than `names`.
        needed: Bytes that may be written to `out`.
        option: That names the directory.

    Raises:
        typer.BadParameter: An output exists, is an input, or is given twice.
        FileError: A directory cannot be written, is in use by another process, or has too little space.
    """
    json, overwrite = running.json, running.overwrite
    names = list(names)
    named = {option: path for option, path in {**(files or {}), "--json": json}.items() if path is not None}
    named = {option: path for option, path in named.items() if not spadwarp.io.is_stream(path)}
    written = [*named.items(), *((option, out / name) for name in names if out is not None)]
    _check_apart(written, inputs)
    for name, path in named.items():
        if path.is_dir():
            raise typer.BadParameter(f"{path} is a directory; a file is needed", param_hint=name)
        if os.path.lexists(path) and not overwrite:
            raise typer.BadParameter(f"{path} exists; --overwrite replaces it", param_hint=name)
    if out is not None:
        if beside and not overwrite and out.is_dir():
            for path in sorted(path for name in names for path in out.glob(name)):
                raise typer.BadParameter(f"{path} exists; --overwrite replaces it", param_hint=option)
        _prepare_directory(out, option, may_hold_files=overwrite or resume or beside, needed=needed)
    for path in named.values():
        _check_writable(path.parent)


def _check_apart(written: Iterable[tuple[str, Path]], inputs: Iterable[str | Path | None]) -> None:
    """Raises `typer.BadParameter` where two outputs, or an output and an input, are one file."""
    read = [Path(path) for path in inputs if path is not None]
    for folder in [path for path in read if path.is_dir()]:
        if (folder / "recipe.toml").exists():  # a dataset
            read += [path for path in (*folder.glob("*"), *folder.glob("*/*")) if path.name != "preview.png"]
        else:
            read += [folder / name for name in _READ_IN_DIRECTORIES]
    kept = {place for path in read for place in (_place(path), path.resolve())}
    taken: dict[Path, str] = {}
    for option, path in written:
        place = _place(path)
        if place in kept:
            raise typer.BadParameter(f"{path} is read by this command and would be replaced", param_hint=option)
        if place in taken:
            raise typer.BadParameter(f"{path} is also written for {taken[place]}", param_hint=option)
        taken[place] = option


def _place(path: Path) -> Path:
    """Where a file is written: links in its folder are followed, but not one in its own place, which is replaced."""
    return path.parent.resolve() / path.name


def _prepare_directory(out: Path, option: str, *, may_hold_files: bool, needed: int) -> None:
    if out.exists() and not out.is_dir():
        raise typer.BadParameter(f"{out} is a file; a directory is needed", param_hint=option)
    _check_writable(out)
    if not until_the_end(spadwarp.io.lock(out / ".lock")):
        raise FileError(f"{out}: another process is writing to this directory; wait for it, or name another one")
    if any(not path.name.startswith(".") for path in out.iterdir()) and not may_hold_files:
        raise typer.BadParameter(f"{out} is not empty; --overwrite replaces results in it", param_hint=option)
    free = shutil.disk_usage(out).free
    if free < needed:
        raise FileError(f"{out}: up to {in_bytes(needed)} will be written; {in_bytes(free)} are free there")


def _check_writable(directory: Path) -> None:
    """Raises `FileError` where no file can be made in the directory, which is made if it is not there, and removed
    again if it is empty when the command ends."""
    until_the_end(_not_left_empty([place for place in (directory, *directory.parents) if not os.path.exists(place)]))
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise FileError(f"{directory}: cannot be written: {error.strerror}") from error


@contextmanager
def _not_left_empty(folders: list[Path]) -> Iterator[None]:
    """Removes folders in the end, in this order, unless something is in them."""
    try:
        yield
    finally:
        for folder in folders:
            with suppress(OSError):
                folder.rmdir()
