"""Images with their colour bars, side by side, and strips of images under one colour bar."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from numpy.typing import NDArray

from spadwarp.result import Result
from spadwarp.viz.style import (
    BACKGROUND,
    BOUND_MAP,
    DASHED,
    DEPTH_MAP,
    ERROR_MAP,
    INTENSITY_MAP,
    TEXT,
    colour_map,
    new_figure,
)

__all__ = ["Panels", "arrival_line", "coloured_depth", "depth_bar", "median_pixel", "shown_limits", "strips"]
__all__ += ["target_limits"]

_WIDTH = 3.4  # of a panel [inch]


class Panels:
    """A figure of images of `shape` (height, width), line after line, each with its colour bar below.

    `below`: height of one more axis over the whole width, `self.below` [inch].
    """

    def __init__(self, shape: tuple[int, ...], columns: int, *, lines: int = 1, below: float = 0.0) -> None:
        height = float(np.clip(_WIDTH * shape[0] / shape[1], 0.8, 7.0))
        self.figure = new_figure(_WIDTH * columns, lines * (height + 1.05) + below + 0.3)
        ratios = [height, 0.15] * lines + [below] * bool(below)
        grid = self.figure.add_gridspec(len(ratios), columns, height_ratios=ratios)
        self._free = iter([(grid[2 * k, c], grid[2 * k + 1, c]) for k in range(lines) for c in range(columns)])
        self._last = grid[-1, :]

    def below(self) -> Axes:
        """The axis below the images."""
        return self.figure.add_subplot(self._last)

    def caption(self, text: str) -> None:
        """Writes what the figure shows above it."""
        self.figure.suptitle(text, fontsize=9, color=TEXT)

    def place(self, title: str) -> tuple[Axes, Axes]:
        """The axis of the next image, and that of its colour bar."""
        axis, bar = map(self.figure.add_subplot, next(self._free))
        axis.set_title(title, fontsize=10)
        axis.set(xlabel="column [pixel]", ylabel="row [pixel]")
        for side in (axis.xaxis, axis.yaxis):
            side.set_major_locator(MaxNLocator(nbins=5, integer=True))
        return axis, bar

    def show(
        self,
        image: NDArray[Any],
        title: str,
        label: str,
        colours: str,
        limits: tuple[float, float],
        scale: str = "linear",
    ) -> None:
        """The next image: grey where it is NaN; its colour bar has pointed ends where values exceed the limits."""
        axis, bar = self.place(title)
        (height, width), (low, high) = image.shape[:2], limits
        if max(height, width) > 5 * min(height, width):  # there is space for two numbers along the short side
            (axis.yaxis if height < width else axis.xaxis).set_major_locator(MaxNLocator(nbins=1, integer=True))
        shown = axis.imshow(image, interpolation="nearest", cmap=colour_map(colours), norm=scale, clim=limits)
        extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[
            int((image < low).any()), int((image > high).any())
        ]
        colour_bar = self.figure.colorbar(shown, cax=bar, orientation="horizontal", label=label, extend=extend)
        if scale == "log":
            ticks = _log_ticks(low, high)
            colour_bar.set_ticks(list(ticks), labels=list(ticks.values()))
            colour_bar.minorticks_off()
        else:
            long_labels = high >= 1e4 or 0 < high - low < 1e-3 * abs(high)
            colour_bar.locator = MaxNLocator(nbins=4 if long_labels else 6)
            colour_bar.formatter = ScalarFormatter(useOffset=False)

    def show_depth(
        self, image: NDArray[Any], title: str, limits: tuple[float, float], label: str = "depth z [m]"
    ) -> None:
        """Depth [m]."""
        self.show(image, title, label, DEPTH_MAP, limits)

    def show_error(self, error: NDArray[Any], title: str, label: str, *, percentile: float) -> None:
        """Signed errors; the colours reach to this percentile of their absolute values."""
        known = np.abs(error[np.isfinite(error)])
        reach = max(float(np.percentile(known, percentile)), 0.1) if known.size else 1.0
        self.show(error, title, label, ERROR_MAP, (-reach, reach))

    def show_intensity(self, image: NDArray[Any], title: str, label: str) -> None:
        """From 0 to the 99.5th percentile, which single bright pixels exceed."""
        values = image.astype(np.float64)
        top = float(np.percentile(values, 99.5)) or float(values.max()) or 1.0
        unit, text = _unit(top)
        self.show(values / unit, title, label + text, INTENSITY_MAP, (0.0, top / unit))

    def show_positive(self, values: NDArray[Any], title: str, label: str, colours: str = BOUND_MAP) -> None:
        """Positive values between their 1st and 99th percentile; on a logarithmic scale if these are far apart."""
        shown = np.where(np.isfinite(values) & (values > 0), values, np.nan)
        known = shown[np.isfinite(shown)]
        low, high = map(float, np.percentile(known, (1.0, 99.0))) if known.size else (0.1, 1.0)
        if high > 4.0 * low:
            self.show(shown, title, label, colours, (low, high), "log")
            return
        unit, text = _unit(high)
        margin = 0.05 * high  # a single value has no interval
        self.show(shown / unit, title, label + text, colours, ((low - margin) / unit, (high + margin) / unit))


def shown_limits(image: NDArray[Any], *, beyond: float = 0.0, margin: float = 0.0) -> tuple[float, float]:
    """Lowest and highest value, at least 1 cm apart, without `beyond` percent at each end; the margin is relative."""
    values = image[np.isfinite(image)]
    low, high = np.percentile(values, (beyond, 100.0 - beyond)) if values.size else (0.0, 1.0)
    spare = max(0.0, 0.01 - (high - low)) / 2
    spare += margin * (high - low + 2 * spare)
    return float(low - spare), float(high + spare)


def target_limits(truth: NDArray[Any], measured: NDArray[Any]) -> tuple[float, float]:
    """Limits that show the true depth with a margin, or the measured depth where no target is in view."""
    if np.isfinite(truth).any():
        return shown_limits(truth, margin=0.05)
    return shown_limits(measured, beyond=1.0, margin=0.05)


def median_pixel(values: NDArray[Any], among: NDArray[np.bool_]) -> tuple[int, int]:
    """Row and column of the median value among these pixels, or among all where there are none."""
    choice = np.flatnonzero(among | ~among.any())
    order = choice[np.argsort(values.ravel()[choice], kind="stable")]
    row, column = divmod(int(order[(len(order) - 1) // 2]), values.shape[1])
    return row, column


def arrival_line(axis: Axes, result: Result, row: int, column: int, edges: NDArray[np.float64]) -> None:
    """A line where the target's light arrives, within the edges [ns]."""
    arrival = 1e9 * result.true_path()[row, column] / result.pulse_speed
    if edges[0] <= arrival < edges[-1]:
        axis.axvline(arrival, color="0.2", linewidth=0.9, linestyle=DASHED, label="true arrival")


