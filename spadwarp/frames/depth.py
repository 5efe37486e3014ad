"""Depth frames: arrival times from histograms of counts, tallies or expected rates, and depth from these."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

import spadwarp_kernels as sk
from spadwarp.arrays import as_warp, histogram_rows, in_torch_order, is_torch, on_host, real_array, tensor_of
from spadwarp.frames.backgrounds import BackgroundLaw, estimate_background
from spadwarp.frames.response import InstrumentResponse
from spadwarp.result import Result
from spadwarp.scene import Camera, Medium, Scene
from spadwarp.scene.sections import field_range
from spadwarp.scene.sight import LinesOfSight, lines_of_camera, lines_of_sight
from spadwarp.values import (
    BIN_WIDTH,
    TIME,
    ArgumentError,
    SpadwarpWarning,
    check_choice,
    check_integer,
    check_real,
    path_from_time,
    range_from_time,
    shown,
)

__all__ = ["METHODS", "Histograms", "Method", "Reduction", "arrival_time", "depth_frame", "depth_of"]

Method = Literal["peak", "centroid", "matched", "likelihood"]
Quantity = Literal["depth", "range"]
FARTHEST = 300.0  # from beyond which no light comes back through water [m]
_PHASE_INDEX = (1.32, 1.35)  # of water; group indices are higher
METHODS: tuple[Method, ...] = ("peak", "centroid", "matched", "likelihood")


@dataclass(frozen=True, eq=False, kw_only=True)
class Histograms:
    """Histograms with what their file knows about them; None for what it does not."""

    values: NDArray[Any]  # `[H, W, T]` or `[frames, H, W, T]`, not negative; counts are integers, rates are not
    bin_width: float | None = None  # [s]
    gate_start: float = 0.0  # time of flight at the lower edge of bin 0 [s]
    group_index: float | None = None  # of the water, where there is no scene
    horizontal_fov_deg: float | None = None  # of a measuring camera with square pixels
    background: NDArray[np.float32] | None = None
    """Expected background in the unit of `values`, of a shape that `arrival_time` takes."""
    level_known: bool = True  # whether it is known apart from these values
    pulses: int = 0  # of each histogram, where each counts one photon at most; else 0
    irf: InstrumentResponse | None = None  # the response that the histograms contain
    response: InstrumentResponse | None = None
    """The response to filter with; differs from `irf` for expected histograms of infinitely short pulses."""
    scene: Scene | None = None  # of a simulation
    notes: tuple[str, ...] = ()  # what was inferred from the file, in words

    @property
    def background_per_bin(self) -> NDArray[np.float32] | None:
        """The background where it has a value for each bin `[..., T]`, else None."""
        known = self.background
        return known if known is not None and known.ndim and known.shape[-1] == self.values.shape[-1] else None


def arrival_time(
    histogram: Any,
    *,
    gate_start: float,
    bin_width: float,
    method: Method = "centroid",
    irf: InstrumentResponse | None = None,
    device: Any = None,
    background: Any = None,
    level_known: bool = True,
    pulses: int = 0,
    gate: tuple[float, float] | None = None,
    min_significance: float | None = None,
    significance: Any = None,
) -> NDArray[np.float64]:
    """Arrival time of the return in every pixel [s], in the histogram's own time: float64 `histogram.shape[:-1]`; NaN
    where nothing was detected in the gate. From a torch tensor comes one, on its device.

    Args:
        histogram: `[..., bin]`, usually `[H, W, T]` or `[frames, H, W, T]`; NumPy, torch or Warp; counts (integer) or
            rates (float) in any unit, not negative.
        gate_start: Time of the lower edge of bin 0 [s].
        bin_width: [s], > 0.
        method: `"peak"`: centre of the largest bin. `"centroid"`: mean about the peak, over ± 1.5 FWHM of `irf` (± 3
            bins without one). `"matched"`: log-matched filter; `"likelihood"`: maximum likelihood, of background too
            (eq T3). The last two resolve fractions of a bin.
        irf: The response. Needed by `"matched"` and `"likelihood"`; `"peak"` and `"centroid"` subtract its mode and its
            mean.
        device: Warp device; default: where the array lies, for NumPy the first GPU or else the CPU.
        background: Expected background per bin in the unit of `histogram` (dark counts, ambient, backscatter): a
            number, `[T]`, or `[H, W, T]`, which all frames share. Peak and centroid subtract it; the matched filter
            does not use it.
        level_known: False: detections use the shape of `background` over time alone, and the level of the pixel's own
            counts. Without a background, the shape is that of `estimate_background`.
        pulses: Of each histogram, where each counts one photon at most; 0: any number. For detections.
        gate: (start, stop) [s]: only bins whose centres lie in it are used.
        min_significance: Pixels below this significance have no arrival time, see `spadwarp_kernels.DetectionTest`; the
            others that of what was detected. 0: every pixel reports. Default: 4, one false alarm in 10⁴ pixels, for
            counts (integers); 0 for rates, which have no significance.
        significance: Array or tensor to write that of counts into, float32 `histogram.shape[:-1]`.

    Raises `ArgumentError`, which names the argument, its value and what is allowed.
    """
    import warp as wp

    check_choice("method", method, METHODS)
    gate_start = check_real("gate_start", gate_start, TIME)
    bin_width = check_real("bin_width", bin_width, BIN_WIDTH)
    filtered = method in ("matched", "likelihood")
    if irf is None and filtered:
        raise ArgumentError(
            f"method = {method!r} needs an irf, the instrument response of the histogram. Those of `simulate` have "
            "none yet: `detect` adds it, or take 'centroid'"
        )
    if not isinstance(irf, InstrumentResponse | None):
        raise ArgumentError(f"irf = {shown(irf)} is not an InstrumentResponse")
    with in_torch_order(histogram, background):
        rows, shape = histogram_rows(histogram, name="histogram", device=device, dimensions=range(2, 16))
        frame, bins = shape[:-1], shape[-1]
        first, stop = (0, bins) if gate is None else _bins_of_gate(gate, gate_start, bin_width, bins)
        response, lowest_tap, half_width, offset, fwhm = None, 0, 3, 0.0, 2.0
        if irf is not None:
            fwhm = irf.fwhm / bin_width
            half_width = max(1, int(np.ceil(1.5 * fwhm)))
            offset = {"peak": irf.mode / bin_width, "centroid": irf.mean / bin_width}.get(method, 0.0)
        if irf is not None and filtered:
            response, lowest_tap = _response_table(irf, bin_width, sk.detection.PHASES)
        known = None if background is None else _background_rows(background, rows, frame)
        options: dict[str, Any] = {"first": first, "stop": stop, "half_width": half_width, "lowest_tap": lowest_tap}
        if min_significance is not None:
            options["min_significance"] = check_real("min_significance", min_significance, "[0, 1000]")
        if rows.dtype in (wp.int32, wp.int64):
            options["significance"] = tested = wp.empty(rows.shape[0], dtype=float, device=rows.device)
            options |= {"width": fwhm, "pulses": check_integer("pulses", pulses, "[0, 4611686018427387904]")}
            options["pixels"] = math.prod(frame[-2:])
            if known is None or not level_known:
                given = known is not None and known.numpy().any()
                options["profile"] = known if given else _background_shape(rows, frame, first, stop, fwhm)
        elif min_significance:
            raise ArgumentError(f"min_significance = {min_significance} needs counts, integers; these are rates")
        found = sk.detection.arrival_bins(rows, method=method, background=known, response=response, **options)
        position: Any = tensor_of(found).double() if is_torch(histogram) else found.numpy().astype(np.float64)
        if significance is not None and "significance" in options:
            if not hasattr(significance, "dtype"):
                raise ArgumentError(f"significance = {shown(significance)} is no array or tensor")
            significance[...] = (tensor_of(tested) if is_torch(significance) else tested.numpy()).reshape(frame)
    return gate_start + (position.reshape(frame) - offset) * bin_width


def _bins_of_gate(gate: tuple[float, float], gate_start: float, bin_width: float, bins: int) -> tuple[int, int]:
    """The bins [first, stop) whose centres lie in the gate."""
    if not (isinstance(gate, tuple | list) and len(gate) == 2):
        raise ArgumentError(f"gate = {shown(gate)} is not (start [s], stop [s])")
    # Centres at (k + 0.5): k from ceil(x - 0.5) to, not including, ceil(y - 0.5).
    edges = [(check_real("gate", time, "[-inf, inf] s") - gate_start) / bin_width - 0.5 for time in gate]
    first, stop = (int(np.clip(np.ceil(np.nan_to_num(edge)), 0, bins)) for edge in edges)
    if first >= stop:
        end = gate_start + bins * bin_width
        raise ArgumentError(f"gate = {gate} s holds no bin of the histogram's [{gate_start}, {end}) s")
    return first, stop


def _background_rows(background: Any, rows: Any, frame: tuple[int, ...]) -> Any:
    """float32 `[1 or pixels of a frame, 1 or T]` on the histogram's device."""
    import warp as wp

    bins = rows.shape[1]
    if not is_torch(background) and not (isinstance(background, wp.array) and background.dtype == wp.float32):
        background = real_array("background", background.numpy() if isinstance(background, wp.array) else background)
    shape = tuple(background.shape)
    if shape not in ((), (bins,), *((*frame[i:], last) for i in range(len(frame)) for last in (bins, 1))):
        raise ArgumentError(f"background has shape {shape}; a number, ({bins},) or {(*frame[-2:], bins)} is needed")
    flat = background.float() if is_torch(background) else background
    return histogram_rows(flat.reshape((-1, shape[-1] if shape else 1)), name="background", device=rows.device)[0]


