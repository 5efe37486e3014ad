"""`spadwarp merge`, `validate` and `targets`: runs added up, runs held to known physics, and what to aim at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import spadwarp
from spadwarp.cli._app import app, complain, fail, say
from spadwarp.cli._options import (
    Device,
    Json,
    Out,
    Overwrite,
    Quiet,
    Seed,
    check_writable,
    count,
    load_run,
    prepare_directory,
    rows,
    show_table,
    whole_number,
    write_json,
)
from spadwarp.cli.simulate import bytes_needed, described, write_run

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp.validate import CaseResult


@app.command()
def merge(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Results, or the directories they lie in.", show_default=False),
    ],
    out: Out,
    device: Device = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Add runs of one scene and seed that traced different photons.

    The sum is, bit for bit, the run of all the photons at once. Writes what `spadwarp simulate` writes.

    \b
    Example:
      spadwarp simulate configs/scenes/plane_5m.toml --photons 1e8 --out a/
      spadwarp simulate configs/scenes/plane_5m.toml --photons 1e8 --first-photon 1e8 --out b/
      spadwarp merge a/ b/ --out ab/
    """
    result = spadwarp.merge(load_run(place) for place in runs)
    needed = bytes_needed(result.scene, records=False, batches=result.batch_size > 0)
    prepare_directory(out, overwrite=overwrite, needed=needed)
    written, frame = write_run(result, out, device=device)
    if not quiet:
        ids = ", ".join(f"{count(start)} to {count(stop - 1)}" for start, stop in result.photon_ranges)
        say(rows({"photon ids": ids}))
        say(described(result, frame, written))
    write_json({**result.summary(), "photon_ranges": result.photon_ranges, "files": written}, json_path)


@app.command()
def validate(
    cases: Annotated[
        list[str] | None,
        typer.Argument(metavar="CASE", help="Names of cases; all if left out.", show_default=False),
    ] = None,
    photons: Annotated[
        int, typer.Option(parser=whole_number, metavar="N", help="Photons for each scene of a case.")
    ] = 1_000_000,
    seed: Seed = None,
    device: Device = None,
    tabulated: Annotated[
        bool, typer.Option("--tabulated", help="Take Henyey–Greenstein from tables of angle and value.")
    ] = False,
    plots: Annotated[Path | None, typer.Option(metavar="DIR", help="Also draw a picture of each case.")] = None,
    list_cases: Annotated[bool, typer.Option("--list", help="Name the cases and leave.")] = False,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Hold the simulator to physics whose answer is known without it.

    A correct simulator fails once in a thousand runs. Exit code 1 when a value misses its reference.

    \b
    Examples:
      spadwarp validate
      spadwarp validate slab cube60 --photons 1e7 --seed 1 --json report.json --plots plots/
    """
    from spadwarp.validate import CASES, plot_results
    from spadwarp.validate import write_json as write_report

    if list_cases:
        say(rows({case.name: case.about for case in CASES.values()}))
        return
    for place in (plots, None if json_path is None else json_path.parent):
        if place is not None:
            check_writable(place)
    results = spadwarp.validate.validate(
        cases or None,
        photons=photons,
        seed=seed or 0,
        device=device,
        tabulated=tabulated,
        progress=None if quiet else lambda case: complain(f"{case.name}: {case.about}"),
    )
    failed = [result for result in results if not result.passed]
    if json_path is not None:
        write_report(results, json_path, photons=photons, seed=seed or 0)
    drawn = [] if plots is None else plot_results(results, plots)
    if not quiet:
        show_table(_table(results))
        say(f"{len(results) - len(failed)} of {len(results)} agree" + (f"; plots in {plots}" if drawn else ""))
    if failed:
        fail("\n".join(f"{one.name}: {one.quantity}: z = {one.z:.2f}" for one in failed))


def _table(results: Sequence[CaseResult]) -> Table:
    from rich import box
    from rich.table import Table

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
            "[green]ok[/]" if one.passed else "[bold red]FAILED[/]",
        )
        before = one.name
    return table


@app.command()
def targets(
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Directory for targets.png, a sheet of all of them.")
    ] = None,
    device: Device = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """The targets that come along; with --out a sheet with a picture of each.

    A scene takes one by `builtin = "NAME"` in [[targets]].

    \b
    Example:
      spadwarp targets --out pictures/
    """
    from spadwarp.viz.targets import describe_targets, draw_targets

    if out is not None:
        prepare_directory(out, overwrite=overwrite, needed=16 << 20)
    found = describe_targets()
    sheet = None if out is None else draw_targets(out / "targets.png", device=device)
    if not quiet:
        for one in found:
            extent = " x ".join(f"{side:.2f}" for side in one["extent"])
            say(f"{one['name']:<14}  {extent} m  {count(one['faces']):>7} faces")
        if sheet is not None:
            say(f"written: {sheet}")
    write_json({"targets": found, "files": [] if sheet is None else [sheet]}, json_path)
