"""`spadwarp analytic`: depth frames by the analytic model."""

from __future__ import annotations

import enum
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say
from spadwarp.errors import ArgumentError
from spadwarp.limits import parse_number

if TYPE_CHECKING:
    from spadwarp.analytic import AnalyticResult
    from spadwarp.result import Truth
from spadwarp.cli._tables import percent


class Exporter(enum.StrEnum):
    """`spadwarp.result.result.rendered_truth.EXR_PRESETS`, known without loading it."""

    unreal = "unreal"
    blender = "blender"


@app.command()
def analytic(
    scene_path: opt.ScenePath,
    out: opt.Out,
    frames: Annotated[int, typer.Option(parser=opt.whole_number, metavar="N", help="Depth frames to draw.")] = 1,
    seed: Annotated[int, typer.Option(parser=opt.whole_number, metavar="N", help="Key of the random numbers.")] = 0,
    mesh: opt.Mesh = None,
    overrides: opt.Overrides = None,
    depth: Annotated[
        Path | None, typer.Option(metavar="EXR", help="Rendered depth, which replaces the scene's targets.")
    ] = None,
    depth_channel: Annotated[str | None, typer.Option(metavar="NAME", help="Its channel; the preset's.")] = None,
    depth_scale: Annotated[
        float | None,
        typer.Option(
            parser=opt.real_number, metavar="M", help="Metres per unit of depth; the preset's (unreal: 0.01)."
        ),
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
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Depth frames by the analytic model.

    From the scene's targets, or from images that a game engine or Blender rendered with the scene's camera. Writes
    analytic.h5 (maps, frames, and labels of the pixels that report background) and analytic.png.

    \b
    Examples:
      spadwarp analytic configs/scenes/staircase_15m.toml --frames 1000 --out frames/
      spadwarp analytic scene.toml --depth cat_RGBD.EXR --depth-channel A --depth-scale 0.01 \\
          --normal cat_Surf_Norm.EXR --albedo cat_Base_Col.EXR --out cat/
    """
    from spadwarp.viz import draw_analytic

    scene = opt.read_scene(scene_path, mesh=mesh, overrides=overrides)
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
    outputs = opt.check_outputs(
        out,
        ("analytic.h5", "analytic.png"),
        json=json_path,
        inputs=(scene_path, mesh, *scene.files, depth, normal, albedo, profile),
        overwrite=overwrite,
        needed=(5 * max(frames, 0) + 200) * pixels + (16 << 20),
    )
    if frames < 0:
        raise ArgumentError(f"frames = {frames} is outside [0, inf)")
    truth: Truth | None = None
    if depth is not None:
        truth = spadwarp.result.load_truth_exr(
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
        backscatter_profile=None if profile is None else opt.load_run(profile),
    )
    written = [result.save(out / "analytic.h5", frames=frames, device=device)]
    written.append(draw_analytic(result, out / "analytic.png"))
    summary = {"frames": frames, "seed": seed, **_summary(result), "notes": spadwarp.analytic.model_notes(scene)}
    if not quiet:
        say(opt.rows({**_lines(summary), "written": ", ".join(path.name for path in written) + f" in {out}"}))
    outputs.write_json({**summary, "files": written})


def _albedo(text: str | None) -> Path | float:
    """A number, or the path of a file."""
    try:
        return 0.5 if text is None else parse_number(text)
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


def _lines(summary: dict[str, Any]) -> dict[str, str]:
    return {
        "pixels": f"{opt.count(summary['pixels'])}, {opt.count(summary['pixels_with_target'])} see a target, "
        f"{opt.count(summary['pixels_with_estimate'])} have an estimate; medians of these:",
        "signal": f"{summary['signal']:.3g} detections a pulse of unscattered light, {summary['backscatter']:.3g} of "
        f"backscatter that was scattered once, {summary['alpha']:.3g} with dark counts and ambient light",
        "signal to backscatter": f"{summary['signal_to_backscatter']:.3g}",
        "bound": f"{1e12 * summary['sigma_time']:.3g} ps, {1e3 * summary['sigma_depth']:.3g} mm of depth",
        "outliers": f"{percent(summary['outlier_probability'])} of the fits would find a false peak",
        "frames": f"{opt.count(summary['frames'])}, seed {summary['seed']}, "
        f"{percent(summary['background_probability'])} of their pixels report background",
    }
