"""`spadwarp targets`: the built-in targets, and mesh files before they stand in a scene."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say

if TYPE_CHECKING:
    from spadwarp.mesh import MeshSummary


@app.command()
def targets(
    meshes: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FILE]...", help="Mesh files (STL, OBJ, PLY, OFF, GLB, USD) to look at instead."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Directory for pictures: targets.png, or NAME.png of each mesh.")
    ] = None,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """The built-in targets, or what mesh files hold: size, unit, orientation, closedness.

    A scene selects a built-in target by `builtin = "NAME"` in [[targets]], a file by `mesh = "FILE"`. With --out also
    pictures.

    \b
    Examples:
      spadwarp targets --out pictures/
      spadwarp targets bust.stl --out pictures/
    """
    names = [f"{path.stem}.png" for path in meshes or ()] or ["targets.png"]
    options: dict[str, Any] = {"inputs": meshes or (), "overwrite": overwrite, "needed": 16 << 20}
    outputs = opt.check_outputs(out, names, json=json_path, **options)
    if meshes:
        _show_meshes(meshes, out, device, quiet, outputs)
        return
    from spadwarp.viz import describe_targets, draw_targets

    found = describe_targets()
    sheet = None if out is None else draw_targets(out / "targets.png", device=device)
    if not quiet:
        for one in found:
            extent = " x ".join(f"{side:.2f}" for side in one["extent"])
            say(f"{one['name']:<14}  {extent} m  {opt.count(one['faces']):>7} faces")
        if sheet is not None:
            say(f"written: {sheet}")
    outputs.write_json({"targets": found, "files": [] if sheet is None else [sheet]})


def _show_meshes(meshes: list[Path], out: Path | None, device: str | None, quiet: bool, outputs: opt.Outputs) -> None:
    from spadwarp.mesh import describe_mesh
    from spadwarp.viz import draw_mesh

    found = [describe_mesh(path) for path in meshes]
    pictures = [] if out is None else [draw_mesh(one, out / f"{one.path.stem}.png", device=device) for one in found]
    if not quiet:
        for one in found:
            say(opt.rows(_lines(one)))
        for picture in pictures:
            say(f"written: {picture}")
    summary = [{**dataclasses.asdict(one), "hints": one.hints} for one in found]
    outputs.write_json({"meshes": summary, "files": pictures})


def _lines(mesh: MeshSummary) -> dict[str, str]:
    unit = f"probably {mesh.unit}" if mesh.unit else "unknown"
    surface = "closed" if mesh.is_watertight else "not closed"
    surface += ", wound inwards (which makes no difference here)" if mesh.is_inside_out else ""
    parts = f", {mesh.bodies} parts" if mesh.bodies > 1 else ""
    return {
        str(mesh.path): f"{opt.count(mesh.faces)} faces{parts}, {surface}",
        "  size": " x ".join(f"{side:.4g}" for side in mesh.extent) + " along x (right), y (down), z (away)",
        "  unit": f"{unit}; a scene takes metres: scale = {mesh.scale:g}",
        "  centre": ", ".join(f"{place:.4g}" for place in mesh.centre),
        **{f"  {number})": hint for number, hint in enumerate(mesh.hints, 1)},
    }
