"""Whether cases became faster: the timed runs of two reports, with their noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.benchmark.results import load_report
from spadwarp.errors import FileError

__all__ = ["MARGIN", "Comparison", "compare", "history", "newest_report"]

MARGIN = 0.03
"""Change of speed that a comparison ignores: processes differ by this much where the runs of one agree better."""

_CONFIDENCE = 0.99
_RESOLUTION = 0.1  # "same" is not said where the interval reaches beyond this change of speed
_TIMER = 1e-3  # the least relative scatter of a timed run: clocks are not better


@dataclass(frozen=True)
class Comparison:
    """One case now and before.

    Attributes:
        case: Its name.
        unit: What is counted: photons, frames or bins a second.
        before, now: Rate [1/s], geometric mean of the timed runs.
        spread_before, spread_now: Relative standard deviation of a timed run; None from one run.
        ratio: now / before; above 1 is faster.
        interval: Confidence interval of the ratio at 99 %; None where one side has a single run.
        verdict: "faster" or "slower" where the whole interval lies more than `MARGIN` from 1; else "same", or
            "unclear" where it reaches further than 10 % from 1.
    """

    case: str
    unit: str
    before: float
    now: float
    spread_before: float | None
    spread_now: float | None
    ratio: float
    interval: tuple[float, float] | None
    verdict: Literal["faster", "slower", "same", "unclear"]


def compare(now: Mapping[str, Any], before: Mapping[str, Any]) -> list[Comparison]:
    """Compares two reports case by case, those that both have.

    Logarithms of rates are compared, so that a ratio is a difference, by the t-test of Welch (1947), which takes the
    scatter of either side as it is. It knows the noise between runs of one process alone; `MARGIN` stands for the rest.

    Args:
        now, before: From `report` or `load_report`.
    """
    earlier = {row["case"]: row for row in before["results"]}
    return [_compared(row, earlier[row["case"]]) for row in now["results"] if row["case"] in earlier]


def _compared(now: Mapping[str, Any], before: Mapping[str, Any]) -> Comparison:
    unit = next(iter(now["rates"]))
    new, old = _log_rates(now, unit), _log_rates(before, unit)
    interval = _interval(new, old)
    return Comparison(
        case=now["case"],
        unit=unit,
        before=math.exp(old.mean()),
        now=math.exp(new.mean()),
        spread_before=_spread(old),
        spread_now=_spread(new),
        ratio=math.exp(new.mean() - old.mean()),
        interval=interval,
        verdict=_verdict(interval),
    )


def _verdict(interval: tuple[float, float] | None) -> Literal["faster", "slower", "same", "unclear"]:
    if interval is None:
        return "unclear"
    low, high = interval
    if low > 1.0 + MARGIN:
        return "faster"
    if high < 1.0 / (1.0 + MARGIN):
        return "slower"
    return "same" if max(high, 1.0 / low) <= 1.0 + _RESOLUTION else "unclear"


def _log_rates(row: Mapping[str, Any], unit: str) -> NDArray[np.float64]:
    return np.asarray(np.log(row["size"][unit] / np.asarray(row["seconds"], dtype=np.float64)))


def _spread(log_rates: NDArray[np.float64]) -> float | None:
    return float(log_rates.std(ddof=1)) if log_rates.size > 1 else None


def _interval(new: NDArray[np.float64], old: NDArray[np.float64]) -> tuple[float, float] | None:
    """Of the ratio, from logarithms of rates; degrees of freedom by Welch and Satterthwaite."""
    from scipy.special import stdtrit

    if min(new.size, old.size) < 2:
        return None
    parts = [max(float(side.var(ddof=1)), _TIMER**2) / side.size for side in (new, old)]
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / (new.size - 1) + parts[1] ** 2 / (old.size - 1))
    half = float(stdtrit(freedom, 0.5 + 0.5 * _CONFIDENCE)) * math.sqrt(sum(parts))
    difference = float(new.mean() - old.mean())
    return math.exp(difference - half), math.exp(difference + half)


def history(directory: str | Path) -> list[tuple[Path, dict[str, Any]]]:
    """The reports (*.json) of a directory and their paths, oldest first. Raises `FileError`."""
    paths = sorted(Path(directory).glob("*.json"))
    if not paths:
        raise FileError(f"{directory}: holds no report (*.json) that `spadwarp bench --json` wrote")
    return sorted(((path, load_report(path)) for path in paths), key=lambda entry: str(entry[1]["provenance"]["date"]))


def newest_report(directory: str | Path, *, like: Mapping[str, Any], cases: Sequence[str]) -> Path:
    """The newest report of a directory with one of these cases, from the same kind of device.

    Args:
        directory: Of reports.
        like: Provenance of a report: `device_name` and `threads` count.
        cases: Names of cases.

    Raises:
        FileError: There is none.
    """
    for path, stored in reversed(history(directory)):
        made = stored["provenance"]
        same = all(made.get(name) == like[name] for name in ("device_name", "threads"))
        if same and any(row["case"] in cases for row in stored["results"]):
            return path
    threads = "" if like["threads"] is None else f" with {like['threads']} threads"
    raise FileError(f"{directory}: no report of {', '.join(cases)} from {like['device_name']}{threads}")