def strips(
    count: int, *, columns: int, size: tuple[float, float], spare: float, pads: tuple[float, float]
) -> tuple[Figure, Sequence[Axes]]:
    """A figure of `count` axes without frames, each of this size, `spare` for the colour bar [inch]."""
    columns = min(columns, count)
    lines = math.ceil(count / columns)
    figure = new_figure(size[0] * columns, size[1] * lines + spare)
    figure.get_layout_engine().set(w_pad=pads[0], h_pad=pads[1])  # type: ignore[call-arg,union-attr]
    axes = list(np.ravel(figure.subplots(lines, columns, squeeze=False)))
    for axis in axes:
        axis.axis("off")
    return figure, axes


def coloured_depth(depth: NDArray[Any], scale: Normalize) -> NDArray[np.float64]:
    """RGB `[H, W, 3]` of a depth image; the background's colour where it is NaN."""
    return colour_map(DEPTH_MAP, missing=BACKGROUND)(scale(np.ma.masked_invalid(depth)))[..., :3]


def depth_bar(figure: Figure, axes: Sequence[Axes], scale: Normalize, label: str, *, fontsize: float) -> None:
    """One colour bar of depth below all axes."""
    bar = figure.colorbar(
        ScalarMappable(scale, DEPTH_MAP), ax=list(axes), orientation="horizontal", fraction=0.012, aspect=70, pad=0.01
    )
    bar.set_label(label, fontsize=fontsize)
    bar.ax.tick_params(labelsize=fontsize - 1)
    bar.outline.set_visible(False)  # type: ignore[operator]


def _unit(top: float) -> tuple[float, str]:
    """A power of ten for values up to `top`, and its text for a label; 1 for numbers that are short by themselves."""
    exponent = int(np.floor(np.log10(top)))
    return (1.0, "") if -2 <= exponent <= 3 else (10.0**exponent, f" [$10^{{{exponent}}}$]")


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