def _background_shape(rows: Any, frame: tuple[int, ...], first: int, stop: int, fwhm: float) -> Any:
    """Shape of the background over time, float32 `[1, T]` on the device of the counts: that of all pixels together.

    One count more keeps it from 0.
    """
    shape = np.ones((1, rows.shape[1]), np.float32)
    counts = rows.numpy()[:, first:stop].reshape(-1, *(1, *frame)[-2:], stop - first)
    shape[0, first:stop] = estimate_background(counts, fwhm).per_bin + 1.0 / len(rows)
    return as_warp(shape, name="background", device=rows.device)


def _response_table(irf: InstrumentResponse, bin_width: float, phases: int) -> tuple[NDArray[np.float64], int]:
    """Fraction of the response per bin for returns at every sub-bin phase, and the bin of the first tap."""
    lower, upper = (edge / bin_width for edge in irf.support)
    lowest = int(np.floor(lower))
    taps = int(np.ceil(upper)) + 1 - lowest
    edges = lowest + np.arange(taps + 1)[None, :] - np.arange(phases)[:, None] / phases
    return np.clip(np.diff(irf.cumulative(edges * bin_width), axis=1), 0.0, None), lowest


# Depth


def depth_frame(
    result: Result, *, method: Method = "centroid", quantity: Quantity = "depth", **options: Any
) -> NDArray[np.float64]:
    """Depth frame of a simulation's histograms [m], float64 `[H, W]`; NaN where nothing returned.

    `method` and `options` (`irf`, `background`, `gate`, `device`): see `spadwarp.arrival_time`. `quantity`: "depth" is
    planar, z; "range" runs along the line of sight.
    """
    check_choice("quantity", quantity, ("depth", "range"))
    scene, gate = result.scene, result.scene.gate
    time = arrival_time(result.expected(), gate_start=gate.start, bin_width=gate.bin_width, method=method, **options)
    lines = lines_of_sight(scene)
    distance = lines.range_from_path(time * result.pulse_speed)
    return lines.depth_from_range(distance) if quantity == "depth" else distance


