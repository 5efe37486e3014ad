"""`spadwarp analytic`, `budget` and `sweep`: what a scene gives back, without tracing photons."""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import spadwarp
from spadwarp.cli._app import app, say
from spadwarp.cli._options import (
    Device,
    Json,
    Mesh,
    Out,
    Overrides,
    Overwrite,
    Quiet,
    ScenePath,
    arguments_checked,
    count,
    load_run,
    prepare_directory,
    read_scene,
    rows,
    show_table,
    whole_number,
    write_json,
)
from spadwarp.errors import ArgumentError

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp import AnalyticResult, Scene, Truth
    from spadwarp.analytic.budget import BudgetRow, DepthErrorRow


class Exporter(enum.StrEnum):
    """`spadwarp.result.result.rendered_truth.EXR_PRESETS`, known without loading it."""

    unreal = "unreal"
    blender = "blender"


class Quantity(enum.StrEnum):
    """What `spadwarp.sweep` can be of."""

    budget = "budget"
    depth_error = "depth-error"


@app.command()
def analytic(
    scene_path: ScenePath,
    out: Out,
    frames: Annotated[int, typer.Option(parser=whole_number, metavar="N", help="Depth frames to draw.")] = 1,
    seed: Annotated[int, typer.Option(parser=whole_number, metavar="N", help="Key of the random numbers.")] = 0,
    mesh: Mesh = None,
    overrides: Overrides = None,
    depth: Annotated[
        Path | None, typer.Option(metavar="EXR", help="Depth that a program rendered, in place of the scene's targets.")
    ] = None,
    depth_channel: Annotated[str | None, typer.Option(metavar="NAME", help="Its channel; the preset's.")] = None,
    depth_scale: Annotated[
        float | None, typer.Option(metavar="M", help="Metres per unit of depth; the preset's (unreal: 0.01).")
    ] = None,
    radial: Annotated[
        bool, typer.Option("--radial", help="Depth is the distance from the camera, not planar.")
    ] = False,
    normal: Annotated[
        Path | None, typer.Option(metavar="EXR", help="World normals; else surfaces face the camera.")
    ] = None,
    albedo: Annotated[
        str | None, typer.Option(metavar="EXR|X", help="Diffuse reflectance: a file, or one number (0.5).")
    ] = None,
    albedo_channel: Annotated[str | None, typer.Option(metavar="NAME", help="Its channel; the preset's.")] = None,
    exr_preset: Annotated[Exporter, typer.Option(help="Program that wrote the EXR files.")] = Exporter.unreal,
    profile: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="Result of the same scene whose backscatter is taken; analytic.backscatter = monte_carlo.",
        ),
    ] = None,
    device: Device = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Depth frames by the paper's analytic model.

    From the scene's targets, or from what a game engine or Blender rendered with the scene's camera. Writes analytic.h5
    (maps, frames and which of their pixels are stray) and analytic.png.

    \b
    Examples:
      spadwarp analytic configs/scenes/staircase_15m.toml --frames 1000 --out frames/
      spadwarp analytic scene.toml --depth cat_RGBD.EXR --depth-channel A --depth-scale 0.01 \\
          --normal cat_Surf_Norm.EXR --albedo cat_Base_Col.EXR --out cat/
    """
    from spadwarp.viz.frames import draw_analytic

    scene = read_scene(scene_path, mesh=mesh, overrides=overrides)
    given = {
        "--depth-channel": depth_channel,
        "--depth-scale": depth_scale,
        "--radial": radial or None,
        "--normal": normal,
        "--albedo": albedo,
        "--albedo-channel": albedo_channel,
    }
    if depth is None and (useless := [name for name, value in given.items() if value is not None]):
        raise typer.BadParameter("go with --depth", param_hint=", ".join(useless))
    if profile is not None and scene.analytic.backscatter != "monte_carlo":
        raise typer.BadParameter(
            f"needs --set analytic.backscatter=monte_carlo; the scene's is {scene.analytic.backscatter!r}",
            param_hint="--profile",
        )
    pixels = scene.camera.width * scene.camera.height
    prepare_directory(out, overwrite=overwrite, needed=(5 * max(frames, 0) + 200) * pixels + (16 << 20))
    with arguments_checked():
        if frames < 0:
            raise ArgumentError(f"frames = {frames} is outside [0, inf)")
        truth: Truth | None = None
        if depth is not None:
            truth = spadwarp.load_truth_exr(
                depth=depth,
                camera=scene.camera,
                preset=exr_preset.value,
                depth_channel=depth_channel,
                depth_scale=depth_scale,
                radial=radial,
                normal=normal,
                albedo=_albedo(albedo),
                albedo_channel=albedo_channel,
            )
        result = spadwarp.simulate_analytic(
            scene,
            truth=truth,
            frames=min(frames, 1),
            seed=seed,
            device=device,
            backscatter_profile=None if profile is None else load_run(profile),
        )
    written = [result.save(out / "analytic.h5", frames=frames, device=device)]
    written.append(draw_analytic(result, out / "analytic.png"))
    summary = {"frames": frames, "seed": seed, **_summary(result)}
    if not quiet:
        say(rows({**_told(summary), "written": ", ".join(path.name for path in written) + f" in {out}"}))
    write_json({**summary, "files": written}, json_path)


def _albedo(text: str | None) -> Path | float:
    """A number, or the path of a file."""
    try:
        return 0.5 if text is None else float(text)
    except ValueError:
        return Path(str(text))


def _summary(result: AnalyticResult) -> dict[str, Any]:
    import numpy as np

    def median(values: Any) -> float:
        return float(np.median(values[there])) if there.any() else math.nan

    there = result.fisher > 0
    return {
        "pixels": int(there.size),
        "pixels_with_target": int(np.isfinite(result.truth.depth).sum()),
        "pixels_with_estimate": int(there.sum()),
        "signal": median(result.signal),
        "backscatter": median(result.backscatter),
        "alpha": median(result.alpha),
        "signal_to_backscatter": median(result.signal_to_backscatter),
        "sigma_time": median(result.sigma_time),
        "sigma_depth": median(result.sigma_depth),
        "outlier_probability": float(result.outlier_probability[there].mean()) if there.any() else math.nan,
        "background_probability": float(result.background_probability[there].mean()) if there.any() else math.nan,
    }


def _told(summary: dict[str, Any]) -> dict[str, str]:
    return {
        "pixels": f"{count(summary['pixels'])}, {count(summary['pixels_with_target'])} see a target, "
        f"{count(summary['pixels_with_estimate'])} have an estimate; medians of these:",
        "signal": f"{summary['signal']:.3g} detections a pulse, backscatter {summary['backscatter']:.3g}, "
        f"all together {summary['alpha']:.3g}",
        "signal to backscatter": f"{summary['signal_to_backscatter']:.3g}",
        "bound": f"{1e12 * summary['sigma_time']:.3g} ps, {1e3 * summary['sigma_depth']:.3g} mm of depth",
        "outliers": f"{_percent(summary['outlier_probability'])} of the fits would find a false peak",
        "frames": f"{count(summary['frames'])}, seed {summary['seed']}, "
        f"{_percent(summary['background_probability'])} of their pixels report background",
    }


@app.command()
def budget(
    scene_path: ScenePath,
    ranges: Annotated[
        str | None,
        typer.Option("--range", metavar="FROM:TO:N", help="Ranges [m]; also a,b,c. By default 1 to 50 m."),
    ] = None,
    media: Annotated[
        list[str] | None,
        typer.Option("--medium", metavar="NAME", help="A named water; may be repeated. By default the scene's."),
    ] = None,
    reflectance: Annotated[
        float | None, typer.Option(metavar="X", help="Of the face; by default that of the scene's first target.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Directory for budget.png and budget.csv.")] = None,
    overrides: Overrides = None,
    device: Device = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """What comes back from a face on the optical axis.

    Signal and background per pulse and pixel, depth error, pulses for 1 cm; over range and water, from the analytic
    model. Depth errors in brackets are not reached: more than 1 % of the fits would find a false peak.

    \b
    Example:
      spadwarp budget configs/scenes/harbour_5m.toml --range 1:10:10 --medium petzold-nuc-2240 --medium uwoc-clear
    """
    from spadwarp.analytic.budget import plot_budget

    scene = read_scene(scene_path, mesh=None, overrides=overrides)
    if out is not None:
        prepare_directory(out, overwrite=overwrite, needed=16 << 20)
    with arguments_checked():
        found = spadwarp.budget(scene, _numbers(ranges), media or None, reflectance=reflectance, device=device)
    written = []
    if out is not None:
        plot_budget(found, out / "budget.png")
        written = [out / "budget.png", _write_csv(out / "budget.csv", [dataclasses.asdict(row) for row in found])]
    if not quiet:
        show_table(_budget_table([row.medium for row in found], "water", found))
        if written:
            say(f"written: {', '.join(path.name for path in written)} in {out}")
    write_json({"rows": [dataclasses.asdict(row) for row in found], "files": written}, json_path)


def _numbers(text: str | None) -> list[float] | None:
    from spadwarp.analytic.budget import parse_vary

    if text is None:
        return None
    _, values = parse_vary(f"range={text}")
    if not all(isinstance(value, (int, float)) for value in values):
        raise ArgumentError(f"range = {text!r} is not of the form from:to:count or a,b,c")
    return [float(value) for value in values]


@app.command()
def sweep(
    scene_path: ScenePath,
    vary: Annotated[
        str,
        typer.Option(metavar="FIELD=FROM:TO:N", help="Field and values; :log for a geometric progression; or a,b,c."),
    ],
    out: Out,
    of: Annotated[Quantity, typer.Option(help="Budget of the central pixel, or depth error of all.")] = Quantity.budget,
    mesh: Mesh = None,
    overrides: Overrides = None,
    device: Device = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Curves over any field of the scene, from the analytic model.

    Writes sweep.png and sweep.csv.

    \b
    Example:
      spadwarp sweep configs/scenes/staircase_5m.toml --vary medium.extinction=0.1:2:20 --of depth-error --out sweep/
    """
    from spadwarp.analytic.budget import plot_sweep

    scene: Scene = read_scene(scene_path, mesh=mesh, overrides=overrides)
    prepare_directory(out, overwrite=overwrite, needed=16 << 20)
    with arguments_checked():
        curves = spadwarp.sweep(scene, vary=vary, of=of.value, device=device)
    plot_sweep(curves, out / "sweep.png")
    values, some = list(curves.values), list[Any](curves.rows)
    found = [dataclasses.asdict(row) for row in some]
    table = [{curves.field: value, **row} for value, row in zip(values, found, strict=True)]
    written = [out / "sweep.png", _write_csv(out / "sweep.csv", table)]
    if not quiet:
        names = [f"{value:.5g}" if isinstance(value, float) else str(value) for value in values]
        show_table(
            _budget_table(names, curves.field, some)
            if of is Quantity.budget
            else _error_table(names, curves.field, some)
        )
        say(f"written: {', '.join(path.name for path in written)} in {out}")
    write_json({"field": curves.field, "values": values, "of": of.value, "rows": found, "files": written}, json_path)


