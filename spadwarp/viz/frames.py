"""Pictures of depth frames: of a camera's counts, of the analytic model, of a measurement."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.io.atomic import atomic_path
from spadwarp.viz.result import image_panels, show_image, shown_limits

if TYPE_CHECKING:
    from spadwarp.analytic.result import AnalyticResult
    from spadwarp.frames.frames import Frames
    from spadwarp.frames.record import Recording
    from spadwarp.result.result import Result

__all__ = ["draw_analytic", "draw_depth", "draw_recording", "expected_counts"]

_DPI = 150
_GREEN, _BLUE = "#009E73", "#0072B2"


def draw_recording(recording: Recording, result: Result, path: str | Path) -> Path:
    """The first frame: depth by the last estimator, its error, the bound, counts; one pixel's counts over time."""
    truth = result.truth.depth
    method, frame = list(recording.depth.items())[-1]
    low, high = shown_limits(truth) if np.isfinite(truth).any() else shown_limits(frame, beyond=1.0)
    margin = 0.05 * (high - low)
    counts = recording.first.intensity[0]
    error = 1e3 * (frame - truth)
    spread = np.abs(error[np.isfinite(error)])
    reach = max(float(np.percentile(spread, 95)), 0.1) if spread.size else 1.0
    bound = 1e3 * recording.bound_depth

    figure, images, bars = image_panels(truth.shape, 4, below=2.6)
    show_image(
        images[0],
        bars[0],
        frame,
        title=f"Depth ({method})",
        label="depth z [m]",
        colours="viridis_r",
        low=low - margin,
        high=high + margin,
    )
    title = "Depth − truth"
    show_image(images[1], bars[1], error, title=title, label="error [mm]", colours="PuOr", low=-reach, high=reach)
    label = "standard deviation of depth [mm]"
    _show_positive(images[2], bars[2], bound, title="Cramér–Rao bound", label=label, colours="magma_r")
    top = float(max(np.percentile(counts, 99.5), 1))
    show_image(
        images[3], bars[3], counts, title="Intensity", label="counts in a frame", colours="cividis", low=0.0, high=top
    )
    _plot_counts(recording, result, figure.axes[-1])
    pulses = f"{recording.first.pulses:,}".replace(",", " ")
    mode = result.scene.detector.mode.replace("_", "-")
    figure.suptitle(
        f"frame {recording.first.first_frame}: {pulses} pulses, {mode}; seed {recording.first.seed}",
        fontsize=9,
        color="0.25",
    )
    return _write(figure, path)


