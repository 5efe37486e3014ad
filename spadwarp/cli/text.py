"""What people read: numbers, tables, notes below them, and how far a run is."""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from spadwarp.cli.app import complain, running, say

__all__ = [
    "Report",
    "bracketed",
    "count",
    "counted",
    "in_bytes",
    "percent",
    "progress",
    "readable",
    "rows",
]
__all__ += ["short", "show_table", "written"]

Report = Callable[[str, int, int], None]


# Numbers


def count(number: float) -> str:
    """2 000 000"""
    return f"{number:,.0f}".replace(",", " ")


def counted(value: float) -> str:
    """A number of pulses to three digits: 5 300, 1.2e+07."""
    if not 100.0 <= value < 1e7:
        return short(value)
    return f"{float(f'{value:.3g}'):,.0f}".replace(",", " ")


def short(value: float) -> str:
    """A number to three digits; "-" for NaN."""
    if math.isnan(value):
        return "-"
    return "∞" if math.isinf(value) else f"{value:.3g}"


def bracketed(value: float, reached: bool) -> str:
    """A number, in brackets where it is not reached."""
    text = short(value)
    return text if reached or text == "-" else f"({text})"


def percent(value: float) -> str:
    """A fraction in per cent."""
    if math.isnan(value):
        return "-"
    return "< 0.001 %" if 0 < value < 1e-5 else f"{100 * value:.3g} %"


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


def written(paths: Sequence[Path]) -> str:
    """The names of files of one folder."""
    return ", ".join(path.name for path in paths) + f" in {paths[0].parent}"


_UNITS = {"_m": "m", "_mm": "mm", "_s": "s", "_ns": "ns", "_ps": "ps", "_nm": "nm", "_deg": "°", "_bytes": "bytes"}
_UNITS |= dict.fromkeys(("range", "length", "distance", "extent", "centre", "limit", "depth_error"), "m")
_UNITS |= dict.fromkeys(("absorption", "scattering", "extinction"), "1/m")
_UNITS |= {"energy": "J", "power": "W", "rate": "Hz", "irradiance": "W/m²", "area": "m²", "seconds": "s"}


def readable(summary: Mapping[str, Any]) -> str:
    """A summary in two columns, its tables below their names."""
    tables = {name: value for name, value in summary.items() if isinstance(value, Mapping) and len(value) > 3}
    flat = {name: value for name, value in summary.items() if name not in tables and value not in ({}, [], ())}
    parts = [rows(dict(_row(name, value) for name, value in flat.items()))] if flat else []
    for name, table in tables.items():
        parts.append(f"{name.replace('_', ' ')}\n" + rows(dict(map(_row, table, table.values())), indent="  "))
    return "\n".join(parts)


def _row(name: str, value: Any) -> tuple[str, str]:
    """A name without its unit, and its value with it; fields of a scene keep their names."""
    numbers = value if isinstance(value, list | tuple) else [value]
    if "." in name or not all(isinstance(one, int | float) for one in numbers):
        return name.replace("_", " ") if "." not in name else name, _plain(value)
    ending = next((one for one in _UNITS if name.endswith(one)), "")
    label = name.removesuffix(ending) if ending.startswith("_") else name
    return label.replace("_", " "), f"{_plain(value)} {_UNITS.get(ending, '')}".rstrip()


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(" ".join(_row(name, item)) for name, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_plain, value))
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4g}"
    return count(value) if isinstance(value, int) else str(value)


def show_table(table: Sequence[Mapping[str, Any]], *, keys: int = 1) -> None:
    """Rows of values by title on stdout, numbers to three digits, as wide as the terminal; 160 columns elsewhere.

    A table that is wider is printed in several parts, each with the first `keys` columns, so that no number is cut off.
    """
    titles = list(dict.fromkeys(title for row in table for title in row))
    cells = {title: [title, *(_cell(row.get(title, "")) for row in table)] for title in titles}
    widths = {title: max(map(len, column)) for title, column in cells.items()}
    width = shutil.get_terminal_size().columns if sys.stdout is not None and sys.stdout.isatty() else 160
    first, groups = titles[:keys], [titles[keys : keys + 1]]
    for title in titles[keys + 1 :]:
        if sum(widths[one] + 2 for one in (*first, *groups[-1], title)) - 2 <= width:
            groups[-1].append(title)
        else:
            groups.append([title])
    for group in groups:
        for line in range(len(table) + 1):
            parts = [cells[title][line].ljust(widths[title]) for title in first]
            parts += [cells[title][line].rjust(widths[title]) for title in group]
            say("  ".join(parts).rstrip())


def _cell(value: Any) -> str:
    return short(value) if isinstance(value, float) else str(value)


# Progress


@contextmanager
def progress(unit: str = "photons") -> Iterator[Report | None]:
    """The argument `progress` of `spadwarp.simulate`; None where nothing is to be said.

    On a terminal one line that changes; elsewhere a line at every tenth, but not more often than every second, in a
    long run soon, then ever more seldom.
    """
    if running.quiet:
        yield None
        return
    terminal = sys.stderr is not None and sys.stderr.isatty()
    began: tuple[float, int] | None = None  # the first report: kernels are loaded and truth maps made before it
    reported_at, reported_done, patience = time.monotonic(), 0, 2.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal began, reported_at, reported_done, patience
        now = time.monotonic()
        if not total:
            compiling = "loading kernels; the first run of a kind compiles them, which takes a while"
            complain(compiling if stage == "compile" else stage)
            return
        began = began or (now, done)
        seconds, waited = now - began[0], now - reported_at
        often = waited >= 0.1 if terminal else (done - reported_done >= 0.1 * total and waited >= 1.0)
        if done > reported_done and (often or waited >= patience or done == total):
            line = f"{100 * done / total:3.0f} %  {count(done)} of {count(total)} {unit}"
            if seconds > 0.05 and (rate := (done - began[1]) / seconds):
                line += f", {rate:.3g} {unit}/s"
                line += f", {_duration((total - done) / rate)} left" if done < total else f" in {_duration(seconds)}"
            typer.echo(f"\r{line:<79}" if terminal else line, err=True, nl=not terminal or done == total)
            reported_at, reported_done, patience = now, done, min(2.0 * patience, 60.0)

    yield report


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 100 else f"{minutes} min {seconds:.0f} s"
