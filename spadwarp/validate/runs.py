"""Running the reference cases, judging their quantities together, and reporting them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spadwarp.limits import check_choice, check_integer
from spadwarp.validate import camera, phase, water
from spadwarp.validate.case import Case, Run
from spadwarp.validate.statistics import holm, two_sided_p
from spadwarp.viz import draw_validation

__all__ = ["CASES", "FAMILY_LEVEL", "CaseResult", "draw_results", "report", "run"]

CASES: dict[str, Case] = {case.name: case for case in (*water.CASES, *phase.CASES, *camera.CASES)}
"""The reference cases by name."""

FAMILY_LEVEL = 1e-3
"""Probability that a run of a correct simulator fails, however many quantities it has."""


@dataclass(frozen=True)
class CaseResult:
    """One measured quantity of a case.

    Attributes:
        name: Of the case.
        quantity: What was measured, with its unit.
        value: The simulator's value.
        reference: The known value.
        standard_error: Of the difference; 0 where both must be equal.
        z: The difference in standard deviations of a normal distribution.
        p: Two-sided probability of such a z, corrected for the number of quantities in the run (Holm 1979).
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


def run(
    cases: Iterable[str] | None = None,
    *,
    photons: int = 1_000_000,
    seed: int = 0,
    device: str | None = None,
    tabulated: bool = False,
    progress: Callable[[Case], None] | None = None,
) -> list[CaseResult]:
    """Runs reference cases and compares them with their references.

    Args:
        cases: Names out of `CASES`; all by default.
        photons: For each scene of a case, at least 1000. A million take a few seconds per case on a GPU; more photons
            find smaller errors.
        seed: Of the random numbers, in [0, 2^40].
        device: As for `spadwarp.simulate`.
        tabulated: Whether every Henyey–Greenstein phase function is first written to a table and read from it.
        progress: Called with each case before it is run.

    Returns:
        One result for each quantity, in the order of the cases.

    Raises:
        ArgumentError: An unknown case, or photons or seed out of range.
    """
    names = list(CASES) if cases is None else list(cases)
    for name in names:
        check_choice("cases: an item", name, [*CASES])
    photons = check_integer("photons", photons, "[1000, 1000000000000]")
    seed = check_integer("seed", seed, "[0, 1099511627776]")
    measured = []
    with tempfile.TemporaryDirectory() as folder:
        setup = Run(photons=photons, seed=seed, device=device, tables=Path(folder) if tabulated else None)
        for name in names:
            if progress is not None:
                progress(CASES[name])
            measured += [(name, quantity) for quantity in CASES[name].measure(setup)]
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
        for (name, quantity), p in zip(measured, holm(two_sided_p(quantity.z) for _, quantity in measured), strict=True)
    ]


def report(results: Sequence[CaseResult], *, photons: int, seed: int) -> dict[str, Any]:
    """The results with their cases' summaries as plain values; `spadwarp.io.write_json` writes them."""
    return {
        "photons": photons,
        "seed": str(seed),
        "family_level": FAMILY_LEVEL,
        "passed": all(result.passed for result in results),
        "cases": {result.name: CASES[result.name].summary for result in results},
        "results": [asdict(result) for result in results],
    }


def draw_results(results: Sequence[CaseResult], folder: str | Path) -> list[Path]:
    """One PNG for each case: values over references with their errors, and the z of each quantity; returns the paths.

    Raises `FileError`.
    """
    return [
        draw_validation(
            [asdict(result) for result in results if result.name == name],
            Path(folder) / f"{name}.png",
            title=f"{name}: {CASES[name].summary}",
        )
        for name in dict.fromkeys(result.name for result in results)
    ]
