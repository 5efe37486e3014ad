"""The camera: counts and time tags of a SPAD array from expected detections.

Expected detections per pulse, `[H, W, T]`, in unfolded time → response (pulse ⊗ jitter), folding at the pulse period,
dark counts, ambient light, crosstalk → hazard λ per detector bin → counts, drawn exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import as_warp, in_torch_order, is_torch, output_tensor, tensor_of
from spadwarp.frames.response import InstrumentResponse, instrument_response, response_matrix
from spadwarp.scene import Detector, Laser

if TYPE_CHECKING:
    from spadwarp.frames.arrival_time import Method

__all__ = [
    "Frames",
    "InstrumentResponse",
    "TimeTags",
    "coates",
    "detect",
    "first_photon_probabilities",
    "instrument_response",
]


class TimeTags(NamedTuple):
    """Detections one by one, in the order of frame, pixel and time; `bin` counts from the window's start."""

    frame: NDArray[np.int64]
    y: NDArray[np.int64]
    x: NDArray[np.int64]
    pulse: NDArray[np.int64]
    bin: NDArray[np.int32]


@dataclass(frozen=True, eq=False, kw_only=True)
class Frames:
    """What the camera reports; `counts`, `expected` and `background` are torch tensors if it was asked by them.

    Attributes:
        counts: int32 `[frames, H, W, T]`, or `[H, W, T]` for the sum of the frames.
        pulses: laser pulses per frame; frames: how many; first_frame: number of the first.
        gate_start: start of the detector's window [s]. With folding a count at time t stands for light at t plus any
            number of periods.
        bin_width: nominal [s].
        edges: `[T + 1]`, actual bin edges from `gate_start` [s] (differential non-linearity).
        period: of the pulses [s], where time is folded; else None.
        irf: the response that was applied.
        expected: float32 `[H, W, T]`, expected detections per pulse and bin before pile-up, of which the counts were
            drawn: light through the response, dark counts, ambient light, crosstalk.
        background: float32 `[H, W, 1 or T]`, expected background detections per pulse and bin before pile-up: dark
            counts, ambient light and, where the source tells it, backscatter.
        seed: of the random numbers.
        tags: the time-tag stream, where it was asked for.
        notes: what the source could not give, in words.
    """

    counts: NDArray[np.int32]
    pulses: int
    frames: int
    first_frame: int
    gate_start: float
    bin_width: float
    edges: NDArray[np.float64]
    period: float | None
    irf: InstrumentResponse
    expected: NDArray[np.float32]
    background: NDArray[np.float32]
    seed: int
    tags: TimeTags | None = None
    notes: tuple[str, ...] = ()

    @property
    def summed(self) -> bool:
        """Whether the frames have been added up."""
        return self.counts.ndim == 3

    @property
    def exposure(self) -> int:
        """Pulses behind each histogram of `counts`."""
        return self.pulses * self.frames if self.summed else self.pulses

    @property
    def intensity(self) -> NDArray[np.int64]:
        """Counts of each pixel over all bins: `[frames, H, W]` or `[H, W]`."""
        return self.counts.sum(-1) if is_torch(self.counts) else self.counts.sum(axis=-1, dtype=np.int64)

    def coates(self) -> NDArray[np.float64]:
        """Detections per pulse and bin with pile-up undone; see `coates`."""
        return coates(self.counts, pulses=self.exposure)

    def arrival_time(
        self,
        method: Method = "centroid",
        *,
        irf: Any = None,
        undo_pile_up: bool = False,
        gate: tuple[float, float] | None = None,
        device: Any = None,
    ) -> NDArray[np.float64]:
        """Arrival time of the return [s]: `[frames, H, W]` or `[H, W]`, NaN where there is none.

        Bins count as evenly wide, as for a camera that nobody has calibrated. The background is known to the estimator.

        Args:
            method: as in `spadwarp.frames.arrival_time.arrival_time`.
            irf: the response that the estimator assumes; default: the one that was applied.
            undo_pile_up: estimate from Coates' correction of the counts.
            gate: (start, stop) [s] to look in.
        """
        from spadwarp.frames.arrival_time import arrival_time

        histogram: Any = self.counts
        if undo_pile_up:
            undone: Any = self.coates()
            histogram = (undone.nan_to_num() if is_torch(undone) else np.nan_to_num(undone)) * self.exposure
        return arrival_time(
            histogram,
            gate_start=self.gate_start,
            bin_width=self.bin_width,
            method=method,
            irf=self.irf if irf is None else irf,
            background=self.background * float(self.exposure),
            gate=gate,
            device=device,
        )


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
    detection. Crosstalk enters as a mean: λ gains `crosstalk_probability` times what each of the four neighbours is
    expected to detect in the same bin; that its counts come in pairs is left out. Dead time acts in free-running mode.

    Args:
        source: a `Result` or `TorchResult`, or expected detections per pulse `[H, W, T]` (PDE included, noise not;
            NumPy, torch, Warp). Torch tensors in: torch tensors out, on their device.
        pulses: per frame; default: the detector's.
        frames: independent exposures.
        seed: 64 bits. The counts of a frame depend on the seed and the frame's number alone.
        detector, laser: sections of a scene; default: those of the Result's scene. An array needs a laser to fold.
        gate_start, bin_width: time axis of an array source [s].
        irf: the response; default: from laser and detector. `InstrumentResponse()` where the source has it already.
        background: the part of `source` that is not target, of the same shape, for the estimators; default: the
            backscatter of a Result.
        window: (start [s], bins) of the detector; default: those of the source, cut to the period to fold. A source of
            longer time axis than the window has the near-range backscatter of later pulses folded into it.
        tdc_widths: relative widths of the window's bins, `[bins]`; their mean counts as `bin_width`.
        first_frame: number of the first frame.
        summed: add the frames up.
        tags: also return every detection.
        camera_seed: of the pixels' dark count rates, which a camera keeps.
        out: the caller's own torch tensor for the counts, contiguous int32 of their shape, on the device.
        device: Warp device; default: where the source lies, for NumPy the first GPU or else the CPU.

    Raises:
        ValueError: naming the argument, its value and what is allowed.
    """
    import warp as wp

    from spadwarp_kernels import detection as kernels

    scene = getattr(source, "scene", None)
    if scene is not None:
        detector, laser = detector or scene.detector, laser or scene.laser
        gate_start, bin_width = scene.gate.start, scene.gate.bin_width
        detections_per_photon = laser.photons_per_pulse * detector.pde
        if background is None:
            background = source.component("backscatter") * detections_per_photon
        source = source.histogram * detections_per_photon
    detector = detector or Detector()
    pulses = detector.pulses if pulses is None else pulses
    _check_numbers(pulses=pulses, frames=frames, first_frame=first_frame, seed=seed, camera_seed=camera_seed)
    if summed and pulses * frames > 2**31 - 1:
        raise ValueError(f"pulses · frames = {pulses * frames} is above {2**31 - 1}: give fewer, or summed=False")
    if gate_start is None or bin_width is None:
        raise ValueError("gate_start or bin_width is missing: an array source needs both")
    if not (math.isfinite(gate_start) and math.isfinite(bin_width) and bin_width > 0):
        raise ValueError(f"gate_start = {gate_start} s, bin_width = {bin_width} s: finite and a width > 0 are needed")
    free_running = detector.mode == "free_running"
    if laser is None and (detector.fold or free_running or tags):
        raise ValueError("laser is missing: the detector needs its repetition rate (with fold = false it need not)")

    with in_torch_order(source, background, out):
        rows, (height, width, bins) = _rows(source, "source", device)
        device = rows.device
        shape = (() if summed else (frames,)) + (height, width)
        axis = _window(
            window or (gate_start, bins),
            bin_width,
            tdc_widths,
            period=1.0 / laser.repetition_rate if laser is not None else math.inf,
            fold=detector.fold,
            free_running=free_running,
        )
        if irf is None:
            irf = instrument_response(
                pulse_fwhm=laser.pulse_fwhm_ps * 1e-12 if laser is not None else 0.0,
                jitter_fwhm=detector.jitter_fwhm_ps * 1e-12,
                shape=detector.irf,
                tail=detector.irf_tail_ps * 1e-12,
            )
        period = axis.period if detector.fold else None
        matrix = response_matrix(
            irf,
            source_start=gate_start,
            source_width=bin_width,
            source_bins=bins,
            edges=axis.start + axis.edges,
            period=period,
        )
        noise = kernels.dark_count_rates(
            rows.shape[0],
            median=detector.dark_count_rate,
            spread=detector.dark_count_spread,
            hot_fraction=detector.hot_pixel_fraction,
            hot_rate=detector.hot_pixel_rate,
            offset=detector.ambient_rate,
            seed=camera_seed,
            device=device,
        )

        def hazard_of(light: Any) -> Any:
            return kernels.expected_detections(light, **matrix._asdict(), width=np.diff(axis.edges), noise_rate=noise)

        hazard = hazard_of(rows)
        dead_time = detector.dead_time_ns * 1e-9
        if detector.crosstalk_probability > 0:
            if free_running:
                seen = kernels.free_running_probabilities(hazard, dead_time=dead_time, period=axis.period)
            else:
                seen = kernels.first_photon_probabilities(hazard)
            kernels.add_crosstalk(hazard, seen, image_width=width, probability=detector.crosstalk_probability)

        if background is None:
            widths = np.diff(axis.edges[: axis.recorded + 1])
            flat = widths[:1] if tdc_widths is None else widths
            known: Any = wp.array((noise.numpy()[:, None] * flat).astype(np.float32), device=device)
        else:
            known_rows, known_shape = _rows(background, "background", device)
            if known_shape != (height, width, bins):
                raise ValueError(
                    f"background has shape {known_shape}; that of the source, {(height, width, bins)}, is needed"
                )
            known = hazard_of(known_rows)

        by_event = free_running or tags or detector.afterpulsing_probability > 0
        as_torch = is_torch(source) or out is not None
        if as_torch:
            out = output_tensor(out, name="out", shape=(*shape, axis.recorded), device=device)
        common: dict[str, Any] = {
            "pulses": pulses,
            "frames": frames,
            "first_frame": first_frame,
            "counter_depth": detector.counter_depth,
            "seed": seed,
            "counts": wp.from_torch(out).flatten() if as_torch and not (by_event and summed) else None,
        }
        stream = None
        if by_event:
            counts, stream = kernels.event_counts(
                hazard,
                edges=axis.edges,
                recorded=axis.recorded,
                period=axis.period,
                gated=not free_running,
                dead_time=dead_time,
                afterpulsing_probability=detector.afterpulsing_probability,
                afterpulsing_time_constant=detector.afterpulsing_time_constant_ns * 1e-9,
                tags=tags,
                **common,
            )
        else:
            counts = kernels.first_photon_counts(hazard, summed=summed, **common)
        give: Callable[[Any], Any] = tensor_of if as_torch else wp.array.numpy
        arrays: dict[str, Any] = {"expected": give(hazard), "background": give(known)}
        if not as_torch or common["counts"] is None:
            arrays["counts"] = give(counts)

    counts = arrays.get("counts", out)
    if by_event and summed:
        counts = counts.reshape(frames, height, width, axis.recorded).sum(0, dtype=counts.dtype)
        if as_torch:
            counts = out.copy_(counts)
    return Frames(
        counts=counts.reshape(*shape, axis.recorded),
        pulses=pulses,
        frames=frames,
        first_frame=first_frame,
        gate_start=axis.start,
        bin_width=bin_width,
        edges=axis.edges[: axis.recorded + 1],
        period=period,
        irf=irf,
        expected=arrays["expected"][:, : axis.recorded].reshape(height, width, -1),
        background=arrays["background"][:, : axis.recorded].reshape(height, width, -1),
        seed=seed,
        tags=None if stream is None else _time_tags(stream, (height, width), first_frame),
        notes=_missing_light(axis, gate_start) if detector.fold else (),
    )


def first_photon_probabilities(hazard: Any, *, device: Any = None) -> NDArray[np.float64]:
    """Law of first-photon counting, with pile-up: P(k) = exp(−Σ_{j<k} λ_j)·(1 − exp(−λ_k)); same shape as `hazard` (λ).

    Args:
        hazard: expected detections per pulse and bin `[..., T]`, not negative; NumPy, torch or Warp.
    """
    import warp as wp

    from spadwarp_kernels import detection as kernels

    with in_torch_order(hazard):
        rows, shape = _rows(hazard, "hazard", device, dimensions=None)
        if rows.dtype not in (wp.float32, wp.float64):
            rows = wp.array(rows.numpy().astype(np.float64), device=rows.device)
        law = kernels.first_photon_probabilities(rows)
        given: Any = tensor_of(law).double() if is_torch(hazard) else law.numpy().astype(np.float64)
    return given.reshape(shape)


def coates(counts: Any, *, pulses: int, device: Any = None) -> NDArray[np.float64]:
    """Coates' correction of first-photon counts: λ̂_k = −ln(1 − n_k / (pulses − Σ_{j<k} n_j)), same shape as `counts`.

    NaN from the bin on that takes the last pulse. Source: P. B. Coates, J. Phys. E 1, 878 (1968).

    Args:
        counts: integers `[..., T]`, not negative; NumPy, torch or Warp.
        pulses: behind each histogram; no histogram may hold more counts.
    """
    import warp as wp

    from spadwarp_kernels import detection as kernels

    with in_torch_order(counts):
        rows, shape = _rows(counts, "counts", device, dimensions=None)
        if rows.dtype not in (wp.int32, wp.int64):
            raise ValueError(f"counts are {rows.dtype.__name__}; integers are needed")
        whole = rows.numpy()
        most = int(whole.sum(axis=1, dtype=np.int64).max())
        if most > pulses:
            raise ValueError(
                f"pulses = {pulses} is below the {most} counts of a histogram: it has seen more than one a pulse"
            )
        if rows.dtype != wp.int32:
            rows = wp.array(whole.astype(np.int32), dtype=wp.int32, device=rows.device)
        corrected = kernels.coates(rows, pulses=pulses)
        given: Any = tensor_of(corrected) if is_torch(counts) else corrected.numpy()
    return given.reshape(shape)


# Boundary


def _check_numbers(**numbers: int) -> None:
    limits = {"pulses": (1, 2**31 - 1), "frames": (1, 2**31 - 1), "first_frame": (0, 2**32 - 1)}
    for name, value in numbers.items():
        least, most = limits.get(name, (0, 2**64 - 1))
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not least <= value <= most:
            raise ValueError(f"{name} = {value!r} is not an integer in [{least}, {most}]")


def _rows(array: Any, name: str, device: Any, *, dimensions: int | None = 3) -> tuple[Any, tuple[int, ...]]:
    """Warp rows `[pixel, bin]` of a cube and the cube's shape; finite and not negative."""
    from spadwarp_kernels.detection import first_invalid_row

    cube = as_warp(array, name=name, device=device)
    shape = tuple(int(n) for n in cube.shape)
    if cube.size == 0 or (dimensions is not None and cube.ndim != dimensions):
        raise ValueError(f"{name} has shape {shape}; [H, W, T] with at least one pixel and one bin is needed")
    rows = cube.reshape((cube.size // shape[-1], shape[-1]))
    if (row := first_invalid_row(rows)) is not None:
        pixel = tuple(int(i) for i in np.unravel_index(row, shape[:-1])) if len(shape) > 1 else ()
        raise ValueError(f"{name} holds a negative or non-finite value in pixel {pixel}")
    return rows, shape


class _Window(NamedTuple):
    """Bins in which the detector is on; the first `recorded` of them are histogrammed."""

    start: float
    edges: NDArray[np.float64]  # [s] from the start
    recorded: int
    period: float  # from one window to the next [s]


def _window(
    window: tuple[float, int],
    bin_width: float,
    tdc_widths: ArrayLike | None,
    *,
    period: float,
    fold: bool,
    free_running: bool,
) -> _Window:
    start, bins = window
    if not math.isfinite(start) or isinstance(bins, bool) or not isinstance(bins, (int, np.integer)) or bins < 1:
        raise ValueError(f"window = {window} is not (start [s], bins >= 1)")
    if fold:
        # Time from one pulse to the next is all that the detector can tell apart.
        bins = min(bins, math.floor(period / bin_width * (1 + 1e-12)))
        if bins < 1:
            raise ValueError(f"bin_width = {bin_width} s is longer than the pulse period, {period} s")
    widths = np.full(bins, 1.0)
    if tdc_widths is not None:
        widths = np.asarray(tdc_widths, np.float64)
        if widths.shape != (bins,):
            raise ValueError(f"tdc_widths has shape {widths.shape}; ({bins},), the window's bins, is needed")
        if not (np.isfinite(widths).all() and (widths > 0).all()):
            raise ValueError(f"tdc_widths = {widths.min()} … {widths.max()} is outside (0, inf)")
        widths = widths / widths.mean()
    edges = np.append(0.0, np.cumsum(widths)) * bin_width
    if not fold:
        period = max(period, edges[-1])
    left = period - edges[-1]
    if free_running and left > 1e-9 * period:
        # Between two windows the detector goes on firing, unrecorded; without folding only from noise.
        more = math.ceil(left / bin_width) if fold else 1
        edges = np.append(edges, edges[-1] + left * np.arange(1, more + 1) / more)
    return _Window(start, edges, bins, period)


def _missing_light(axis: _Window, gate_start: float) -> tuple[str, ...]:
    """Says so if light from before the source's first bin would fold into the window."""
    turn = math.ceil((gate_start - axis.start) / axis.period - 1e-9) - 1
    if gate_start <= 0 or axis.start + turn * axis.period + axis.edges[-1] <= 0:
        return ()
    return (
        f"the source begins at {gate_start * 1e9:.6g} ns: light of later pulses that comes earlier, near-range "
        "backscatter above all, is not folded in (start the source at 0 and give `window`)",
    )


def _time_tags(stream: dict[str, NDArray], image: tuple[int, int], first_frame: int) -> TimeTags:
    frame, pixel = np.divmod(stream["row"], image[0] * image[1])
    y, x = np.divmod(pixel, image[1])
    return TimeTags(frame + first_frame, y, x, stream["pulse"], stream["bin"])
