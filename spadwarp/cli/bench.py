"""`spadwarp bench`: how fast this machine is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, fail, say
from spadwarp.cli._tables import new_table

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp.benchmark import BenchResult


@app.command()
def bench(
    cases: Annotated[
        list[str] | None,
        typer.Argument(metavar="CASE", help='Names of cases, or "scaling"; all cases if left out.', show_default=False),
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
        typer.Option(metavar="FILE", help="Also print the ratio of the rates to those in FILE, written by --json."),
    ] = None,
) -> None:
    """Measure the speed of named cases.

    Compile time is apart from run time. "error" is the relative standard error of the brightest bins after one second
    of transport. Ends with code 1 where a mean that is known from elsewhere is missed.

    \b
    Examples:
      spadwarp bench water staircase_5m --json before.json
      spadwarp bench water staircase_5m --compare before.json
      spadwarp bench scaling --device cpu
    """
    from spadwarp.benchmark import CASES, load_report, ratios, report, run

    if list_cases:
        for case in CASES.values():
            say(f"{case.name:<20}  {case.summary}")
        say(f"{'scaling':<20}  how cost and memory grow with photons, faces and bins")
        return
    before = None if compare is None else load_report(compare)
    outputs = opt.check_outputs(json=json_path, inputs=(compare,), overwrite=overwrite)
    results: list[BenchResult] = []

    def found(result: BenchResult) -> None:
        if not quiet and not results:
            say(_HEAD)
        results.append(result)
        if not quiet:
            say(_row(result))

    try:
        run(
            cases or None,
            device=device,
            photons=photons,
            repeats=repeats,
            progress=None if quiet else lambda case: complain(f"{case.name}: {case.summary}"),
            found=found,
        )
    except BaseException:  # Ctrl-C and a device that is too small leave what was measured until then
        if results:
            outputs.write_json(report(results))
        raise
    summary = report(results)
    if not quiet:
        _say_summary(results, summary["provenance"])
    if before is not None:
        faster = ratios(results, before)
        summary["ratios"] = faster
        if not quiet:
            made = before["provenance"]
            say(f"over {compare}: {made['device_name']}, {made['date']}")
            opt.show_table(_ratio_table(faster))
    outputs.write_json(summary)
    missed = [result.case for result in results if result.check is not None and not result.check["passed"]]
    if missed:
        fail(f"{', '.join(missed)}: a mean is not what it should be")


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


def _ratio_table(faster: Mapping[str, Mapping[str, float]]) -> Table:
    units = list(dict.fromkeys(unit for rates in faster.values() for unit in rates))
    table = new_table("case", *(f"{unit}/s" for unit in units))
    for case, rates in faster.items():
        table.add_row(case, *(f"× {rates[unit]:.3f}" if unit in rates else "-" for unit in units))
    return table


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
