"""The camera: frames of counts of a SPAD array from expected detections, and the noise they have of a simulation.

Expected detections per pulse, `[H, W, T]`, in unwrapped time → response (pulse ⊗ jitter), wrapping at the pulse period,
dark counts, ambient light, effects such as crosstalk → hazard λ per detector bin → counts, drawn exactly.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

import spadwarp_kernels as sk
from spadwarp.arrays import (
    Variable,
    as_warp,
    histogram_rows,
    in_torch_order,
    is_torch,
    labelled,
    on_host,
    output_tensor,
    real_array,
    tensor_of,
)
from spadwarp.frames.depth import Method, arrival_time
from spadwarp.frames.response import InstrumentResponse, SparseResponse, detector_response, response_matrix
from spadwarp.io.hdf5 import PIXELS, image_coordinates
from spadwarp.result.analysis import UNKNOWN_NOISE, noise_problem, with_frames
from spadwarp.result.file import as_result
from spadwarp.result.result import Result, Truth
from spadwarp.scene import Detector, Laser, noise_rate
from spadwarp.values import BIN_WIDTH, SEED, TIME, ArgumentError, Shown, SpadwarpWarning, check_integer, check_real

if TYPE_CHECKING:
    import xarray

__all__ = ["Frames", "Receiver", "TimeTags", "coates", "detect", "first_photon_probabilities", "to_xarray"]


class Window(NamedTuple):
    """Bins in which the detector is on, by their edges from the start; the first `recorded` are histogrammed.

    `period`: from one window to the next. All times [s].
    """

    start: float
    edges: NDArray[np.float64]
    recorded: int
    period: float

    @classmethod
    def of(
        cls, detector: Detector, laser: Laser | None, window: tuple[float, int], bin_width: float, tdc_widths: Any
    ) -> Self:
        """The window of (start [s], bins); arguments as in `spadwarp.detect`. Raises `ArgumentError`."""
        start, bins = window
        start, bins = check_real("start of window", start, TIME), check_integer("bins of window", bins, "[1, 1000000]")
        wrap, period = detector.wrap, math.inf if laser is None else 1.0 / laser.repetition_rate
        if wrap:
            # The detector knows no time beyond that from one pulse to the next.
            bins = min(bins, math.floor(period / bin_width * (1 + 1e-12)))
            if bins < 1:
                raise ArgumentError(f"bin_width = {bin_width} s is longer than the pulse period, {period} s")
        given = np.ones(bins) if tdc_widths is None else tdc_widths
        widths = real_array("tdc_widths", given, np.float64, shapes=((bins,),), within="(0, inf)")
        edges = np.append(0.0, np.cumsum(widths / widths.mean())) * bin_width
        period = period if wrap else max(period, edges[-1])
        rest = period - edges[-1]
        if detector.mode == "free_running" and rest > 1e-9 * period:
            # Between two windows the detector goes on detecting, unrecorded; where time does not wrap, noise alone.
            extra = math.ceil(rest / bin_width) if wrap else 1
            edges = np.append(edges, edges[-1] + rest * np.arange(1, extra + 1) / extra)
        return cls(start, edges, bins, period)

    def missing_light(self, gate_start: float) -> tuple[str, ...]:
        """A note if light from before the source's first bin would fall into the window, some periods later."""
        wrap = math.ceil((gate_start - self.start) / self.period - 1e-9) - 1
        if gate_start <= 0 or self.start + wrap * self.period + self.edges[-1] <= 0:
            return ()
        text = "earlier light of later pulses, near-range backscatter above all, is missing in the window"
        return (f"the source begins at {gate_start * 1e9:.6g} ns: {text} (start the source at 0 and give `window`)",)


DRAWN_EFFECTS = ("afterpulsing_probability", "max_count")  # on single detections, 0 without: a fit refuses them


