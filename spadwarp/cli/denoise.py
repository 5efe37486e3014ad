"""`spadwarp denoise`: denoised depth frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _measured as measured
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, say
from spadwarp.errors import ArgumentError, ConfigError, FileError
from spadwarp.units import range_from_time

_ENDINGS = (".npy", "_target.npy", "_confidence.npy", "_second.npy", ".exr", ".png")


@app.command()
def denoise(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="IN",
            help="A result or frames (.h5, or their directory); an analytic file, a dataset or a shard, of which the "
            "stored depth counts; depth (.exr, .npy, .mat, .h5), measured histograms (.npy, .mat, .h5, .ptu), or a "
            "folder of them.",
            show_default=False,
        ),
    ],
    out: opt.Out,
    model: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="pyramid, histograms, dncnn, usdn; or median, gating, bm3d; for counts "
            "also likelihood, pooled, semi-global, total-variation, belief-propagation.",
        ),
    ] = "pyramid",
    gate: Annotated[
        str | None,
        typer.Option(
            metavar="FROM:TO",
            help="Gate in depth, such as 13.5:16 [m]; also in time, such as 90ns:110ns, with --group-index. By default "
            "that of the file, or the range of its depths.",
        ),
    ] = None,
    profile: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help=".npy with the water's backscatter over the gate in equal bins."),
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Weights of spadwarp train. By default the package's.")
    ] = None,
    depth: Annotated[
        bool,
        typer.Option("--depth", help="Three dimensions in .npy, .mat and .h5 are frames of depth, not a histogram."),
    ] = False,
    channel: Annotated[
        str | None, typer.Option(metavar="NAME", help="Channel of an EXR that holds depth; of a result: co or cross.")
    ] = None,
    scale: Annotated[
        float, typer.Option(parser=opt.real_number, metavar="M", help="Metres per unit of stored depth; 0.01 for cm.")
    ] = 1.0,
    dataset: measured.Dataset = None,
    axes: measured.Axes = None,
    image_size: measured.ImageSize = None,
    tag_unit_ps: measured.TagUnit = None,
    bin_width_ps: measured.BinWidth = None,
    gate_start_ns: measured.GateStart = None,
    sum_frames: measured.SumFrames = False,
    group_index: measured.GroupIndex = None,
    irf_fwhm_ps: measured.IrfFwhm = None,
    irf: measured.Irf = None,
    mask: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="Leave out pixels that see a target with less than this probability: 0.08 for PyramidNet of depth, "
            "0.5 for histograms.",
        ),
    ] = None,
    device: opt.TorchDevice = None,
    precision: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Of the layers of pyramid: float32, float16 (default on a GPU), bfloat16 (default on a CPU with AMX).",
        ),
    ] = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Denoise depth frames.

    Writes for each file: NAME.npy (depth of all frames), NAME_target.npy and NAME_confidence.npy (the probabilities
    that a pixel sees a target, and that its depth is right), NAME.exr (all three of the first frame) and NAME.png.
    Every pixel has a depth, also where there is only water; --mask leaves these out. Histograms become depth first:
    counts by the likelihood, rates by the log-matched filter where the instrument response is known; counts are then
    denoised with their histograms, and NAME_second.npy has second surfaces in a pixel. Datasets do not keep the
    background that this needs: their depth frames are denoised without their histograms, as one line of the output
    says. Needs pip install "spadwarp[denoise]".

    \b
    Examples:
      spadwarp denoise out/result.h5 --out denoised/
      spadwarp denoise depth.npy --gate 13.5:16 --model dncnn --out denoised/
      spadwarp denoise engine/ --channel A --scale 0.01 --gate 13.5:16 --out denoised/
    """
    import numpy as np

    from spadwarp.denoise import denoise_file, depth_files

    depths = _gate(gate, group_index)
    paths = depth_files(path)
    stems = [one.stem for one in paths]
    if twice := sorted({one for one in stems if stems.count(one) > 1}):
        raise FileError(f"{path}: several files are called {twice[0]!r} and would overwrite each other's results")
    given = None if profile is None else spadwarp.io.read_npy(profile, largest=1 << 20)
    names = [stem + ending for stem in stems for ending in _ENDINGS]
    needed = sum(one.stat().st_size for one in paths if one.is_file())
    options: dict[str, Any] = {"inputs": (*paths, profile, weights, irf), "overwrite": overwrite, "needed": needed}
    outputs = opt.check_outputs(out, names, json=json_path, **options)
    facts = measured.facts(
        dataset, axes, image_size, tag_unit_ps, bin_width_ps, gate_start_ns, irf_fwhm_ps, irf, sum_frames
    )
    settings: dict[str, Any] = {
        "model": model, "gate": depths, "profile": given, "weights": weights, "device": device,
        "precision": precision, "mask": mask,
        "as_depth": depth, "channel": channel, "scale": scale, "group_index": group_index, **facts,
    }  # fmt: skip
    lines, summary, failed, written = {}, [], 0, 0
    for number, one in enumerate(paths, 1):
        try:
            done = denoise_file(one, out, **settings)
        except (ConfigError, FileError, ArgumentError) as error:
            text = str(error) if str(one) in str(error) else f"{one}: {error}"
            if len(paths) == 1:
                raise type(error)(text) from None
            complain(f"error: {text}")
            failed += 1
            continue
        there = float(np.isfinite(done.depth).mean())
        frames = "1 frame" if len(done.depth) == 1 else f"{opt.count(len(done.depth))} frames"
        written += len(done.files)
        target = float((done.target_probability >= done.threshold).mean())
        parts = f"{100 * there:.3g} % of the pixels have a depth, {100 * target:.3g} % show a target"
        lines[one.name] = f"{frames}, {parts}"
        summary.append(
            {
                "file": one,
                "gate": done.gate,
                "filled": there,
                "target": target,
                "files": done.files,
                "notes": done.notes,
            }
        )
        if not quiet:
            for note in done.notes:
                complain(f"{one.name}: {note}")
            if len(paths) > 1:
                complain(f"{number} of {len(paths)}")
    if not quiet:
        say(opt.rows({**lines, "written": f"{written} files in {out}"}))
    outputs.write_json({"model": model, "files": summary})
    if failed:
        raise FileError(f"{path}: {failed} of {len(paths)} files could not be denoised")


def _gate(text: str | None, group_index: float | None) -> tuple[float, float] | None:
    """Depths [m] of a gate in depth, or in time of flight."""
    if text is None:
        return None
    try:
        return opt.from_to(text, "m", "--gate")
    except typer.BadParameter as error:
        if " is a time" not in error.message:
            raise
    if group_index is None:
        raise typer.BadParameter(
            f"{text!r} is in time of flight: --group-index makes depth of it; or give two lengths", param_hint="--gate"
        )
    start, stop = opt.from_to(text, "s", "--gate")
    return range_from_time(start, group_index), range_from_time(stop, group_index)
