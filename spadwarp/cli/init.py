"""`spadwarp init`: a scene to start from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say


@app.command()
def init(
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="The scene file to write, with or without .toml.")] = (
        "scene"
    ),
    example: Annotated[
        str | None, typer.Option(metavar="EXAMPLE", help="A scene of `spadwarp examples` instead of the template.")
    ] = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
    """Write a commented scene to start from.

    \b
    Examples:
      spadwarp init
      spadwarp init my_harbour --example harbour_5m
    """
    path = Path(name if name.endswith(".toml") else f"{name}.toml")
    opt.check_outputs(files={"NAME": path}, overwrite=overwrite)
    out = f"{path.with_suffix('')}/"
    if example is None:
        text = spadwarp.scene.template().replace("out/", out).replace(" scene.toml", f" {path}")
    else:
        text = spadwarp.io.example_or_path(example, "scenes").read_text(encoding="utf-8")
    spadwarp.io.write_text(text, path)
    if not quiet:
        say(f"written: {path}")
        say(f"next: spadwarp check {path}; spadwarp plan {path}; spadwarp simulate {path} --out {out}")
