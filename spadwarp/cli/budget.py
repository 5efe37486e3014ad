"""`spadwarp budget`: photons, signal to background and depth error over range and water."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say
from spadwarp.cli._tables import budget_table, table_notes
from spadwarp.errors import ArgumentError
from spadwarp.limits import shown


@app.command()
def budget(
    scene_path: opt.ScenePath,
    ranges: Annotated[
        str | None,
        typer.Option("--range", metavar="FROM:TO:N", help="Ranges [m]; also a,b,c. By default 1 to 50 m."),
    ] = None,
    media: Annotated[
        list[str] | None,
        typer.Option("--medium", metavar="NAME", help="A named water; may be repeated. By default the scene's."),
    ] = None,
    reflectance: Annotated[
        float | None,
        typer.Option(parser=opt.real_number, metavar="X", help="Of the surface; by default that of the first target."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Directory for budget.png and budget.csv.")] = None,
    overrides: opt.Overrides = None,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Photon budget of a surface on the optical axis.

    Signal and background per pulse and pixel, depth error, and pulses for a depth error of 1 cm, over range and water,
    from the analytic model. Depth errors are those of one depth frame, of so many pulses as the table shows:
    analytic.pulses_per_depth_frame if given, else detector.pulses_per_frame. In brackets they are not reached: more
    than 1 % of the fits would find a false peak. Where a return misses the scene's gate, gates as long follow the
    returns, marked *.

    \b
    Example:
      spadwarp budget configs/scenes/harbour_5m.toml --range 1:10:10 --medium petzold-nuc-2240 --medium uwoc-clear
    """
    from spadwarp.viz import draw_budget

    scene = opt.read_scene(scene_path, mesh=None, overrides=overrides)
    outputs = opt.check_outputs(
        out,
        ("budget.png", "budget.csv"),
        json=json_path,
        inputs=(scene_path, *scene.files),
        overwrite=overwrite,
        needed=16 << 20,
    )
    found = spadwarp.budget(scene, _numbers(ranges), media or None, reflectance=reflectance, device=device)
    written = []
    if out is not None:
        draw_budget(found, out / "budget.png")
        written = [
            out / "budget.png",
            spadwarp.io.write_csv([dataclasses.asdict(row) for row in found], out / "budget.csv"),
        ]
    if not quiet:
        opt.show_table(budget_table([row.medium for row in found], "water", found), keys=2)
        for text in table_notes(found, scene):
            say(text)
        if written:
            say(f"written: {', '.join(path.name for path in written)} in {out}")
    rows = [dataclasses.asdict(row) for row in found]
    outputs.write_json({"rows": rows, "notes": spadwarp.analytic.model_notes(scene), "files": written})


def _numbers(text: str | None) -> list[float] | None:
    from spadwarp.analytic import parse_values

    if text is None:
        return None
    lengths = [part.strip() for part in (text.split(":")[:2] if ":" in text else text.split(","))]
    if len({part[-1:] in "0123456789." for part in lengths}) > 1:
        raise ArgumentError(f"--range = {shown(text)} is ambiguous: write the unit of all lengths, or of none")
    values = parse_values(text, "m", name="--range")
    if not all(isinstance(value, (int, float)) for value in values):
        raise ArgumentError(f"--range = {shown(text)} is not of the form from:to:count or a,b,c")
    return [float(value) for value in values]
