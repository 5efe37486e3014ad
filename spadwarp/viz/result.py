"""Figures of a result, of depth frames, of the analytic model and of a fit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import SymmetricalLogLocator
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from spadwarp.analytic import AnalyticResult
from spadwarp.errors import ArgumentError
from spadwarp.frames import Frames, FramesFile, Method, first_photon_probabilities
from spadwarp.frames.spad import noise_caption
from spadwarp.inverse import Fit
from spadwarp.result import COMPONENTS, Result, degree_of_polarisation
from spadwarp.result.result import pixel_channel, pixel_standard_error
from spadwarp.scene import Medium, Scene
from spadwarp.scene.sight import lines_of_sight
from spadwarp.units import rounded
from spadwarp.viz.style import (
    BLUE,
    CHANNEL_NAMES,
    ERROR_MAP,
    GREEN,
    INTENSITY_MAP,
    MISSING,
    PAGE,
    PROBABILITY_MAP,
    PURPLE,
    RED,
    TEXT,
    Panels,
    arrival_line,
    log_axis,
    mark_pixels,
    middle_text,
    new_figure,
    paper,
    percent,
    save,
    shown_limits,
    spaced,
    target_limits,
    wrapped_items,
)
from spadwarp.viz.style import COMPONENTS as STYLES

__all__ = ["draw_analytic", "draw_denoised", "draw_depth", "draw_fit", "draw_recording", "draw_result", "picture_calls"]

_ERROR = 1.0 / 3.0  # relative standard error at which a bin stands alone
_NEIGHBOURS = 6  # bins on each side that share a weight
_EVEN = 0.5  # (Σv)² / (n Σv²) of the n neighbours of one side, where light is not sparse
_NARROW = 8  # bins that are added up before a group may end for its width

KINDS = ("depth", "intensity", "histogram", "truth")
"""Figures of a result."""


@paper()
def draw_result(
    result: Result,
    directory: str | Path,
    *,
    depth: NDArray[np.float64] | None = None,
    method: Method = "centroid",
    formats: Sequence[str] = ("png",),
    width: float = PAGE,
) -> list[Path]:
    """Writes pictures of depth, intensity, histograms and truth, such as `depth.png`; returns their paths.

    Args:
        result: What to show; frames without returns give empty pictures, not errors.
        directory: The folder; it is made if it is missing.
        depth: Depth frame `[H, W]` [m] to show; `result.depth(method=method)` if not given.
        method: Estimator of the depth frame, named in the picture.
        formats: "png", and "pdf" with vectors, for print.
        width: Of the pictures [inch]: 7.2 for a journal's page, 3.5 for its column.

    Raises:
        FileError: The folder or a file cannot be written.
    """
    options: dict[str, Any] = {"depth": depth, "method": method, "formats": formats, "width": width}
    return [path for call in picture_calls(result, directory, **options) for path in call()]


def picture_calls(
    result: Result, directory: str | Path, *, formats: Sequence[str], **options: Any
) -> list[Callable[[], list[Path]]]:
    """The parts of `draw_result`, which do not need each other: a figure each."""
    return [partial(_draw, result, kind, Path(directory), formats, options) for kind in KINDS]


@paper()
def _draw(result: Result, kind: str, folder: Path, formats: Sequence[str], options: dict[str, Any]) -> list[Path]:
    figure = result_figure(result, kind, **options)
    return [save(figure, folder / f"{kind}.{ending}") for ending in formats]


@paper()
def result_figure(
    result: Result,
    kind: str,
    *,
    depth: NDArray[np.float64] | None = None,
    method: Method = "centroid",
    device: Any = None,
    width: float = PAGE,
) -> Figure:
    """One of the figures of `draw_result`, of `KINDS`."""
    if kind == "histogram":
        return _histogram_figure(result, width)
    two = kind == "intensity" and not result.channels
    panels = Panels(result.truth.depth.shape, 2 if two else 3, width=width)
    panels.caption(_caption(result))
    if kind == "depth":
        frame = result.depth(method=method, device=device) if depth is None else np.asarray(depth, dtype=np.float64)
        _show_depth(panels, result, frame, method)
    else:
        {"intensity": _show_intensity, "truth": _show_truth}[kind](panels, result)
    return panels.figure


def _show_depth(panels: Panels, result: Result, frame: NDArray[np.float64], method: str) -> None:
    truth = result.truth.depth
    limits = target_limits(truth, frame)
    panels.show_depth(frame, f"Measured ({method})", limits)
    panels.show_depth(truth, "Truth", limits)
    panels.show_error(frame - truth, "Measured − truth")


def _show_intensity(panels: Panels, result: Result) -> None:
    per_pulse = result.scene.laser.photons_per_pulse * result.scene.detections_per_photon
    ballistic = result.tallies[COMPONENTS.index("ballistic")].sum(axis=-1) * result.tally_value
    panels.show_intensity(result.intensity * per_pulse, "All light in the gate", "expected detections per pulse")
    panels.show_intensity(ballistic * per_pulse, "Ballistic light alone", "expected detections per pulse")
    if result.channels:
        part = degree_of_polarisation(result, gated=True)
        low = -1.0 if (part < 0.0).any() else 0.0
        panels.show(part, "Degree of polarisation", "of all light in the gate", "viridis", (low, 1.0))


def _show_truth(panels: Panels, result: Result) -> None:
    truth = result.truth
    normal = 0.5 + 0.5 * truth.normal * np.array([1.0, -1.0, -1.0])
    panels.show_depth(truth.depth, "Depth", shown_limits(truth.depth))
    axis, bar = panels.place("Normal")
    axis.imshow(np.where(np.isfinite(normal), normal, float(MISSING)).clip(0.0, 1.0))
    bar.axis("off")
    bar.text(0.5, 0.0, "red: right, green: up,\nblue: to the camera", ha="center", va="center", transform=bar.transAxes)
    panels.show(truth.reflectance, "Reflectance", "Lambertian reflectance", INTENSITY_MAP, (0.0, 1.0))


def _histogram_figure(result: Result, width: float) -> Figure:
    figure = new_figure(width, 5.2)
    figure.suptitle(wrapped_items(_caption(result), width - 0.3), color=TEXT)
    # Ranked by ballistic light where there is any: in a short run a rare photon of large weight can make any other
    # pixel the brightest.
    ballistic = result.tallies[0].sum(axis=2)
    on_target = bool(ballistic.any())
    intensity = ballistic if on_target else result.intensity
    order = np.argsort(intensity, axis=None, kind="stable")
    order = order[intensity.ravel()[order] > 0]
    group = "on the target" if on_target else "of those with a return"
    handles: dict[str, Any] = {}
    for axis, name, index in zip(
        figure.subplots(2, 1), ("Brightest", "Median"), (-1, (len(order) - 1) // 2), strict=True
    ):
        axis.set(xlabel="time of flight [ns]", xlim=1e9 * result.bin_edges[[0, -1]])
        if len(order) == 0:
            middle_text(axis, "nothing returned in the gate")
            axis.set_yticks([])
        else:
            row, column = divmod(int(order[index]), intensity.shape[1])
            axis.set_title(f"{name} pixel {group}: row {row}, column {column}")
            _plot_pixel(result, axis, row, column)
            handles |= dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
    if handles:
        columns = 5 if width > 5.0 else 2
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)
    return figure


def _plot_pixel(result: Result, axis: Axes, row: int, column: int) -> None:
    """Components of one pixel over time of flight, and over the range along its line of sight; of polarised light also
    what each channel has of all of them.

    Where light is sparse, bins are added up until their sum is known to a third; see `shared_edges`.
    """
    per_pulse = result.scene.laser.photons_per_pulse * result.scene.detections_per_photon
    parts = result.tallies[:, row, column] * (result.tally_value[row, column] * per_pulse)
    time = 1e9 * result.bin_edges
    total = parts.sum(axis=0)
    known = result.second_moment is not None and result.photons >= 2 * result.batch_size
    error = pixel_standard_error(result, row, column) * per_pulse if known else None
    variance = typical_weight(total) * total if error is None else error**2
    edges, groups = shared_edges(parts, variance)
    groups[COMPONENTS.index("ballistic")] = np.arange(len(time))
    curves = {name: (own, merged_means(part, own)) for name, part, own in zip(COMPONENTS, parts, groups, strict=True)}
    means = np.concatenate([values for _, values in curves.values()])
    top = float(parts.max())
    bottom = float(np.clip(0.5 * means[means > 0].min(), 1e-7 * top, 0.01 * top))
    if error is not None:  # standard errors of the bins of a group taken as independent
        spread = np.sqrt(np.add.reduceat(error**2, edges[:-1])) / np.diff(edges)
        lower, upper = (np.maximum(merged_means(total, edges) + sign * spread, 0.01 * bottom) for sign in (-1, 1))
        label = "all light ± standard error"
        axis.stairs(upper, time[edges], baseline=lower, fill=True, color="0.75", zorder=1, label=label)
    for name, (own, values) in curves.items():
        label, colour = STYLES[name]
        ballistic = name == "ballistic"
        # Zeros lie below the axis, so that a single bin still shows as a spike.
        axis.stairs(
            np.maximum(values, 0.01 * bottom), time[own], baseline=None, label=label, color=colour,
            linewidth=1.4 if ballistic else 0.9, zorder=3 if ballistic else 2,
        )  # fmt: skip
    # Light of the water is nearly all co-polarised, and light of the target half: a wide line below the components, and
    # a dotted one above them, hide neither each other nor them.
    channel_styles = ((PURPLE, "-", 3.0, 1.5), ("black", (0, (1, 1.5)), 1.1, 4)) if result.channels else ()
    for (channel, label), (colour, line, linewidth, zorder) in zip(CHANNEL_NAMES.items(), channel_styles, strict=False):
        seen = pixel_channel(result, channel, row, column).sum(axis=0) * per_pulse
        axis.stairs(
            np.maximum(merged_means(seen, edges), 0.01 * bottom), time[edges], baseline=None,
            label=label, color=colour, linewidth=linewidth, linestyle=line, zorder=zorder,
        )  # fmt: skip
    arrival_line(axis, 1e9 * float(result.true_path()[row, column]) / result.pulse_speed, time)
    axis.set(ylim=(bottom, 3.0 * top), yscale="log", ylabel="detections\nper pulse and bin")
    log_axis(axis, "y")
    axis.xaxis.minorticks_on()
    axis.grid(which="major")
    _range_axis(result, axis, row, column)


def _range_axis(result: Result, axis: Axes, row: int, column: int) -> None:
    """A second axis above: range along the line of sight."""
    speed, line = 1e-9 * result.pulse_speed, lines_of_sight(result.scene)[row, column]

    def to_range(at: ArrayLike) -> NDArray[np.float64]:
        # Range 0 before light can go from laser to lens: an axis cannot begin with NaN.
        return np.nan_to_num(line.range_from_path(np.asarray(at) * speed))

    def to_time(at: ArrayLike) -> NDArray[np.float64]:
        return line.path_from_range(at) / speed

    above = axis.secondary_xaxis("top", functions=(to_range, to_time))
    above.set_xlabel("range [m]")
    above.xaxis.minorticks_on()


def _caption(result: Result) -> str:
    medium = result.scene.medium
    albedo = "U(0, 0.97)" if medium.albedo == "lu2024" else f"{medium.albedo:.3g}"
    water = f"water c = {medium.extinction:.3g} 1/m, albedo {albedo}, {_phase_text(medium)}"
    if medium.layers:
        extinctions = ", ".join(f"{water.extinction:.3g}" for water in medium.waters)
        water = f"{len(medium.waters)} layers of water, c = {extinctions} 1/m"
    if medium.grid is not None:
        water += f", with {medium.grid.shape or Path(str(medium.grid.file)).name}"
    photons = f"{result.photons:.3g}" if result.photons >= 1e6 else spaced(result.photons)
    if "e+" in photons:
        mantissa, power = photons.split("e+")
        photons = f"{'' if mantissa == '1' else mantissa + ' × '}$10^{{{int(power)}}}$"
    partial = ", interrupted" if result.partial else ""
    return f"{photons} photons{partial}{channel_text(result.provenance.get('channel'))}; {water}; seed {result.seed}"


def channel_text(channel: str | None) -> str:
    """Words of a caption for light of one channel alone; none for all light."""
    names = {str(key): name for key, name in CHANNEL_NAMES.items()}
    return f", {names[channel]} light" if channel in names else ""


def _phase_text(medium: Medium) -> str:
    if medium.phase_function == "tabulated":
        return f"phase function {Path(str(medium.phase_table)).stem}"
    law = {"fournier_forand": "Fournier–Forand ", "two_term_henyey_greenstein": "two-term "}.get(
        str(medium.phase_function), ""
    )
    symbols = {"anisotropy": "g", "alpha": "α", "particle_index": "n", "junge_slope": "µ"}
    values = [f"{symbols.get(name, name)} = {value:.4g}" for name, value in medium.phase_parameters.items()]
    return law + ", ".join(values)


# Bins wide enough to mean something


def typical_weight(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Light that one photon adds to a bin, `[T]`, from how much neighbouring bins differ.

    A bin of n photons of weight w has the mean n w and the variance n w². The second difference of three bins has no
    part of a slope; its square over the sum of the bins, weighted as the variances are, estimates w. The median over
    the neighbours keeps peaks out; where a few photons make most of the light on both sides, the largest counts.
    """
    padded = np.pad(values, 1)
    left, middle, right = padded[:-2], padded[1:-1], padded[2:]
    spread = left + 4.0 * middle + right
    local = np.divide((left - 2.0 * middle + right) ** 2, spread, out=np.full(len(values), np.nan), where=spread > 0)
    around = sliding_window_view(np.pad(local, _NEIGHBOURS, constant_values=np.nan), 2 * _NEIGHBOURS + 1)
    one_side = sliding_window_view(np.pad(values, _NEIGHBOURS), _NEIGHBOURS)
    squares = np.maximum((one_side**2).mean(axis=1), np.finfo(float).tiny)
    even = one_side.mean(axis=1) ** 2 / squares
    sparse = np.maximum(even[: len(values)], even[_NEIGHBOURS + 1 :]) < _EVEN
    weight = np.zeros(len(values))
    some = np.isfinite(around).any(axis=1)
    weight[some] = np.nanmedian(around[some], axis=1)
    weight[some & sparse] = np.nanmax(around[some & sparse], axis=1, initial=0.0)
    return weight


