"""`spadwarp presets`: named waters, lasers, cameras, detectors and gates."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say


@app.command()
def presets(
    section: Annotated[
        str | None,
        typer.Argument(metavar="SECTION", help="medium, laser, camera, port, detector or gate; all if left out."),
    ] = None,
    overwrite: opt.Overwrite = False,
    json_path: opt.Json = None,
) -> None:
    """Named waters, lasers, cameras, ports, detectors and gates with their sources.

    A scene selects one by `preset = "NAME"` in the section of that name.
    The waters are for about 532 nm; `spadwarp water` computes other wavelengths.

    \b
    Example:
      spadwarp presets medium
    """
    outputs = opt.check_outputs(json=json_path, overwrite=overwrite)
    everything = spadwarp.scene.presets()
    sections = list(dict.fromkeys(preset.section for preset in everything.values()))
    if section is not None and section not in sections:
        raise typer.BadParameter(f"{section!r} is not one of {', '.join(sections)}", param_hint="SECTION")
    chosen = [preset for preset in everything.values() if section in (None, preset.section)]
    source = None
    for preset in chosen:
        if (preset.section, preset.source) != source:
            say(f"{'' if source is None else chr(10)}[{preset.section}] {preset.source}")
            source = (preset.section, preset.source)
        shown = {name: f"{value:.5g}" if isinstance(value, float) else value for name, value in preset.values.items()}
        values = ", ".join(f"{name} {value}" for name, value in shown.items())
        say(f"  {preset.name:<28}  {values}")
    outputs.write_json({"presets": [dataclasses.asdict(preset) for preset in chosen]})
