"""Pictures of a result: depth, intensity, histograms, truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from spadwarp.frames import Method
from spadwarp.result import COMPONENTS, Result, degree_of_polarisation
from spadwarp.result.result import pixel_channel, pixel_standard_error
from spadwarp.scene import Medium
from spadwarp.scene.sight import lines_of_sight
from spadwarp.viz.panels import Panels, arrival_line, shown_limits, target_limits
from spadwarp.viz.sparse import merged_means, shared_edges, typical_weight
from spadwarp.viz.style import (
    CHANNEL_NAMES,
    INTENSITY_MAP,
    MISSING,
    PAGE,
    PURPLE,
    TEXT,
    log_axis,
    new_figure,
    paper,
    save,
    spaced,
    wrapped_items,
)
from spadwarp.viz.style import COMPONENTS as STYLES

__all__ = ["KINDS", "draw_result", "picture_calls", "result_figure"]

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
            axis.text(0.5, 0.5, "nothing returned in the gate", transform=axis.transAxes, ha="center", va="center")
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
    if error is not None:
        _plot_band(axis, time[edges], merged_means(total, edges), error, edges, bottom)
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


def _plot_band(
    axis: Axes,
    time: NDArray[np.float64],
    mean: NDArray[np.float64],
    error: NDArray[np.float64],
    edges: NDArray[np.intp],
    bottom: float,
) -> None:
    """The sum of all light with its standard error, those of the bins of a group taken as independent."""
    spread = np.sqrt(np.add.reduceat(error**2, edges[:-1])) / np.diff(edges)
    lower = np.maximum(mean - spread, 0.01 * bottom)
    axis.stairs(
        np.maximum(mean + spread, 0.01 * bottom), time, baseline=lower, fill=True, color="0.75", zorder=1,
        label="all light ± standard error",
    )  # fmt: skip


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
    """What a caption says of light of one channel alone; nothing of all light."""
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
