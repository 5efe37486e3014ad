"""The camera: counts and time tags of a SPAD array from expected detections.

Expected detections per pulse, `[H, W, T]`, in unwrapped time → response (pulse ⊗ jitter), wrapping at the pulse period,
dark counts, ambient light, crosstalk → hazard λ per detector bin → counts, drawn exactly.
"""

from __future__ import annotations

import os
import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import histogram_rows, in_torch_order, is_torch, on_host, output_tensor, tensor_of
from spadwarp.errors import ArgumentError, SpadwarpWarning, kernel_errors
from spadwarp.frames.frames import Frames, TimeTags
from spadwarp.frames.monte_carlo_noise import UNKNOWN, monte_carlo_noise
from spadwarp.frames.receiver import Receiver
from spadwarp.frames.response import InstrumentResponse, detector_response
from spadwarp.frames.window import Window, missing_light
from spadwarp.limits import BIN_WIDTH, SEED, TIME, check_integer, check_real, shown
from spadwarp.result.file import as_result
from spadwarp.result.result import Truth
from spadwarp.scene import Detector, Laser, detection_efficiency, noise_rate

__all__ = ["detect"]

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
    given = {"pulses": pulses, "frames": frames, "first_frame": first_frame, "seed": seed}
    numbers = {name: check_integer(name, value, _LIMITS.get(name, SEED)) for name, value in given.items()}
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
    camera = _Camera(detector, laser, irf, window, tdc_widths, camera_seed, ambient)
    with in_torch_order(source, background, out):
        light = _expected(source, background, camera, (gate_start, bin_width), device)
        drawn = _draw(light, detector, is_torch(source), numbers, summed=summed, tags=tags, out=out)
    time_axis, recorded = light.window, light.window.recorded
    noise, unknown = (None, ()) if scene is None else _noise_of_simulation(result, pulses, detector, laser)
    return Frames(
        counts=drawn.counts,
        expected=drawn.expected[:, :recorded].reshape(*light.image, -1),
        background=drawn.background[:, :recorded].reshape(*light.image, -1),
        gate_start=time_axis.start,
        bin_width=bin_width,
        edges=time_axis.edges[: recorded + 1],
        period=time_axis.period if detector.wrap else None,
        irf=irf,
        tags=None if drawn.events is None else _time_tags(drawn.events, light.image, first_frame),
        notes=(
            *(missing_light(time_axis, gate_start) if detector.wrap else ()),
            *unknown,
        ),
        monte_carlo_noise=noise,
        **numbers,
    )


def _noise_of_simulation(
    result: Any, pulses: int, detector: Detector, laser: Laser | None
) -> tuple[float | None, tuple[str, ...]]:
    """Noise over shot noise, with a warning where frames show it, and a note where nobody knows whether they do."""
    noise = monte_carlo_noise(result, pulses=pulses, detector=detector, laser=laser)
    if noise is None:
        return None, (UNKNOWN,)
    if noise.exceeds:
        warnings.warn(str(noise), SpadwarpWarning, stacklevel=4)
    return noise.ratio, ()


# Expected detections


class _Camera(NamedTuple):
    detector: Detector
    laser: Laser | None
    irf: InstrumentResponse
    window: tuple[float, int] | None
    tdc_widths: ArrayLike | None
    seed: int
    ambient: ArrayLike | None


class _Light(NamedTuple):
    """Expected detections per pulse before pile-up, in the bins of the window: Warp rows `[pixel, bin]`."""

    hazard: Any
    background: Any
    window: Window
    image: tuple[int, int]


def _expected(source: Any, background: Any, camera: _Camera, axis: tuple[float, float], device: Any) -> _Light:
    """Light through the response, noise and crosstalk; `axis`: start and bin width of the source [s]."""
    form: Any = {"shape": "[H, W, T]", "dimensions": range(3, 4)}
    rows, shape = histogram_rows(source, name="source", device=device, **form)
    receiver = Receiver.of(
        camera.detector,
        camera.laser,
        shape=shape,
        axis=axis,
        device=rows.device,
        irf=camera.irf,
        window=camera.window,
        tdc_widths=camera.tdc_widths,
        ambient=camera.ambient,
        camera_seed=camera.seed,
    )
    hazard = receiver.hazard(rows)
    if background is None:
        expected_background = receiver.noise_alone()
    else:
        known, known_shape = histogram_rows(background, name="background", device=rows.device, **form)
        if known_shape != shape:
            raise ArgumentError(f"background has shape {known_shape}; that of the source, {shape}, is needed")
        expected_background = receiver.light(known)
    return _Light(hazard, expected_background, receiver.window, (shape[0], shape[1]))


# Counts


class _Drawn(NamedTuple):
    """Arrays for the caller, NumPy or torch; `events`: detections one by one, or None."""

    counts: Any
    expected: Any
    background: Any
    events: dict[str, NDArray] | None


def _draw(
    light: _Light, detector: Detector, as_torch: bool, numbers: dict[str, int], *, summed: bool, tags: bool, out: Any
) -> _Drawn:
    import warp as wp

    from spadwarp_kernels import detection as kernels

    window, free_running, frames = light.window, detector.mode == "free_running", numbers["frames"]
    by_event = free_running or tags or detector.afterpulsing_probability > 0
    shape = (*(() if summed else (frames,)), *light.image, window.recorded)
    add_frames = by_event and summed  # the kernel of events does not
    as_torch = as_torch or out is not None
    if as_torch:
        out = output_tensor(out, name="out", shape=shape, device=light.hazard.device)
    in_place = as_torch and not add_frames
    common: dict[str, Any] = {**numbers, "counter_depth": detector.max_count}
    common["counts"] = wp.from_torch(out).flatten() if in_place else None
    events = None
    if by_event:
        counts, events = kernels.event_counts(
            light.hazard,
            edges=window.edges,
            recorded=window.recorded,
            period=window.period,
            gated=not free_running,
            dead_time=detector.dead_time_ns * 1e-9,
            afterpulsing_probability=detector.afterpulsing_probability,
            afterpulsing_time_constant=detector.afterpulsing_time_constant_ns * 1e-9,
            tags=tags,
            **common,
        )
    else:
        counts = kernels.first_photon_counts(light.hazard, summed=summed, **common)
    to_caller: Any = tensor_of if as_torch else wp.array.numpy
    counts = out if in_place else to_caller(counts)
    if add_frames:
        counts = counts.reshape(frames, *shape).sum(0, dtype=counts.dtype)
        counts = out.copy_(counts) if as_torch else counts
    return _Drawn(counts.reshape(shape), to_caller(light.hazard), to_caller(light.background), events)


def _time_tags(events: dict[str, NDArray], image: tuple[int, int], first_frame: int) -> TimeTags:
    frame, pixel = np.divmod(events["row"], image[0] * image[1])
    y, x = np.divmod(pixel, image[1])
    return TimeTags(frame + first_frame, y, x, events["pulse"], events["bin"])
