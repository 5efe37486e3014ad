"""`spadwarp targets`: the built-in targets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say

if TYPE_CHECKING:
    pass


@app.command()
def targets(
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Directory for targets.png, a sheet of all of them.")
    ] = None,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """The built-in targets; with --out a sheet with a picture of each.

    A scene selects one by `builtin = "NAME"` in [[targets]].

    \b
    Example:
      spadwarp targets --out pictures/
    """
    from spadwarp.viz import describe_targets, draw_targets

    if out is not None:
        opt.prepare_directory(out, overwrite=overwrite, needed=16 << 20)
    found = describe_targets()
    sheet = None if out is None else draw_targets(out / "targets.png", device=device)
    if not quiet:
        for one in found:
            extent = " x ".join(f"{side:.2f}" for side in one["extent"])
            say(f"{one['name']:<14}  {extent} m  {opt.count(one['faces']):>7} faces")
        if sheet is not None:
            say(f"written: {sheet}")
    opt.write_json({"targets": found, "files": [] if sheet is None else [sheet]}, json_path)