def merged_edges(values: NDArray[np.float64], variance: NDArray[np.float64]) -> NDArray[np.intp]:
    """Edges, as indices of bins, of groups that are wide enough to mean something, `[G + 1]`.

    A bin that is known to a third stands alone. The bins between two such bins are added up from the left until their
    sum is known to a third, or until the group is as wide as what lies before it in that stretch. Bins before the first
    and after the last light stay apart, so that light does not seem to come before its time. `values`, `variance`:
    `[T]`.
    """
    alone = (values > 0) & (variance <= (_ERROR * values) ** 2)
    filled = np.flatnonzero(values)
    first, last = (int(filled[0]), int(filled[-1]) + 1) if len(filled) else (0, 0)
    edges = [0]
    changes = np.flatnonzero(np.diff(np.concatenate([[True], alone, [True]]).astype(np.int8)))
    for start, stop in changes.reshape(-1, 2):
        edges += list(range(edges[-1], start + 1))  # bins that stand alone
        if first < start < last and not values[start:stop].any():
            edges.pop()  # a stretch without light is part of the bin before it
        else:
            edges += _cuts(values, variance, max(start, first), min(stop, last))
        edges.append(int(stop))
    edges += list(range(edges[-1], len(values) + 1))
    return np.unique(edges)


def shared_edges(
    parts: NDArray[np.float64], variance: NDArray[np.float64]
) -> tuple[NDArray[np.intp], list[NDArray[np.intp]]]:
    """Edges of groups for the sum of components of light, and for each component.

    Groups of the sum, by `merged_edges`, do not go across the first or last light of a component. Where a component is
    more than half of a group, it has the same groups; where it is less, groups that are wide enough for itself.

    Args:
        parts: `[component, T]`.
        variance: Of their sum, `[T]`; each has a part of it as it has of the light.
    """
    total = parts.sum(axis=0)
    filled = [np.flatnonzero(part) for part in parts if part.any()]
    ends = sorted({0, len(total), *(int(end) for bins in filled for end in (bins[0], bins[-1] + 1))})
    edges = _joined(low + merged_edges(total[low:high], variance[low:high]) for low, high in pairwise(ends))
    weight = np.divide(variance, total, out=np.zeros_like(total), where=total > 0)
    return edges, [_own_edges(part, total, weight * part, edges) for part in parts]


