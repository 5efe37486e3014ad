"""How far a run is: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ._app import complain
from ._options import count

_COMPILING = "loading kernels; the first run of a kind compiles them, which takes a while"


@contextmanager
def progress(*, quiet: bool, unit: str = "photons") -> Iterator[Callable[[str, int, int], None] | None]:
    """What `spadwarp.simulate` takes as `progress`; None where nothing is to be said."""
    if quiet:
        yield None
    elif sys.stderr.isatty():
        with _bar(unit) as report:
            yield report
    else:
        yield _lines(unit)


def _lines(unit: str) -> Callable[[str, int, int], None]:
    """A line at every tenth, but not more often than every second; in a long run soon, then ever more seldom."""
    began = told = time.monotonic()
    told_done, patience = 0, 2.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal began, told, told_done, patience
        now = time.monotonic()
        if stage == "compile":
            complain(_COMPILING)
        if done == 0:
            began = told = now
            told_done = 0
            return
        waited = now - told
        due = (done - told_done >= 0.1 * total and waited >= 1.0) or waited >= patience
        if done > told_done and (due or done == total):
            rate = done / max(now - began, 1e-9)
            left = f", {_duration((total - done) / rate)} left" if done < total else f" in {_duration(now - began)}"
            complain(f"{100 * done / total:3.0f} %  {count(done)} of {count(total)} {unit}, {rate:.3g} {unit}/s{left}")
            told, told_done, patience = now, done, min(2.0 * patience, 60.0)

    return report


@contextmanager
def _bar(unit: str) -> Iterator[Callable[[str, int, int], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        SpinnerColumn(),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.description}"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)
        began = time.monotonic()

        def report(stage: str, done: int, total: int) -> None:
            nonlocal began
            if stage == "compile":
                bar.update(task, description=_COMPILING, total=None)
            if done == 0:
                began = time.monotonic()
                return
            rate = done / max(time.monotonic() - began, 1e-9)
            text = f"{count(done)} {unit}, {rate:.3g} {unit}/s"
            bar.update(task, description=text, completed=done, total=total)

        yield report


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 100 else f"{minutes} min {seconds:.0f} s"