@dataclass(frozen=True, eq=False, kw_only=True)
class Reduction:
    """Depth of histograms."""

    quantity: Quantity
    """`"depth"`: planar, z; `"range"`: along the line of sight, where the view is not known."""
    values: NDArray[np.float64]  # float64 `[frames, H, W]` [m]; NaN where nothing returned
    range: NDArray[np.float64]  # the same along the line of sight
    intensity: NDArray[Any]  # sum over the bins, `[frames, H, W]`
    lines: LinesOfSight | None  # lines of sight `[H, W]`, or None
    method: str  # estimator of the arrival time, or "stored" for depth that was read
    camera: Camera | None = None  # that of a simulation, with its pose in the world; else None
    significance: NDArray[np.float32] | None = None  # of counts, float32 `[frames, H, W]`, see `spadwarp.arrival_time`
    notes: tuple[str, ...] = ()  # what a measured file covers, and how the background was estimated, in words

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.values)

    @property
    def first(self) -> NDArray[np.float64]:
        """The first frame, `[H, W]` [m]."""
        return self.values[0]

    def plot(self, path: str | Path, **options: Any) -> Path:
        """Draws the first frame beside its intensity, see `spadwarp.viz.draw_depth`; returns the path."""
        import spadwarp

        return spadwarp.viz.draw_depth(self.first, self.intensity[0], path, **options)


