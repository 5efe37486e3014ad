"""`spadwarp examples`: scenes and recipes that come with the package."""

from __future__ import annotations

from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say
from spadwarp.limits import suggestion

KINDS = {
    "scenes": "spadwarp simulate NAME",
    "datasets": "spadwarp dataset make NAME",
    "training": "spadwarp train NAME",
}


@app.command()
def examples(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Print this one.", show_default=False)] = None,
    overwrite: opt.Overwrite = False,
    json_path: opt.Json = None,
) -> None:
    """Scenes and recipes that come with spadwarp; commands take them by name.

    \b
    Examples:
      spadwarp examples
      spadwarp examples staircase_5m
      spadwarp simulate staircase_5m --photons 1e6 --out out/
    """
    outputs = opt.check_outputs(json=json_path, overwrite=overwrite)
    known = {kind: spadwarp.io.examples(kind) for kind in KINDS}
    if name is not None:
        found = [paths[name] for paths in known.values() if name in paths]
        if not found:
            hint = suggestion(name, [one for paths in known.values() for one in paths])
            raise typer.BadParameter(f"{name!r} is not one of `spadwarp examples`{hint}", param_hint="NAME")
        for path in found:
            say(path.read_text(encoding="utf-8").rstrip())
        return
    for kind, paths in known.items():
        say(f"{kind}: {KINDS[kind]}")
        say(opt.rows({one: _heading(path.read_text(encoding="utf-8")) for one, path in paths.items()}, indent="  "))
    outputs.write_json(known)


def _heading(text: str) -> str:
    """The first sentence of a file's comment."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("# ") or line.startswith("#   "):
            break
        lines.append(line[2:])
    return " ".join(lines)
