"""A short Monte Carlo run on a window of the image, and what it says of an experiment.

The window has the pixels of the camera about the target pixel nearest to the optical axis, so that light which is
scattered from other parts of the target into them is all there. Two runs of equal length are compared: what differs
between them is noise of the runs.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.model import source_name
from spadwarp.errors import ConfigError
from spadwarp.frames import detect, detector_response, first_photon_probabilities, information_from_histogram
from spadwarp.frames.estimators import METHODS, arrival_time
from spadwarp.frames.response import FWHM_PER_SIGMA
from spadwarp.result import Channel, analyser_channel, merge
from spadwarp.scene import noise_rate
from spadwarp.scene.geometry import pixel_directions
from spadwarp.scene.sight import depth_from_time, depth_per_time
from spadwarp.transport import RunOptions, simulate, truth_maps

if TYPE_CHECKING:
    from spadwarp.frames import Frames
    from spadwarp.result import Result
    from spadwarp.scene import Scene

__all__ = ["Pilot", "measure", "trace", "window"]

Floats = NDArray[np.float64]

SIDE = 16
"""Largest width and height of the window [pixels]."""
MOST_NOISE = 0.95
"""Part of the information that may be noise; a bound from what is left of more would be noise itself."""


@dataclass(frozen=True, kw_only=True)
class Pilot:
    """What a window of the image detects, medians over its pixels with a target unless said otherwise.

    Attributes:
        pixels: Their number.
        unscattered, target: Detections of the target per pulse in the gate, without scattered light and with it.
        backscatter, noise: Of backscatter, and of dark counts and ambient light.
        brightest: Detections of light per pulse of the brightest hundredth of the pixels; of the brightest one, where
            so short a run has light in fewer.
        bound: Cramér–Rao bound of depth for one pulse [m]; for N pulses it is bound/√N.
        shot_noise: The same without background and pile-up.
        information_noise: Part of the runs' information on the depth that was their noise, which `bound` and
            `shot_noise` leave out.
        floor: Estimator → median |error| of depth that is left after any number of pulses [m].
        bias: Estimator → median error, positive if too far [m].
        unscattered_floor: The same as `floor`, of unscattered light alone: slopes and edges within a pixel, bins.
        pile_up: Estimator → change of depth by pile-up, median [m]; 0 in free-running mode.
        run_noise: Median |error| of `floor` in a pixel that comes from the shortness of the runs [m].
        peak, level: Detections per pulse of the return within ±3σ of its peak, and of background per σ under it, σ
            that of the response.
        photons: Of both runs.
    """

    pixels: int
    unscattered: float
    target: float
    backscatter: float
    noise: float
    brightest: float
    bound: float
    shot_noise: float
    information_noise: float
    floor: dict[str, float]
    bias: dict[str, float]
    unscattered_floor: dict[str, float]
    pile_up: dict[str, float]
    run_noise: float
    peak: float
    level: float
    photons: int


def window(scene: Scene, device: str | None = None) -> Scene:
    """The scene with a camera of the pixels about the target pixel nearest to the axis, 16 × 16 at most.

    Raises `ConfigError` where no target is in view.
    """
    camera, truth = scene.camera, truth_maps(scene, device=device)
    hit = ~np.isnan(truth.depth)
    if not hit.any():
        raise ConfigError("no target is in view", source=source_name(scene))
    width, height = min(SIDE, camera.width), min(SIDE, camera.height)
    if (width, height) == (camera.width, camera.height):
        return scene
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    middle = hit[top : top + height, left : left + width]
    centred = (camera.width - width) % 2 == 0 == (camera.height - height) % 2 and middle.mean() > 0.25
    if centred and camera.is_plain:  # the kernels of a plain camera are those of the whole image
        fov = 2.0 * math.atan(0.5 * width * camera.pixel_tangent)
        return scene.with_overrides(camera={"width": width, "height": height, "horizontal_fov_deg": math.degrees(fov)})
    off_axis = np.where(hit, -pixel_directions(camera)[..., 2], np.inf)
    row, column = np.unravel_index(np.argmin(off_axis), off_axis.shape)
    left = int(np.clip(column - width // 2, 0, camera.width - width))
    top = int(np.clip(row - height // 2, 0, camera.height - height))
    (fx, fy), (cx, cy) = camera.focal_pixels, camera.principal_point
    centre = {"cx": cx - 0.5 - left, "cy": cy - 0.5 - top}
    return scene.with_overrides(camera={"width": width, "height": height, "fx": fx, "fy": fy, **centre})


def trace(
    scene: Scene, photons: int, seed: int, device: str | None, progress: Callable[[str, int, int], None] | None = None
) -> tuple[Result, Result]:
    """Two runs of half the photons each."""
    half = max(1, photons // 2)

    def report(stage: str, done: int, total: int) -> None:
        if progress is not None and total:
            progress(stage, traced + done, 2 * half)
        elif progress is not None and not traced:
            progress(stage, done, total)

    runs = []
    for traced in (0, half):
        options: dict[str, Any] = {
            "run": RunOptions(first_photon=traced),
            "seed": seed,
            "device": device,
            "progress": report,
        }
        runs.append(simulate(scene, photons=half, **options))
    return runs[0], runs[1]


def measure(
    runs: tuple[Result, Result],
    scene: Scene,
    device: str | None = None,
    *,
    even: bool = False,
    channel: Channel = "I",
) -> Pilot:
    """What the runs say about `scene`, whose laser's energy and detector may differ from those that were traced, seen
    in a channel of an analyser.

    `even`: the target is the same for all pixels, so that their median error has no noise of the runs; `floor` is then
    its modulus.
    """
    first, second = (
        analyser_channel(dataclasses.replace(run, scene=_as_traced(run.scene, scene)), channel) for run in runs
    )
    both = merge([first, second])
    frames = detect(both, pulses=1, seed=0, device=device)
    light = frames.expected.astype(np.float64)
    background = np.broadcast_to(frames.background, light.shape).astype(np.float64)
    seen = np.isfinite(both.truth.depth) & ((light - background).sum(axis=-1) > 0)
    if not seen.any():
        raise ConfigError(
            "no light of the target reaches the pixels near the axis: `spadwarp check` says why",
            source=source_name(scene),
        )

    def median(values: Any) -> float:
        return float(np.median(np.asarray(values)[seen]))

    errors: dict[str, Any] = {method: _depth_error(both, frames, light, method, device) for method in METHODS}
    bias: dict[str, Any] = {method: _finite_median(error[seen]) for method, error in errors.items()}
    clear = dataclasses.replace(both, tallies=both.tallies * np.array([1, 0, 0])[:, None, None, None])
    without = detect(clear, pulses=1, seed=0, device=device)
    alone: dict[str, Any] = {
        method: _depth_error(clear, without, without.expected.astype(np.float64), method, device) for method in METHODS
    }
    halves = [
        _depth_error(run, detect(run, pulses=1, seed=0, device=device), None, "likelihood", device)
        for run in (first, second)
    ]
    piled: dict[str, Any] = {method: 0.0 for method in METHODS}
    if scene.detector.mode == "first_photon":
        recorded = first_photon_probabilities(light, device=device)
        piled = {
            method: _finite_median((_depth_error(both, frames, recorded, method, device) - errors[method])[seen])
            for method in METHODS
        }
    signal, scale = light - background, both.scene.laser.photons_per_pulse * scene.detections_per_photon
    peak, level = _return(signal, background, both)
    bound, shot, information_noise = _bounds(both, (first, second), seen, device)
    detected = both.detections.sum(axis=-1)
    noise = float(np.median(noise_rate(both.scene, both.truth))) * (scene.gate.stop - scene.gate.start)
    return Pilot(
        pixels=int(seen.sum()),
        unscattered=median(both.component("ballistic").sum(axis=-1) * scale),
        target=median(signal.sum(axis=-1)),
        backscatter=median(both.component("backscatter").sum(axis=-1) * scale),
        noise=noise,
        brightest=float(np.quantile(detected, 0.99) or detected.max()),
        bound=bound,
        shot_noise=shot,
        information_noise=information_noise,
        floor={name: abs(bias[name]) if even else _finite_median(np.abs(errors[name][seen])) for name in errors},
        bias=bias,
        unscattered_floor={name: _finite_median(np.abs(error[seen])) for name, error in alone.items()},
        pile_up=piled,
        run_noise=_finite_median(0.5 * np.abs(halves[0] - halves[1])[seen]),
        peak=median(peak),
        level=median(level),
        photons=both.photons,
    )


def _as_traced(traced: Scene, wanted: Scene) -> Scene:
    """The traced scene with what a detector sees of the wanted one."""
    laser = traced.laser.model_copy(
        update={name: getattr(wanted.laser, name) for name in ("pulse_energy", "repetition_rate", "pulse_fwhm_ps")}
    )
    return traced.model_copy(update={"laser": laser, "detector": wanted.detector})


def _finite_median(values: Floats) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.inf


def _depth_error(result: Result, frames: Frames, histogram: Floats | None, method: Any, device: str | None) -> Floats:
    """Depth by an estimator that knows the background, from a histogram without noise, less the true depth [m]."""
    time = arrival_time(
        frames.expected if histogram is None else histogram,
        gate_start=frames.gate_start,
        bin_width=frames.bin_width,
        method=method,
        irf=frames.irf,
        background=frames.background,
        device=device,
    )
    return depth_from_time(time, scene=result.scene) - result.truth.depth


def _return(signal: Floats, background: Floats, result: Result) -> tuple[Floats, Floats]:
    """Detections per pulse about the return's peak, and of background per σ under it."""
    scene = result.scene
    sigma = max(detector_response(scene.detector, scene.laser).fwhm, scene.gate.bin_width) / FWHM_PER_SIGMA
    reach = max(1, round(3.0 * sigma / scene.gate.bin_width))
    top = signal.argmax(axis=-1)[..., None]
    near = np.clip(top + np.arange(-reach, reach + 1), 0, signal.shape[-1] - 1)
    inside = np.abs(near - top) <= reach
    peak = (np.take_along_axis(signal, near, axis=-1) * inside).sum(axis=-1)
    level = np.take_along_axis(background, near, axis=-1).mean(axis=-1) * (sigma / scene.gate.bin_width)
    return peak, level


