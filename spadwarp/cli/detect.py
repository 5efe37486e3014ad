"""`spadwarp detect`: counts of a SPAD camera from expected histograms."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, say
from spadwarp.cli._progress import progress
from spadwarp.errors import ConfigError
from spadwarp.units import percent

if TYPE_CHECKING:
    from spadwarp import Result
    from spadwarp.frames import Recording

# What a detector sees of a scene; the rest has decided which photons came.
_DETECTOR_FIELDS = (
    "detector",
    "daylight",
    *(f"laser.{name}" for name in ("pulse_energy", "average_power", "peak_power", "repetition_rate", "pulse_fwhm_ps")),
    *(f"laser.{name}" for name in ("linewidth_nm", "spectrum")),
)

_MEDIAN_PER_SIGMA = 0.6745  # of the absolute values of normal errors
_NOISE = 0.1  # part of the bound's information that is noise of the simulation, from which on it is said


@app.command()
def detect(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A result, or its directory.", show_default=False)],
    out: opt.Out,
    pulses: Annotated[
        int | None,
        typer.Option(
            parser=opt.whole_number, metavar="N", help="Pulses per frame; by default detector.pulses_per_frame."
        ),
    ] = None,
    frames: Annotated[int, typer.Option(parser=opt.whole_number, metavar="N", help="Frames to record.")] = 1,
    seed: Annotated[int, typer.Option(parser=opt.whole_number, metavar="N", help="Key of the random numbers.")] = 0,
    method: Annotated[
        list[opt.Estimator] | None,
        typer.Option(help="Estimator of depth; may be repeated. By default all four; the last is drawn."),
    ] = None,
    coates: Annotated[
        bool, typer.Option("--coates", help="Correct pile-up (Coates) before depth is estimated.")
    ] = False,
    tags: Annotated[bool, typer.Option("--tags", help="Also keep the time tag of every detection.")] = False,
    window: Annotated[
        tuple[str, str] | None,
        typer.Option(
            metavar="NS BINS",
            help="Start [ns] and bins of the detector's window, such as 10 512 or 10ns 512. By default the run's gate.",
        ),
    ] = None,
    channel: opt.ChannelName = opt.Channel.I,
    overrides: opt.Overrides = None,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Frames of counts that the camera would record.

    Writes frames.h5 (counts, depth frames of each estimator, intensity, the Cramér–Rao bound) and frame.png. --set
    takes fields of the detector and of daylight, and of the laser its energy or power, repetition_rate, pulse_fwhm_ps
    and spectrum.

    \b
    Example:
      spadwarp detect run1/result.h5 --pulses 20000 --frames 100 --seed 3 --out frames/
      spadwarp detect run1/ --pulses 1e6 --out frames/ --coates --set detector.dark_count_rate=1e3
    """
    from spadwarp.frames import record_frames
    from spadwarp.viz import draw_recording

    recorded = _window(window)
    result = _with_detector(opt.load_run(run, channel), overrides)
    chosen: Any = [one.value for one in method or opt.Estimator]
    width, height = result.scene.camera.width, result.scene.camera.height
    pixels, bins = max(frames, 0) * width * height, result.scene.gate.bins if recorded is None else recorded[1]
    shots = result.scene.detector.pulses_per_frame if pulses is None else pulses
    counted = min(shots, bins) if result.scene.detector.mode == "first_photon" else bins
    outputs = opt.check_outputs(
        out,
        ("frames.h5", "frame.png"),
        json=json_path,
        inputs=(run,),
        overwrite=overwrite,
        needed=pixels * (4 * counted + 4 * len(chosen) + 8) + (16 << 20),
    )
    with progress(quiet=quiet, unit="frames") as report:
        recording = record_frames(
            result,
            out / "frames.h5",
            pulses=pulses,
            frames=frames,
            seed=seed,
            methods=list(dict.fromkeys(chosen)),
            undo_pile_up=coates,
            tags=tags,
            window=recorded,
            device=device,
            progress=report,
        )
    for note in recording.notes:
        complain(f"note: {note}")
    if recording.bound_noise > _NOISE and not _refused(recording):
        complain(f"note: {_bound_noise(recording, result.photons)}")
    written = [recording.path, draw_recording(recording, result, out / "frame.png")]
    summary = _summary(recording, frames)
    if not quiet:
        lines = _lines(recording, summary)
        lines["written"] = ", ".join(path.name for path in written) + f" in {out}"
        say(opt.rows(lines))
    outputs.write_json({**summary, "channel": channel.value, "files": written})


