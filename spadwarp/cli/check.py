"""`spadwarp check`: what may be wrong with a scene, without running it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say
from spadwarp.units import with_prefix


@app.command()
def check(
    scene_path: opt.ScenePath,
    mesh: opt.Mesh = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the water cut open, with laser, camera and targets."),
    ] = None,
    overrides: opt.Overrides = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Validate a scene without running it; warn with numbers.

    Exit code 0 with or without warnings, 2 for a scene that is not valid.

    \b
    Examples:
      spadwarp check configs/scenes/harbour_5m.toml --set medium.extinction=2.5
      spadwarp check sediment_4m --picture water.png
    """
    from spadwarp.checks import summary
    from spadwarp.mesh import build_mesh

    scene = opt.read_scene(scene_path, mesh=mesh, overrides=overrides)
    outputs = opt.check_outputs(
        files={"--picture": picture}, json=json_path, inputs=(scene_path, *scene.files), overwrite=overwrite
    )
    triangles = build_mesh(scene)
    messages, numbers = spadwarp.check(scene, triangles), summary(scene, triangles)
    faces = 0 if triangles is None else triangles.face_count
    if not quiet:
        say(opt.rows(_derived(numbers, faces)))
        say()
    for message in messages:
        if message.level == "warning" or not quiet:
            say(str(message))
    if not quiet and not any(message.level == "warning" for message in messages):
        say(f"{scene_path}: valid, no warnings")
    if picture is not None:
        spadwarp.viz.draw_water(scene, picture, triangles)
        if not quiet:
            say(f"written: {picture}")
    found = [dataclasses.asdict(message) for message in messages]
    outputs.write_json({"scene": scene_path, "faces": faces, **numbers, "messages": found})


def _derived(numbers: Mapping[str, Any], faces: int) -> dict[str, str]:
    """What follows from a scene, for people."""

    def between(pair: tuple[float, float] | None, unit: str) -> str:
        return "none in the view and the beam" if pair is None else f"{pair[0]:.5g} to {pair[1]:.5g} {unit}"

    def about(value: float | None, text: str) -> str:
        return "-" if value is None else text.format(value)

    return {
        "attenuation length": "; ".join(
            f"{water['attenuation_length']:.4g} m, albedo {water['albedo']:.3g}"
            + (f" from {water['start']:.4g} m on" if "start" in water else "")
            for water in (numbers, *numbers["layers"])
        ),
        **_grid(numbers["grid"]),
        "target": f"{between(numbers['target_range'], 'm')}, {opt.count(faces)} faces",
        "optical depth": about(numbers["optical_depth"], "{:.3g} one way"),
        "returns": between(numbers["target_arrival_ns"], "ns"),
        "gate": f"{between(numbers['gate_range'], 'm')}, a bin {1000 * numbers['bin_range']:.3g} mm",
        "unambiguous": f"to {numbers['unambiguous_range']:.4g} m",
        "focus": "all depths" if numbers["focus_distance"] is None else f"{numbers['focus_distance']:.4g} m",
        "view": f"{numbers['horizontal_fov_deg']:.3g} x {numbers['vertical_fov_deg']:.3g} degrees",
        "laser": f"{numbers['photons_per_pulse']:.3g} photons a pulse, {with_prefix(numbers['average_power'], 'W')} on "
        f"average, {with_prefix(numbers['peak_power'], 'W')} at the peak",
        "irradiance": about(numbers["irradiance"], "{:.3g} W/m² unscattered at the target, mean over time"),
        "photons": about(numbers["photons_per_pixel"], "{:.3g} unscattered ones a pulse arrive in a pixel")
        + f"; detection efficiency {100 * numbers['pde']:.3g} %",
        "signal": about(numbers["signal_per_pulse"], "{:.3g} unscattered detections a pulse in a pixel"),
        "sampling": about(numbers["samples_per_pixel"], "{:.3g} traced photons on what a pixel sees, unscattered"),
        "histograms": opt.in_bytes(numbers["histogram_bytes"]),
    }


def _grid(numbers: Mapping[str, Any] | None) -> dict[str, str]:
    """The row about cells of water."""
    if numbers is None:
        return {}
    counts = " x ".join(map(str, numbers["cells"]))
    edges = " x ".join(f"{edge:.3g}" for edge in numbers["size"])
    low, high = numbers["extinction"]
    text = f"{counts} cells in {edges} m, c = {low:.3g} to {high:.3g} 1/m, {opt.in_bytes(numbers['bytes'])}"
    return {"grid": f"{text}; optical depth {numbers['optical_depth']:.3g} along the axis through its box"}