def depth_of(
    histograms: Histograms,
    *,
    method: Method = "centroid",
    group_index: float | None = None,
    horizontal_fov_deg: float | None = None,
    background: ArrayLike | BackgroundLaw | None = None,
    min_significance: float | None = None,
    device: Any = None,
) -> Reduction:
    """Depth of histograms from a file; measured ones count as of a laser in the lens, whose pulse leaves at time 0.

    Args:
        histograms: From `spadwarp.frames.read_histograms`.
        method: See `spadwarp.arrival_time`; `"matched"` and `"likelihood"` need a response.
        group_index: Vacuum speed of light over that of the pulse, ≥ 1; default: that of the file.
        horizontal_fov_deg: Full horizontal field of view of a measuring camera with square pixels, in (0, 180).
        background: Expected background in the unit of the values, ≥ 0, as `arrival_time` takes it; or the law by which
            `estimate_background` estimates it: "decay", "flat" or "none". Default: that of the file; else "decay" of
            counts, and of rates for `"likelihood"`. The log-matched filter does not use it.
        min_significance: See `spadwarp.arrival_time`; default: of counts of a scene its `detector.min_significance`.
        device: Warp device.

    Raises `ArgumentError`: something that is needed is missing, given twice or out of range.
    """
    values, filtered = histograms.values, method in ("matched", "likelihood")
    height, width = values.shape[-3:-1]
    response = histograms.response if filtered else histograms.irf
    histograms = with_view(histograms, group_index, horizontal_fov_deg)
    missing = {
        "bin width is missing (bin_width): the file does not hold it": histograms.bin_width,
        "group index is missing (group_index): 1 in air, 1.3566 in fresh water, 1.3638 in seawater": histograms.scene
        or histograms.group_index,
        f"method = {method!r} needs an instrument response (irf)": response if filtered else "",
    }
    if any(value is None for value in missing.values()):
        raise ArgumentError("; ".join(text for text, value in missing.items() if value is None))
    index, lines = geometry(histograms)
    counted = values.dtype.kind in "iu"
    window = () if histograms.scene is not None else (_window(histograms, index),)
    notes: tuple[str, ...] = ()
    if isinstance(background, int | float):
        check_real("background", background, "[0, inf)")
    known: Any = histograms.background if background is None else background
    level_known = histograms.level_known or background is not None
    if known is None and (counted or method == "likelihood"):
        known = "decay"
    if isinstance(known, str):
        # Of the log-matched filter, which does not use it, `arrival_time` needs its shape alone.
        taps = 2.0 if response is None else response.per_bin(float(histograms.bin_width or 0.0))
        found = None if method == "matched" or known == "none" else estimate_background(values, taps, law=known)
        known, level_known = (None, False) if found is None else (found.counts, False)
        notes = () if found is None else (found.summary,)
    significance = np.empty(values.shape[:-1], np.float32) if counted else None
    if min_significance is None and histograms.scene is not None and significance is not None:
        min_significance = histograms.scene.detector.min_significance
    options: dict[str, Any] = {"gate_start": histograms.gate_start, "bin_width": histograms.bin_width, "method": method}
    options |= {"level_known": level_known, "pulses": histograms.pulses, "min_significance": min_significance}
    time = arrival_time(values, irf=response, background=known, significance=significance, device=device, **options)
    if known is not None and counted and histograms.scene is None:
        _check_background(values, known)
    path = path_from_time(time.reshape(-1, height, width), index)
    distance = 0.5 * path if lines is None else lines.range_from_path(path)
    return Reduction(
        quantity="range" if lines is None else "depth",
        values=distance if lines is None else lines.depth_from_range(distance),
        range=distance,
        intensity=values.sum(axis=-1).reshape(-1, height, width),
        lines=lines,
        method=method,
        camera=None if histograms.scene is None else histograms.scene.camera,
        significance=None if significance is None else significance.reshape(-1, height, width),
        notes=(*notes, *window),
    )


