"""Options of the commands that read measured histograms, and what they make of them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from spadwarp.cli._options import in_unit, real_number

Dataset = Annotated[
    str | None,
    typer.Option(
        "--dataset",
        "--variable",
        metavar="NAME",
        help="Array in a .mat or .h5 file; by default the only one that fits.",
    ),
]
Axes = Annotated[
    str | None,
    typer.Option(
        metavar="LETTERS",
        help="Order of an array's axes: y rows, x columns, t bins, n frames, such as yxt, tyx, nyxt; by default "
        "inferred, if there is one answer.",
    ),
]
ImageSize = Annotated[
    str | None,
    typer.Option(
        metavar="WxH", help="Where pixels stand one after the other, or are scanned with a marker for pixels or lines."
    ),
]
TagUnit = Annotated[
    float | None, typer.Option(parser=in_unit("ps"), metavar="PS", help="Unit of time tags (cells of a .mat file).")
]
BinWidth = Annotated[
    float | None,
    typer.Option(
        parser=in_unit("ps"),
        metavar="PS",
        help="Width of a bin, if the file does not hold it; of time tags a multiple of their unit, else the unit.",
    ),
]
GateStart = Annotated[
    float | None,
    typer.Option(
        parser=in_unit("ns"),
        metavar="NS",
        help="Time of flight at the start of bin 0, or at tag 0. By default that of the file, else 0 with a warning.",
    ),
]
GroupIndex = Annotated[
    float | None,
    typer.Option(
        parser=real_number,
        metavar="N",
        help="For the speed of light; 1 in air, 1.3566 in fresh water, 1.3638 in seawater.",
    ),
]
IrfFwhm = Annotated[
    float | None,
    typer.Option(parser=in_unit("ps"), metavar="PS", help="Width of a Gaussian instrument response."),
]
Irf = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Measured instrument response: .csv of time_ps, value; or .csv or .npy of one value for each bin.",
    ),
]
SumFrames = Annotated[bool, typer.Option("--sum-frames", help="Add the frames of a file up.")]


def facts(
    dataset: str | None,
    axes: str | None,
    image_size: str | None,
    tag_unit_ps: float | None,
    bin_width_ps: float | None,
    gate_start_ns: float | None,
    irf_fwhm_ps: float | None,
    irf: Path | None,
    sum_frames: bool,
) -> dict[str, Any]:
    """Arguments of `spadwarp.frames.read_histograms`, those that were given."""
    from spadwarp.frames import instrument_response, read_response

    if irf is not None and irf_fwhm_ps is not None:
        raise typer.BadParameter("goes without --irf-fwhm-ps", param_hint="--irf")
    width = None if bin_width_ps is None else bin_width_ps * 1e-12
    response = None
    if irf is not None:
        response = read_response(irf, bin_width=width)
    elif irf_fwhm_ps is not None:
        response = instrument_response(pulse_fwhm=0.0, jitter_fwhm=irf_fwhm_ps * 1e-12)
    given = {
        "dataset": dataset,
        "axes": axes,
        "image_size": _size(image_size),
        "tag_unit": None if tag_unit_ps is None else tag_unit_ps * 1e-12,
        "bin_width": width,
        "gate_start": None if gate_start_ns is None else gate_start_ns * 1e-9,
        "irf": response,
        "sum_frames": sum_frames or None,
    }
    return {name: value for name, value in given.items() if value is not None}


def _size(text: str | None) -> tuple[int, int] | None:
    """(height, width) of "640x480"."""
    if text is None:
        return None
    found = re.fullmatch(r"([1-9][0-9]{0,4})[x×]([1-9][0-9]{0,4})", text.strip())
    if found is None:
        raise typer.BadParameter(f"{text!r} is not of the form WIDTHxHEIGHT", param_hint="--image-size")
    return int(found[2]), int(found[1])