def expected_counts(
    detection: Frames, result: Result, row: int, column: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean counts of one pixel in one frame and the background's part of them, float64 `[T]` each.

    `result` is what the frames were drawn from. First-photon pile-up is in it; dead time, afterpulsing, crosstalk and
    the counter's depth are not.
    """
    from spadwarp.frames.response import response_matrix

    scene = result.scene
    tallies = result.tallies[:2, row, column].sum(axis=0)
    light = tallies * (result.tally_value[row, column] * scene.laser.photons_per_pulse * scene.detector.pde)
    matrix = response_matrix(
        detection.irf,
        source_start=scene.gate.start,
        source_width=scene.gate.bin_width,
        source_bins=scene.gate.bins,
        edges=detection.gate_start + detection.edges,
        period=detection.period,
    )
    bins = len(detection.edges) - 1
    of_bin = np.repeat(np.arange(bins), np.diff(matrix.row_start))
    hazard = np.bincount(of_bin, matrix.weight * light[matrix.source_bin], minlength=bins)
    floor = np.broadcast_to(detection.background[row, column].astype(np.float64), hazard.shape)
    hazard = hazard + floor
    share = np.divide(floor, hazard, out=np.zeros_like(hazard), where=hazard > 0)
    if scene.detector.mode == "first_photon":
        before = np.append(0.0, np.cumsum(hazard)[:-1])
        hazard = np.exp(-before) * -np.expm1(-hazard)
    return hazard * detection.pulses, share * hazard * detection.pulses


def _plot_counts(recording: Recording, result: Result, axis: Any) -> None:
    """The pixel of median bound, or intensity: counts, their mean, where the target is."""
    first = recording.first
    known = np.isfinite(recording.bound_depth)
    measure = recording.bound_depth if known.any() else first.intensity[0]
    choice = np.flatnonzero(known | ~known.any())
    order = choice[np.argsort(measure.ravel()[choice], kind="stable")]
    row, column = divmod(int(order[(len(order) - 1) // 2]), measure.shape[1])
    edges = 1e9 * (first.gate_start + first.edges)
    expected, floor = expected_counts(first, result, row, column)
    values = first.counts[0, row, column]
    detector = result.scene.detector
    blind = detector.mode == "free_running" and detector.dead_time_ns > 0
    label = "expected, dead time aside" if blind else "expected"
    axis.stairs(values, edges, fill=True, color="0.72", label="counts of the frame")
    axis.stairs(expected, edges, baseline=None, color=_BLUE, linewidth=1.4, label=label)
    axis.stairs(floor, edges, baseline=None, color=_GREEN, linewidth=1.0, label="of that, background")
    arrival = 1e9 * result.true_path()[row, column] / result.pulse_speed
    if edges[0] <= arrival < edges[-1]:
        axis.axvline(arrival, color="0.2", linewidth=0.9, linestyle=(0, (4, 3)), label="true arrival")
    top = float(max(values.max(), expected.max(), 1.0))
    if top > 50 * max(float(np.median(expected)), 0.02):
        axis.set_yscale("symlog", linthresh=1.0)
        axis.set_yticks([0] + [10**e for e in range(int(np.log10(top)) + 1)])
    axis.set(xlim=edges[[0, -1]], ylim=(0, 1.3 * top), xlabel="time of flight [ns]", ylabel="counts per bin")
    axis.set_title(f"Pixel in row {row}, column {column}", fontsize=10)
    axis.legend(frameon=False, fontsize=8, ncols=4)


def draw_analytic(result: AnalyticResult, path: str | Path) -> Path:
    """Maps of the model, and its first frame where there is one, else one that is drawn here."""
    frame, labels = (result.depth[0], result.labels[0]) if len(result.depth) else (one[0] for one in result.sample(1))
    truth = result.truth.depth
    low, high = shown_limits(truth[result.fisher > 0] if (result.fisher > 0).any() else truth)
    margin = 0.05 * (high - low)
    figure, images, bars = image_panels(truth.shape, 3, lines=2)
    depth: dict[str, Any] = {
        "label": "depth z [m]",
        "colours": "viridis_r",
        "low": low - margin,
        "high": high + margin,
    }
    with np.errstate(invalid="ignore"):
        signal = np.where(result.signal > 0, result.signal, np.nan)
        maps = (
            ("Signal S", signal, "detections per pulse", "cividis"),
            ("Cramér–Rao bound σ*", 1e3 * result.sigma_depth, "standard deviation of depth [mm]", "magma_r"),
            ("Signal to backscatter", result.signal_to_backscatter, "ratio", "cividis"),
        )
    for image, bar, (title, values, label, colours) in zip(images, bars, maps, strict=False):
        _show_positive(image, bar, values, title=title, label=label, colours=colours)
    show_image(
        images[3],
        bars[3],
        np.where(np.isnan(truth), np.nan, result.outlier_probability),
        title="Outlier probability",
        label="probability of a false peak",
        colours="inferno_r",
        low=0.0,
        high=1.0,
    )
    show_image(images[4], bars[4], truth, title="Truth", **depth)
    outliers = f", {labels.sum()} outliers" if labels.any() else ""
    show_image(images[5], bars[5], frame, title=f"A depth frame{outliers}", **depth)
    scene = result.scene
    figure.suptitle(
        f"analytic, {scene.analytic.form} form; water c = {scene.medium.extinction:.3g} 1/m; "
        f"backscatter {scene.analytic.backscatter.replace('_', ' ')}; seed {result.seed}",
        fontsize=9,
        color="0.25",
    )
    return _write(figure, path)


def draw_depth(
    image: NDArray[np.float64], intensity: NDArray[Any], path: str | Path, *, label: str, title: str
) -> Path:
    """A depth or range image beside the intensity."""
    figure, images, bars = image_panels(image.shape, 2)
    low, high = shown_limits(image, beyond=1.0)
    show_image(images[0], bars[0], image, title=title, label=label, colours="viridis_r", low=low, high=high)
    bright = intensity.astype(np.float64)
    top = float(np.percentile(bright, 99.5)) or float(bright.max()) or 1.0
    exponent = 0 if 1e-2 <= top < 1e4 else int(np.floor(np.log10(top)))
    show_image(
        images[1],
        bars[1],
        bright / 10.0**exponent,
        title="Intensity",
        label="sum over bins" + (f" [$10^{{{exponent}}}$]" if exponent else ""),
        colours="cividis",
        low=0.0,
        high=top / 10.0**exponent,
    )
    return _write(figure, path)


def _show_positive(image: Any, bar: Any, values: NDArray[Any], *, title: str, label: str, colours: str) -> None:
    """An image of positive values between their 1st and 99th percentile; logarithmic if these are far apart."""
    shown = np.where(np.isfinite(values) & (values > 0), values, np.nan)
    there = shown[np.isfinite(shown)]
    low, high = map(float, np.percentile(there, (1.0, 99.0))) if there.size else (0.1, 1.0)
    wide = high > 4.0 * low
    exponent = 0 if wide or 1e-2 <= high < 1e4 else int(np.floor(np.log10(high)))
    unit = 10.0**exponent
    if not wide:
        low, high = low - 0.05 * high, 1.05 * high  # one value alone is no interval
    show_image(
        image,
        bar,
        shown / unit,
        title=title,
        label=label + (f" [$10^{{{exponent}}}$]" if exponent else ""),
        colours=colours,
        low=low / unit,
        high=high / unit,
        scale="log" if wide else "linear",
    )


def _write(figure: Any, path: str | Path) -> Path:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=_DPI, format="png")
    return Path(path)
