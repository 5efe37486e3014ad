"""Pictures of a result: depth, intensity, histograms, truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from spadwarp.frames import Method
from spadwarp.result import COMPONENTS, Result
from spadwarp.scene import Medium
from spadwarp.scene.geometry import path_from_range, pixel_directions, range_from_path
from spadwarp.viz.panels import Panels, arrival_line, shown_limits, target_limits
from spadwarp.viz.style import COMPONENTS as STYLES
from spadwarp.viz.style import GRID, INTENSITY_MAP, MISSING, TEXT, new_figure, save, spaced

__all__ = ["KINDS", "draw_result", "result_figure"]

KINDS = ("depth", "intensity", "histogram", "truth")
"""Figures of a result."""


def draw_result(
    result: Result,
    directory: str | Path,
    *,
    depth: NDArray[np.float64] | None = None,
    method: Method = "centroid",
    formats: Sequence[str] = ("png",),
) -> list[Path]:
    """Writes pictures of depth, intensity, histograms and truth, such as `depth.png`; returns their paths.

    Args:
        result: What to show; frames without returns give empty pictures, not errors.
        directory: The folder; it is made if it is missing.
        depth: Depth frame `[H, W]` [m] to show; `result.depth(method=method)` if not given.
        method: Estimator of the depth frame, named in the picture.
        formats: "png", and "pdf" with vectors, for print.

    Raises:
        FileError: The folder or a file cannot be written.
    """
    folder = Path(directory)
    figures = {name: result_figure(result, name, depth=depth, method=method) for name in KINDS}
    return [save(figure, folder / f"{name}.{ending}") for name, figure in figures.items() for ending in formats]


def result_figure(
    result: Result,
    kind: str,
    *,
    depth: NDArray[np.float64] | None = None,
    method: Method = "centroid",
    device: Any = None,
) -> Figure:
    """One of the figures of `draw_result`, of `KINDS`."""
    if kind == "depth":
        frame = result.depth(method=method, device=device) if depth is None else np.asarray(depth, dtype=np.float64)
        return _depth_figure(result, frame, method)
    return {"intensity": _intensity_figure, "histogram": _histogram_figure, "truth": _truth_figure}[kind](result)


def _panels(result: Result, columns: int) -> Panels:
    panels = Panels(result.truth.depth.shape, columns)
    panels.caption(_caption(result))
    return panels


def _depth_figure(result: Result, frame: NDArray[np.float64], method: str) -> Figure:
    truth = result.truth.depth
    limits = target_limits(truth, frame)
    panels = _panels(result, 3)
    panels.show_depth(frame, f"Measured ({method})", limits)
    panels.show_depth(truth, "Truth", limits)
    panels.show_error(100.0 * (frame - truth), "Measured − truth", "depth error [cm]", percentile=98.0)
    return panels.figure


def _intensity_figure(result: Result) -> Figure:
    per_pulse = result.scene.laser.photons_per_pulse * result.scene.detections_per_photon
    ballistic = result.component("ballistic").sum(axis=-1)
    panels = _panels(result, 2)
    panels.show_intensity(result.intensity * per_pulse, "All light in the gate", "expected detections per pulse")
    panels.show_intensity(ballistic * per_pulse, "Ballistic light alone", "expected detections per pulse")
    return panels.figure


def _truth_figure(result: Result) -> Figure:
    truth = result.truth
    normal = 0.5 + 0.5 * truth.normal * np.array([1.0, -1.0, -1.0])
    panels = _panels(result, 3)
    panels.show_depth(truth.depth, "Depth", shown_limits(truth.depth))
    axis, bar = panels.place("Normal")
    axis.imshow(np.where(np.isfinite(normal), normal, float(MISSING)).clip(0.0, 1.0), interpolation="nearest")
    bar.axis("off")
    bar.text(0.5, 0.0, "red: right, green: up, blue: to the camera", fontsize=9, ha="center", va="center")
    panels.show(truth.reflectance, "Reflectance", "Lambertian reflectance", INTENSITY_MAP, (0.0, 1.0))
    return panels.figure


def _histogram_figure(result: Result) -> Figure:
    figure = new_figure(7.0, 6.4)
    figure.suptitle(_caption(result), fontsize=9, color=TEXT)
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
            axis.set_title(f"{name} pixel {group}: row {row}, column {column}", fontsize=10)
            _plot_pixel(result, axis, row, column)
            handles |= {line.get_label(): line for line in axis.get_legend_handles_labels()[0]}
    if handles:
        figure.legend(handles=list(handles.values()), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def _plot_pixel(result: Result, axis: Axes, row: int, column: int) -> None:
    """Components of one pixel over time of flight, and over the range along its line of sight."""
    per_pulse = result.scene.laser.photons_per_pulse * result.scene.detections_per_photon
    parts = result.tallies[:, row, column] * (result.tally_value[row, column] * per_pulse)
    time = 1e9 * result.bin_edges
    top = parts.max()
    bottom = np.clip(0.5 * parts[parts > 0].min(), 1e-7 * top, 0.01 * top)
    for name, values in zip(COMPONENTS, parts, strict=True):
        label, colour = STYLES[name]
        ballistic = name == "ballistic"
        # Zeros lie below the axis, so that a single bin still shows as a spike.
        axis.stairs(
            np.maximum(values, 0.01 * bottom), time, baseline=None, label=label, color=colour,
            linewidth=1.6 if ballistic else 1.0, zorder=3 if ballistic else 2,
        )  # fmt: skip
    arrival_line(axis, result, row, column, time)
    axis.set(yscale="log", ylim=(bottom, 3.0 * top), ylabel="detections per pulse and bin")
    axis.grid(which="major", color=GRID, linewidth=0.6)
    axis.set_axisbelow(True)

    speed, laser = 1e-9 * result.pulse_speed, result.scene.beam.position
    direction = pixel_directions(result.scene.camera)[row, column]

    def to_range(at: ArrayLike) -> NDArray[np.float64]:
        # Range 0 before light can go from laser to lens: an axis cannot begin with NaN.
        return np.nan_to_num(range_from_path(np.asarray(at) * speed, direction, laser))

    def to_time(at: ArrayLike) -> NDArray[np.float64]:
        return path_from_range(at, direction, laser) / speed

    axis.secondary_xaxis("top", functions=(to_range, to_time)).set_xlabel("range [m]")


def _caption(result: Result) -> str:
    medium = result.scene.medium
    albedo = "U(0, 0.97)" if medium.albedo == "lu2024" else f"{medium.albedo:.3g}"
    water = f"water c = {medium.extinction:.3g} 1/m, albedo {albedo}, {_phase_text(medium)}"
    if medium.layers:
        extinctions = ", ".join(f"{water.extinction:.3g}" for water in medium.waters)
        water = f"{len(medium.waters)} layers of water, c = {extinctions} 1/m"
    photons = f"{result.photons:.3g}" if result.photons >= 1e6 else spaced(result.photons)
    if "e+" in photons:
        mantissa, power = photons.split("e+")
        photons = f"{'' if mantissa == '1' else mantissa + ' × '}$10^{{{int(power)}}}$"
    partial = ", interrupted" if result.partial else ""
    return f"{photons} photons{partial}; {water}; seed {result.seed}"


def _phase_text(medium: Medium) -> str:
    if medium.phase_function == "tabulated":
        return f"phase function {Path(str(medium.phase_table)).stem}"
    symbols = {"anisotropy": "g", "alpha": "α", "particle_index": "n", "junge_slope": "µ"}
    return ", ".join(f"{symbols.get(name, name)} = {value:.4g}" for name, value in medium.phase_parameters.items())
