"""`spadwarp detect` and `depth`: from expected histograms to counts, and from histograms to depth."""

from __future__ import annotations

import dataclasses
import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import spadwarp
from spadwarp.cli._app import app, complain, say
from spadwarp.cli._options import (
    Device,
    Json,
    Out,
    Overrides,
    Overwrite,
    Quiet,
    arguments_checked,
    check_writable,
    count,
    load_run,
    prepare_directory,
    rows,
    whole_number,
    write_json,
)
from spadwarp.cli._progress import progress
from spadwarp.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from spadwarp import Result
    from spadwarp.frames import Histograms, Recording

# What a detector sees of a scene; the rest has decided which photons came.
_DETECTOR_FIELDS = ("detector", "laser.pulse_energy", "laser.repetition_rate", "laser.pulse_fwhm_ps")


class Estimator(enum.StrEnum):
    """`spadwarp.frames.METHODS`, known without loading it."""

    peak = "peak"
    centroid = "centroid"
    matched = "matched"
    likelihood = "likelihood"


@app.command()
def detect(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A result, or its directory.", show_default=False)],
    out: Out,
    pulses: Annotated[
        int | None,
        typer.Option(parser=whole_number, metavar="N", help="Pulses of a frame. By default detector.pulses."),
    ] = None,
    frames: Annotated[int, typer.Option(parser=whole_number, metavar="N", help="Frames to record.")] = 1,
    seed: Annotated[int, typer.Option(parser=whole_number, metavar="N", help="Key of the random numbers.")] = 0,
    method: Annotated[
        list[Estimator] | None,
        typer.Option(help="Estimator of depth; may be repeated. By default all four; the last is drawn."),
    ] = None,
    coates: Annotated[bool, typer.Option("--coates", help="Undo pile-up (Coates) before depth is estimated.")] = False,
    tags: Annotated[bool, typer.Option("--tags", help="Also keep the time tag of every detection.")] = False,
    window: Annotated[
        tuple[float, int] | None,
        typer.Option(metavar="NS BINS", help="Start and bins of the detector's window. By default the run's gate."),
    ] = None,
    overrides: Overrides = None,
    device: Device = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Frames of counts that the camera would record of a run.

    Writes frames.h5 (counts, depth frames of each estimator, intensity, the Cramér–Rao bound) and frame.png. --set
    takes fields of the detector, and pulse_energy, repetition_rate and pulse_fwhm_ps of the laser.

    \b
    Example:
      spadwarp detect run1/result.h5 --pulses 20000 --frames 100 --seed 3 --out frames/
      spadwarp detect run1/ --pulses 1e6 --out frames/ --coates --set detector.dark_count_rate=1e3
    """
    from spadwarp.frames import record_frames
    from spadwarp.viz.frames import draw_recording

    result = _with_detector(load_run(run), overrides)
    chosen: Any = [one.value for one in method or Estimator]
    width, height = result.scene.camera.width, result.scene.camera.height
    pixels, bins = max(frames, 0) * width * height, result.scene.gate.bins if window is None else window[1]
    shots = result.scene.detector.pulses if pulses is None else pulses
    counted = min(shots, bins) if result.scene.detector.mode == "first_photon" else bins
    prepare_directory(out, overwrite=overwrite, needed=pixels * (4 * counted + 4 * len(chosen) + 8) + (16 << 20))
    with arguments_checked(), progress(quiet=quiet, unit="frames") as report:
        recording = record_frames(
            result,
            out / "frames.h5",
            pulses=pulses,
            frames=frames,
            seed=seed,
            methods=list(dict.fromkeys(chosen)),
            undo_pile_up=coates,
            tags=tags,
            window=None if window is None else (window[0] * 1e-9, window[1]),
            device=device,
            progress=report,
        )
    for note in recording.notes:
        complain(f"note: {note}")
    written = [recording.path, draw_recording(recording, result, out / "frame.png")]
    summary = _summary(recording, frames)
    if not quiet:
        lines = _told(recording, summary)
        lines["written"] = ", ".join(path.name for path in written) + f" in {out}"
        say(rows(lines))
    write_json({**summary, "files": written}, json_path)


def _with_detector(result: Result, overrides: list[str] | None) -> Result:
    """The result with another detector; other fields would belong to another run."""
    for one in overrides or []:
        field = one.partition("=")[0].strip()
        if not any(field == known or field.startswith(f"{known}.") for known in _DETECTOR_FIELDS):
            raise ConfigError(f"--set: {field} is not a field of {', '.join(_DETECTOR_FIELDS)}; simulate again")
    return dataclasses.replace(result, scene=result.scene.with_overrides(overrides or []))


def _summary(recording: Recording, frames: int) -> dict[str, Any]:
    import numpy as np

    first, bound = recording.first, recording.bound_depth[np.isfinite(recording.bound_depth)]
    pixels = first.counts.shape[1] * first.counts.shape[2]
    return {
        "pulses": first.pulses,
        "frames": frames,
        "seed": first.seed,
        "detections_per_frame_and_pixel": recording.detections / (frames * pixels),
        "detections_per_pulse_and_pixel": recording.detections / (frames * pixels * first.pulses),
        "bound": {"pixels": int(bound.size), "median_m": float(np.median(bound)) if bound.size else None},
        "depth": {name: dataclasses.asdict(error) for name, error in recording.errors.items()},
        "notes": list(recording.notes),
    }


def _told(recording: Recording, summary: dict[str, Any]) -> dict[str, str]:
    median = summary["bound"]["median_m"]
    lines = {
        "frames": f"{count(summary['frames'])} of {count(summary['pulses'])} pulses, seed {summary['seed']}",
        "detections": f"{summary['detections_per_frame_and_pixel']:.4g} a frame and pixel, "
        f"{summary['detections_per_pulse_and_pixel']:.3g} a pulse and pixel",
        "bound": "no information on depth in any pixel"
        if median is None
        else f"{1000 * median:.3g} mm of depth in the median pixel (Cramér–Rao, one frame)",
    }
    for name, error in recording.errors.items():
        lines[name] = (
            f"{100 * error.estimate_fraction:.3g} % of the target's pixels; error {1000 * error.median:.3g} mm in the "
            f"median, below {1000 * error.p90:.3g} mm in 90 %"
        )
    return lines


@app.command()
def depth(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A result or frames (.h5, or their directory), or measured: .npy, .mat, .ptu.",
            show_default=False,
        ),
    ],
    out: Out,
    method: Annotated[Estimator, typer.Option(help="Estimator of the arrival time.")] = Estimator.centroid,
    bin_width_ps: Annotated[
        float | None, typer.Option(metavar="PS", help="Width of a bin; measured histograms need it, .ptu knows it.")
    ] = None,
    gate_start_ns: Annotated[
        float | None,
        typer.Option(metavar="NS", help="Time of flight at the start of bin 0. By default what the file knows, or 0."),
    ] = None,
    group_index: Annotated[
        float | None,
        typer.Option(metavar="N", help="For the speed of light; 1 in air, 1.3566 in fresh water, 1.3638 in seawater."),
    ] = None,
    horizontal_fov_deg: Annotated[
        float | None, typer.Option(metavar="DEG", help="View of a measuring camera: planar depth, and --ply, need it.")
    ] = None,
    irf_fwhm_ps: Annotated[
        float | None, typer.Option(metavar="PS", help="Width of a Gaussian instrument response.")
    ] = None,
    irf: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Measured instrument response: .csv of time_ps, value.")
    ] = None,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="COUNTS",
            help='Background per bin, or "median": each pixel\'s median bin. By default what the file knows; for '
            "measured ones none, with likelihood the median.",
        ),
    ] = None,
    variable: Annotated[
        str | None, typer.Option(metavar="NAME", help="Array in a .mat file; by default the largest.")
    ] = None,
    ply: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the points of the first frame.")] = None,
    device: Device = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_path: Json = None,
) -> None:
    """Depth from histograms, simulated or measured.

    Writes depth.npy (all frames), depth.exr and depth.png (the first). Measured: [height, width, bin], or frames of
    them. Without a field of view only the range along the line of sight is known, for a laser in the lens.

    \b
    Examples:
      spadwarp depth out/result.h5 --method matched --ply points.ply --out depth/
      spadwarp depth counts.npy --bin-width-ps 55 --group-index 1.3566 --horizontal-fov-deg 15 \\
          --irf-fwhm-ps 200 --method likelihood --out depth/
    """
    from spadwarp.frames import read_histograms
    from spadwarp.frames.depth import depth_of
    from spadwarp.io.atomic import file_within
    from spadwarp.run.depth import write_depth

    if ply is not None:
        check_writable(ply.parent)
    histograms = read_histograms(file_within(path, ("frames.h5", "result.h5")), variable=variable)
    prepare_directory(out, overwrite=overwrite, needed=8 * histograms.values.size // histograms.values.shape[-1])
    with arguments_checked():
        histograms = _with_options(histograms, bin_width_ps, gate_start_ns, irf_fwhm_ps, irf)
        reduced = depth_of(
            histograms,
            method=method.value,
            group_index=group_index,
            horizontal_fov_deg=horizontal_fov_deg,
            background=_background(background),
            device=device,
        )
        written = write_depth(reduced, out, ply=ply, comment=f"{path.name}, {method.value}")
    first = reduced.first
    summary = {**_statistics(first), "quantity": reduced.quantity, "frames": reduced.frames, "files": written}
    if not quiet:
        found = f"{count(summary['pixels_with_return'])} of {count(first.size)} pixels"
        if summary["metres"]:
            found += ", {:.4g} to {:.4g} m, median {:.4g} m".format(*summary["metres"])
        frames = f" (first of {count(reduced.frames)} frames)" if reduced.frames > 1 else ""
        say(rows({reduced.quantity: found + frames, "written": ", ".join(map(str, written))}))
    write_json(summary, json_path)


def _background(text: str | None) -> Any:
    if text is None or text == "median":
        return text
    try:
        return float(text)
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
        raise typer.BadParameter(f"the file knows its {', '.join(clash).replace('_', ' ')}", param_hint="FILE")
    if irf is not None:
        changes["irf"] = changes["response"] = spadwarp.instrument_response(pulse_fwhm=0.0, jitter_fwhm=0.0, shape=irf)
    elif irf_fwhm_ps is not None:
        changes["irf"] = changes["response"] = spadwarp.instrument_response(
            pulse_fwhm=0.0, jitter_fwhm=irf_fwhm_ps * 1e-12
        )
    return dataclasses.replace(histograms, **changes)


def _statistics(image: NDArray[np.float64]) -> dict[str, Any]:
    import numpy as np

    there = image[np.isfinite(image)]
    metres = [float(there.min()), float(there.max()), float(np.median(there))] if there.size else None
    return {"pixels_with_return": int(there.size), "metres": metres}