@dataclass(frozen=True, eq=False, kw_only=True)
class Receiver:
    """The camera before it counts: expected detections of a detector, from expected light."""

    detector: Detector  # the section of a scene
    window: Window  # its bins in time
    image: tuple[int, int]  # (height, width)
    noise: Any
    """Dark counts and ambient light of each pixel [1/s], Warp float32 `[pixel]`; where it lies, the others lie."""
    matrix: SparseResponse  # fraction of the light of each source bin that is detected in each detector bin
    equal_bins: bool = True  # whether all bins of the window are equally wide

    @classmethod
    def of(
        cls,
        detector: Detector,
        laser: Laser | None,
        *,
        shape: tuple[int, ...],
        axis: tuple[float, float],
        device: Any,
        irf: InstrumentResponse | None = None,
        window: tuple[float, int] | None = None,
        tdc_widths: ArrayLike | None = None,
        ambient: ArrayLike | None = None,
        camera_seed: int = 0,
    ) -> Self:
        """The receiver of a source of `shape` `[H, W, T]` whose time axis is (start, bin width) [s].

        `device` is a Warp device; the others are arguments of `spadwarp.detect`. Raises `ArgumentError`.
        """
        seen = Window.of(detector, laser, window or (axis[0], shape[2]), axis[1], tdc_widths)
        noise: Any = sk.detection.dark_count_rates(
            shape[0] * shape[1],
            median=detector.dark_count_rate,
            spread=detector.dark_count_spread,
            hot_fraction=detector.hot_pixel_fraction,
            hot_rate=detector.hot_pixel_rate,
            offset=detector.ambient_rate,
            seed=camera_seed,
            device=device,
        )
        if ambient is not None:
            values = real_array("ambient", ambient, np.float64, shapes=((), shape[:2]), within="[0, inf)")
            rates = noise.numpy() + np.broadcast_to(values, shape[:2]).reshape(-1)
            noise = as_warp(rates.astype(np.float32), name="ambient", device=noise.device)
        matrix = response_matrix(
            detector_response(detector, laser) if irf is None else irf,
            source_start=axis[0],
            source_width=axis[1],
            source_bins=shape[2],
            edges=seen.start + seen.edges,
            period=seen.period if detector.wrap else None,
        )
        image, even = (shape[0], shape[1]), tdc_widths is None
        return cls(detector=detector, window=seen, image=image, noise=noise, matrix=matrix, equal_bins=even)

    def light(self, rows: Any, noise: Any = None) -> Any:
        """Light and noise in the detector's bins before its effects, Warp float32 `[pixel, bin]`, of source rows."""
        options = {"width": np.diff(self.window.edges), "noise_rate": self.noise if noise is None else noise}
        return sk.detection.expected_detections(rows, **self.matrix._asdict(), **options)

    def hazard(self, rows: Any) -> Any:
        """λ: expected detections per pulse and bin of a detector that is always ready, Warp float32 `[pixel, bin]`."""
        return self._with_crosstalk(self.light(rows), self.detections)

    def _with_crosstalk(self, rates: Any, neighbours: Callable[[Any], Any]) -> Any:
        """λ, or its slope, with a part of the detections of the four neighbours, which follow from it; in place."""
        if (probability := self.detector.crosstalk_probability) > 0:
            others = neighbours(rates)
            sk.detection.add_crosstalk(rates, others, image_width=self.image[1], probability=probability)
        return rates

    def detections(self, hazard: Any) -> Any:
        """Expected detections per pulse of λ with pile-up, Warp float32 of the same shape."""
        if self.detector.mode != "free_running":
            return sk.detection.first_photon_probabilities(hazard)
        dead_time = self.detector.dead_time_ns * 1e-9
        return sk.detection.free_running_probabilities(hazard, dead_time=dead_time, period=self.window.period)

    def background(self, rows: Any) -> Any:
        """λ of what is not target, with its own crosstalk and afterpulses, Warp float32 `[pixel, bin]`, of source rows
        of backscatter or None; of dark counts and ambient light alone `[pixel, 1]` where all bins are alike."""
        probability, device = self.detector.afterpulsing_probability, self.noise.device
        if rows is None:
            if not (probability or self.detector.crosstalk_probability):
                widths = np.diff(self.window.edges[: 2 if self.equal_bins else self.window.recorded + 1])
                return as_warp((self.noise.numpy()[:, None] * widths).astype(np.float32), name="noise", device=device)
            shape = self.noise.size, int(self.matrix.source_bin.max(initial=0)) + 1
            rows = as_warp(np.zeros(shape, np.float32), name="background", device=device)
        known = found = self.hazard(rows)
        if probability:
            share = (probability * self._afterpulse_share()).astype(np.float32)
            for _ in range(math.ceil(math.log(1e-4, probability))):  # afterpulses have afterpulses
                more = self.detections(found).numpy() @ share
                found = as_warp(known.numpy() + more, name="background", device=device)
        return found

    def _afterpulse_share(self) -> NDArray[np.float64]:
        """Of the afterpulses of a detection in a bin the part in each bin, `[bin, bin]`, of all pulses that follow; the
        delay is exponential, and those of a first-photon detector begin with the next pulse."""
        detector, edges, period = self.detector, self.window.edges, self.window.period
        dead_time, delay = 1e-9 * detector.dead_time_ns, 1e-9 * detector.afterpulsing_time_constant_ns
        middle, whole = 0.5 * (edges[1:] + edges[:-1]), -math.expm1(-period / delay)
        if detector.mode != "free_running":
            left = np.exp(-np.maximum(period - middle - dead_time, 0.0) / delay) / whole
            return np.outer(left, -np.diff(np.exp(-edges / delay)))
        turns, time = np.divmod(edges - (middle + dead_time)[:, None], period)
        return np.diff(turns - np.expm1(-time / delay) / whole, axis=1)

    def slope(self, rows: Any) -> Any:
        """Derivative of λ by what changes the source by `rows` `[pixel, source bin]`, which may be negative; with
        crosstalk as if the pile-up of the neighbours stayed as it is."""
        import warp as wp

        none = wp.zeros(rows.shape[0], dtype=wp.float32, device=rows.device)
        return self._with_crosstalk(self.light(rows, none), wp.clone)

    def noise_slope(self) -> Any:
        """Derivative of λ by a noise rate [1/s] that all pixels share; crosstalk as in `slope`."""
        import warp as wp

        widths = np.tile(np.diff(self.window.edges).astype(np.float32), (self.image[0] * self.image[1], 1))
        return self._with_crosstalk(wp.array(widths, device=self.noise.device), wp.clone)


