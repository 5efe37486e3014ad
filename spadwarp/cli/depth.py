"""`spadwarp depth`: depth from histograms, simulated or measured."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _measured as measured
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, say
from spadwarp.limits import parse_number

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class PlyFrame(enum.StrEnum):
    """What `spadwarp.files.write_depth` takes as `ply_frame`."""

    camera = "camera"
    world = "world"


@app.command()
def depth(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A result or frames (.h5, or their directory), or measured: .npy, .mat, .h5, .ptu. Of an analytic "
            "file, a dataset or a shard its depth frames are written as they are.",
            show_default=False,
        ),
    ],
    out: opt.Out,
    method: Annotated[opt.Estimator, typer.Option(help="Estimator of the arrival time.")] = opt.Estimator.centroid,
    channel: opt.ChannelName = opt.Channel.I,
    dataset: measured.Dataset = None,
    axes: measured.Axes = None,
    image_size: measured.ImageSize = None,
    tag_unit_ps: measured.TagUnit = None,
    bin_width_ps: measured.BinWidth = None,
    gate_start_ns: measured.GateStart = None,
    sum_frames: measured.SumFrames = False,
    group_index: measured.GroupIndex = None,
    horizontal_fov_deg: Annotated[
        float | None,
        typer.Option(
            parser=opt.in_unit("°"),
            metavar="DEG",
            help="Field of view of a measuring camera, for planar depth and --ply.",
        ),
    ] = None,
    irf_fwhm_ps: measured.IrfFwhm = None,
    irf: measured.Irf = None,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="COUNTS",
            help='Background per bin, or "median": each pixel\'s median bin. By default that of the file; for '
            "measured histograms none, with likelihood the median.",
        ),
    ] = None,
    ply: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write the points of the first frame, with normals.")
    ] = None,
    ply_frame: Annotated[
        PlyFrame, typer.Option(help="Frame of the points: the camera's, or the world for a simulation.")
    ] = PlyFrame.camera,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Depth from histograms, simulated or measured.

    Writes depth.npy (all frames), depth.exr and depth.png (the first). Measured histograms are arrays of any order of
    axes, sparse matrices, cells of time tags, or T3 records. What the file does not say is asked for; what was inferred
    is printed. Without a field of view, the output is the range along the line of sight, for a laser in the lens.

    \b
    Examples:
      spadwarp depth out/result.h5 --method matched --ply points.ply --out depth/
      spadwarp depth counts.npy --axes tyx --bin-width-ps 55 --gate-start-ns 20 --group-index 1.3566 \\
          --irf-fwhm-ps 200 --method likelihood --out depth/
      spadwarp depth tags.mat --tag-unit-ps 8 --bin-width-ps 64 --gate-start-ns 0 --group-index 1 --out depth/
    """
    from spadwarp.files import write_depth
    from spadwarp.frames import depth_of, read_histograms

    given = measured.facts(
        dataset, axes, image_size, tag_unit_ps, bin_width_ps, gate_start_ns, irf_fwhm_ps, irf, sum_frames
    )
    place = spadwarp.files.locate(path)
    reduced = spadwarp.files.stored_depth(spadwarp.load(place)) if spadwarp.files.is_own_file(place) else None
    size, histograms = 0, None
    if reduced is None:
        histograms = read_histograms(place, channel=channel.value, **given)
        size = histograms.values.size // histograms.values.shape[-1]
        for text in histograms.notes:
            complain(f"note: {text}")
    outputs = opt.check_outputs(
        out,
        [f"{quantity}.{ending}" for quantity in ("depth", "range") for ending in ("npy", "exr", "png")],
        files={"--ply": ply},
        json=json_path,
        inputs=(path, irf),
        overwrite=overwrite,
        needed=8 * size if reduced is None else 32 * reduced.values.size,
    )
    if reduced is None:
        assert histograms is not None
        reduced = depth_of(
            histograms,
            method=method.value,
            group_index=group_index,
            horizontal_fov_deg=horizontal_fov_deg,
            background=_background(background),
            device=device,
        )
    written = write_depth(reduced, out, ply=ply, ply_frame=ply_frame.value, comment=f"{path.name}, {reduced.method}")
    first = reduced.first
    summary = {**_statistics(first), "quantity": reduced.quantity, "frames": reduced.frames, "files": written}
    if not quiet:
        found = f"{opt.count(summary['pixels_with_return'])} of {opt.count(first.size)} pixels"
        if summary["metres"]:
            found += ", {:.4g} to {:.4g} m, median {:.4g} m".format(*summary["metres"])
        frames = f" (first of {opt.count(reduced.frames)} frames)" if reduced.frames > 1 else ""
        say(opt.rows({reduced.quantity: found + frames, "written": ", ".join(map(str, written))}))
    outputs.write_json(summary)


def _background(text: str | None) -> Any:
    if text is None or text == "median":
        return text
    try:
        return parse_number(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is neither a number nor 'median'", param_hint="--background") from None


def _statistics(image: NDArray[np.float64]) -> dict[str, Any]:
    import numpy as np

    there = image[np.isfinite(image)]
    metres = [float(there.min()), float(there.max()), float(np.median(there))] if there.size else None
    return {"pixels_with_return": int(there.size), "metres": metres}
