"""`spadwarp export`: results and frames in the formats of other programs."""

from __future__ import annotations

import enum
import glob
from pathlib import Path
from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say


class Format(enum.StrEnum):
    """Endings of `spadwarp.files.FORMATS`, and a layout; known without loading it."""

    npy = "npy"
    mat = "mat"
    ptu = "ptu"
    exr = "exr"
    xml = "xml"
    fusion = "fusion"


@app.command()
def export(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A result, frames, an analytic file, a dataset or a shard; or their directory.",
            show_default=False,
        ),
    ],
    formats: Annotated[
        list[Format],
        typer.Option("--format", help="Format to write; may be repeated.", show_default=False),
    ],
    out: opt.Out,
    frames: Annotated[
        str | None, typer.Option(metavar="N or A:B", help="Only frame N, or A to B - 1; by default all.")
    ] = None,
    split: Annotated[
        str, typer.Option(metavar="NAME", help="Split of a dataset: train, validation, test or all.")
    ] = "all",
    factor: Annotated[
        int,
        typer.Option(parser=opt.whole_number, metavar="N", help="fusion: finer pixels of the camera image, each way."),
    ] = 8,
    channel: opt.ChannelName = opt.Channel.I,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Results, frames and datasets in the formats of other programs.

    \b
    npy  NumPy: [height, width, bin], with frames before that; depth where there are no counts
    mat  MATLAB, one file a frame, as the simulated data that single-photon
         denoisers read: sparse spad, rates, 1-based bin, bin_size in seconds
    ptu  PicoQuant T3 image, one record a detection
    exr  images: depth, intensity, truth; one file a frame
    xml  the camera's calibration, as OpenCV's cv::FileStorage reads it
    fusion  mat files and a camera image of finer pixels, as networks for
         sensor fusion read them: intensity/, spad/ with bin_hr, a list

    The folder may hold other files. fusion, mat and ptu are for counts (`spadwarp detect`); ptu needs
    spadwarp[formats].

    \b
    Examples:
      spadwarp export frames/frames.h5 --format mat --format ptu --out exported/
      spadwarp export run1/result.h5 --format npy --out exported/
      spadwarp export data/small/ --split test --frames 0:20 --format exr --out exported/
    """
    source = spadwarp.files.locate(path)
    chosen = _frames(frames)
    stem = source.resolve().stem
    outputs = opt.check_outputs(
        out,
        [name for one in dict.fromkeys(formats) for name in _names(stem, one)],
        json=json_path,
        inputs=(source,),
        overwrite=overwrite,
        beside=True,
        needed=source.stat().st_size if source.is_file() else 0,
    )
    written: dict[str, list[Path]] = {}
    # Those that not every source has go first, so that nothing is written where one is refused.
    for one in sorted(set(formats), key=["fusion", "ptu", "mat", "npy", "exr", "xml"].index):
        if one is Format.fusion:
            written[one.value] = spadwarp.files.export_sensor_fusion(
                source, out, stem=stem, factor=factor, frames=chosen, split=split
            )
            continue
        written[one.value] = spadwarp.export(
            source, out / f"{stem}.{one.value}", frames=chosen, split=split, channel=channel.value
        )
    if not quiet:
        lines = {}
        for name, paths in written.items():
            more = f" to {paths[-1].name} ({len(paths)} files)" if len(paths) > 1 else ""
            lines[name] = f"{paths[0]}{more}"
        say(opt.rows(lines))
    outputs.write_json({"files": [path for paths in written.values() for path in paths]})


def _names(stem: str, one: Format) -> list[str]:
    """What a format is written to, as patterns."""
    stem = glob.escape(stem)
    if one is Format.fusion:
        return [f"{stem}.txt", f"intensity/{stem}-[0-9]*.mat", f"spad/{stem}-[0-9]*_p1.mat"]
    return [f"{stem}.{one.value}", f"{stem}-[0-9]*.{one.value}"]


def _frames(text: str | None) -> int | slice | None:
    if text is None:
        return None
    first, colon, stop = text.partition(":")
    numbers = [int(one) if one else None for one in (first, stop) if not one or one.isdecimal()]
    if len(numbers) != 2 or (not colon and not first):
        raise typer.BadParameter(f"{text!r} is not of the form N or A:B", param_hint="--frames")
    return slice(*numbers) if colon else int(first)