# Frames, and the law of their pile-up


def first_photon_probabilities(hazard: Any, *, device: Any = None) -> NDArray[np.float64]:
    """Law of first-photon counting, with pile-up: P(k) = exp(−Σ_{j<k} λ_j)·(1 − exp(−λ_k)); same shape as `hazard` (λ).

    `hazard`: expected detections per pulse and bin `[..., T]`, not negative; NumPy, torch or Warp; `device`: of Warp.
    """
    import warp as wp

    with in_torch_order(hazard):
        rows, shape = histogram_rows(hazard, name="hazard", device=device)
        if rows.dtype not in (wp.float32, wp.float64):
            rows = wp.array(rows.numpy().astype(np.float64), device=rows.device)
        law = sk.detection.first_photon_probabilities(rows)
        values: Any = tensor_of(law).double() if is_torch(hazard) else law.numpy().astype(np.float64)
    return values.reshape(shape)


def coates(counts: Any, *, pulses: int, device: Any = None) -> NDArray[np.float64]:
    """Coates' correction of first-photon counts: λ̂_k = −ln(1 − n_k / (pulses − Σ_{j<k} n_j)), same shape as `counts`.

    NaN from the bin on that takes the last pulse. Source: P. B. Coates, J. Phys. E 1, 878 (1968).

    `counts`: integers `[..., T]`, not negative; NumPy, torch or Warp; `pulses`: of each histogram, which may hold no
    more counts than that; `device`: of Warp.
    """
    with in_torch_order(counts):
        rows, shape = histogram_rows(counts, name="counts", device=device)
        values = rows.numpy()
        if values.dtype.kind != "i":
            raise ArgumentError(f"counts are {values.dtype}; integers are needed")
        if values.max() > 2**31 - 1:
            raise ArgumentError(f"counts = {values.max()} is above {2**31 - 1}")
        pulses = check_integer("pulses", pulses, "[1, 9007199254740992]")
        if (most := int(values.sum(axis=1, dtype=np.int64).max())) > pulses:
            raise ArgumentError(f"pulses = {pulses} is below the {most} counts of a histogram: more than one a pulse")
        if values.dtype != np.int32:
            rows = as_warp(values.astype(np.int32), name="counts", device=rows.device)
        corrected = sk.detection.coates(rows, pulses=pulses)
        result: Any = tensor_of(corrected) if is_torch(counts) else corrected.numpy()
    return result.reshape(shape)