def _window(window: tuple[str, str] | None) -> tuple[float, int] | None:
    """Start [s] and bins."""
    if window is None:
        return None
    try:
        return 1e-9 * opt.in_unit("ns")(window[0]), opt.whole_number(window[1])
    except typer.BadParameter as error:
        error.param_hint = "--window"
        raise


def _with_detector(result: Result, overrides: list[str] | None) -> Result:
    """The result with another detector; other fields would belong to another run."""
    for one in overrides or []:
        field = one.partition("=")[0].strip()
        if not any(field == known or field.startswith(f"{known}.") for known in _DETECTOR_FIELDS):
            raise ConfigError(f"--set: {field} is not a field of {', '.join(_DETECTOR_FIELDS)}; simulate again")
    return dataclasses.replace(result, scene=result.scene.with_overrides(overrides or []))


def _summary(recording: Recording, frames: int) -> dict[str, Any]:
    import numpy as np

    first, bound = recording.first, recording.bound_depth[~np.isnan(recording.bound_depth)]
    median = float(np.median(bound)) if bound.size else math.inf
    pixels = first.counts.shape[1] * first.counts.shape[2]
    return {
        "pulses": first.pulses,
        "frames": frames,
        "seed": first.seed,
        "detections_per_frame_and_pixel": recording.detections / (frames * pixels),
        "detections_per_pulse_and_pixel": recording.detections / (frames * pixels * first.pulses),
        "bound": {
            "pixels": int(bound.size),
            "median_m": median if math.isfinite(median) else None,
            "noise_fraction": recording.bound_noise if math.isfinite(recording.bound_noise) else None,
        },
        "depth": {name: dataclasses.asdict(error) for name, error in recording.errors.items()},
        "monte_carlo_noise": None if recording.monte_carlo is None else dataclasses.asdict(recording.monte_carlo),
        "notes": list(recording.notes),
    }


def _lines(recording: Recording, summary: dict[str, Any]) -> dict[str, str]:
    median = summary["bound"]["median_m"]
    lines = {
        "frames": f"{opt.count(summary['frames'])} of {opt.count(summary['pulses'])} pulses, seed {summary['seed']}",
        "detections": f"{summary['detections_per_frame_and_pixel']:.4g} a frame and pixel, "
        f"{summary['detections_per_pulse_and_pixel']:.3g} a pulse and pixel",
        "bound": (
            "unknown" if summary["bound"]["pixels"] or _refused(recording) else "no depth information in any pixel"
        )
        if median is None
        else f"standard deviation {1000 * median:.3g} mm of depth in the median pixel (Cramér–Rao, one frame); normal "
        f"errors then have a median of {1000 * _MEDIAN_PER_SIGMA * median:.3g} mm",
    }
    for name, error in recording.errors.items():
        lines[name] = (
            f"{100 * error.estimate_fraction:.3g} % of the target's pixels; median error {1000 * error.median:.3g} mm, "
            f"below {1000 * error.p90:.3g} mm in 90 %"
            if error.estimate_fraction > 0.0
            else "no pixel of the target has a depth"
        )
    return lines


def _refused(recording: Recording) -> bool:
    """There is information, but no bound: too few photons were traced, as a note says."""
    return math.isfinite(recording.bound_noise) and not (recording.bound_time == recording.bound_time).any()


def _bound_noise(recording: Recording, photons: int) -> str:
    """How much of the bound's information was noise, and the photons that would leave a tenth."""
    return (
        f"{percent(recording.bound_noise)} % of the information in the median pixel was noise of the simulation; the "
        "Cramér–Rao bound is without it"
        + (", and only roughly known" if recording.bound_noise > 0.3 else "")
        + f"; about {recording.bound_photons:.1e} photons instead of {photons:.1e} would make that a tenth"
    )