def _own_edges(
    part: NDArray[np.float64], total: NDArray[np.float64], variance: NDArray[np.float64], edges: NDArray[np.intp]
) -> NDArray[np.intp]:
    sums = (np.add.reduceat(values, edges[:-1]) for values in (part, 0.5 * total))
    major = np.repeat(np.greater(*sums), np.diff(edges))
    turns = [0, *(np.flatnonzero(np.diff(major)) + 1), len(part)]
    return _joined(
        edges[(edges >= low) & (edges <= high)]
        if major[low]
        else low + merged_edges(part[low:high], variance[low:high])
        for low, high in pairwise(turns)
    )


def _joined(stretches: Iterable[NDArray[np.intp]]) -> NDArray[np.intp]:
    return np.unique(np.concatenate(list(stretches)))


def _cuts(values: NDArray[np.float64], variance: NDArray[np.float64], start: int, stop: int) -> list[int]:
    """Edges of the groups in [start, stop)."""
    if stop <= start:
        return []
    cuts, total, error = [start], 0.0, 0.0
    for bin in range(start, stop):
        total, error = total + values[bin], error + variance[bin]
        width = bin + 1 - cuts[-1]
        if 0.0 < error <= (_ERROR * total) ** 2 or width >= max(_NARROW, cuts[-1] - start):
            cuts.append(bin + 1)
            total = error = 0.0
    if len(cuts) > 2 and stop - cuts[-1] < cuts[-1] - cuts[-2]:  # what is left over joins the group before it
        cuts.pop()
    return [*cuts, stop]