class TimeTags(NamedTuple):
    """Detections one by one, in the order of frame, pixel and time; `bin` counts from the window's start."""

    frame: NDArray[np.int64]
    y: NDArray[np.int64]
    x: NDArray[np.int64]
    pulse: NDArray[np.int64]
    bin: NDArray[np.int32]


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Frames:
    """Counts that the camera records; `counts`, `expected` and `background` are torch tensors if the source was one."""

    counts: NDArray[np.int32]  # int32 `[frames, H, W, T]`, or `[H, W, T]` for the sum of the frames
    pulses: int  # laser pulses per frame; frames: how many; first_frame: number of the first
    frames: int
    first_frame: int
    gate_start: float
    """Start of the detector's window [s]. Where time wraps, a count at t stands for light at t plus whole periods."""
    bin_width: float  # nominal [s]
    edges: NDArray[np.float64]  # `[T + 1]`, actual bin edges from `gate_start` [s] (differential non-linearity)
    period: float | None  # of the pulses [s], where time wraps; else None
    irf: InstrumentResponse  # the response that was applied
    detector: Detector  # the section of a scene
    expected: NDArray[np.float32]
    """float32 `[H, W, T]`, expected detections per pulse and bin before pile-up, from which the counts were drawn:
    light through the response, dark counts, ambient light, crosstalk."""
    background: NDArray[np.float32]
    """float32 `[H, W, 1 or T]`, expected background detections per pulse and bin before pile-up: dark counts, ambient
    light and, where the source has it apart, backscatter; with the crosstalk and the afterpulses of these."""
    seed: int  # of the random numbers
    tags: TimeTags | None = None  # every detection, where it was asked for
    target_noise_ratio: float | None = None  # `Result.target_noise_ratio` of frames of these pulses; None: not known
    notes: tuple[str, ...] = ()  # what the source could not give, in words

    def __repr__(self) -> str:
        height, width, bins = self.counts.shape[-3:]
        frames = f"{self.frames} frame" + "s" * (self.frames != 1) + (" added up" if self.summed else "")
        return f"Frames({frames} of {self.pulses} pulses, seed {self.seed}, {width} x {height} pixels x {bins} bins)"

    def plot(self, frame: int = 0, **options: Any) -> Any:
        """A figure of one frame: time of the fullest bin, intensity, the counts of a pixel; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(self, frame=frame, **options)

    _repr_html_ = Shown._repr_html_

    def to_xarray(self) -> Any:
        """Counts and what they were drawn from, with coordinates and units: see `spadwarp.frames.to_xarray`."""
        return to_xarray(self)

    @property
    def summed(self) -> bool:
        """Whether the frames have been added up."""
        return self.counts.ndim == 3

    @property
    def exposure(self) -> int:
        """Pulses of each histogram of `counts`."""
        return self.pulses * self.frames if self.summed else self.pulses

    @property
    def intensity(self) -> NDArray[np.int64]:
        """Counts of each pixel over all bins: `[frames, H, W]` or `[H, W]`."""
        return self.counts.sum(-1) if is_torch(self.counts) else self.counts.sum(axis=-1, dtype=np.int64)

    def coates(self) -> NDArray[np.float64]:
        """Detections per pulse and bin without pile-up; see `coates`."""
        return coates(self.counts, pulses=self.exposure)

    def arrival_time(
        self,
        method: Method = "centroid",
        *,
        irf: Any = None,
        undo_pile_up: bool = False,
        gate: tuple[float, float] | None = None,
        min_significance: float | None = None,
        significance: Any = None,
        device: Any = None,
    ) -> NDArray[np.float64]:
        """Arrival time of the return [s]: `[frames, H, W]` or `[H, W]`, NaN where nothing was detected.

        All bins count as equally wide, as in a camera without calibration. The estimator knows the background.
        `method`, `gate` (start, stop) [s], `significance`, `device`: as of `spadwarp.arrival_time`; `irf`: that the
        estimator assumes; default: the one that was applied; `undo_pile_up`: estimate from Coates' correction of the
        counts; `min_significance`: default: that of the detector.
        """
        least = self.detector.min_significance if min_significance is None else min_significance
        axis: dict[str, Any] = {"gate_start": self.gate_start, "bin_width": self.bin_width, "gate": gate}
        known, irf = self.background * float(self.exposure), self.irf if irf is None else irf
        options = {**axis, "method": method, "irf": irf, "background": known, "device": device}
        test: dict[str, Any] = {"min_significance": least, "significance": significance}
        test["pulses"] = self.exposure if self.detector.mode == "first_photon" else 0
        time = arrival_time(self.counts, **options, **test)
        if undo_pile_up:
            corrected: Any = self.coates()
            histogram = (corrected.nan_to_num() if is_torch(corrected) else np.nan_to_num(corrected)) * self.exposure
            every: Any = arrival_time(histogram, **options)
            if least > 0:
                every[time != time] = math.nan
            time = every
        return time


def to_xarray(frames: Frames) -> xarray.Dataset:
    """Counts, and the expectation that they were drawn from, as an xarray data set with coordinates and units.

    `counts` has the dimensions (frame, y, x, time), without frame where they are added up; `expected` and `background`
    are detections per pulse and bin before pile-up. Torch tensors are copied to the host. Raises `FileError` without
    xarray.
    """
    counts, expected = on_host(frames.counts), on_host(frames.expected)
    background = np.broadcast_to(on_host(frames.background), expected.shape)
    height, width, _ = expected.shape
    cube = ("y", "x", "time")
    variables: dict[str, Variable] = {
        "counts": (cube if frames.summed else ("frame", *cube), counts, "1", "detections in the bin"),
        "expected": (cube, expected, "1", "expected detections per pulse and bin before pile-up"),
        "background": (cube, background, "1", "the part of `expected` that is not target"),
    }
    edges = frames.gate_start + frames.edges
    coordinates: dict[str, Variable] = {
        "time": (("time",), 0.5 * (edges[:-1] + edges[1:]), "s", "time of flight at the centre of the bin"),
        "bin_width": (("time",), np.diff(edges), "s", "width of the bin"),
        **{name: ((name,), *image_coordinates(height, width)[name]) for name in PIXELS},
    }
    if not frames.summed:
        numbers = np.arange(frames.first_frame, frames.first_frame + frames.frames)
        coordinates["frame"] = (("frame",), numbers, "1", "number of the frame")
    attributes = {
        "pulses": frames.exposure,
        "seed": str(frames.seed),
        "period": np.inf if frames.period is None else frames.period,
        "response_fwhm": frames.irf.fwhm,
        "notes": list(frames.notes),
    }
    return labelled(variables, coordinates, attributes)


_LIMITS = {"pulses": "[1, 2147483647]", "frames": "[1, 2147483647]", "first_frame": "[0, 4294967295]", "seed": SEED}


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

    First-photon counts are exact multinomials, at a cost that does not depend on `pulses`. Free-running, first-photon
    with afterpulsing, and time tags are followed event by event, at a cost per detection. Crosstalk enters as a mean.

    The light of a Result has the noise of the simulation, which is drawn as if it were light, the same in every frame:
    a warning says where it shows beside that of the photons (`Result.target_noise_ratio`), a note that it is not known.

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
    if scene is not None:
        if gate_start is not None or bin_width is not None:
            raise ArgumentError("gate_start and bin_width are for arrays: a result has its own; give window instead")
        detector, laser = detector or scene.detector, laser or scene.laser
        gate_start, bin_width = scene.gate.start, scene.gate.bin_width
        scene = scene.model_copy(update={"detector": detector, "laser": laser})
        scale = scene.detectable_photons_per_pulse
        if background is None:
            expected = getattr(source, "expected", source.component)  # a TorchResult has no other light
            background = expected("backscatter") * scale
        if ambient is None and scene.daylight is not None:
            truth = Truth(**{name: on_host(getattr(source.truth, name)) for name in Truth.__dataclass_fields__})
            ambient = noise_rate(scene, truth)[..., 0] - detector.noise_rate
        source = (source.expected() if isinstance(source, Result) else source.histogram) * scale
    detector = detector or Detector()
    pulses = detector.pulses_per_frame if pulses is None else pulses
    arguments = {"pulses": pulses, "frames": frames, "first_frame": first_frame, "seed": seed}
    numbers = {name: check_integer(name, value, _LIMITS[name]) for name, value in arguments.items()}
    camera_seed = check_integer("camera_seed", camera_seed, SEED)
    if summed and (total := numbers["pulses"] * numbers["frames"]) > 2**31 - 1:
        raise ArgumentError(f"pulses · frames = {total} is above {2**31 - 1}: give fewer, or summed=False")
    if gate_start is None or bin_width is None:
        raise ArgumentError("gate_start or bin_width is missing: an array source needs both")
    axis = (check_real("gate_start", gate_start, TIME), check_real("bin_width", bin_width, BIN_WIDTH))
    if laser is None and (detector.wrap or detector.mode == "free_running" or tags):
        raise ArgumentError("laser is missing: the detector needs its repetition rate (unless wrap = false)")
    irf = detector_response(detector, laser) if irf is None else irf
    options: dict[str, Any] = {"irf": irf, "window": window, "tdc_widths": tdc_widths, "ambient": ambient}
    form: Any = {"shape": "[H, W, T]", "dimensions": range(3, 4)}
    with in_torch_order(source, background, out):
        rows, shape = histogram_rows(source, name="source", device=device, **form)
        options |= {"shape": shape, "axis": axis, "device": rows.device, "camera_seed": camera_seed}
        receiver = Receiver.of(detector, laser, **options)
        seen, image = receiver.window, receiver.image
        hazard, light = receiver.hazard(rows), None
        if background is not None:
            light, known_shape = histogram_rows(background, name="background", device=rows.device, **form)
            if known_shape != shape:
                raise ArgumentError(f"background has shape {known_shape}; that of the source, {shape}, is needed")
        known = receiver.background(light)
        as_torch = is_torch(source) or out is not None
        if as_torch:
            out_shape = (*(() if summed else (numbers["frames"],)), *image, seen.recorded)
            out = output_tensor(out, name="out", shape=out_shape, device=hazard.device)
        counts, found = _draw(receiver, hazard, numbers, summed=summed, tags=tags, out=out)
        to_caller: Any = tensor_of if as_torch else (lambda rows: rows.numpy())
        expected, known = (to_caller(rows)[:, : seen.recorded].reshape(*image, -1) for rows in (hazard, known))
    notes = seen.missing_light(axis[0]) if detector.wrap else ()
    if (begin := 1e9 * seen.start) >= (end := 1e9 * (axis[0] + shape[2] * axis[1])):
        text = f"window: begins at {begin:g} ns, after the source ends at {end:g} ns: light there is of earlier pulses"
        warnings.warn(text, SpadwarpWarning, stacklevel=3)
    ratio = None
    if isinstance(result, Result) and result.batches > 1:
        exposed = with_frames(result, pulses, detector, laser)
        ratio = exposed.target_noise_ratio
        if problem := noise_problem(exposed):
            warnings.warn(problem, SpadwarpWarning, stacklevel=3)
    elif scene is not None:
        notes += (UNKNOWN_NOISE,)
    return Frames(
        counts=counts,
        expected=expected,
        background=known,
        gate_start=seen.start,
        bin_width=axis[1],
        edges=seen.edges[: seen.recorded + 1],
        period=seen.period if detector.wrap else None,
        irf=irf,
        tags=found,
        detector=detector,
        notes=notes,
        target_noise_ratio=ratio,
        **numbers,
    )


def _draw(
    receiver: Receiver, hazard: Any, numbers: dict[str, int], *, summed: bool, tags: bool, out: Any
) -> tuple[Any, TimeTags | None]:
    """Counts, in the tensor `out` where there is one, and for tags the detections one by one."""
    detector, window = receiver.detector, receiver.window
    by_event = detector.mode == "free_running" or tags or detector.afterpulsing_probability > 0
    add_frames = by_event and summed  # the kernel of events does not
    in_place = out is not None and not add_frames
    given = as_warp(out, name="out").flatten() if in_place else None
    common: dict[str, Any] = {**numbers, "counter_depth": detector.max_count, "counts": given}
    found = None
    if by_event:
        counts, events = sk.detection.event_counts(
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
        if events is not None:
            frame, pixel = np.divmod(events["row"], receiver.image[0] * receiver.image[1])
            y, x = np.divmod(pixel, receiver.image[1])
            found = TimeTags(frame + numbers["first_frame"], y, x, events["pulse"], events["bin"])
    else:
        counts = sk.detection.first_photon_counts(hazard, summed=summed, **common)
    if in_place:
        return out, found
    every: Any = counts.numpy() if out is None else tensor_of(counts)
    frames = () if summed and not add_frames else (numbers["frames"],)
    every = every.reshape(*frames, *receiver.image, window.recorded)
    every = every.sum(0, dtype=every.dtype) if add_frames else every
    return (every if out is None else out.copy_(every)), found
