"""What commands print and write: numbers, tables, progress; files, checked before the work begins.

A file that exists is refused by name unless --overwrite is given, and so is a directory that is not empty. What a
command reads is never what it writes. Pipes and devices such as /dev/stdout are written to as they are.
"""

from __future__ import annotations

import math
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import typer

import spadwarp
from spadwarp.cli.app import running, say, until_the_end, wrong
from spadwarp.values import FileError

Report = Callable[[str, int, int], None]


# Numbers


def short(value: float) -> str:
    """A number to three digits; "-" for NaN."""
    return "-" if math.isnan(value) else "∞" if math.isinf(value) else f"{value:.3g}"


def in_bytes(number: float) -> str:
    """1.5 GiB"""
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if number < 1024:
            return f"{number:.4g} {unit}"
        number /= 1024
    return f"{number:.3g} TiB"


# Tables


def rows(table: Mapping[str, str], *, indent: str = "") -> str:
    """Names and values in two columns."""
    width = max(map(len, table), default=0)
    return "\n".join(f"{indent}{name:<{width}}  {value}".rstrip() for name, value in table.items())


def readable(summary: Mapping[str, Any]) -> str:
    """A summary in two columns, its tables below their names."""
    tables = {name: value for name, value in summary.items() if isinstance(value, Mapping) and len(value) > 3}
    flat = {name: value for name, value in summary.items() if name not in tables and value not in ({}, [], ())}

    def facts(table: Mapping[str, Any], indent: str = "") -> str:
        return rows(dict(map(spadwarp.io.fact, table, table.values())), indent=indent)

    parts = [facts(flat)] if flat else []
    return "\n".join([*parts, *(f"{name.replace('_', ' ')}\n{facts(table, '  ')}" for name, table in tables.items())])


def show_table(table: Iterable[Mapping[str, Any]], *, keys: int = 1) -> None:
    """Rows of values by title on stdout, numbers to three digits, as wide as the terminal; 160 columns elsewhere.

    A table that is wider is printed in several parts, each with the first `keys` columns, so that no number is cut off.
    """
    table, columns = list(table), list[list[str]]()
    for title in dict.fromkeys(title for row in table for title in row):
        texts = [title, *(_cell(row.get(title, "")) for row in table)]
        width = max(map(len, texts))
        columns.append([text.ljust(width) if len(columns) < keys else text.rjust(width) for text in texts])
    width = shutil.get_terminal_size().columns if sys.stdout is not None and sys.stdout.isatty() else 160
    first, others = columns[:keys], columns[keys:]
    while others:
        taken = 1
        while taken < len(others) and sum(len(one[0]) + 2 for one in (*first, *others[: taken + 1])) - 2 <= width:
            taken += 1
        for line in zip(*first, *others[:taken], strict=True):
            say("  ".join(line).rstrip())
        others = others[taken:]


def _cell(value: Any) -> str:
    return short(value) if isinstance(value, float) else "-" if value is None else str(value)


# Progress


def progress(unit: str = "photons") -> Report | None:
    """The argument `progress` of `spadwarp.simulate`; None where nothing is to be said.

    On a terminal one line that changes; elsewhere a line at every tenth or more seldom.
    """
    if running.quiet:
        return None
    terminal = sys.stderr is not None and sys.stderr.isatty()

    def show(part: float | None, text: str) -> None:
        line = f"\r{text:<79}" if terminal and part is not None else text
        typer.echo(line, err=True, nl=not terminal or part in (None, 1.0))

    return spadwarp.io.progress_report(show, unit, seldom=not terminal)


# Files


def written(paths: Sequence[Path]) -> None:
    """Prints the names of files of one folder, if there are any."""
    if paths:
        say(f"written: {', '.join(path.name for path in paths)} in {paths[0].parent}")


def answer(summary: Mapping[str, Any], *, shown: Mapping[str, Any] | None = None) -> None:
    """Prints a summary, or what is shown of it, and the files in it; and writes all of it as JSON."""
    hidden = ("files", "notes", "warnings")
    say(readable({name: value for name, value in summary.items() if name not in hidden} if shown is None else shown))
    written(summary.get("files") or ())
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
        out: Directory of `option`, for as many bytes as are `needed`.
        names: Files that the command may write in it; patterns where it may hold others `beside` them.
        files: Option → file that the command writes.
        inputs: Files that the command reads, or directories of a result or frames.
        resume: Whether the command continues what is in the directory.
    """
    asked = {option: path for option, path in {**(files or {}), "--json": running.json}.items() if path is not None}
    named = {option: path for option, path in asked.items() if not spadwarp.io.is_stream(path)}
    names = list(names)
    _check_apart([*named.items(), *((option, out / name) for name in names if out is not None)], inputs)
    for name, path in named.items():
        if path.is_dir():
            wrong(f"{path} is a directory; a file is needed", name)
        if os.path.lexists(path) and not running.overwrite:
            wrong(f"{path} exists; --overwrite replaces it", name)
    if out is not None:
        if beside and not running.overwrite and out.is_dir():
            for path in sorted(path for name in names for path in out.glob(name)):
                wrong(f"{path} exists; --overwrite replaces it", option)
        _prepare_directory(out, option, may_hold_files=running.overwrite or resume or beside, needed=needed)
    for path in named.values():
        _check_writable(path.parent)


# Where an input is the directory of one of them.
_READ_IN_DIRECTORIES = ("result.h5", "frames.h5", "sequence.h5", "analytic.h5")


def _check_apart(written: Iterable[tuple[str, Path]], inputs: Iterable[str | Path | None]) -> None:
    """Raises `typer.BadParameter` where two outputs, or an output and an input, are one file."""

    def place(path: Path) -> Path:
        """Links in a file's folder are followed, but not one in its own place, which is replaced."""
        return path.parent.resolve() / path.name

    read = [Path(path) for path in inputs if path is not None]
    for folder in [path for path in read if path.is_dir()]:
        if (folder / "recipe.toml").exists():  # a dataset
            read += [path for path in (*folder.glob("*"), *folder.glob("*/*")) if path.name != "preview.png"]
        else:
            read += [folder / name for name in _READ_IN_DIRECTORIES]
    kept = {one for path in read for one in (place(path), path.resolve())}
    taken: dict[Path, str] = {}
    for option, path in written:
        if place(path) in kept:
            what = f"{path} is read by this command and would be replaced"
            wrong(what if path.exists() else f"{path.parent} is read by this command; name another directory", option)
        if place(path) in taken:
            wrong(f"{path} is also written for {taken[place(path)]}", option)
        taken[place(path)] = option


def _prepare_directory(out: Path, option: str, *, may_hold_files: bool, needed: int) -> None:
    if out.exists() and not out.is_dir():
        wrong(f"{out} is a file; a directory is needed", option)
    _check_writable(out)
    if not until_the_end(spadwarp.io.lock(out / ".spadwarp.lock")):
        raise FileError(f"{out}: another process is writing to this directory; wait for it, or name another one")
    if any(not path.name.startswith(".") for path in out.iterdir()) and not may_hold_files:
        wrong(f"{out} is not empty; --overwrite replaces results in it", option)
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