def merged_means(values: NDArray[np.float64], edges: NDArray[np.intp]) -> NDArray[np.float64]:
    """Mean over the bins of each group, `[G]`."""
    return np.add.reduceat(values, edges[:-1]) / np.diff(edges)


# Depth frames


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthMaps:
    """A frame beside its counts: the scene, and `[H, W]` [m] depth by an estimator, truth, bound; the
    channel of polarised light, "I" for all light."""

    scene: Scene
    method: str
    depth: NDArray[Any]
    truth: NDArray[Any]
    bound: NDArray[Any]
    channel: str = "I"


def draw_recording(file: FramesFile, path: str | Path, *, width: float = PAGE) -> Path:
    """The first frame of a file, see `frame_figure`; returns the path."""
    return save(stored_frame_figure(file, 0, width), path)


def stored_frame_figure(file: FramesFile, number: int, width: float = PAGE) -> Figure:
    """`frame_figure` of a frame in a file, with the depth and the bound that stand there."""
    frame, method = file.frame(number), file.best_method
    maps = None
    if method is not None:
        depth, bound = file.depth(method, number), file.bound_depth()
        truth, channel = file.truth_depth, file.channel
        maps = DepthMaps(scene=file.scene, method=method, depth=depth, truth=truth, bound=bound, channel=channel)
    return frame_figure(frame, maps=maps, width=width)