def _budget_table(names: Sequence[str], title: str, found: Sequence[BudgetRow]) -> Table:
    from spadwarp.analytic.budget import OUTLIERS

    table = _table(
        title,
        "range [m]",
        "c·r",
        "signal",
        "background",
        "α",
        "S/B",
        "σ* [ps]",
        "σ* [mm]",
        "outliers",
        "pulses for 1 cm",
    )
    before = None
    for name, row in zip(names, found, strict=True):
        reached = row.outlier_probability <= OUTLIERS
        table.add_row(
            name if name != before else "",
            f"{row.range:.4g}",
            f"{row.optical_depth:.3g}",
            f"{row.signal:.3g}",
            f"{row.background:.3g}",
            f"{row.alpha:.3g}",
            _short(row.signal_to_backscatter),
            _bracketed(1e12 * row.sigma_time, reached),
            _bracketed(1e3 * row.sigma_depth, reached),
            _percent(row.outlier_probability),
            "never" if math.isinf(row.pulses_for_1cm) else f"{row.pulses_for_1cm:.3g}",
        )
        before = name
    return table


def _error_table(names: Sequence[str], title: str, found: Sequence[DepthErrorRow]) -> Table:
    table = _table(title, "σ* median [mm]", "σ* 90 % below [mm]", "outliers", "pixels with an estimate", "S/B")
    for name, row in zip(names, found, strict=True):
        table.add_row(
            name,
            _short(1e3 * row.sigma_depth),
            _short(1e3 * row.sigma_depth_p90),
            _percent(row.outlier_probability),
            _percent(row.estimate_fraction),
            _short(row.signal_to_backscatter),
        )
    return table


def _table(first: str, *titles: str) -> Table:
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column(escape(first), no_wrap=True)
    for title in titles:
        table.add_column(escape(title), justify="right", no_wrap=True)
    return table


def _short(value: float) -> str:
    if math.isnan(value):
        return "-"
    return "∞" if math.isinf(value) else f"{value:.3g}"


def _bracketed(value: float, reached: bool) -> str:
    text = _short(value)
    return text if reached or text == "-" else f"({text})"


def _percent(value: float) -> str:
    if math.isnan(value):
        return "-"
    return "< 0.001 %" if 0 < value < 1e-5 else f"{100 * value:.3g} %"


def _write_csv(path: Path, table: Sequence[dict[str, Any]]) -> Path:
    import csv

    from spadwarp.io.atomic import atomic_path

    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)
    return path
