"""Commands about trust and speed: `validate`, `bench`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import spadwarp
from spadwarp.cli.app import fail, note, say, wrong
from spadwarp.cli.options import command
from spadwarp.cli.outputs import check_outputs, in_bytes, show_table, write_json
from spadwarp.values import percent

if TYPE_CHECKING:
    from spadwarp.benchmark import BenchResult


def _announce(case: Any) -> None:
    note(f"{case.name}: {case.summary}")


@command(prints_result=True)
def validate(
    cases: list[str] | None = None,
    *,
    photons: int = 1_000_000,
    seed: int = 0,
    device: str | None = None,
    tabulated: bool = False,
    plots: Path | None = None,
) -> None:
    """Compare the simulator with known results of physics.

    A correct simulator fails in one run of a thousand. Exit code 1 if a value does not agree with its reference.

    Args:
        cases (CASE): Names of `spadwarp list validation`; all if left out.
        photons: Photons for each scene of a case.
        tabulated: Use Henyey–Greenstein as tables of angle and value.
        plots (DIR): Also draw a picture of each case.

    \b
    Examples:
      spadwarp validate
      spadwarp validate slab cube60 --photons 1e7 --seed 1 --json report.json --plots plots/
    """
    trust = spadwarp.validate
    check_outputs(plots, [f"{name}.png" for name in trust.CASES], option="--plots")
    options: dict[str, Any] = {"photons": photons, "seed": seed}
    results = trust.run(cases or None, device=device, tabulated=tabulated, progress=_announce, **options)
    failed = [result for result in results if not result.passed]
    write_json(trust.report(results, **options))
    drawn = [] if plots is None else trust.draw_results(results, plots)
    table = (
        {
            "case": one.name,
            "quantity": one.quantity,
            "value": f"{one.value:.6g}",
            "reference": f"{one.reference:.6g}",
            "error": f"{one.standard_error:.2g}",
            "z": f"{one.z:+.2f}",
            "": "ok" if one.passed else "FAILED",
        }
        for one in results
    )
    show_table(table, keys=2)
    say(f"{len(results) - len(failed)} of {len(results)} agree" + (f"; plots in {plots}" if drawn else ""))
    if failed:
        fail("\n".join(f"{one.name}: {one.quantity}: z = {one.z:.2f}" for one in failed))


@command(prints_result=True)
def bench(
    cases: list[str] | None = None,
    *,
    device: str | None = None,
    photons: int | None = None,
    repeats: int = 3,
    compare: Path | None = None,
) -> None:
    """Measure the speed of named cases.

    "error" is the relative standard error of the brightest bins after one second of transport. With --compare, a case
    is faster or slower where the 99 % confidence interval of the ratio of its speeds (Welch's t-test on the logarithms
    of the timed runs) lies more than 3 % from 1; the same where it stays within 10 %; else unclear, for which more
    --repeats help. Exit code 1 where a case is slower, or a mean that is known from elsewhere is missed.

    Args:
        cases (CASE): Names of `spadwarp list benchmarks`, or "scaling"; all if left out. A FILE.json that --json wrote
            stands for its results, and nothing is measured.
        photons: Photons of a timed run. By default chosen for the device.
        repeats: Timed runs; the fastest is reported.
        compare: Also say which cases are faster, slower or the same as in FILE, written by --json; for a directory, as
            in its newest file from such a device.

    \b
    Examples:
      spadwarp bench water staircase_5m --json before.json
      spadwarp bench water staircase_5m --compare before.json
      spadwarp bench --compare before.json after.json
    """
    load = spadwarp.benchmark.load_report
    files = [case for case in cases or () if case.endswith(".json")]  # one stands for results
    if files and len(cases or ()) > 1:
        wrong(f"{files[0]} cannot be combined with other cases and files", "CASE")
    before = None
    if compare is not None and compare.is_dir():
        spadwarp.benchmark.history(compare)  # one without reports is known before cases are measured
    elif compare is not None:
        before = load(compare)
    check_outputs(inputs=(compare, *files))
    measured = load(files[0]) if files else _measure(cases, device=device, photons=photons, repeats=repeats)
    _show_report(measured)
    slower = []
    try:
        if compare is not None:
            slower = _compare(measured, compare, before)
    finally:  # also without a report of such a device: what was measured is kept
        write_json(measured)
    checks = {row["case"]: row["check"] for row in measured["results"]}
    missed = [case for case, check in checks.items() if check is not None and not check["passed"]]
    problems = [f"{', '.join(missed)}: a mean is not what it should be"] if missed else []
    problems += [f"{', '.join(slower)}: slower than in {compare}"] if slower else []
    if problems:
        fail("\n".join(problems))


def _measure(cases: list[str] | None, **options: Any) -> dict[str, Any]:
    """Runs the cases."""
    results: list[BenchResult] = []
    try:
        spadwarp.benchmark.run(cases or None, progress=_announce, found=results.append, **options)
    except BaseException:  # Ctrl-C and a device that is too small leave what was measured until then
        if results:
            report = spadwarp.benchmark.report(results)
            _show_report(report)
            write_json(report)
        raise
    return spadwarp.benchmark.report(results)


def _compare(summary: dict[str, Any], place: Path, before: dict[str, Any] | None) -> list[str]:
    """Adds the comparison to the summary; returns the cases that are slower."""
    if before is None:
        cases = [row["case"] for row in summary["results"]]
        place = spadwarp.benchmark.newest_report(place, like=summary["provenance"], cases=cases)
        before = spadwarp.benchmark.load_report(place)
    found = spadwarp.benchmark.compare(summary, before)
    summary["comparison"] = [asdict(one) for one in found]
    made = before["provenance"]
    say(f"against {place}: {made['device_name']}, spadwarp {made['spadwarp']}, {made['date']}")

    def rate(value: float, spread: float | None) -> str:
        return f"{value:.3g} ± " + ("?" if spread is None else f"{percent(spread)} %")

    table = [
        {
            "case": f"{one.case} [{one.unit}/s]",
            "": one.verdict,
            "before": rate(one.before, one.spread_before),
            "now": rate(one.now, one.spread_now),
            "ratio": f"{one.ratio:.3f}",
            "99 % interval": "-" if one.interval is None else f"{one.interval[0]:.3f} to {one.interval[1]:.3f}",
        }
        for one in found
    ]
    if table:
        show_table(table)
    else:
        say("no case is in both")
    return [one.case for one in found if one.verdict == "slower"]


def _show_report(report: Mapping[str, Any]) -> None:
    """A report as a table, and what follows from it."""
    table, made = [], report["provenance"]
    for result in report["results"]:
        unit, rate = next(iter(result["rates"].items()))
        memory = result["tally_bytes"] if result["memory"] is None else result["memory"]
        error = result["error_per_root_second"]
        cells = {
            "case": result["case"],
            "faces": result["faces"] or "-",
            "setup [s]": result["setup"],
            "compile [s]": result["compile"],
            "run [s]": min(result["seconds"]),
            "per second": f"{rate:.3g} {unit}",
        }
        cells |= {f"{unit}/s": result["rates"].get(unit, math.nan) for unit in ("collisions", "queries")}
        cells["memory"] = "-" if memory is None else in_bytes(memory) + ("*" if result["memory"] is None else "")
        table.append({**cells, "error": "-" if error is None else f"{100 * error:.3g} %"})
    show_table(table)
    if any(result["memory"] is None and result["tally_bytes"] for result in report["results"]):
        say("* histograms alone; Warp does not count memory on the CPU")
    say(f"{made['device_name']} ({made['device']}), {made['date']}")
    for line in _growth(report["results"]):
        say(line)
    for result in report["results"]:
        if (check := result["check"]) is not None:
            verdict = "agrees with" if check["passed"] else "MISSES"
            value, error, known = (100 * check[name] for name in ("value", "standard_error", "reference"))
            say(f"{result['case']}: {check['name']} {value:.3f} ± {error:.3f} %, {verdict} {known:.2f} %")


def _growth(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """The result of "scaling": time and memory of the largest case over those of a smaller one."""
    lines = []
    for kind, base in (("photons_", -2), ("faces_", 0), ("bins_", 0)):
        cases = [result for result in results if result["case"].startswith(kind)]
        if len(cases) < 2:
            continue
        small, large = cases[base], cases[-1]
        time = large["rates"]["photons"] and small["rates"]["photons"] / large["rates"]["photons"]
        line = f"{small['case']} -> {large['case']}: {time:.3g} times the time of a photon"
        if small["memory"] and large["memory"]:
            line += f", {large['memory'] / small['memory']:.3g} times the memory"
        lines.append(line)
    return lines
