"""`spadwarp check`, `info`, `presets`, `water` and `devices`: what there is, without running anything."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

import spadwarp
from spadwarp.cli._app import app, say
from spadwarp.cli._options import (
    Json,
    Mesh,
    Overrides,
    Quiet,
    ScenePath,
    arguments_checked,
    count,
    in_bytes,
    load_run,
    read_scene,
    rows,
    write_json,
)


@app.command()
def check(
    scene_path: ScenePath,
    mesh: Mesh = None,
    overrides: Overrides = None,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Validate a scene without running it; warn with numbers.

    Exit code 0 with or without warnings, 2 for a scene that is not valid.

    \b
    Example:
      spadwarp check configs/scenes/harbour_5m.toml --set medium.extinction=2.5
    """
    from spadwarp.checks import summary
    from spadwarp.mesh import build_mesh

    scene = read_scene(scene_path, mesh=mesh, overrides=overrides)
    triangles = build_mesh(scene)
    messages, numbers = spadwarp.check(scene, triangles), summary(scene, triangles)
    faces = 0 if triangles is None else triangles.face_count
    if not quiet:
        say(rows(_derived(numbers, faces)))
        say()
    for message in messages:
        if message.level == "warning" or not quiet:
            say(str(message))
    if not quiet and not any(message.level == "warning" for message in messages):
        say(f"{scene_path}: valid, no warnings")
    found = [dataclasses.asdict(message) for message in messages]
    write_json({"scene": scene_path, "faces": faces, **numbers, "messages": found}, json_path)


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
        "target": f"{between(numbers['target_range'], 'm')}, {count(faces)} faces",
        "optical depth": about(numbers["optical_depth"], "{:.3g} one way"),
        "returns": between(numbers["target_arrival_ns"], "ns"),
        "gate": f"{between(numbers['gate_range'], 'm')}, a bin {1000 * numbers['bin_range']:.3g} mm",
        "unambiguous": f"to {numbers['unambiguous_range']:.4g} m",
        "view": f"{numbers['horizontal_fov_deg']:.3g} x {numbers['vertical_fov_deg']:.3g} degrees",
        "pulse": f"{numbers['photons_per_pulse']:.3g} photons, detected with {100 * numbers['pde']:.3g} % efficiency",
        "signal": about(numbers["signal_per_pulse"], "{:.3g} unscattered detections a pulse in a pixel"),
        "sampling": about(numbers["samples_per_pixel"], "{:.3g} traced photons on what a pixel sees, unscattered"),
        "histograms": in_bytes(numbers["histogram_bytes"]),
    }


@app.command()
def info(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="A result, or the directory it lies in.")],
    json_path: Json = None,
) -> None:
    """What is in a result, and how it was made.

    With the energy ledger: where the emitted light went.

    \b
    Example:
      spadwarp info out/result.h5
    """
    result = load_run(path)
    summary = result.summary()
    outside = {name: result.counters[name] * result.unit / result.photons for name in ("before_gate", "after_gate")}
    say("\n\n".join(f"{title}\n{rows(lines, indent='  ')}" for title, lines in _told(summary, outside).items()))
    write_json(summary, json_path)


