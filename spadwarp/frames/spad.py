"""The camera: counts and time tags of a SPAD array from expected detections, and the noise they have of a simulation.

Expected detections per pulse, `[H, W, T]`, in unwrapped time → response (pulse ⊗ jitter), wrapping at the pulse period,
dark counts, ambient light, crosstalk → hazard λ per detector bin → counts, drawn exactly.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import histogram_rows, in_torch_order, is_torch, on_host, output_tensor, tensor_of
from spadwarp.errors import ArgumentError, SpadwarpWarning, kernel_errors
from spadwarp.frames.frames import Frames, TimeTags
from spadwarp.frames.receiver import Receiver, missing_light
from spadwarp.frames.response import InstrumentResponse, detector_response
from spadwarp.limits import BIN_WIDTH, SEED, TIME, check_integer, check_real, shown
from spadwarp.result.file import as_result
from spadwarp.result.result import Result, Truth
from spadwarp.scene import Detector, Laser, detection_efficiency, noise_rate

__all__ = ["MonteCarloNoise", "detect", "monte_carlo_noise"]

LIMIT = 0.5
"""Standard error of a pixel over its shot noise from which on it counts: variances then add up to 1.25 times."""

_PART = 0.95  # of the pixels that have to be below the limit


@dataclass(frozen=True, kw_only=True)
class MonteCarloNoise:
    """The standard error of a result against the shot noise of one frame, both of the counts of a pixel.

    Attributes:
        pulses: Of the frame.
        ratio: Standard error over shot noise, at the 95th percentile of the pixels.
        pixels: Part of the pixels in which it is above 0.5.
        photons: That were traced.
        photons_needed: That would bring `ratio` to 0.5, from its fall with the square root of their number.
    """

    pulses: int
    ratio: float
    pixels: float
    photons: int
    photons_needed: float

    @property
    def exceeds(self) -> bool:
        """Whether the frames show it."""
        return self.ratio > LIMIT

    def __str__(self) -> str:
        return (
            f"Monte Carlo noise, the same in every frame: the standard error of the simulation is above {LIMIT:g} of "
            f"the shot noise of {self.pulses} pulses in {100 * self.pixels:.3g} % of the pixels, and {self.ratio:.2g} "
            f"of it at the 95th percentile; about {self.photons_needed:.1e} photons instead of {self.photons:.1e} "
            f"would make that {LIMIT:g}"
        )


UNKNOWN = (
    "Monte Carlo noise is unknown: the result keeps no standard errors (simulate with --uncertainty); the noise of its "
    "histograms is drawn as if it were light, the same in every frame, and counts as information in the Cramér–Rao "
    "bound, which is too small where few photons were traced"
)


def noise_caption(ratio: float | None) -> str:
    """For the caption of a picture of frames that show the noise of the simulation; else empty."""
    if ratio is None or ratio <= LIMIT:
        return ""
    return f"; too few photons traced: Monte Carlo noise of expected and counts {ratio:.2g} times the shot noise"


def monte_carlo_noise(
    result: Any, *, pulses: int, detector: Detector | None = None, laser: Laser | None = None
) -> MonteCarloNoise | None:
    """The noise that frames of so many pulses inherit from a result; None where it keeps no standard errors.

    Args:
        result: A `Result`.
        pulses: Of one frame.
        detector, laser: Sections of a scene; default: those of the result's.
    """
    if not isinstance(result, Result) or result.second_moment is None or result.photons < 2 * result.batch_size:
        return None
    scene = result.scene
    detector, laser = detector or scene.detector, laser or scene.laser
    scale = laser.photons_per_pulse * detection_efficiency(laser, detector)
    # Bins are nearly independent: a history adds to few of those of one pixel.
    error = np.sqrt(np.square(result.standard_error).sum(axis=2)) * scale
    seen = scene.model_copy(update={"detector": detector, "laser": laser})
    noise = noise_rate(seen, result.truth)
    expected = result.intensity * scale + (noise[..., 0] if np.ndim(noise) else noise) * (
        scene.gate.stop - scene.gate.start
    )
    # A first-photon detector counts one a pulse at most, of light and error in the same measure.
    counted = pulses * (-np.expm1(-expected) if detector.mode == "first_photon" else expected)
    ratios = np.sqrt(counted) * np.divide(error, expected, out=np.zeros_like(error), where=expected > 0)
    ratio = float(np.quantile(ratios, _PART))
    return MonteCarloNoise(
        pulses=pulses,
        ratio=ratio,
        pixels=float(np.mean(ratios > LIMIT)),
        photons=result.photons,
        photons_needed=result.photons * (ratio / LIMIT) ** 2,
    )


# Frames


_LIMITS = {"pulses": "[1, 2147483647]", "frames": "[1, 2147483647]", "first_frame": "[0, 4294967295]"}


@kernel_errors()
def detect(
    source: Any,
    *,
    pulses: int | None = None,
    frames: int = 1,
    seed: int,
    detector: Detector | None = None,
    laser: Laser | None = None,
    gate_start: float | None = None,
    bin_width: float | None = None,
    irf: InstrumentResponse | None = None,
    background: Any = None,
    ambient: ArrayLike | None = None,
    window: tuple[float, int] | None = None,
    tdc_widths: ArrayLike | None = None,
    first_frame: int = 0,
    summed: bool = False,
    tags: bool = False,
    camera_seed: int = 0,
    out: Any = None,
    device: Any = None,
) -> Frames:
    """Frames of counts that the camera would record.

    First-photon counts are exact multinomials, drawn bin after bin as binomials at a cost that does not depend on
    `pulses`. Free-running, first-photon with afterpulsing, and time tags are followed event by event, at a cost per
    detection. Crosstalk enters as a mean: λ gains `crosstalk_probability` times the expected detections of each of the
    four neighbours in the same bin; that its counts come in pairs is left out. Dead time acts in free-running mode.

    The light of a Result has the noise of the simulation, which is drawn as if it were light, the same in every frame:
    a warning says by how much it exceeds the shot noise (see `monte_carlo_noise`), a note that it is unknown.

    Args:
        source: A `Result`, its path, or a `TorchResult`; or expected detections per pulse `[H, W, T]` (PDE included,
            noise not; NumPy, torch, Warp). From torch tensors come torch tensors, on their device.
        pulses: Per frame; default: the detector's.
        frames: Independent exposures.
        seed: 64 bits. The counts of a frame depend on the seed and the frame's number alone.
        detector, laser: Sections of a scene; default: those of the Result's scene. To wrap time, an array needs a
            laser.
        gate_start, bin_width: Time axis of an array source [s].
        irf: The response; default: from laser and detector. `InstrumentResponse()` where the source has it already.
        background: The part of `source` that is not target, of the same shape, for the estimators; default: the
            backscatter of a Result.
        ambient: Detected ambient light [1/s], a number or `[H, W]`, on top of `detector.ambient_rate`; default: the
            daylight of a Result's scene, on what its pixels see.
        window: (start [s], bins) of the detector; default: those of the source, cut to the period where time wraps.
            If the source is longer than the window, the near-range backscatter of later pulses is wrapped into it.
        tdc_widths: Relative widths of the window's bins, `[bins]`; their mean counts as `bin_width`.
        first_frame: Number of the first frame.
        summed: Add the frames up.
        tags: Also return every detection.
        camera_seed: Of the pixels' dark count rates, which a camera keeps.
        out: The caller's own torch tensor for the counts, contiguous int32 of their shape, on the device.
        device: Warp device; default: where the source lies, for NumPy the first GPU or else the CPU.

    Raises:
        ArgumentError: Names the argument, its value and what is allowed.
    """
    import warp as wp

    source = as_result(source) if isinstance(source, str | os.PathLike) else source
    result, scene = source, getattr(source, "scene", None)
    for name, value, kind in (("detector", detector, Detector), ("laser", laser, Laser)):
        if not (value is None or isinstance(value, kind)):
            raise ArgumentError(f"{name} = {shown(value)} is not the section {name} of a scene")
    if scene is not None:
        if gate_start is not None or bin_width is not None:
            raise ArgumentError(
                "gate_start and bin_width are for arrays: a result has its own; window gives the camera's"
            )
        detector, laser = detector or scene.detector, laser or scene.laser
        gate_start, bin_width = scene.gate.start, scene.gate.bin_width
        detections_per_photon = laser.photons_per_pulse * detection_efficiency(laser, detector)
        if background is None:
            background = source.component("backscatter") * detections_per_photon
        if ambient is None and scene.daylight is not None:
            lit = scene.model_copy(update={"detector": detector, "laser": laser})
            truth = Truth(**{name: on_host(getattr(source.truth, name)) for name in Truth.__dataclass_fields__})
            ambient = noise_rate(lit, truth)[..., 0] - detector.noise_rate
        source = source.histogram * detections_per_photon
    detector = detector or Detector()
    pulses = detector.pulses_per_frame if pulses is None else pulses
    arguments = {"pulses": pulses, "frames": frames, "first_frame": first_frame, "seed": seed}
    numbers = {name: check_integer(name, value, _LIMITS.get(name, SEED)) for name, value in arguments.items()}
    camera_seed = check_integer("camera_seed", camera_seed, SEED)
    if summed and (total := numbers["pulses"] * numbers["frames"]) > 2**31 - 1:
        raise ArgumentError(f"pulses · frames = {total} is above {2**31 - 1}: give fewer, or summed=False")
    if gate_start is None or bin_width is None:
        raise ArgumentError("gate_start or bin_width is missing: an array source needs both")
    gate_start = check_real("gate_start", gate_start, TIME)
    bin_width = check_real("bin_width", bin_width, BIN_WIDTH)
    if laser is None and (detector.wrap or detector.mode == "free_running" or tags):
        raise ArgumentError("laser is missing: the detector needs its repetition rate (unless wrap = false)")
    irf = detector_response(detector, laser) if irf is None else irf
    options: dict[str, Any] = {"irf": irf, "window": window, "tdc_widths": tdc_widths, "ambient": ambient}
    form: Any = {"shape": "[H, W, T]", "dimensions": range(3, 4)}
    with in_torch_order(source, background, out):
        rows, shape = histogram_rows(source, name="source", device=device, **form)
        axis = (gate_start, bin_width)
        receiver = Receiver.of(
            detector, laser, shape=shape, axis=axis, device=rows.device, camera_seed=camera_seed, **options
        )
        hazard, known = receiver.hazard(rows), receiver.noise_alone()
        if background is not None:
            rows, known_shape = histogram_rows(background, name="background", device=rows.device, **form)
            if known_shape != shape:
                raise ArgumentError(f"background has shape {known_shape}; that of the source, {shape}, is needed")
            known = receiver.light(rows)
        as_torch = is_torch(source) or out is not None
        if as_torch:
            out_shape = (*(() if summed else (numbers["frames"],)), *receiver.image, receiver.window.recorded)
            out = output_tensor(out, name="out", shape=out_shape, device=hazard.device)
        counts, events = _draw(receiver, hazard, numbers, summed=summed, tags=tags, out=out)
        to_caller: Any = tensor_of if as_torch else wp.array.numpy
        expected, known = to_caller(hazard), to_caller(known)
    recorded = receiver.window.recorded
    notes = missing_light(receiver.window, gate_start) if detector.wrap else ()
    noise = None if scene is None else monte_carlo_noise(result, pulses=pulses, detector=detector, laser=laser)
    if noise is not None and noise.exceeds:
        warnings.warn(str(noise), SpadwarpWarning, stacklevel=3)
    return Frames(
        counts=counts,
        expected=expected[:, :recorded].reshape(*receiver.image, -1),
        background=known[:, :recorded].reshape(*receiver.image, -1),
        gate_start=receiver.window.start,
        bin_width=bin_width,
        edges=receiver.window.edges[: recorded + 1],
        period=receiver.window.period if detector.wrap else None,
        irf=irf,
        tags=None if events is None else _time_tags(events, receiver.image, first_frame),
        notes=notes if scene is None or noise is not None else (*notes, UNKNOWN),
        monte_carlo_noise=None if noise is None else noise.ratio,
        **numbers,
    )


def _draw(
    receiver: Receiver, hazard: Any, numbers: dict[str, int], *, summed: bool, tags: bool, out: Any
) -> tuple[Any, dict[str, NDArray[Any]] | None]:
    """Counts, in the tensor `out` where there is one, and for tags the detections one by one."""
    import warp as wp

    from spadwarp_kernels import detection as kernels

    detector, window, frames = receiver.detector, receiver.window, numbers["frames"]
    by_event = detector.mode == "free_running" or tags or detector.afterpulsing_probability > 0
    add_frames = by_event and summed  # the kernel of events does not
    in_place = out is not None and not add_frames
    common: dict[str, Any] = {**numbers, "counter_depth": detector.max_count}
    common["counts"] = wp.from_torch(out).flatten() if in_place else None
    events = None
    if by_event:
        counts, events = kernels.event_counts(
            hazard,
            edges=window.edges,
            recorded=window.recorded,
            period=window.period,
            gated=detector.mode != "free_running",
            dead_time=detector.dead_time_ns * 1e-9,
            afterpulsing_probability=detector.afterpulsing_probability,
            afterpulsing_time_constant=detector.afterpulsing_time_constant_ns * 1e-9,
            tags=tags,
            **common,
        )
    else:
        counts = kernels.first_photon_counts(hazard, summed=summed, **common)
    if in_place:
        return out, events
    every: Any = counts.numpy() if out is None else tensor_of(counts)
    every = every.reshape(*(() if summed and not add_frames else (frames,)), *receiver.image, window.recorded)
    every = every.sum(0, dtype=every.dtype) if add_frames else every
    return (every if out is None else out.copy_(every)), events


def _time_tags(events: dict[str, NDArray], image: tuple[int, int], first_frame: int) -> TimeTags:
    frame, pixel = np.divmod(events["row"], image[0] * image[1])
    y, x = np.divmod(pixel, image[1])
    return TimeTags(frame + first_frame, y, x, events["pulse"], events["bin"])
