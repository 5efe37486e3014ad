"""`spadwarp evaluate`: every method on the same frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say
from spadwarp.cli._progress import progress

if TYPE_CHECKING:
    from spadwarp.denoise import Evaluation


_PICTURES = ("metrics", "samples", "rescaled", "detail", "ranking", "photons", "reliability")
_REPORT = ("report.html", "scores.json", *(f"{name}.png" for name in _PICTURES))


@app.command()
def evaluate(
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DATA]",
            help="A dataset's folder; or a Monte Carlo result. Without it, scenes of the package that no training saw.",
            show_default=False,
        ),
    ] = None,
    models: Annotated[
        str,
        typer.Option(
            metavar="NAMES",
            help='"all", or a list: median, gating, bm3d, usdn, dncnn, pyramid; for results also histograms.',
        ),
    ] = "all",
    split: Annotated[str, typer.Option(metavar="NAME", help="test, validation, train or all.")] = "test",
    frames: Annotated[
        int, typer.Option(parser=opt.whole_number, metavar="N", help="Frames of each target and level.")
    ] = 20,
    bm3d_frames: Annotated[
        int,
        typer.Option(parser=opt.whole_number, metavar="N", help="Frames of each level for BM3D, up to a minute each."),
    ] = 0,
    crop: Annotated[
        tuple[int, int] | None,
        typer.Option(
            metavar="WIDTH HEIGHT", help="Only the middle part of each frame [pixels]; 128 96 makes BM3D faster."
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Also write report.html, its pictures and scores.json there; for a result only photons.png.",
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Weights of spadwarp train for the network that they name. By default the package's."
        ),
    ] = None,
    histograms: Annotated[
        bool,
        typer.Option(
            "--histograms", help="Without DATA: the network for histograms against classical estimates, point by point."
        ),
    ] = False,
    seed: Annotated[
        int, typer.Option(parser=opt.whole_number, metavar="N", help="Seed of the noise, except that of a dataset.")
    ] = 0,
    device: opt.TorchDevice = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Compare denoisers by scene type, on a dataset, or on frames with few photons.

    Without DATA: scenes before a wall, above a floor and in open water, with backscatter from in front, from the whole
    gate and from near-range, at six backscatter fractions; gains, errors near rims and inside, targets missed and
    invented.
    On a dataset: PSNR, SSIM and entropy over the gate, errors in millimetres, steps resolved. On a Monte Carlo result:
    frames of 1 to 100 signal photons a pixel at several signal-to-background ratios, RMSE beside the Cramér-Rao bound.

    \b
    Examples:
      spadwarp evaluate --report report/
      spadwarp evaluate --histograms
      spadwarp dataset make configs/datasets/lu2024.toml --out data/lu2024/
      spadwarp evaluate data/lu2024/ --models all --report report/
      spadwarp evaluate data/lu2024/ --weights runs/pyramid/pyramid.safetensors --report report/
      spadwarp evaluate data/lu2024/ --models bm3d,pyramid --frames 7 --bm3d-frames 20 --crop 128 96
      spadwarp evaluate out/result.h5 --report photons/
    """
    from spadwarp.denoise import evaluate as run
    from spadwarp.denoise import write_report

    named = {"all": ["median", "gating", "usdn", "dncnn", "pyramid"]}
    chosen = named.get(models, models.split(","))
    chosen = [name.strip() for name in chosen]
    if "bm3d" in chosen and bm3d_frames == 0:
        bm3d_frames = 20
    outputs = opt.check_outputs(
        report, _REPORT, json=json_path, inputs=(data, weights), overwrite=overwrite, option="--report"
    )
    if data is None:
        common: dict[str, Any] = {"weights": weights, "seed": seed, "device": device}
        if histograms:
            _points(quiet=quiet, outputs=outputs, **common)
        else:
            _scenes(chosen, report, quiet=quiet, outputs=outputs, **common)
        return
    if data.is_file() or (data / "result.h5").is_file():
        _sweep(
            data,
            [*chosen, "histograms"] if models == "all" else chosen,
            report,
            weights=weights,
            seed=seed,
            device=device,
            quiet=quiet,
            outputs=outputs,
        )
        return
    with progress(quiet=quiet, unit="frames") as shown:
        found = run(
            data,
            models=chosen,
            split=split,
            frames=frames,
            bm3d_frames=bm3d_frames,
            crop=crop,
            weights=weights,
            device=device,
            progress=shown,
        )
    written = write_report(found, report) if report is not None else []
    if not quiet:
        _say_gains(found)
        if written:
            say(f"written: {written[0]}")
    outputs.write_json({**found.to_dict(), "files": written})


