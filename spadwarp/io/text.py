"""Text files: TOML, JSON, columns of numbers, read with limits to their cost, and written; progress as text."""

from __future__ import annotations

import csv
import datetime
import io
import json
import math
import os
import re
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.io.paths import similar, used, write_file
from spadwarp.values import UNITS, ArgumentError, ConfigError, FileError, Interval, count, parse_number, shown

__all__ = ["fact", "json_text", "parse_json", "parse_toml", "progress_report", "read_columns", "read_json", "read_text"]
__all__ += ["read_toml", "write_csv", "write_json", "write_text"]

_LARGEST_TEXT = 4 << 20  # bytes; a table of 100 000 rows has 2 MiB
_DEEPEST = 32  # tables and lists in each other; a recipe has 6
# More parts than a key of ours has, in front of which no other part stands: the time to read one grows as their square.
_LONG_KEY = re.compile(r"""(?<![\w"'-])(?:[\w"'-]++\s*+\.\s*+){64}""")


def read_text(path: str | os.PathLike[str], *, largest: int = _LARGEST_TEXT) -> str:
    """The text of a UTF-8 file of `largest` bytes at most; raises `FileError` if it cannot be read or is no text."""
    try:
        with open(path, "rb") as file:
            content = file.read(largest + 1)
    except OSError as error:
        hint = similar(path) if isinstance(error, FileNotFoundError) else ""
        raise FileError(f"{path}: cannot be read: {error.strerror}{hint}") from None
    except ValueError:  # a NUL in the name
        raise FileError(f"{str(path)!r} is no name of a file") from None
    if len(content) > largest:
        raise FileError(f"{path}: has more than {largest} bytes, the most that is read of such a file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        other = "" if str(path).lower().endswith(".toml") else used(path)
        raise FileError(f"{path}: not a text file in UTF-8: {error}{other or '; save it as UTF-8'}") from None


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The tables of a TOML file. Raises `FileError` if it cannot be read, `ConfigError` as `parse_toml` does."""
    return parse_toml(read_text(path), source=str(path))


def parse_toml(text: str, *, source: str | None = None) -> dict[str, Any]:
    """The tables of a TOML text: numbers, words, lists and tables; `source` is its file, for errors.

    Raises `ConfigError` for what is not TOML, nested too deeply, or of a kind that no field takes: dates, integers
    beyond 64 bits, text with NUL.
    """
    try:
        if (key := _LONG_KEY.search(text)) is not None:
            raise ValueError(f"a key in line {text.count(chr(10), 0, key.start()) + 1} has 64 parts or more")
        tables = tomllib.loads(text, parse_float=_parse_float)
    except ValueError as error:
        raise ConfigError(f"not valid TOML: {error}{_bare_unit(text, str(error))}", source=source) from None
    except RecursionError:
        raise ConfigError("not valid TOML: lists or tables are nested too deeply", source=source) from None
    if problems := list(_problems(tables)):
        raise ConfigError(problems, source=source)
    return tables


# A number and what follows it, outside quotes.
_WITH_UNIT = re.compile(r"""(?<![\w.+"'-])([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*([^\s\d,"'#[\]]+)""", re.I | re.A)


def _bare_unit(text: str, error: str) -> str:
    """Addition to the error of a line such as `aperture_diameter = 20 mm`."""
    if (place := re.search(r"at line (\d+)", error)) is None:
        return ""
    value = text.split("\n")[int(place[1]) - 1][:200].partition("=")[2].partition(" #")[0]
    for number, unit in _WITH_UNIT.findall(value):
        if unit in UNITS:
            return f'; a number with a unit needs quotes: "{number} {unit}"'
    if re.fullmatch(r"\s*\d+,\d+\s*", value):
        return f"; a decimal point is needed: {value.strip().replace(',', '.')}"
    return "; text stands in quotes" if re.match(r"\s*[^\W\d]", value) and "Invalid value" in error else ""


def _parse_float(text: str) -> float:
    """TOML's floats; NaN is left to the fields, which name themselves."""
    if text.lstrip("+-") == "nan":
        return math.nan
    try:
        return parse_number(text)
    except ValueError as error:
        raise ValueError(f"{shown(text)} {error}") from None


def _problems(tables: dict[str, Any]) -> Iterator[str]:
    """Values that no field takes, each by its key."""
    left: list[tuple[str, int, Any]] = [("", 0, tables)]
    while left:
        name, depth, value = left.pop()
        if depth > _DEEPEST:
            yield f"{name[:60]}... is nested more than {_DEEPEST} deep"
        elif isinstance(value, dict):
            left += [(f"{name}.{key}" if name else key, depth + 1, item) for key, item in reversed(value.items())]
        elif isinstance(value, list):
            left += [(f"{name}[{index}]", depth + 1, item) for index, item in reversed(list(enumerate(value)))]
        elif isinstance(value, datetime.date | datetime.time):
            yield f"{name} = {value} is a date or a time of day; text stands in quotes"
        elif isinstance(value, int) and not -(2**63) <= value < 2**64:
            yield f"{name} = {shown(value)} is outside [-2^63, 2^64)"
        elif isinstance(value, str) and "\0" in value:
            yield f"{name} = {shown(value)} holds a NUL character"


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text. Raises `ValueError` for what is not JSON, or nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("lists or tables are nested too deeply") from None


def read_json(path: str | os.PathLike[str], *, largest: int = _LARGEST_TEXT) -> Any:
    """The value of a JSON file of `largest` bytes at most. Raises `FileError`."""
    try:
        return parse_json(read_text(path, largest=largest))
    except ValueError as error:
        raise FileError(f"{path}: not JSON: {error}") from error


def read_columns(path: str | os.PathLike[str], columns: Mapping[str, str]) -> NDArray[np.float64]:
    """The first columns of a .csv file, `[rows, columns]`; `columns`: name → range, such as "[0, 180]".

    Lines that begin with # and one line of names are passed over. Raises `FileError` if it cannot be read,
    `ConfigError` for a name with another unit than the column's, a line that is not so many numbers in their ranges.
    """
    rows: list[list[float]] = []
    named = False
    with csv_lines(path) as lines:
        for cells in lines:
            row: list[float] = []
            with suppress(ValueError):
                row = [parse_number(cell) for cell, _ in zip(cells, columns, strict=False)]
            if len(row) == len(columns):
                for value, (name, within) in zip(row, columns.items(), strict=True):
                    if value not in Interval.read(within):
                        raise ValueError(f"{name} = {value:g} is outside {within}")
                rows.append(row)
            elif rows or named:
                raise ValueError(f"{shown(','.join(cells))} is not {','.join(columns)} in finite numbers")
            else:
                named = True
                for cell, name in zip(cells, columns, strict=False):  # "time [ns]" of time_ps is another unit
                    unit, words = name.rpartition("_")[2], re.split(r"[\s_()\[\],/]+", cell)
                    kinds = {UNITS[word][0] for word in words if word in UNITS}
                    if unit in UNITS and unit not in words and UNITS[unit][0] in kinds:
                        raise ValueError(f"{shown(cell)} has another unit than the column, {name}")
    return np.array(rows, np.float64).reshape(-1, len(columns))


@contextmanager
def csv_lines(path: str | os.PathLike[str]) -> Iterator[Iterator[list[str]]]:
    """Cells of each line of a .csv file but empty ones and those that begin with #.

    Makes a `ConfigError` with the line's number of a `ValueError` in the block. Raises `FileError`.
    """
    lines = csv.reader(io.StringIO(read_text(path), newline=""))
    try:
        yield (cells for cells in lines if cells and not cells[0].lstrip().startswith("#"))
    except (ValueError, csv.Error) as error:  # the latter: a cell of more than 131 072 characters
        raise ConfigError(f"line {lines.line_num}: {error}", source=str(path)) from None


# Writing


def json_text(value: Any, *, indent: int | None = 2) -> str:
    """A value as JSON with a line end; numbers that are not finite become null, paths text, those of NumPy numbers."""
    try:
        return json.dumps(_plain(value), indent=indent, allow_nan=False) + "\n"
    except TypeError as error:
        raise ArgumentError(f"value: {error}") from None


def write_text(text: str, path: str | Path) -> Path:
    """Writes UTF-8 text; returns the path. Raises `FileError`."""
    return write_file(path, lambda file: file.write(text.encode()))


def write_json(value: Any, path: str | Path, *, indent: int = 2) -> Path:
    """Writes `json_text` of a value; returns the path. Raises `FileError`."""
    return write_text(json_text(value, indent=indent), path)


def write_csv(table: Sequence[Mapping[str, Any]], path: str | Path) -> Path:
    """Writes rows with the same names as CSV with a header; returns the path. Raises `FileError`."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(table[0]))
    writer.writeheader()
    writer.writerows(table)
    return write_text(text.getvalue(), path)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return os.fspath(value) if isinstance(value, os.PathLike) else value


# For people


_ENDINGS = {"_m": "m", "_mm": "mm", "_s": "s", "_ns": "ns", "_ps": "ps", "_nm": "nm", "_deg": "°", "_bytes": "bytes"}
_ENDINGS |= dict.fromkeys(("range", "length", "distance", "extent", "centre", "limit", "depth_error"), "m")
_ENDINGS |= dict.fromkeys(("absorption", "scattering", "extinction"), "1/m")
_ENDINGS |= {"energy": "J", "power": "W", "rate": "Hz", "irradiance": "W/m²", "area": "m²", "seconds": "s"}
_ENDINGS |= {"time": "s", "exposure": "s", "sigma_depth": "m", "sigma_time": "s", "psnr": "dB"}


def fact(name: str, value: Any) -> tuple[str, str]:
    """A name without its unit, and its value with it, of a summary; fields of a scene keep their names."""
    numbers = value if isinstance(value, list | tuple) else [value]
    if "." in name or not all(isinstance(one, int | float) for one in numbers):
        return name if "." in name else name.replace("_", " "), _shown(value)
    ending = next((one for one in _ENDINGS if name.endswith(one)), "")
    label = name.removesuffix(ending) if ending.startswith("_") else name
    return label.replace("_", " "), f"{_shown(value)} {_ENDINGS.get(ending, '')}".rstrip()


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(" ".join(fact(name, item)) for name, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_shown, value))
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4g}"
    return count(value) if isinstance(value, int) else str(value)


def progress_report(
    show: Callable[[float | None, str], None], unit: str, *, seldom: bool = False
) -> Callable[[str, int, int], None]:
    """An argument `progress`: `show` is called with the part that is done and its text, with None for a stage.

    Ten times a second at most; or `seldom`, at every tenth, once a second at most, in a long run ever more seldom.
    """
    began: tuple[float, int] | None = None  # the first report: kernels are loaded and truth maps made before it
    shown_at, shown_done, ended, patience = time.monotonic() if seldom else 0.0, 0, False, 2.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal began, shown_at, shown_done, ended, patience
        now = time.monotonic()
        if not total:
            compiling = "loading kernels; the first run of a kind compiles them, which takes a while"
            return show(None, compiling if stage == "compile" else stage)
        began = began or (now, done)
        seconds, waited = now - began[0], now - shown_at
        often = done - shown_done >= 0.1 * total and waited >= 1.0 if seldom else waited >= 0.1
        if (done > shown_done and (often or waited >= patience)) or (done == total and not ended):
            text = f"{100 * done / total:3.0f} %  {count(done)} of {count(total)} {unit}"
            if seconds > 0.05 and (rate := (done - began[1]) / seconds):
                text += f", {rate:.3g} {unit}/s"
                text += f", {duration((total - done) / rate)} left" if done < total else f" in {duration(seconds)}"
            show(done / total, text)
            shown_at, shown_done, ended, patience = now, done, done == total, min(2.0 * patience, 60.0)

    return report


def duration(seconds: float) -> str:
    """A time [s] for people: "8.5 s", "3 min 20 s", "2 h 5 min"."""
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 100 else f"{minutes} min {seconds:.0f} s"
