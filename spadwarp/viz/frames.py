"""Depth frames: of a camera's counts, and of the analytic model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import SymmetricalLogLocator
from numpy.typing import NDArray

from spadwarp.frames import first_photon_probabilities
from spadwarp.viz.panels import Panels, arrival_line, shown_limits, target_limits
from spadwarp.viz.style import BLUE, GREEN, INTENSITY_MAP, PAGE, PROBABILITY_MAP, paper, save, spaced

if TYPE_CHECKING:
    from spadwarp.analytic import AnalyticResult
    from spadwarp.frames import Frames, Recording
    from spadwarp.result import Result

__all__ = ["analytic_figure", "draw_analytic", "draw_recording"]


@paper()
def draw_recording(recording: Recording, result: Result, path: str | Path, *, width: float = PAGE) -> Path:
    """The first frame: depth by the last estimator, its error, the bound, counts; one pixel's counts over time.

    `result` is what the frames were drawn from; `width` [inch]. Returns the path.
    """
    truth, first = result.truth.depth, recording.first
    method, frame = list(recording.depth.items())[-1]
    panels = Panels(truth.shape, 4, width=width, below=2.0)
    panels.show_depth(frame, f"Depth ({method})", target_limits(truth, frame))
    panels.show_error(frame - truth, "Depth − truth")
    panels.show_positive(1e3 * recording.bound_depth, "Cramér–Rao bound", "standard deviation [mm]")
    panels.show_intensity(first.intensity[0], "Intensity", "counts in a frame")
    _plot_counts(recording, result, panels.below())
    columns = 4 if width > 5 else 2
    panels.figure.legend(*panels.figure.axes[-1].get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    mode = result.scene.detector.mode.replace("_", "-")
    panels.caption(f"frame {first.first_frame + 1}: {spaced(first.pulses)} pulses, {mode}; seed {first.seed}")
    return save(panels.figure, path)


def _plot_counts(recording: Recording, result: Result, axis: Axes) -> None:
    """Counts of the pixel of the target with most of its light, or of most counts; their mean, the true arrival."""
    first, detector = recording.first, result.scene.detector
    signal = (first.expected - first.background).sum(axis=-1)
    chosen = np.where(np.isfinite(result.truth.depth), signal, -1.0)
    brightest = int(np.argmax(chosen if (chosen > 0).any() else first.intensity[0]))
    row, column = divmod(brightest, chosen.shape[1])
    edges = 1e9 * (first.gate_start + first.edges)
    expected, background = _mean_counts(first, row, column, pile_up=detector.mode == "first_photon")
    counts = first.counts[0, row, column]
    with_dead_time = detector.mode == "free_running" and detector.dead_time_ns > 0
    label = "expected without dead time" if with_dead_time else "expected"
    axis.stairs(counts, edges, fill=True, color="0.72", label="counts of the frame")
    axis.stairs(expected, edges, baseline=None, color=BLUE, linewidth=1.0, label=label)
    axis.stairs(background, edges, baseline=None, color=GREEN, linewidth=0.8, label="background part")
    arrival_line(axis, result, row, column, edges)
    top = float(max(counts.max(), expected.max(), 1.0))
    scale = "counts per bin"
    if top > 50 * max(float(np.median(expected)), 0.02):
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
    """Mean counts of one pixel in one frame and the background's part of them, without dead time and afterpulsing."""
    hazard = frames.expected[row, column].astype(np.float64)
    background = np.broadcast_to(frames.background[row, column].astype(np.float64), hazard.shape)
    share = np.divide(background, hazard, out=np.zeros_like(hazard), where=hazard > 0)
    mean = frames.pulses * (first_photon_probabilities(hazard) if pile_up else hazard)
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
