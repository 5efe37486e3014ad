"""`spadwarp validate`: the simulator against known physics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, fail, say

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp.validate import CaseResult


@app.command()
def validate(
    cases: Annotated[
        list[str] | None,
        typer.Argument(metavar="CASE", help="Names of cases; all if left out.", show_default=False),
    ] = None,
    photons: Annotated[
        int, typer.Option(parser=opt.whole_number, metavar="N", help="Photons for each scene of a case.")
    ] = 1_000_000,
    seed: opt.Seed = None,
    device: opt.Device = None,
    tabulated: Annotated[
        bool, typer.Option("--tabulated", help="Use Henyey–Greenstein as tables of angle and value.")
    ] = False,
    plots: Annotated[Path | None, typer.Option(metavar="DIR", help="Also draw a picture of each case.")] = None,
    list_cases: Annotated[bool, typer.Option("--list", help="List the cases and exit.")] = False,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Compare the simulator with known results of physics.

    A correct simulator fails in one run of a thousand. Exit code 1 if a value does not agree with its reference.

    \b
    Examples:
      spadwarp validate
      spadwarp validate slab cube60 --photons 1e7 --seed 1 --json report.json --plots plots/
    """
    from spadwarp.validate import CASES, draw_results, report, run

    if list_cases:
        say(opt.rows({case.name: case.summary for case in CASES.values()}))
        return
    outputs = opt.check_outputs(
        plots, [f"{name}.png" for name in CASES], json=json_path, overwrite=overwrite, option="--plots"
    )
    results = run(
        cases or None,
        photons=photons,
        seed=seed or 0,
        device=device,
        tabulated=tabulated,
        progress=None if quiet else lambda case: complain(f"{case.name}: {case.summary}"),
    )
    failed = [result for result in results if not result.passed]
    outputs.write_json(report(results, photons=photons, seed=seed or 0))
    drawn = [] if plots is None else draw_results(results, plots)
    if not quiet:
        opt.show_table(_table(results))
        say(f"{len(results) - len(failed)} of {len(results)} agree" + (f"; plots in {plots}" if drawn else ""))
    if failed:
        fail("\n".join(f"{one.name}: {one.quantity}: z = {one.z:.2f}" for one in failed))


def _table(results: Sequence[CaseResult]) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("case", no_wrap=True)
    table.add_column("quantity", overflow="fold")
    for title in ("value", "reference", "error", "z", ""):
        table.add_column(title, justify="right", no_wrap=True)
    before = None
    for one in results:
        table.add_row(
            one.name if one.name != before else "",
            one.quantity,
            f"{one.value:.6g}",
            f"{one.reference:.6g}",
            f"{one.standard_error:.2g}",
            f"{one.z:+.2f}",
            Text("ok", "green") if one.passed else Text("FAILED", "bold red"),
        )
        before = one.name
    return table
