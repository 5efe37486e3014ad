"""Pictures for a first look at a result, good enough for a paper."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from numpy.typing import ArrayLike, NDArray

from spadwarp.frames.estimators import Method
from spadwarp.io.atomic import atomic_path
from spadwarp.result.result import COMPONENTS, Component, Result
from spadwarp.scene import Medium
from spadwarp.scene.geometry import path_from_range, pixel_directions, range_from_path

__all__ = ["image_panels", "show_image", "shown_limits", "write_previews"]

_MISSING = "0.85"  # light grey: NaN
# Okabe and Ito's colours: told apart with every common colour-blindness and, by their lightness, in print.
_STYLES: dict[Component, dict[str, Any]] = {
    "ballistic": {"label": "target, ballistic", "color": "#0072B2", "linewidth": 1.6, "zorder": 3},
    "forward_scattered": {"label": "target, forward-scattered", "color": "#E69F00", "linewidth": 1.0, "zorder": 2.5},
    "backscatter": {"label": "water, backscatter", "color": "#009E73", "linewidth": 1.0, "zorder": 2},
}
_DPI = 150


def write_previews(
    result: Result,
    directory: str | Path,
    *,
    depth: NDArray[np.float64] | None = None,
    method: Method = "centroid",
    formats: Sequence[str] = ("png",),
) -> list[Path]:
    """Writes pictures of depth, intensity, histograms and truth, such as `depth.png`; returns their paths.

    Args:
        result: What to show; empty frames give empty pictures, not errors.
        directory: The folder, made if it is not there.
        depth: Depth frame `[H, W]` [m] to show; `result.depth(method=method)` if not given.
        method: How the frame was, or is to be, made; named in the picture.
        formats: "png", and "pdf" with vectors, for print.

    Raises:
        FileError: The folder or a file cannot be written.
    """
    frame = result.depth(method=method) if depth is None else np.asarray(depth, dtype=np.float64)
    figures = {
        "depth": _depth_figure(result, frame, method),
        "intensity": _intensity_figure(result),
        "histogram": _histogram_figure(result),
        "truth": _truth_figure(result),
    }
    paths = []
    for name, figure in figures.items():
        for ending in formats:
            path = Path(directory) / f"{name}.{ending}"
            with atomic_path(path) as temporary:
                # Without the date, so that the same result makes the same file.
                figure.savefig(
                    temporary, dpi=_DPI, format=ending, metadata={"CreationDate": None} if ending == "pdf" else {}
                )
            paths.append(path)
    return paths


# Figures; `Figure` without pyplot keeps no state and needs no display


def _depth_figure(result: Result, frame: NDArray[np.float64], method: str) -> Figure:
    truth = result.truth.depth
    error = 100.0 * (frame - truth)
    low, high = shown_limits(truth) if np.isfinite(truth).any() else shown_limits(frame, beyond=1.0)
    margin = 0.05 * (high - low)
    scale: dict[str, Any] = {"label": "depth z [m]", "colours": "viridis_r", "low": low - margin, "high": high + margin}
    spread = np.abs(error[np.isfinite(error)])
    reach = max(float(np.percentile(spread, 98)), 0.1) if spread.size else 1.0

    figure, images, bars = _panels(result, 3)
    show_image(images[0], bars[0], frame, title=f"Measured ({method})", **scale)
    show_image(images[1], bars[1], truth, title="Truth", **scale)
    title = "Measured − truth"
    show_image(images[2], bars[2], error, title=title, label="depth error [cm]", colours="PuOr", low=-reach, high=reach)
    return figure


def _intensity_figure(result: Result) -> Figure:
    per_pulse = result.scene.laser.photons_per_pulse * result.scene.detector.pde
    frames = {
        "All light in the gate": result.intensity * per_pulse,
        "Ballistic light alone": result.component("ballistic").sum(axis=-1) * per_pulse,
    }
    figure, images, bars = _panels(result, len(frames))
    for image, bar, (title, frame) in zip(images, bars, frames.items(), strict=True):
        top = float(np.percentile(frame, 99.5)) or float(frame.max()) or 1.0  # single bright pixels go beyond the bar
        exponent = int(np.floor(np.log10(top)))
        exponent = 0 if -2 <= exponent <= 3 else exponent
        label = "expected detections per pulse" + (f" [$10^{{{exponent}}}$]" if exponent else "")
        scaled, high = frame / 10.0**exponent, top / 10.0**exponent
        show_image(image, bar, scaled, title=title, label=label, colours="cividis", low=0.0, high=high)
    return figure


def _truth_figure(result: Result) -> Figure:
    truth = result.truth
    normal = 0.5 + 0.5 * truth.normal * np.array([1.0, -1.0, -1.0])
    normal = np.where(np.isfinite(normal), normal, float(_MISSING)).clip(0.0, 1.0)
    low, high = shown_limits(truth.depth)

    figure, images, bars = _panels(result, 3)
    show_image(
        images[0], bars[0], truth.depth, title="Depth", label="depth z [m]", colours="viridis_r", low=low, high=high
    )
    _decorate(images[1], "Normal")
    images[1].imshow(normal, interpolation="nearest")
    bars[1].axis("off")
    bars[1].text(0.5, 0.0, "red: right, green: up, blue: to the camera", fontsize=9, ha="center", va="center")
    label = "Lambertian reflectance"
    show_image(
        images[2], bars[2], truth.reflectance, title="Reflectance", label=label, colours="cividis", low=0.0, high=1.0
    )
    return figure


def _histogram_figure(result: Result) -> Figure:
    figure = Figure(figsize=(7.0, 6.4), layout="constrained")
    _caption(result, figure)
    axes = figure.subplots(2, 1)
    # Ranked by the light that came straight from the target, where there is any: a rare photon of large weight can make
    # any other pixel the brightest of a short run.
    straight = result.tallies[0].sum(axis=2)
    on_target = bool(straight.any())
    intensity = straight if on_target else result.intensity
    order = np.argsort(intensity, axis=None, kind="stable")
    order = order[intensity.ravel()[order] > 0]
    place = "on the target" if on_target else "of those with a return"
    handles: dict[str, Any] = {}
    for axis, name, index in zip(axes, ("Brightest", "Median"), (-1, (len(order) - 1) // 2), strict=True):
        axis.set(xlabel="time of flight [ns]", xlim=1e9 * result.bin_edges[[0, -1]])
        if len(order) == 0:
            axis.text(0.5, 0.5, "nothing returned in the gate", transform=axis.transAxes, ha="center", va="center")
            axis.set_yticks([])
        else:
            row, column = divmod(int(order[index]), intensity.shape[1])
            axis.set_title(f"{name} pixel {place}: row {row}, column {column}", fontsize=10)
            _plot_pixel(result, axis, row, column)
            handles |= {line.get_label(): line for line in axis.get_legend_handles_labels()[0]}
    if handles:
        figure.legend(handles=list(handles.values()), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def _plot_pixel(result: Result, axis: Axes, row: int, column: int) -> None:
    """Components of one pixel over time of flight, and over the range along its line of sight."""
    per_pulse = result.scene.laser.photons_per_pulse * result.scene.detector.pde
    parts = result.tallies[:, row, column] * (result.tally_value[row, column] * per_pulse)
    time = 1e9 * result.bin_edges
    top = parts.max()
    bottom = np.clip(0.5 * parts[parts > 0].min(), 1e-7 * top, 0.01 * top)
    for name, values in zip(COMPONENTS, parts, strict=True):
        # Zeros lie below the axis, so that a single bin still shows as a spike.
        axis.stairs(np.maximum(values, 0.01 * bottom), time, baseline=None, **_STYLES[name])
    arrival = 1e9 * result.true_path()[row, column] / result.pulse_speed
    if time[0] <= arrival < time[-1]:
        axis.axvline(arrival, color="0.2", linewidth=0.9, linestyle=(0, (4, 3)), label="true arrival")
    axis.set(yscale="log", ylim=(bottom, 3.0 * top), ylabel="detections per pulse and bin")
    axis.grid(which="major", color="0.92", linewidth=0.6)
    axis.set_axisbelow(True)

    speed, laser = 1e-9 * result.pulse_speed, result.scene.beam.position
    direction = pixel_directions(result.scene.camera)[row, column]

    def to_range(at: ArrayLike) -> NDArray[np.float64]:
        # Range 0 before light could have gone from laser to lens: an axis cannot begin with NaN.
        return np.nan_to_num(range_from_path(np.asarray(at) * speed, direction, laser))

    def to_time(at: ArrayLike) -> NDArray[np.float64]:
        return path_from_range(at, direction, laser) / speed

    axis.secondary_xaxis("top", functions=(to_range, to_time)).set_xlabel("range [m]")


# Parts


def _panels(result: Result, count: int) -> tuple[Figure, Sequence[Axes], Sequence[Axes]]:
    """A figure of `count` images in a row with the run in its title, and the places of their colour bars."""
    figure, images, bars = image_panels((result.scene.camera.height, result.scene.camera.width), count)
    _caption(result, figure)
    return figure, images, bars


def image_panels(
    shape: tuple[int, int], columns: int, *, lines: int = 1, below: float = 0.0
) -> tuple[Figure, Sequence[Axes], Sequence[Axes]]:
    """A figure of images of `shape` (height, width), line after line, and the places of their colour bars.

    `below`: height of one more axis over the whole width, the last of `figure.axes` [inch].
    """
    width = 3.4
    height = float(np.clip(width * shape[0] / shape[1], 0.8, 7.0))
    figure = Figure(figsize=(width * columns, lines * (height + 1.05) + below + 0.3), layout="constrained")
    grid = figure.add_gridspec(
        2 * lines + bool(below), columns, height_ratios=[height, 0.15] * lines + [below] * bool(below)
    )
    places = [(2 * line, column) for line in range(lines) for column in range(columns)]
    images = [figure.add_subplot(grid[place]) for place in places]
    bars = [figure.add_subplot(grid[line + 1, column]) for line, column in places]
    if below:
        figure.add_subplot(grid[-1, :])
    return figure, images, bars


def show_image(
    axis: Axes,
    bar: Axes,
    image: NDArray[Any],
    *,
    title: str,
    label: str,
    colours: str,
    low: float,
    high: float,
    scale: Literal["linear", "log"] = "linear",
) -> None:
    """An image with its colour bar below; grey where it is NaN, pointed ends where it goes beyond the bar."""
    _decorate(axis, title)
    height, width = image.shape[:2]
    if max(height, width) > 5 * min(height, width):  # two numbers have room along the short side
        (axis.yaxis if height < width else axis.xaxis).set_major_locator(MaxNLocator(nbins=1, integer=True))
    cmap = matplotlib.colormaps[colours].with_extremes(bad=_MISSING)
    shown = axis.imshow(image, interpolation="nearest", cmap=cmap, norm=scale, clim=(low, high))
    below, above = bool((image < low).any()), bool((image > high).any())
    extend = ("both" if above else "min") if below else ("max" if above else "neither")
    colour_bar = axis.figure.colorbar(shown, cax=bar, orientation="horizontal", label=label, extend=extend)
    if scale == "log":
        ticks = _log_ticks(low, high)
        colour_bar.set_ticks(list(ticks), labels=list(ticks.values()))
        colour_bar.minorticks_off()
    else:
        longer = high >= 1e4 or 0 < high - low < 1e-3 * abs(high)
        colour_bar.locator = MaxNLocator(nbins=4 if longer else 6)  # what is long needs room
        colour_bar.formatter = ScalarFormatter(useOffset=False)


def _log_ticks(low: float, high: float) -> dict[float, str]:
    """A few values between `low` and `high` with their texts: powers of ten, 2 and 5 times these if they are few."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    digits = (1,) if len(powers) > 4 else (1, 2, 5)
    ticks: dict[float, str] = {}
    for power, digit in ((power, digit) for power in powers for digit in digits):
        value = digit * 10.0**power
        if low <= value <= high:
            exponential = ("" if digit == 1 else rf"{digit} \cdot ") + f"10^{{{power}}}"
            ticks[value] = f"{value:g}" if -3 < power < 4 else f"${exponential}$"
    step = 1 + (len(ticks) - 1) // 7
    return dict(list(ticks.items())[::step])