def _window(histograms: Histograms, index: float) -> str:
    """A note on the ranges of a measured file; warns of those from which no light comes back through water."""
    width, start = float(histograms.bin_width or 0.0), histograms.gate_start
    near, far = (range_from_time(start + bins * width, index) for bins in (0, histograms.values.shape[-1]))
    if index > _PHASE_INDEX[0] and not 0.0 < far <= FARTHEST:
        text = f"{near:.4g} to {far:.4g} m: no light comes back through water: another unit of"
        text += f" bin_width = {width * 1e12:g} ps or gate_start = {start * 1e9:g} ns?"
        warnings.warn(text, SpadwarpWarning, stacklevel=3)
    if _PHASE_INDEX[0] < index < _PHASE_INDEX[1]:
        text = f"group_index = {index:g} is a phase index; for pulses it is 1.3566 in fresh water, 1.3638 in seawater"
        warnings.warn(text, SpadwarpWarning, stacklevel=3)
    return f"bins from {near:.4g} to {far:.4g} m"


def _check_background(counts: NDArray[Any], background: ArrayLike) -> None:
    """Warns of twice all counts, or half of those of the darker bins: a background of a pulse, or of all bins."""
    cube, given = counts.reshape(-1, counts.shape[-1]), np.asarray(on_host(background), np.float64)
    known = np.broadcast_to(given, (*given.shape[:-1], cube.shape[1])).reshape(-1, cube.shape[1]).mean(axis=0)
    dark = np.argsort(seen := cube.mean(axis=0))[: len(known) // 2 + 1]
    pairs = (known.sum(), seen.sum()), (seen[dark].sum(), known[dark].sum())
    if known.any() and any(
        more > 2.0 * less and more - less > 5.0 * math.sqrt(more / len(cube)) for more, less in pairs
    ):
        text = f"background: {known.sum():.3g} counts in a pixel do not explain its {seen.sum():.3g}"
        warnings.warn(f"{text}; it is that of each bin in all pulses of a frame", SpadwarpWarning, stacklevel=3)


def with_view(histograms: Histograms, group_index: float | None, horizontal_fov_deg: float | None) -> Histograms:
    """With what the file of a measurement does not say. Raises `ArgumentError` for that of a scene."""
    view = {"group_index": group_index, "horizontal_fov_deg": horizontal_fov_deg}
    given: dict[str, Any] = {name: value for name, value in view.items() if value is not None}
    if given and histograms.scene is not None:
        raise ArgumentError(f"the file has its own {' and '.join(given)}")
    return replace(histograms, **given)


def geometry(histograms: Histograms) -> tuple[float, LinesOfSight | None]:
    """Group index, and lines of sight where they are known."""
    scene, fov = histograms.scene, histograms.horizontal_fov_deg
    if scene is not None:
        return scene.medium.group_index, lines_of_sight(scene)
    index = check_real("group index", histograms.group_index, field_range(Medium, "group_index"))
    if fov is None:
        return index, None
    check_real("horizontal field of view", fov, field_range(Camera, "horizontal_fov_deg"))
    height, width = histograms.values.shape[-3:-1]
    camera = Camera(width=width, height=height, horizontal_fov_deg=fov, aperture_diameter=1.0)
    return index, lines_of_camera(camera)
