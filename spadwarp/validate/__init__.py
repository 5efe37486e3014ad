"""`spadwarp.validate`: the simulator against physics whose answer is known without it.

>>> from spadwarp.validate import validate
>>> results = validate(["slab", "cube60"], photons=1_000_000, seed=1)
>>> all(result.passed for result in results)
True
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from spadwarp.errors import ConfigError
from spadwarp.validate.camera import CASES as LIDAR_CASES
from spadwarp.validate.phase import CASES as PHASE_CASES
from spadwarp.validate.runs import Case, Run
from spadwarp.validate.statistics import holm, two_sided_p
from spadwarp.validate.water import CASES as WATER_CASES

__all__ = ["CASES", "FAMILY_LEVEL", "CaseResult", "plot_results", "validate", "write_json"]

CASES: dict[str, Case] = {case.name: case for case in (*WATER_CASES, *PHASE_CASES, *LIDAR_CASES)}
"""The reference cases by name."""

FAMILY_LEVEL = 1e-3
"""A run of correct physics fails with this probability, however many quantities it has."""


@dataclass(frozen=True)
class CaseResult:
    """One measured quantity of a case.

    Attributes:
        name: Of the case.
        quantity: What was measured, with its unit.
        value: The simulator's.
        reference: What it should be.
        standard_error: Of the difference; 0 where equality is asked for.
        z: The difference in standard deviations of a normal distribution.
        p: Two-sided probability of such a z, raised for the number of quantities in the run (Holm 1979).
        passed: Whether p exceeds `FAMILY_LEVEL`.
    """

    name: str
    quantity: str
    value: float
    reference: float
    standard_error: float
    z: float
    p: float
    passed: bool


def validate(
    cases: Iterable[str] | None = None,
    *,
    photons: int = 1_000_000,
    seed: int = 0,
    device: str | None = None,
    tabulated: bool = False,
    progress: Callable[[Case], None] | None = None,
) -> list[CaseResult]:
    """Run reference cases and hold them to their references.

    Args:
        cases: Names out of `CASES`; all by default.
        photons: For each scene of a case, at least 1000. A million takes seconds a case on a GPU, ten million show
        more. seed: Of the random numbers, in [0, 2^40].
        device: As for `simulate`.
        tabulated: Whether every Henyey–Greenstein phase function is first tabulated and then read from the file.
        progress: Called with each case before it is run.

    Returns:
        One result for each quantity, in the order of the cases.

    Raises:
        ConfigError: An unknown case, or photons or seed out of range.
    """
    names = list(CASES) if cases is None else list(cases)
    for name in names:
        if name not in CASES:
            raise ConfigError(f"cases: {name!r} is not one of {', '.join(CASES)}")
    for field, value, low, high in (("photons", photons, 1000, 10**12), ("seed", seed, 0, 2**40)):
        if not low <= value <= high:
            raise ConfigError(f"{field} = {value} is outside [{low}, {high}]")
    measured = []
    with tempfile.TemporaryDirectory() as folder:
        run = Run(photons=photons, seed=seed, device=device, tables=Path(folder) if tabulated else None)
        for name in names:
            if progress is not None:
                progress(CASES[name])
            measured += [(name, quantity) for quantity in CASES[name].measure(run)]
    return [
        CaseResult(
            name=name,
            quantity=quantity.name,
            value=quantity.estimate.value,
            reference=quantity.reference,
            standard_error=quantity.standard_error,
            z=quantity.z,
            p=p,
            passed=p > FAMILY_LEVEL,
        )
        for (name, quantity), p in zip(measured, holm(two_sided_p(q.z) for _, q in measured), strict=True)
    ]


def write_json(results: Sequence[CaseResult], path: str | Path, *, photons: int, seed: int) -> None:
    """Write the results with their cases' descriptions; an infinite z is written as null."""
    rows = [{**asdict(r), "z": r.z if math.isfinite(r.z) else None} for r in results]
    about = {name: CASES[name].about for name in dict.fromkeys(r.name for r in results)}
    report = {
        "photons": photons,
        "seed": str(seed),
        "family_level": FAMILY_LEVEL,
        "passed": all(r.passed for r in results),
        "cases": about,
        "results": rows,
    }
    Path(path).write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def plot_results(results: Sequence[CaseResult], folder: str | Path) -> list[Path]:
    """One PNG a case: values over references with their errors, and the z of each quantity. Returns the paths."""
    from matplotlib.figure import Figure

    Path(folder).mkdir(parents=True, exist_ok=True)
    paths = []
    for name in dict.fromkeys(r.name for r in results):
        rows = [r for r in results if r.name == name]
        height = 1.6 + 0.26 * len(rows)
        figure = Figure(figsize=(11, height), layout="constrained")
        ratio, deviation = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
        for y, row in enumerate(rows):
            colour = "C0" if row.passed else "C3"
            if row.reference:
                error = abs(row.standard_error / row.reference)
                ratio.errorbar(row.value / row.reference - 1.0, y, xerr=error, fmt="o", ms=4, color=colour)
            if math.isfinite(row.z):
                deviation.plot(row.z, y, "o", ms=4, color=colour)
        ratio.axvline(0.0, color="0.6", lw=0.8)
        ratio.set_xlabel("value / reference − 1")
        ratio.set_yticks(range(len(rows)), [r.quantity for r in rows], fontsize=8)
        ratio.invert_yaxis()
        deviation.axvspan(-2.0, 2.0, color="0.92")
        deviation.set_xlabel("z")
        figure.suptitle(f"{name}: {CASES[name].about}", fontsize=10)
        paths.append(Path(folder) / f"{name}.png")
        figure.savefig(paths[-1], dpi=130)
    return paths