@paper()
def frame_figure(frames: Frames, number: int = 0, *, maps: DepthMaps | None = None, width: float = PAGE) -> Figure:
    """One frame: depth by an estimator, its error, the bound, intensity; the counts of one pixel over time.

    Without `maps` the time of the fullest bin stands for the depth. Raises `ArgumentError` for a number that is not
    there or a width [inch] that cannot hold text.
    """
    if not 0 <= number < (1 if frames.summed else frames.frames):
        raise ArgumentError(f"frame = {number} is outside [0, {1 if frames.summed else frames.frames})")
    counts = np.asarray(frames.counts if frames.summed else frames.counts[number])
    intensity = counts.sum(axis=-1)
    panels = Panels(intensity.shape, 2 if maps is None else 4, width=width, below=2.0)
    if maps is None:
        edges = 1e9 * (frames.gate_start + frames.edges)
        fullest = np.where(intensity > 0, (0.5 * (edges[:-1] + edges[1:]))[counts.argmax(axis=-1)], np.nan)
        panels.show_depth(fullest, "Fullest bin", shown_limits(fullest), "time of flight [ns]")
    else:
        panels.show_depth(maps.depth, f"Depth ({maps.method})", target_limits(maps.truth, maps.depth))
        panels.show_error(maps.depth - maps.truth, "Depth − truth")
        known = "" if np.isfinite(maps.bound).any() else ": unknown"
        panels.show_positive(1e3 * maps.bound, f"Cramér–Rao bound{known}", "standard deviation [mm]")
    panels.show_intensity(intensity, "Intensity", "counts in a frame")
    axis = panels.below()
    _plot_counts(frames, counts, maps, axis)
    columns = 4 if width > 5 else 2
    panels.figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    which = "all frames added up" if frames.summed else f"frame {frames.first_frame + number + 1}"
    mode = "" if maps is None else f", {maps.scene.detector.mode.replace('_', '-')}"
    mode += "" if maps is None else channel_text(maps.channel)
    noise = noise_caption(frames.monte_carlo_noise)
    panels.caption(f"{which}: {spaced(frames.pulses)} pulses{mode}; seed {frames.seed}{noise}")
    return panels.figure