def _told(summary: Mapping[str, Any], outside: Mapping[str, float]) -> dict[str, dict[str, str]]:
    """A result's summary by headings."""
    image, gate, medium, made = summary["image"], summary["gate"], summary["medium"], summary["provenance"]
    depth, ledger, timing = summary["truth"]["depth_m"], summary["ledger"], summary["timing"]
    fractions, counters = ledger["fractions"], summary["counters"]
    photons = count(summary["photons"]) + (", stopped early" if summary["partial"] else "")
    water = ", ".join(f"{name.replace('_', ' ')} {_number(value)}" for name, value in medium.items())
    collected = {name.replace("_", "-"): f"{part:.4g}" for name, part in summary["collected_fraction"].items()}
    collected |= {f"({name.replace('_', ' the ')})": f"{part:.4g}" for name, part in outside.items()}
    return {
        "Result": {
            "photons": f"{photons}, seed {summary['seed']}",
            "image": f"{image['width']} x {image['height']} pixels x {gate['bins']} bins of {gate['bin_width_ps']:.5g} "
            f"ps from {gate['start_ns']:.5g} ns (path {gate['path_m'][0]:.4g} to {gate['path_m'][1]:.4g} m)",
            "water": water,
            "truth": f"{summary['truth']['pixels']} pixels"
            + (f", {depth[0]:.4g} to {depth[1]:.4g} m" if depth else ""),
            "returns": f"in {summary['pixels_with_return']} pixels, {summary['detections_per_pulse']:.4g} detections a "
            "pulse",
        },
        "Collected, as fractions of the emitted light": collected,
        f"Energy ledger, {'exact' if ledger['exact'] else 'off by ' + str(ledger['difference']) + ' units'}": {
            name: f"{100 * part:10.6f} %" for name, part in fractions.items() if part
        }
        | {"sum": f"{100 * sum(fractions.values()):10.6f} %"},
        "Counted": {name: count(number) for name, number in counters.items() if name not in outside},
        "Made": {
            "from": summary["scene"] or "Python",
            "on": f"{made['device']} ({made['device_name']}), {made['date']}"
            + (f", the first of {len(made['parts'])} parts" if "parts" in made else ""),
            "with": ", ".join(f"{name} {made[name]}" for name in ("spadwarp", "warp", "numpy", "python")),
            "in": ", ".join(f"{name} {seconds:.3g} s" for name, seconds in timing.items()),
        },
    }


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@app.command()
def presets(
    section: Annotated[
        str | None,
        typer.Argument(metavar="SECTION", help="medium, laser, camera, detector or gate; all if left out."),
    ] = None,
    json_path: Json = None,
) -> None:
    """Named waters, lasers and detectors with their sources.

    Cameras and gates too. A scene takes one by `preset = "NAME"` in the section of that name.
    The waters are for about 532 nm; `spadwarp water` has other wavelengths.

    \b
    Example:
      spadwarp presets medium
    """
    everything = spadwarp.presets()
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
    write_json({"presets": [dataclasses.asdict(preset) for preset in chosen]}, json_path)


@app.command()
def water(
    wavelength_nm: Annotated[float, typer.Argument(metavar="NM", help="Vacuum wavelength, 400 to 700 [nm].")],
    chlorophyll: Annotated[float, typer.Option(metavar="C", help="0 (pure water) to 30 [mg/m3].")] = 0.0,
    temperature: Annotated[float, typer.Option(metavar="T", help="0 to 30 [degrees Celsius].")] = 20.0,
    salinity: Annotated[float, typer.Option(metavar="S", help="0 (fresh) to 40 [g/kg].")] = 35.0,
    json_path: Json = None,
) -> None:
    """Absorption, scattering and indices of water at a wavelength.

    What a scene gets by medium.chlorophyll, temperature and salinity.

    \b
    Example:
      spadwarp water 532 --chlorophyll 0.5 --temperature 10 --salinity 35
    """
    with arguments_checked():
        optics = spadwarp.water_optics(
            wavelength_nm, chlorophyll=chlorophyll, temperature=temperature, salinity=salinity
        )
    say(
        rows(
            {
                "absorption": f"{optics.absorption:.4g} 1/m, of pure water {optics.water_absorption:.4g}",
                "scattering": f"{optics.scattering:.4g} 1/m, of pure water {optics.water_scattering:.4g}",
                "extinction": f"{optics.extinction:.4g} 1/m, attenuation length {1.0 / optics.extinction:.4g} m",
                "albedo": f"{optics.albedo:.4g}",
                "phase index": f"{optics.phase_index:.5f}",
                "group index": f"{optics.group_index:.5f}",
            }
        )
    )
    asked = {"chlorophyll": chlorophyll, "temperature": temperature, "salinity": salinity}
    write_json({**asked, **dataclasses.asdict(optics), "extinction": optics.extinction}, json_path)


@app.command()
def devices(json_path: Json = None) -> None:
    """Where photons can be traced: the CPU and the GPUs.

    \b
    Example:
      spadwarp devices
    """
    found = spadwarp.devices()
    for device in found:
        memory = f", {in_bytes(device['memory'])}" if device["memory"] else ""
        say(f"{device['name']:<8}  {device['description']}{memory}" + ("  (default)" if device["default"] else ""))
    if len(found) == 1:
        say("no NVIDIA GPU with driver R580 or newer is seen")
    write_json({"devices": found}, json_path)