def _decorate(axis: Axes, title: str) -> None:
    axis.set_title(title, fontsize=10)
    axis.set(xlabel="column [pixel]", ylabel="row [pixel]")
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_locator(MaxNLocator(nbins=5, integer=True))


def _caption(result: Result, figure: Figure) -> None:
    medium = result.scene.medium
    albedo = "U(0, 0.97)" if medium.albedo == "lu2024" else f"{medium.albedo:.3g}"
    water = f"water c = {medium.extinction:.3g} 1/m, albedo {albedo}, {_phase_text(medium)}"
    if medium.layers:
        extinctions = ", ".join(f"{one.extinction:.3g}" for one in medium.waters)
        water = f"{len(medium.waters)} layers of water, c = {extinctions} 1/m"
    photons = f"{result.photons:.3g}" if result.photons >= 1e6 else f"{result.photons:,}".replace(",", "\u2009")
    if "e+" in photons:
        mantissa, power = photons.split("e+")
        photons = f"{'' if mantissa == '1' else mantissa + ' × '}$10^{{{int(power)}}}$"
    partial = ", interrupted" if result.partial else ""
    figure.suptitle(
        f"{photons} photons{partial}; {water}; seed {result.seed}",
        fontsize=9,
        color="0.25",
    )


def _phase_text(medium: Medium) -> str:
    if medium.phase_function == "tabulated":
        return f"phase function {Path(str(medium.phase_table)).stem}"
    symbols = {"anisotropy": "g", "alpha": "α", "particle_index": "n", "junge_slope": "µ"}
    return ", ".join(f"{symbols.get(name, name)} = {value:.4g}" for name, value in medium.phase_parameters.items())


def shown_limits(image: NDArray[Any], *, beyond: float = 0.0) -> tuple[float, float]:
    """Lowest and highest value, at least 1 cm apart, leaving out `beyond` percent at each end."""
    values = image[np.isfinite(image)]
    low, high = np.percentile(values, (beyond, 100.0 - beyond)) if values.size else (0.0, 1.0)
    spare = max(0.0, 0.01 - (high - low)) / 2
    return float(low - spare), float(high + spare)