def _plot_counts(frames: Frames, counts: NDArray[Any], maps: DepthMaps | None, axis: Axes) -> None:
    """Counts of the pixel with most light of a target, their mean, the true arrival."""
    signal = np.asarray(frames.expected - frames.background).sum(axis=-1)
    if maps is not None and np.isfinite(maps.truth).any():
        signal = np.where(np.isfinite(maps.truth), signal, -1.0)
    row, column = divmod(int(np.argmax(signal if (signal > 0).any() else counts.sum(axis=-1))), signal.shape[1])
    detector = None if maps is None else maps.scene.detector
    label = "expected" + ("" if detector else " before pile-up")
    if detector and detector.mode == "free_running" and detector.dead_time_ns > 0:
        label += " without dead time"
    pile_up = detector is not None and detector.mode == "first_photon"
    expected, background = _mean_counts(frames, row, column, pile_up=pile_up)
    edges = 1e9 * (frames.gate_start + frames.edges)
    counts = counts[row, column]
    axis.stairs(counts, edges, fill=True, color="0.72", label="counts of the frame")
    axis.stairs(expected, edges, baseline=None, color=BLUE, linewidth=1.0, label=label)
    axis.stairs(background, edges, baseline=None, color=GREEN, linewidth=0.8, label="background part")
    if maps is not None:
        line = lines_of_sight(maps.scene)[row, column]
        path = line.path_from_range(line.range_from_depth(maps.truth[row, column].astype(np.float64)))
        arrival_line(axis, 1e9 * float(path) / maps.scene.medium.pulse_speed, edges)
    top = float(max(counts.max(), expected.max(), 1.0))
    scale = "counts per bin"
    if top > max(10.0, 50 * float(np.median(expected))):
        axis.set_yscale("symlog", linthresh=1.0)
        scale += " (linear to 1, then log)"
        axis.set_yticks([0] + [10**e for e in range(int(np.log10(top)) + 1)])
        axis.yaxis.set_minor_locator(SymmetricalLogLocator(base=10, linthresh=1.0, subs=range(2, 10)))
    axis.set(xlim=edges[[0, -1]], ylim=(0, 1.3 * top), xlabel="time of flight [ns]", ylabel=scale)
    axis.xaxis.minorticks_on()
    axis.set_title(f"Pixel in row {row}, column {column}")


