"""Depth frames: of a camera's counts, and of the analytic model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import SymmetricalLogLocator
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError
from spadwarp.frames import METHODS, first_photon_probabilities
from spadwarp.frames.spad import noise_caption
from spadwarp.scene.sight import lines_of_sight
from spadwarp.viz.panels import Panels, arrival_line, shown_limits, target_limits
from spadwarp.viz.result import channel_text
from spadwarp.viz.style import BLUE, GREEN, INTENSITY_MAP, PAGE, PROBABILITY_MAP, paper, save, spaced

if TYPE_CHECKING:
    from spadwarp.analytic import AnalyticResult
    from spadwarp.frames import Frames, FramesFile, Recording
    from spadwarp.result import Result
    from spadwarp.scene import Scene

__all__ = ["analytic_figure", "draw_analytic", "draw_recording", "frame_figure", "stored_frame_figure"]


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthMaps:
    """What is known of a frame beside its counts: the scene, and `[H, W]` [m] depth by an estimator, truth, bound; the
    channel of polarised light, "I" for all light."""

    scene: Scene
    method: str
    depth: NDArray[Any]
    truth: NDArray[Any]
    bound: NDArray[Any]
    channel: str = "I"

    @property
    def arrival(self) -> NDArray[np.float64]:
        """True time of flight [ns], `[H, W]`; NaN without a target."""
        lines = lines_of_sight(self.scene)
        path = lines.path_from_range(lines.range_from_depth(self.truth.astype(np.float64)))
        return 1e9 * path / self.scene.medium.pulse_speed


def draw_recording(recording: Recording, result: Result, path: str | Path, *, width: float = PAGE) -> Path:
    """The first frame, see `frame_figure`; `result` is what the frames were drawn from. Returns the path."""
    method = max(recording.depth, key=METHODS.index)
    maps = DepthMaps(
        scene=result.scene,
        method=method,
        depth=recording.depth[method].astype(np.float32),  # as in the file
        truth=result.truth.depth,
        bound=recording.bound_depth,
        channel=result.provenance.get("channel", "I"),
    )
    return save(frame_figure(recording.first, maps=maps, width=width), path)


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
        arrival_line(axis, float(maps.arrival[row, column]), edges)
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