def _say_gains(found: Evaluation) -> None:
    from rich.table import Table

    from spadwarp.denoise import TITLES

    table = Table("method", *found.levels, "mean")
    for method in found.ranking():
        gains = []
        for level in (*found.levels, None):
            after, before = found.mean(method, level=level), found.mean("input", level=level)
            gains.append(f"{after.psnr:.2f}" if method == "input" else f"{after.psnr - before.psnr:+.2f}")
        table.add_row(TITLES[method], *gains)
    say(f"PSNR of the input, and gain over it [dB], by backscatter fraction or photons; {found.summary}")
    opt.show_table(table)
    lines = {}
    for method in found.methods:
        steps = [item for (name, _), item in found.steps.items() if name == method]
        lines[TITLES[method]] = f"{sum(s.resolved for s in steps)} of {sum(s.total for s in steps)} steps"
    if found.steps:
        say(opt.rows(lines))


def _scenes(models: list[str], report: Path | None, *, quiet: bool, outputs: opt.Outputs, **options: Any) -> None:
    """Scenes that no training saw, by scene type."""
    from rich.table import Table

    from spadwarp.denoise import evaluate_scenes, scene_table, write_scene_report

    with progress(quiet=quiet, unit="frames") as shown:
        found = evaluate_scenes(models=models, progress=shown, **options)
    written = write_scene_report(found, report) if report is not None else []
    if not quiet:
        for setting, water in found.types():
            names, rows = scene_table(found, setting, water)
            say(f"{setting}, backscatter {water}: PSNR of the input and gains over it [dB] by backscatter fraction")
            table = Table(*names)
            for row in rows:
                table.add_row(*row)
            opt.show_table(table)
        if written:
            say(f"written: {written[0]}")
    outputs.write_json({**found.to_dict(), "files": written})


def _points(*, quiet: bool, outputs: opt.Outputs, **options: Any) -> None:
    """Histograms: ours and the best tuned classical estimate of each point."""
    import numpy as np
    from rich.table import Table

    from spadwarp.denoise import TITLES, evaluate_histograms

    with progress(quiet=quiet, unit="points") as shown:
        found = evaluate_histograms(progress=shown, **options)
    if not quiet:
        table = Table("photons", "SBR", "background", "returns", "RMSE [mm]", "best classical [mm]", "which")
        for point, values in found.rmse.items():
            name, best = found.best(point)
            numbers = f"{1e3 * values['histograms']:.1f}", f"{1e3 * best:.1f}"
            table.add_row(*map(str, point), *numbers, TITLES[name])
        opt.show_table(table)
        ratios = found.ratios()
        say(
            f"RMSE over that of the best classical estimate: median {np.median(ratios):.2f}, highest {ratios.max():.2f}"
        )
    outputs.write_json(found.to_dict())


def _sweep(
    data: Path,
    models: list[str],
    report: Path | None,
    *,
    weights: Path | None,
    seed: int,
    device: str | None,
    quiet: bool,
    outputs: opt.Outputs,
) -> None:
    """Frames of few photons from a result."""
    from rich.table import Table

    from spadwarp.denoise import TITLES, draw_photon_sweep, photon_sweep

    result = opt.load_run(data)
    with progress(quiet=quiet, unit="frames") as shown:
        found = photon_sweep(
            result,
            models=[one for one in models if one != "bm3d"],
            weights=weights,
            seed=seed,
            device=device,
            progress=shown,
        )
    written = [draw_photon_sweep(found, report / "photons.png")] if report is not None else []
    if not quiet:
        say(f"RMSE [mm]; {found.summary}")
        for row, ratio in enumerate(found.sbr):
            table = Table(f"SBR {ratio:g}", *(f"{n:g} photon{'s' * (n != 1)}" for n in found.photons))
            for name, values in found.rmse.items():
                title = "likelihood of each pixel" if name == "input" else TITLES[name]
                table.add_row(title, *(f"{1e3 * one:.3g}" for one in values[row]))
            table.add_row("Cramér–Rao bound", *(f"{1e3 * one:.3g}" for one in found.bound[row]))
            opt.show_table(table)
        if written:
            say(f"written: {written[0]}")
    outputs.write_json({**found.to_dict(), "files": written})