def _mean_counts(
    frames: Frames, row: int, column: int, *, pile_up: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean counts of one pixel and the background's part of them, without dead time and afterpulsing."""
    hazard = np.asarray(frames.expected[row, column]).astype(np.float64)
    background = np.broadcast_to(np.asarray(frames.background[row, column]).astype(np.float64), hazard.shape)
    share = np.divide(background, hazard, out=np.zeros_like(hazard), where=hazard > 0)
    mean = frames.exposure * (first_photon_probabilities(hazard) if pile_up else hazard)
    return mean, share * mean


def draw_analytic(result: AnalyticResult, path: str | Path, *, width: float = PAGE) -> Path:
    """Maps of the model and a frame, its first one or one that is drawn now; `width` [inch]; returns the path."""
    return save(analytic_figure(result, width), path)


@paper()
def analytic_figure(result: AnalyticResult, width: float = PAGE) -> Figure:
    """The figure of `draw_analytic`."""
    if len(result.depth):
        frame, labels = result.depth[0], result.labels[0]
    else:
        frame, labels = (part[0] for part in result.sample(1))
    truth, analytic = result.truth.depth, result.scene.analytic
    seen = result.fisher > 0
    limits = shown_limits(truth[seen] if seen.any() else truth, margin=0.05)
    outliers = f", {labels.sum()} outliers" if labels.any() else ""
    panels = Panels(truth.shape, 6, width=width)
    panels.show_positive(result.signal, "Signal S", "detections per pulse", INTENSITY_MAP)
    panels.show_positive(1e3 * result.sigma_depth, "Cramér–Rao bound σ*", "standard deviation [mm]")
    panels.show_positive(
        result.signal_to_backscatter, "Signal to backscatter", "signal over backscatter", INTENSITY_MAP
    )
    false_peak = np.where(np.isnan(truth), np.nan, result.outlier_probability)
    panels.show(false_peak, "Outlier probability", "probability of a false peak", PROBABILITY_MAP, (0.0, 1.0))
    panels.show_depth(truth, "Truth", limits)
    panels.show_depth(frame, f"A depth frame{outliers}", limits)
    panels.caption(
        f"analytic, {analytic.form} form; water c = {result.scene.medium.extinction:.3g} 1/m; "
        f"backscatter {analytic.backscatter.replace('_', ' ')}; seed {result.seed}"
    )
    return panels.figure


@paper()
def draw_depth(
    image: NDArray[np.float64],
    intensity: NDArray[Any],
    path: str | Path,
    *,
    label: str,
    title: str,
    width: float = PAGE,
) -> Path:
    """A depth or range image `[H, W]` [m] beside the intensity; returns the path. `width`: of the picture [inch]."""
    panels = Panels(image.shape, 2, width=width)
    panels.show_depth(image, title, shown_limits(image, beyond=1.0, weights=intensity), label)
    panels.show_intensity(intensity, "Intensity", "sum over bins")
    return save(panels.figure, path)


@paper()
def draw_denoised(
    noisy: NDArray[np.float32],
    denoised: NDArray[np.float32],
    path: str | Path,
    *,
    gate: tuple[float, float],
    title: str,
    truth: NDArray[np.float32] | None = None,
    width: float = PAGE,
) -> Path:
    """A frame before and after, depth `[H, W]` [m] each; returns the path.

    With the truth also that, the error, and in colours of their own the pixels in which a target was missed or
    invented, and their parts of the target and of the water: NaN stands for no target. `width`: of the picture [inch].
    """
    known = truth is not None and np.isfinite(truth).any()
    scale = truth if truth is not None and known else denoised if np.isfinite(denoised).any() else noisy
    low, high = shown_limits(scale, beyond=1.0, margin=0.05 * known)
    limits = max(low, gate[0] - 1.0), min(high, gate[1] + 1.0)
    panels = Panels(noisy.shape, 2 if truth is None else 4, width=width)
    panels.show_depth(noisy, "Input", limits)
    if truth is None:
        panels.show_depth(denoised, "Denoised", limits)
    else:
        target, found = np.isfinite(truth), np.isfinite(denoised)
        missed, invented = target & ~found, found & ~target
        parts = (100 * some.sum() / max(1, of.sum()) for some, of in ((missed, target), (invented, ~target)))
        of_target, of_water = map(percent, parts)
        label = f"depth z [m]\nblack: missed, {of_target}\nred: invented, {of_water}"
        mark_pixels(panels.show_depth(denoised, "Denoised", limits, label), missed, invented)
        panels.show_depth(truth, "Truth", limits)
        panels.show_error(denoised - truth, "Denoised − truth")
    panels.caption(title)
    return save(panels.figure, path)


_MOST_POINTS = 160  # bins are added up to at most so many


def draw_fit(fit: Fit, path: str | Path, *, width: float = PAGE) -> Path:
    """Counts, fit and residuals of a fit: over the image and over time; `width` [inch]; returns the path."""
    return save(fit_figure(fit, width), path)


@paper()
def fit_figure(fit: Fit, width: float = PAGE) -> Figure:
    """The figure of `draw_fit`."""
    counts, expected = fit.counts.sum(axis=2), fit.expected.sum(axis=2, dtype=np.float64)
    images = 2 if fit.depth is None else 3
    panels = Panels(counts.shape, images, width=width, below=2.6)
    panels.show_intensity(counts, "Counts", "counts in the exposure")
    residual = (counts - expected) / np.sqrt(np.maximum(expected, 1e-12))
    panels.show(np.where(expected > 0, residual, np.nan), "Residual", "(counts − fit) / √fit", ERROR_MAP, (-3.0, 3.0))
    if fit.depth is not None:
        panels.show_depth(fit.depth, "Depth", shown_limits(fit.depth))
    below = panels.below()
    below.set_axis_off()
    top = below.inset_axes((0.0, 0.42, 1.0, 0.58))
    bottom = below.inset_axes((0.0, 0.0, 1.0, 0.32), sharex=top)
    bins = fit.counts.shape[2]
    factor = max(1, -(-bins // _MOST_POINTS))
    starts = np.arange(0, bins, factor)
    measured = np.add.reduceat(fit.counts.sum(axis=(0, 1)).astype(np.float64), starts)
    mean = np.add.reduceat(fit.expected.sum(axis=(0, 1), dtype=np.float64), starts)
    edges = 1e9 * np.append(fit.edges[starts], fit.edges[-1])
    top.stairs(measured, edges, fill=True, color="0.72", label="counts, all pixels")
    top.stairs(mean, edges, baseline=None, color=BLUE, linewidth=1.0, label="fit")
    seen = mean[mean > 0]
    low = max(0.5, float(seen.min()) if seen.size else 0.5)
    top.set_ylim(0.5 * low, 3.0 * max(float(measured.max()), 2.0 * low))
    log_axis(top, "y", most=5)
    top.set(xlim=edges[[0, -1]], ylabel="counts")
    top.tick_params(labelbottom=False)
    top.legend(loc="upper right", ncols=2)
    left = (measured - mean) / np.sqrt(np.maximum(mean, 1.0))
    bottom.axhline(0.0, color=TEXT, linewidth=0.6)
    bottom.plot(0.5 * (edges[:-1] + edges[1:]), left, ".", color=RED, markersize=2.5)
    reach = max(3.5, 1.1 * float(np.abs(left).max()))
    bottom.set(ylim=(-reach, reach), xlabel="time of flight [ns]", ylabel="residual\n/ √fit")
    values = "; ".join(
        f"{item.name} = {rounded(item.value, item.standard_error)} ± {item.standard_error:.2g} {item.unit}".rstrip()
        for item in fit.estimates.values()
    )
    panels.caption(f"{values}; {spaced(fit.pulses)} pulses" if values else f"{spaced(fit.pulses)} pulses")
    return panels.figure
