"""How far a run is: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from spadwarp.cli import _options as opt
from spadwarp.cli._app import complain

Report = Callable[[str, int, int], None]

_COMPILING = "loading kernels; the first run of a kind compiles them, which takes a while"


@contextmanager
def progress(*, quiet: bool, unit: str = "photons") -> Iterator[Report | None]:
    """What `spadwarp.simulate` takes as `progress`; None where nothing is to be said."""
    if quiet:
        yield None
    elif sys.stderr is not None and sys.stderr.isatty():
        with _bar(unit) as report:
            yield report
    else:
        yield _lines(unit)


class _Pace:
    """What is done per second, since the first report: kernels are loaded and truth maps made before it."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None

    def __call__(self, done: int) -> tuple[float, float]:
        """Rate [1/s], 0 where it is not known yet, and seconds since the first report."""
        now = time.monotonic()
        if self._first is None:
            self._first = now, done
        seconds = now - self._first[0]
        return (done - self._first[1]) / seconds if seconds > 0.05 else 0.0, seconds


def _lines(unit: str) -> Report:
    """A line at every tenth, but not more often than every second; in a long run soon, then ever more seldom."""
    pace = _Pace()
    reported_at, reported_done, patience = time.monotonic(), 0, 2.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal reported_at, reported_done, patience
        if not total:
            complain(_COMPILING if stage == "compile" else stage)
            return
        rate, seconds = pace(done)
        waited = time.monotonic() - reported_at
        due = (done - reported_done >= 0.1 * total and waited >= 1.0) or waited >= patience
        if done > reported_done and (due or done == total):
            line = f"{100 * done / total:3.0f} %  {opt.count(done)} of {opt.count(total)} {unit}"
            if rate:
                line += f", {rate:.3g} {unit}/s"
                line += f", {_duration((total - done) / rate)} left" if done < total else f" in {_duration(seconds)}"
            complain(line)
            reported_at, reported_done, patience = time.monotonic(), done, min(2.0 * patience, 60.0)

    return report


@contextmanager
def _bar(unit: str) -> Iterator[Report]:
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
        pace = _Pace()

        def report(stage: str, done: int, total: int) -> None:
            if stage == "compile":
                bar.update(task, description=_COMPILING, total=None)
                return
            if not total:
                bar.console.print(stage, markup=False, highlight=False)
                return
            rate, _ = pace(done)
            text = f"{opt.count(done)} {unit}" + (f", {rate:.3g} {unit}/s" if rate else "")
            bar.update(task, description=text, completed=done, total=total)

        yield report


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 100 else f"{minutes} min {seconds:.0f} s"
