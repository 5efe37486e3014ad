"""The camera: counts and time tags of a SPAD array from expected detections.

Expected detections per pulse, `[H, W, T]`, in unwrapped time → response (pulse ⊗ jitter), wrapping at the pulse period,
dark counts, ambient light, crosstalk → hazard λ per detector bin → counts, drawn exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import histogram_rows, in_torch_order, is_torch, output_tensor, tensor_of
from spadwarp.errors import ArgumentError
from spadwarp.frames.frames import Frames, TimeTags
from spadwarp.frames.response import InstrumentResponse, detector_response, response_matrix
from spadwarp.frames.window import Window, detector_window, missing_light
from spadwarp.scene import Detector, Laser

__all__ = ["detect"]


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

    Args:
        source: A `Result` or `TorchResult`, or expected detections per pulse `[H, W, T]` (PDE included, noise not;
            NumPy, torch, Warp). From torch tensors come torch tensors, on their device.
        pulses: Per frame; default: the detector's.
        frames: Independent exposures.
        seed: 64 bits. The counts of a frame depend on the seed and the frame's number alone.
        detector, laser: Sections of a scene; default: those of the Result's scene. To wrap time, an array needs a
            laser.
        gate_start, bin_width: Time axis of an array source [s].
        irf: The response; default: from laser and detector. `InstrumentResponse()` where the source has it already.
        background: The part of `source` that is not target, of the same shape, for the estimators; default: the
            backscatter of a Result.
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
    plan = _plan(
        source,
        detector=detector,
        laser=laser,
        gate_start=gate_start,
        bin_width=bin_width,
        irf=irf,
        background=background,
        window=window,
        tdc_widths=tdc_widths,
        pulses=pulses,
        frames=frames,
        first_frame=first_frame,
        seed=seed,
        camera_seed=camera_seed,
        summed=summed,
        tags=tags,
    )
    with in_torch_order(plan.source, plan.background, out):
        light = _expected(plan, device)
        drawn = _draw(plan, light, out)
    return _pack(plan, light, drawn)


# Plan


@dataclass(frozen=True, eq=False, kw_only=True)
class _Plan:
    """Arguments of `detect`, complete and checked; sources are expected detections per pulse."""

    source: Any
    background: Any
    detector: Detector
    laser: Laser | None
    gate_start: float
    bin_width: float
    irf: InstrumentResponse
    window: tuple[float, int] | None
    tdc_widths: ArrayLike | None
    pulses: int
    frames: int
    first_frame: int
    seed: int
    camera_seed: int
    summed: bool
    tags: bool

    @property
    def free_running(self) -> bool:
        return self.detector.mode == "free_running"

    @property
    def by_event(self) -> bool:
        """Whether detections are followed one by one."""
        return self.free_running or self.tags or self.detector.afterpulsing_probability > 0


def _plan(source: Any, *, background: Any, detector: Detector | None, laser: Laser | None, **options: Any) -> _Plan:
    scene = getattr(source, "scene", None)
    if scene is not None:
        detector, laser = detector or scene.detector, laser or scene.laser
        options |= {"gate_start": scene.gate.start, "bin_width": scene.gate.bin_width}
        detections_per_photon = laser.photons_per_pulse * detector.pde
        if background is None:
            background = source.component("backscatter") * detections_per_photon
        source = source.histogram * detections_per_photon
    detector = detector or Detector()
    if options["pulses"] is None:
        options["pulses"] = detector.pulses_per_frame
    _check_integers(**{name: options[name] for name in ("pulses", "frames", "first_frame", "seed", "camera_seed")})
    total = options["pulses"] * options["frames"]
    if options["summed"] and total > 2**31 - 1:
        raise ArgumentError(f"pulses · frames = {total} is above {2**31 - 1}: give fewer, or summed=False")
    start, width = options["gate_start"], options["bin_width"]
    if start is None or width is None:
        raise ArgumentError("gate_start or bin_width is missing: an array source needs both")
    if not (math.isfinite(start) and math.isfinite(width) and width > 0):
        raise ArgumentError(f"gate_start = {start} s, bin_width = {width} s: finite and a width > 0 are needed")
    if laser is None and (detector.wrap or detector.mode == "free_running" or options["tags"]):
        raise ArgumentError("laser is missing: the detector needs its repetition rate (unless wrap = false)")
    if options["irf"] is None:
        options["irf"] = detector_response(detector, laser)
    return _Plan(source=source, background=background, detector=detector, laser=laser, **options)


def _check_integers(**numbers: int) -> None:
    limits = {"pulses": (1, 2**31 - 1), "frames": (1, 2**31 - 1), "first_frame": (0, 2**32 - 1)}
    for name, value in numbers.items():
        least, most = limits.get(name, (0, 2**64 - 1))
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not least <= value <= most:
            raise ArgumentError(f"{name} = {value!r} is not an integer in [{least}, {most}]")


# Expected detections


class _Light(NamedTuple):
    """Expected detections per pulse before pile-up, in the bins of the window: Warp rows `[pixel, bin]`."""

    hazard: Any
    background: Any
    window: Window
    image: tuple[int, int]

    @property
    def device(self) -> Any:
        return self.hazard.device


def _expected(plan: _Plan, device: Any) -> _Light:
    """Light through the response, noise and crosstalk."""
    from spadwarp_kernels import detection as kernels

    detector = plan.detector
    form: Any = {"device": device, "shape": "[H, W, T]", "dimensions": range(3, 4)}
    rows, shape = histogram_rows(plan.source, name="source", **form)
    window = detector_window(
        plan.window or (plan.gate_start, shape[2]),
        plan.bin_width,
        plan.tdc_widths,
        period=math.inf if plan.laser is None else 1.0 / plan.laser.repetition_rate,
        wrap=detector.wrap,
        free_running=plan.free_running,
    )
    matrix = response_matrix(
        plan.irf,
        source_start=plan.gate_start,
        source_width=plan.bin_width,
        source_bins=shape[2],
        edges=window.start + window.edges,
        period=window.period if detector.wrap else None,
    )
    noise = kernels.dark_count_rates(
        rows.shape[0],
        median=detector.dark_count_rate,
        spread=detector.dark_count_spread,
        hot_fraction=detector.hot_pixel_fraction,
        hot_rate=detector.hot_pixel_rate,
        offset=detector.ambient_rate,
        seed=plan.camera_seed,
        device=rows.device,
    )

    def with_noise(light: Any) -> Any:
        return kernels.expected_detections(light, **matrix._asdict(), width=np.diff(window.edges), noise_rate=noise)

    hazard = with_noise(rows)
    if detector.crosstalk_probability > 0:
        if plan.free_running:
            fired = kernels.free_running_probabilities(
                hazard, dead_time=detector.dead_time_ns * 1e-9, period=window.period
            )
        else:
            fired = kernels.first_photon_probabilities(hazard)
        kernels.add_crosstalk(hazard, fired, image_width=shape[1], probability=detector.crosstalk_probability)
    if plan.background is None:
        background = _noise_alone(plan, window, noise)
    else:
        known, known_shape = histogram_rows(plan.background, name="background", **{**form, "device": rows.device})
        if known_shape != shape:
            raise ArgumentError(f"background has shape {known_shape}; that of the source, {shape}, is needed")
        background = with_noise(known)
    return _Light(hazard, background, window, (shape[0], shape[1]))


def _noise_alone(plan: _Plan, window: Window, noise: Any) -> Any:
    """Dark counts and ambient light per pulse, `[pixel, 1]` where all bins are equally wide."""
    import warp as wp

    widths = np.diff(window.edges[: window.recorded + 1])
    widths = widths[:1] if plan.tdc_widths is None else widths
    return wp.array((noise.numpy()[:, None] * widths).astype(np.float32), device=noise.device)


# Counts


class _Drawn(NamedTuple):
    """Arrays for the caller, NumPy or torch; `events`: detections one by one, or None."""

    counts: Any
    expected: Any
    background: Any
    events: dict[str, NDArray] | None


def _draw(plan: _Plan, light: _Light, out: Any) -> _Drawn:
    import warp as wp

    from spadwarp_kernels import detection as kernels

    detector, window = plan.detector, light.window
    shape = (*(() if plan.summed else (plan.frames,)), *light.image, window.recorded)
    add_frames = plan.by_event and plan.summed  # the kernel of events does not
    as_torch = is_torch(plan.source) or out is not None
    if as_torch:
        out = output_tensor(out, name="out", shape=shape, device=light.device)
    in_place = as_torch and not add_frames
    common: dict[str, Any] = {
        "pulses": plan.pulses,
        "frames": plan.frames,
        "first_frame": plan.first_frame,
        "counter_depth": detector.counter_depth,
        "seed": plan.seed,
        "counts": wp.from_torch(out).flatten() if in_place else None,
    }
    events = None
    if plan.by_event:
        counts, events = kernels.event_counts(
            light.hazard,
            edges=window.edges,
            recorded=window.recorded,
            period=window.period,
            gated=not plan.free_running,
            dead_time=detector.dead_time_ns * 1e-9,
            afterpulsing_probability=detector.afterpulsing_probability,
            afterpulsing_time_constant=detector.afterpulsing_time_constant_ns * 1e-9,
            tags=plan.tags,
            **common,
        )
    else:
        counts = kernels.first_photon_counts(light.hazard, summed=plan.summed, **common)
    to_caller: Any = tensor_of if as_torch else wp.array.numpy
    counts = out if in_place else to_caller(counts)
    if add_frames:
        counts = counts.reshape(plan.frames, *shape).sum(0, dtype=counts.dtype)
        counts = out.copy_(counts) if as_torch else counts
    return _Drawn(counts.reshape(shape), to_caller(light.hazard), to_caller(light.background), events)


def _pack(plan: _Plan, light: _Light, drawn: _Drawn) -> Frames:
    window = light.window
    return Frames(
        counts=drawn.counts,
        pulses=plan.pulses,
        frames=plan.frames,
        first_frame=plan.first_frame,
        gate_start=window.start,
        bin_width=plan.bin_width,
        edges=window.edges[: window.recorded + 1],
        period=window.period if plan.detector.wrap else None,
        irf=plan.irf,
        expected=drawn.expected[:, : window.recorded].reshape(*light.image, -1),
        background=drawn.background[:, : window.recorded].reshape(*light.image, -1),
        seed=plan.seed,
        tags=None if drawn.events is None else _time_tags(drawn.events, light.image, plan.first_frame),
        notes=missing_light(window, plan.gate_start) if plan.detector.wrap else (),
    )


def _time_tags(events: dict[str, NDArray], image: tuple[int, int], first_frame: int) -> TimeTags:
    frame, pixel = np.divmod(events["row"], image[0] * image[1])
    y, x = np.divmod(pixel, image[1])
    return TimeTags(frame + first_frame, y, x, events["pulse"], events["bin"])
