"""`spadwarp schema`: JSON Schema of scenes and recipes, for editors."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say


class Kind(enum.StrEnum):
    """Kinds of TOML files."""

    scene = "scene"
    dataset = "dataset"
    training = "training"


@app.command()
def schema(
    kind: Annotated[Kind, typer.Argument(help="What the TOML file holds.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File to write, by default KIND.schema.json.")
    ] = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
    """JSON Schema of a scene or a recipe, so that editors complete and check TOML.

    VS Code reads it with the extension Even Better TOML, other editors with taplo.

    \b
    Example:
      spadwarp schema scene
    """
    path = out or Path(f"{kind.value}.schema.json")
    opt.check_outputs(files={"--out": path}, overwrite=overwrite)
    if kind is Kind.scene:
        model: Any = spadwarp.Scene
    else:
        model = spadwarp.dataset.Recipe if kind is Kind.dataset else spadwarp.denoise.TrainingRecipe
    spadwarp.io.write_json(spadwarp.files.json_schema(model), path)
    if not quiet:
        place = path if path.is_absolute() or path.parent.parts else f"./{path}"
        say(f"written: {path}")
        say("VS Code, once:")
        say("  code --install-extension tamasfe.even-better-toml")
        say("first line of a TOML file beside it, for VS Code and taplo:")
        say(f"  #:schema {place}")