def _bounds(
    result: Result, runs: tuple[Result, Result], seen: NDArray[np.bool_], device: str | None
) -> tuple[float, float, float]:
    """Bounds of depth for one pulse [m], medians: as the detector records it, and without background and pile-up; and
    the part of the information that was noise of the runs, for which the bounds are larger.

    From products of the slopes of both runs, which noise does not change in the mean. One pixel has too few photons to
    say what part is noise, and few bright photons rule a mean over pixels: medians of both are compared. Inf where
    nearly all is noise.
    """
    scene = result.scene
    scale = scene.laser.photons_per_pulse * scene.detections_per_photon
    signal, first, second = (
        (run.component("ballistic") + run.component("forward_scattered")) * scale for run in (result, *runs)
    )
    background = result.component("backscatter") * scale + noise_rate(scene, result.truth) * scene.gate.bin_width
    options: dict[str, Any] = {
        "bin_width": scene.gate.bin_width,
        "irf": detector_response(scene.detector, scene.laser),
        "signal_halves": (first, second),
        "device": device,
    }
    law: Any = "first_photon" if scene.detector.mode == "first_photon" else "poisson"
    slope = depth_per_time(scene, np.nan_to_num(result.truth.range.astype(np.float64)))

    def bound(background: Any, law: Any) -> tuple[float, float]:
        information, noise = information_from_histogram(signal, background, law=law, **options)
        known = seen & (information > 0)
        if not known.any():
            return math.inf, 1.0
        part = float(np.median(noise[known]) / np.median(information[known]))
        left = 1.0 - part if part < MOST_NOISE else 0.0
        with np.errstate(divide="ignore"):
            return float(np.median(slope[known] / np.sqrt(left * information[known]))), part

    recorded, part = bound(background, law)
    return recorded, bound(0.0, "poisson")[0], part
