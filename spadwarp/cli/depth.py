"""`spadwarp depth`: depth from histograms, simulated or measured."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say
from spadwarp.limits import parse_number

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from spadwarp.frames import Histograms


@app.command()
def depth(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A result or frames (.h5, or their directory), or measured: .npy, .mat, .ptu. Of an analytic file, "
            "a dataset or a shard its depth frames are written as they are.",
            show_default=False,
        ),
    ],
    out: opt.Out,
    method: Annotated[opt.Estimator, typer.Option(help="Estimator of the arrival time.")] = opt.Estimator.centroid,
    bin_width_ps: Annotated[
        float | None,
        typer.Option(
            parser=opt.in_unit("ps"), metavar="PS", help="Width of a bin; for measured histograms other than .ptu."
        ),
    ] = None,
    gate_start_ns: Annotated[
        float | None,
        typer.Option(
            parser=opt.in_unit("ns"),
            metavar="NS",
            help="Time of flight at the start of bin 0. By default that of the file, or 0.",
        ),
    ] = None,
    group_index: Annotated[
        float | None,
        typer.Option(
            parser=opt.real_number,
            metavar="N",
            help="For the speed of light; 1 in air, 1.3566 in fresh water, 1.3638 in seawater.",
        ),
    ] = None,
    horizontal_fov_deg: Annotated[
        float | None,
        typer.Option(
            parser=opt.in_unit("°"),
            metavar="DEG",
            help="Field of view of a measuring camera, for planar depth and --ply.",
        ),
    ] = None,
    irf_fwhm_ps: Annotated[
        float | None,
        typer.Option(parser=opt.in_unit("ps"), metavar="PS", help="Width of a Gaussian instrument response."),
    ] = None,
    irf: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Measured instrument response: .csv of time_ps, value.")
    ] = None,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="COUNTS",
            help='Background per bin, or "median": each pixel\'s median bin. By default that of the file; for '
            "measured histograms none, with likelihood the median.",
        ),
    ] = None,
    variable: Annotated[
        str | None, typer.Option(metavar="NAME", help="Array in a .mat file; by default the largest.")
    ] = None,
    ply: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the points of the first frame.")] = None,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Depth from histograms, simulated or measured.

    Writes depth.npy (all frames), depth.exr and depth.png (the first). Measured histograms
    are [height, width, bin], or frames of them. Without a field of view, the output is the range along the line of
    sight, for a laser in the lens.

    \b
    Examples:
      spadwarp depth out/result.h5 --method matched --ply points.ply --out depth/
      spadwarp depth counts.npy --bin-width-ps 55 --group-index 1.3566 --horizontal-fov-deg 15 \\
          --irf-fwhm-ps 200 --method likelihood --out depth/
    """
    from spadwarp.frames import depth_of, read_histograms
    from spadwarp.run import write_depth

    place = spadwarp.files.locate(path)
    stored = _stored(place)
    histograms = None if stored is not None else read_histograms(place, variable=variable)
    size = 4 * stored.values.size if histograms is None else histograms.values.size // histograms.values.shape[-1]
    outputs = opt.check_outputs(
        out,
        [f"{quantity}.{ending}" for quantity in ("depth", "range") for ending in ("npy", "exr", "png")],
        files={"--ply": ply},
        json=json_path,
        inputs=(path, irf),
        overwrite=overwrite,
        needed=8 * size,
    )
    if histograms is None:
        reduced = stored
    else:
        reduced = depth_of(
            _with_options(histograms, bin_width_ps, gate_start_ns, irf_fwhm_ps, irf),
            method=method.value,
            group_index=group_index,
            horizontal_fov_deg=horizontal_fov_deg,
            background=_background(background),
            device=device,
        )
    written = write_depth(reduced, out, ply=ply, comment=f"{path.name}, {reduced.method}")
    first = reduced.first
    summary = {**_statistics(first), "quantity": reduced.quantity, "frames": reduced.frames, "files": written}
    if not quiet:
        found = f"{opt.count(summary['pixels_with_return'])} of {opt.count(first.size)} pixels"
        if summary["metres"]:
            found += ", {:.4g} to {:.4g} m, median {:.4g} m".format(*summary["metres"])
        frames = f" (first of {opt.count(reduced.frames)} frames)" if reduced.frames > 1 else ""
        say(opt.rows({reduced.quantity: found + frames, "written": ", ".join(map(str, written))}))
    outputs.write_json(summary)


def _stored(place: Path) -> Any:
    """The depth frames of a file that holds no histograms, else None."""
    if place.is_dir() or place.suffix.lower() == ".h5":
        return spadwarp.files.stored_depth(spadwarp.load(place))
    return None


def _background(text: str | None) -> Any:
    if text is None or text == "median":
        return text
    try:
        return parse_number(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is neither a number nor 'median'", param_hint="--background") from None


def _with_options(
    histograms: Histograms,
    bin_width_ps: float | None,
    gate_start_ns: float | None,
    irf_fwhm_ps: float | None,
    irf: Path | None,
) -> Histograms:
    changes: dict[str, Any] = {}
    if bin_width_ps is not None:
        changes["bin_width"] = bin_width_ps * 1e-12
    if gate_start_ns is not None:
        changes["gate_start"] = gate_start_ns * 1e-9
    if irf is not None and irf_fwhm_ps is not None:
        raise typer.BadParameter("goes without --irf-fwhm-ps", param_hint="--irf")
    if histograms.scene is not None and (clash := [*changes, *(["irf"] if irf or irf_fwhm_ps else [])]):
        raise typer.BadParameter(f"the file has its own {', '.join(clash).replace('_', ' ')}", param_hint="FILE")
    if irf is not None:
        changes["irf"] = changes["response"] = spadwarp.frames.instrument_response(
            pulse_fwhm=0.0, jitter_fwhm=0.0, shape=irf
        )
    elif irf_fwhm_ps is not None:
        changes["irf"] = changes["response"] = spadwarp.frames.instrument_response(
            pulse_fwhm=0.0, jitter_fwhm=irf_fwhm_ps * 1e-12
        )
    return dataclasses.replace(histograms, **changes)


def _statistics(image: NDArray[np.float64]) -> dict[str, Any]:
    import numpy as np

    there = image[np.isfinite(image)]
    metres = [float(there.min()), float(there.max()), float(np.median(there))] if there.size else None
    return {"pixels_with_return": int(there.size), "metres": metres}
