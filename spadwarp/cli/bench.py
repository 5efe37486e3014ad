"""`spadwarp bench`: how fast this machine is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, fail, say
from spadwarp.cli._tables import new_table
from spadwarp.errors import FileError
from spadwarp.units import percent

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp.benchmark import BenchResult, Comparison


@app.command()
def bench(
    cases: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="CASE",
            help='Names of cases, or "scaling"; all cases if left out. A FILE.json that --json wrote stands for its '
            "results, and nothing is measured.",
            show_default=False,
        ),
    ] = None,
    device: opt.Device = None,
    photons: opt.Photons = None,
    repeats: Annotated[
        int, typer.Option(parser=opt.whole_number, metavar="N", help="Timed runs; the fastest is reported.")
    ] = 3,
    list_cases: Annotated[bool, typer.Option("--list", help="List the cases and exit.")] = False,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also say which cases are faster, slower or the same as in FILE, written by --json; for a directory, "
            "as in its newest file from such a device.",
        ),
    ] = None,
) -> None:
    """Measure the speed of named cases.

    Compile time is apart from run time. "error" is the relative standard error of the brightest bins after one second
    of transport.

    With --compare, a case is faster or slower where the 99 % confidence interval of the ratio of its speeds (the t-test
    of Welch on the logarithms of the timed runs) lies more than 3 % from 1; the same where it stays within 10 %; else
    unclear, for which more --repeats help. Ends with code 1 where a case is slower, or a mean that is known from
    elsewhere is missed.

    \b
    Examples:
      spadwarp bench water staircase_5m --json before.json
      spadwarp bench water staircase_5m --compare before.json
      spadwarp bench --compare before.json after.json
      spadwarp bench scaling --device cpu
    """
    from spadwarp.benchmark import CASES, history, load_report

    if list_cases:
        for case in CASES.values():
            say(f"{case.name:<20}  {case.summary}")
        say(f"{'scaling':<20}  how cost and memory grow with photons, faces and bins")
        return
    kept = _kept_results(cases)
    before = None
    if compare is not None and compare.is_dir():
        history(compare)  # one without reports is known before cases are measured
    elif compare is not None:
        before = load_report(compare)
    outputs = opt.check_outputs(json=json_path, inputs=(compare, kept), overwrite=overwrite)
    if kept is not None:
        summary = _show_kept(load_report(kept), quiet)
    else:
        summary = _measure(cases, outputs, quiet, device=device, photons=photons, repeats=repeats)
    slower = []
    if compare is not None:
        try:
            slower = _compare(summary, compare, before, quiet)
        except FileError:  # no report of such a device: what was measured is kept
            outputs.write_json(summary)
            raise
    outputs.write_json(summary)
    checks = {row["case"]: row["check"] for row in summary["results"]}
    missed = [case for case, check in checks.items() if check is not None and not check["passed"]]
    problems = [f"{', '.join(missed)}: a mean is not what it should be"] if missed else []
    problems += [f"{', '.join(slower)}: slower than in {compare}"] if slower else []
    if problems:
        fail("\n".join(problems))


def _kept_results(cases: Sequence[str] | None) -> Path | None:
    """The file that stands for results, instead of names of cases."""
    files = [case for case in cases or () if case.endswith(".json")]
    if files and len(cases or ()) > 1:
        raise typer.BadParameter(f"{files[0]} goes without other cases and files", param_hint="CASE")
    return Path(files[0]) if files else None


def _measure(cases: list[str] | None, outputs: opt.Outputs, quiet: bool, **options: Any) -> dict[str, Any]:
    """Runs the cases, with a row for each as it comes."""
    from spadwarp.benchmark import report, run

    results: list[BenchResult] = []

    def found(result: BenchResult) -> None:
        if not quiet and not results:
            say(_HEAD)
        results.append(result)
        if not quiet:
            say(_row(result))

    announce = None if quiet else lambda case: complain(f"{case.name}: {case.summary}")
    try:
        run(cases or None, progress=announce, found=found, **options)
    except BaseException:  # Ctrl-C and a device that is too small leave what was measured until then
        if results:
            outputs.write_json(report(results))
        raise
    summary = report(results)
    if not quiet:
        _say_summary(results, summary["provenance"])
    return summary


def _show_kept(stored: dict[str, Any], quiet: bool) -> dict[str, Any]:
    from spadwarp.benchmark import BenchResult

    if not quiet:
        names = [field.name for field in fields(BenchResult)]
        results = [BenchResult(**{name: row[name] for name in names}) for row in stored["results"]]
        say(_HEAD)
        for result in results:
            say(_row(result))
        _say_summary(results, stored["provenance"])
    return stored


def _compare(summary: dict[str, Any], place: Path, before: dict[str, Any] | None, quiet: bool) -> list[str]:
    """Adds the comparison to the summary; returns the cases that are slower."""
    from spadwarp.benchmark import compare, load_report, newest_report

    if before is None:
        cases = [row["case"] for row in summary["results"]]
        place = newest_report(place, like=summary["provenance"], cases=cases)
        before = load_report(place)
    found = compare(summary, before)
    summary["comparison"] = [asdict(one) for one in found]
    if not quiet:
        made = before["provenance"]
        say(f"against {place}: {made['device_name']}, spadwarp {made['spadwarp']}, {made['date']}")
        if found:
            opt.show_table(_comparison_table(found))
        else:
            say("no case is in both")
    return [one.case for one in found if one.verdict == "slower"]


_COLUMNS = (
    ("case", -20),
    ("faces", 7),
    ("setup", 8),
    ("compile", 8),
    ("run", 8),
    ("per second", 15),
    ("collisions/s", 13),
    ("queries/s", 10),
    ("memory", 10),
    ("error", 8),
)


def _line(cells: Sequence[str]) -> str:
    """One row, columns as wide as they are known to get: rows come one by one."""
    return " ".join(
        cell.ljust(-width) if width < 0 else cell.rjust(width) for cell, (_, width) in zip(cells, _COLUMNS, strict=True)
    ).rstrip()


_HEAD = _line([title for title, _ in _COLUMNS])


def _row(result: BenchResult) -> str:
    unit, rate = next(iter(result.rates.items()))
    memory = result.tally_bytes if result.memory is None else result.memory
    return _line(
        [
            result.case,
            str(result.faces or "-"),
            _seconds(result.setup),
            _seconds(result.compile),
            _seconds(min(result.seconds)),
            f"{rate:.3g} {unit}",
            _rate(result.rates.get("collisions")),
            _rate(result.rates.get("queries")),
            "-" if memory is None else opt.in_bytes(memory) + ("" if result.memory is not None else "*"),
            "-" if result.error_per_root_second is None else f"{100 * result.error_per_root_second:.3g} %",
        ]
    )


def _growth(results: Sequence[BenchResult]) -> list[str]:
    """What "scaling" shows: time and memory of the largest case over those of a smaller one."""
    lines = []
    for kind, base in (("photons_", -2), ("faces_", 0), ("bins_", 0)):
        cases = [result for result in results if result.case.startswith(kind)]
        if len(cases) < 2:
            continue
        small, large = cases[base], cases[-1]
        time = large.rates["photons"] and small.rates["photons"] / large.rates["photons"]
        line = f"{small.case} -> {large.case}: {time:.3g} times the time of a photon"
        if small.memory and large.memory:
            line += f", {large.memory / small.memory:.3g} times the memory"
        lines.append(line)
    return lines


def _comparison_table(found: Sequence[Comparison]) -> Table:
    table = new_table("case", "", "before", "now", "ratio", "99 % interval")
    for one in found:
        interval = "-" if one.interval is None else f"{one.interval[0]:.3f} to {one.interval[1]:.3f}"
        rates = (_with_spread(one.before, one.spread_before), _with_spread(one.now, one.spread_now))
        table.add_row(f"{one.case} [{one.unit}/s]", one.verdict, *rates, f"{one.ratio:.3f}", interval)
    return table


def _with_spread(rate: float, spread: float | None) -> str:
    return f"{rate:.3g} ± ?" if spread is None else f"{rate:.3g} ± {percent(spread)} %"


def _say_summary(results: Sequence[BenchResult], made: Mapping[str, Any]) -> None:
    if any(result.memory is None and result.tally_bytes for result in results):
        say("* histograms alone; Warp does not count memory on the CPU")
    say(f"{made['device_name']} ({made['device']}), {made['date']}")
    for line in _growth(results):
        say(line)
    for result in results:
        if result.check is not None:
            say(_checked(result.case, result.check))


def _seconds(value: float) -> str:
    return f"{value:.3g} s" if value >= 1e-3 else "0 s"


def _rate(value: float | None) -> str:
    return f"{value:.3g}" if value else "-"


def _checked(case: str, check: Mapping[str, Any]) -> str:
    verdict = "agrees with" if check["passed"] else "MISSES"
    return (
        f"{case}: {check['name']} {100 * check['value']:.3f} ± {100 * check['standard_error']:.3f} %, "
        f"{verdict} {100 * check['reference']:.2f} %"
    )
