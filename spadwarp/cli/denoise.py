"""`spadwarp denoise`, `evaluate` and `train`: denoisers of depth frames."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from spadwarp.cli._app import app, complain, say
from spadwarp.cli._options import (
    Json,
    Out,
    Overwrite,
    Quiet,
    arguments_checked,
    check_writable,
    count,
    in_bytes,
    load_run,
    prepare_directory,
    rows,
    show_table,
    whole_number,
    write_json,
)
from spadwarp.cli._progress import progress
from spadwarp.errors import ConfigError, FileError

_TorchDevice = Annotated[
    str | None,
    typer.Option("--device", metavar="NAME", help='"cpu", "cuda:0", ...; by default the first GPU, else the CPU.'),
]


@app.command()
def denoise(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="IN",
            help="A result or frames (.h5), depth (.exr, .npy, .mat), measured histograms (.npy, .mat, .ptu), or a "
            "folder of them.",
            show_default=False,
        ),
    ],
    out: Out,
    model: Annotated[
        str, typer.Option(metavar="NAME", help="pyramid, histograms, dncnn, usdn; or median, gating, bm3d.")
    ] = "pyramid",
    gate: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="START STOP", help="Gate in depth [m]. By default the file's, else the depths in it."),
    ] = None,
    profile: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help=".npy with the water's backscatter over the gate in equal bins."),
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Of spadwarp train. By default the package's.")
    ] = None,
    depth: Annotated[
        bool, typer.Option("--depth", help="Three dimensions in .npy and .mat are frames of depth, not a histogram.")
    ] = False,
    channel: Annotated[str | None, typer.Option(metavar="NAME", help="Channel of an EXR that holds depth.")] = None,
    scale: Annotated[float, typer.Option(metavar="M", help="Metres per unit of stored depth; 0.01 for cm.")] = 1.0,
    variable: Annotated[str | None, typer.Option(metavar="NAME", help="Array in a .mat file.")] = None,
    bin_width_ps: Annotated[
        float | None, typer.Option(metavar="PS", help="Width of a bin; measured histograms need it, .ptu knows it.")
    ] = None,
    gate_start_ns: Annotated[
        float | None, typer.Option(metavar="NS", help="Time of flight at the start of bin 0 of measured histograms.")
    ] = None,
    group_index: Annotated[
        float | None,
        typer.Option(metavar="N", help="1 in air, 1.3566 in fresh water, 1.3638 in seawater; measured ones need it."),
    ] = None,
    irf_fwhm_ps: Annotated[
        float | None, typer.Option(metavar="PS", help="Width of the instrument response of measured histograms.")
    ] = None,
    device: _TorchDevice = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Denoise depth frames.

    Writes NAME.npy (all frames), NAME.exr and NAME.png (the first) for each file. Histograms become depth first: counts
    by the likelihood, rates by the log-matched filter where the instrument response is known; counts are then denoised
    with their histograms. Needs pip install "spadwarp[denoise]".

    \b
    Examples:
      spadwarp denoise out/result.h5 --out denoised/
      spadwarp denoise depth.npy --gate 13.5 16 --model dncnn --out denoised/
      spadwarp denoise engine/ --channel A --scale 0.01 --gate 13.5 16 --out denoised/
    """
    import numpy as np

    from spadwarp.denoise import denoise_file, depth_files

    if path.is_dir() and (path / "result.h5").is_file():
        path = path / "result.h5"
    paths = depth_files(path)
    stems = [one.stem for one in paths]
    if twice := sorted({one for one in stems if stems.count(one) > 1}):
        raise FileError(f"{path}: several files are called {twice[0]!r} and would overwrite each other's results")
    given = None
    if profile is not None:
        try:
            given = np.load(profile, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FileError(f"{profile}: not a .npy file that can be read: {error}") from error
    prepare_directory(out, overwrite=overwrite, needed=sum(one.stat().st_size for one in paths if one.is_file()))
    told, summary, failed = {}, [], 0
    for number, one in enumerate(paths, 1):
        try:
            with arguments_checked():
                done = denoise_file(
                    one,
                    out,
                    model=model,
                    gate=gate,
                    profile=given,
                    weights=weights,
                    device=device,
                    as_depth=depth,
                    channel=channel,
                    scale=scale,
                    variable=variable,
                    bin_width_ps=bin_width_ps,
                    gate_start_ns=gate_start_ns,
                    group_index=group_index,
                    irf_fwhm_ps=irf_fwhm_ps,
                )
        except (ConfigError, FileError) as error:
            if len(paths) == 1:
                raise
            complain(f"error: {error}" if isinstance(error, FileError) else f"error: {one}: {error}")
            failed += 1
            continue
        there = float(np.isfinite(done.depth).mean())
        frames = "1 frame" if len(done.depth) == 1 else f"{count(len(done.depth))} frames"
        told[one.name] = f"{frames}, {100 * there:.3g} % of the pixels have a depth"
        summary.append({"file": one, "gate": done.gate, "filled": there, "files": done.files, "notes": done.notes})
        if not quiet:
            for note in done.notes:
                complain(f"{one.name}: {note}")
            if len(paths) > 1:
                complain(f"{number} of {len(paths)}")
    if not quiet:
        say(rows({**told, "written": f"{3 * len(summary)} files in {out}"}))
    write_json({"model": model, "files": summary}, json_path)
    if failed:
        raise FileError(f"{path}: {failed} of {len(paths)} files could not be denoised")


@app.command()
def evaluate(
    data: Annotated[
        Path,
        typer.Argument(metavar="DATA", help="A dataset's folder; or a Monte Carlo result.", show_default=False),
    ],
    models: Annotated[
        str,
        typer.Option(
            metavar="NAMES",
            help='"all", or names with commas: median, gating, bm3d, usdn, dncnn, pyramid, of results histograms too.',
        ),
    ] = "all",
    split: Annotated[str, typer.Option(metavar="NAME", help="test, validation, train or all.")] = "test",
    frames: Annotated[
        int, typer.Option(parser=whole_number, metavar="N", help="Frames of each target and level.")
    ] = 20,
    bm3d_frames: Annotated[
        int, typer.Option(parser=whole_number, metavar="N", help="Frames of each level for BM3D, up to a minute each.")
    ] = 0,
    crop: Annotated[
        tuple[int, int] | None,
        typer.Option(
            metavar="WIDTH HEIGHT", help="Only the middle part of each frame [pixels]; 128 96 spares BM3D time."
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Also write here: report.html, its pictures, scores.json; of a result photons.png alone.",
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Of spadwarp train, for the network it names. By default the package's."),
    ] = None,
    seed: Annotated[
        int, typer.Option(parser=whole_number, metavar="N", help="Of the counts that are drawn from a result.")
    ] = 0,
    device: _TorchDevice = None,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Compare denoisers on a dataset, or on frames of few photons.

    On a dataset: PSNR, SSIM and entropy over the gate, errors in millimetres, steps resolved. On a Monte Carlo result:
    frames of 1 to 100 signal photons a pixel at several signal-to-background ratios, RMSE beside the Cramér-Rao bound.

    \b
    Examples:
      spadwarp dataset make configs/datasets/paper.toml --out data/paper/
      spadwarp evaluate data/paper/ --models all --report report/
      spadwarp evaluate data/paper/ --weights runs/pyramid/pyramid.safetensors --report report/
      spadwarp evaluate data/paper/ --models bm3d,pyramid --frames 7 --bm3d-frames 20 --crop 128 96
      spadwarp evaluate out/result.h5 --report photons/
    """
    from rich.table import Table

    from spadwarp.denoise import TITLES, write_report
    from spadwarp.denoise import evaluate as run

    chosen = ["median", "gating", "usdn", "dncnn", "pyramid"] if models == "all" else models.split(",")
    chosen = [name.strip() for name in chosen]
    if "bm3d" in chosen and bm3d_frames == 0:
        bm3d_frames = 20
    if report is not None:
        check_writable(report)
    if data.is_file() or (data / "result.h5").is_file():
        _sweep(
            data,
            [*chosen, "histograms"] if models == "all" else chosen,
            report,
            weights=weights,
            seed=seed,
            device=device,
            quiet=quiet,
            json_path=json_path,
        )
        return
    with arguments_checked(), progress(quiet=quiet, unit="frames") as told:
        found = run(
            data,
            models=chosen,
            split=split,
            frames=frames,
            bm3d_frames=bm3d_frames,
            crop=crop,
            weights=weights,
            device=device,
            progress=told,
        )
    written = write_report(found, report) if report is not None else []
    if not quiet:
        table = Table("method", *found.levels, "mean")
        for method in found.ranking():
            gains = []
            for level in (*found.levels, None):
                one, before = found.mean(method, level=level), found.mean("input", level=level)
                gains.append(f"{one.psnr:.2f}" if method == "input" else f"{one.psnr - before.psnr:+.2f}")
            table.add_row(TITLES[method], *gains)
        say(f"PSNR of the input, and gain over it [dB], by backscatter fraction or photons; {found.summary}")
        show_table(table)
        if found.steps:
            steps = {
                method: [one for (name, _), one in found.steps.items() if name == method] for method in found.methods
            }
            say(
                rows(
                    {
                        TITLES[method]: f"{sum(one.resolved for one in all_)} of {sum(one.total for one in all_)} steps"
                        for method, all_ in steps.items()
                    }
                )
            )
        if written:
            say(f"written: {written[0]}")
    write_json({**found.to_dict(), "files": written}, json_path)


def _sweep(
    data: Path,
    models: list[str],
    report: Path | None,
    *,
    weights: Path | None,
    seed: int,
    device: str | None,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Frames of few photons from a result."""
    from rich.table import Table

    from spadwarp.denoise import TITLES, draw_photon_sweep, photon_sweep

    result = load_run(data)
    with arguments_checked(), progress(quiet=quiet, unit="frames") as told:
        found = photon_sweep(
            result,
            models=[one for one in models if one != "bm3d"],
            weights=weights,
            seed=seed,
            device=device,
            progress=told,
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
            show_table(table)
        if written:
            say(f"written: {written[0]}")
    write_json({**found.to_dict(), "files": written}, json_path)


@app.command()
def train(
    recipe: Annotated[Path, typer.Argument(metavar="RECIPE", help="Training recipe (TOML).", show_default=False)],
    out: Out,
    data: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Dataset in place of the recipe's.", show_default=False)
    ] = None,
    steps: Annotated[
        int | None, typer.Option(parser=whole_number, metavar="N", help="Updates. By default the recipe's.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(parser=whole_number, metavar="N", help="Seed. By default the recipe's.")
    ] = None,
    device: _TorchDevice = None,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Train a denoiser on the clean scenes of a dataset.

    Noise is drawn anew for each step. Writes weights (safetensors), log.jsonl, curves.png and a checkpoint; the same
    command goes on with a run that was cut short. On several GPUs: torchrun --nproc-per-node N -m spadwarp train ...

    \b
    Example:
      spadwarp dataset make configs/datasets/training.toml --out data/training/
      spadwarp train configs/training/pyramid.toml --out runs/pyramid/
    """
    from spadwarp.denoise import load_training_recipe
    from spadwarp.denoise import train as run

    changes: dict[str, Any] = {}
    if data is not None:
        changes["data"] = str(data)
    if seed is not None:
        changes["seed"] = seed
    if steps is not None:
        changes["optimiser"] = {"steps": steps}
    chosen = load_training_recipe(recipe, overrides=changes)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out: {out} is a file; a directory is needed")
    check_writable(out)
    first = int(os.environ.get("RANK", "0")) == 0
    with arguments_checked(), progress(quiet=quiet or not first, unit="steps") as told:
        trained = run(chosen, out, device=device, progress=told)
    if first:
        if not quiet:
            say(
                rows(
                    {
                        "model": f"{chosen.model}, {count(chosen.optimiser.steps)} steps, seed {chosen.seed}",
                        "validation": f"{trained.psnr:.2f} dB PSNR, mean over six levels of backscatter",
                        "time": f"{trained.seconds:.0f} s",
                        "written": f"{trained.weights} ({in_bytes(trained.weights.stat().st_size)})",
                    }
                )
            )
        write_json({"psnr": trained.psnr, "seconds": trained.seconds, "weights": trained.weights}, json_path)
