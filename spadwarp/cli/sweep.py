"""`spadwarp sweep`: budget or depth error over any field of the scene."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp import Scene
    from spadwarp.analytic import DepthErrorRow
from spadwarp.cli._tables import budget_table, new_table, percent, short, table_notes


class Quantity(enum.StrEnum):
    """Quantities of `spadwarp.sweep`."""

    budget = "budget"
    depth_error = "depth-error"


@app.command()
def sweep(
    scene_path: opt.ScenePath,
    vary: Annotated[
        str,
        typer.Option(metavar="FIELD=FROM:TO:N", help="Field and values; with :log a geometric progression; or a,b,c."),
    ],
    out: opt.Out,
    of: Annotated[
        Quantity, typer.Option(help="Budget of the central pixel, or depth error of all pixels.")
    ] = Quantity.budget,
    mesh: opt.Mesh = None,
    overrides: opt.Overrides = None,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Curves over any field of the scene, from the analytic model.

    Writes sweep.png and sweep.csv. FIELD may be an item of a list, and values may have units. Pulses of a depth frame
    and gates as in `spadwarp budget`.

    \b
    Examples:
      spadwarp sweep configs/scenes/staircase_5m.toml --vary 'targets[0].translation[2]=3:8:11' --out sweep/
      spadwarp sweep configs/scenes/staircase_5m.toml --vary medium.extinction=0.1:2:20 --of depth-error --out sweep/
    """
    from spadwarp.viz import draw_sweep

    scene: Scene = opt.read_scene(scene_path, mesh=mesh, overrides=overrides)
    outputs = opt.check_outputs(
        out,
        ("sweep.png", "sweep.csv"),
        json=json_path,
        inputs=(scene_path, mesh, *scene.files),
        overwrite=overwrite,
        needed=16 << 20,
    )
    curves = spadwarp.sweep(scene, vary=vary, of=of.value, device=device)
    draw_sweep(curves, out / "sweep.png")
    values, some = list(curves.values), list[Any](curves.rows)
    found = [dataclasses.asdict(row) for row in some]
    table = [{curves.field: value, **row} for value, row in zip(values, found, strict=True)]
    written = [out / "sweep.png", spadwarp.io.write_csv(table, out / "sweep.csv")]
    if not quiet:
        names = [f"{value:.5g}" if isinstance(value, float) else str(value) for value in values]
        opt.show_table(
            budget_table(names, curves.field, some)
            if of is Quantity.budget
            else _error_table(names, curves.field, some),
            keys=2 if of is Quantity.budget else 1,
        )
        if of is Quantity.budget:
            for text in table_notes(some, scene):
                say(text)
        say(f"written: {', '.join(path.name for path in written)} in {out}")
    notes = spadwarp.analytic.model_notes(scene)
    outputs.write_json(
        {"field": curves.field, "values": values, "of": of.value, "rows": found, "notes": notes, "files": written}
    )


def _error_table(names: Sequence[str], title: str, found: Sequence[DepthErrorRow]) -> Table:
    table = new_table(
        title, "σ* median [mm]", "σ* 90 % below [mm]", "outliers", "pixels with an estimate", "signal/backscatter"
    )
    for name, row in zip(names, found, strict=True):
        table.add_row(
            name,
            short(1e3 * row.sigma_depth),
            short(1e3 * row.sigma_depth_p90),
            percent(row.outlier_probability),
            percent(row.estimate_fraction),
            short(row.signal_to_backscatter),
        )
    return table
