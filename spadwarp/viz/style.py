"""How all pictures look: the style file, colours, sizes, images with their colour bars; figures without pyplot, which
need no display."""

from __future__ import annotations

import io
import math
import os
import re
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, MaxNLocator, NullFormatter, ScalarFormatter
from numpy.typing import NDArray

from spadwarp.errors import FileError
from spadwarp.io.paths import atomic_path
from spadwarp.limits import check_real
from spadwarp.result import Channel

STYLE = "spadwarp.viz.paper"
"""Name of the style file for `matplotlib.style.use`."""
COLUMN, PAGE = 3.5, 7.2
"""Widths of figures [inch]: one column of a journal (89 mm), the page (183 mm)."""

MISSING = "0.85"  # light grey: pixels without a value
BACKGROUND = "#eef1f3"  # around targets
TEXT = "0.25"
DASHED: Any = (0, (4, 3))

# Okabe and Ito's colours, which differ with every common colour-blindness and, by their lightness, in print.
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
SERIES = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, "#000000", "#F0E442")
COMPONENTS = {
    "ballistic": ("target, ballistic", BLUE),
    "forward_scattered": ("target, forward-scattered", ORANGE),
    "backscatter": ("water, backscatter", GREEN),
}
"""Label and colour of the components of a result."""
CHANNEL_NAMES: dict[Channel, str] = {"co": "co-polarised", "cross": "cross-polarised"}
"""Words for the channels of an analyser."""

DEPTH_MAP, INTENSITY_MAP = "viridis_r", "cividis"
BOUND_MAP, PROBABILITY_MAP, LIGHT_MAP = "magma_r", "inferno_r", "inferno"
# Orange to violet without the dark ends, from which the colours of what is beyond them differ.
ERROR_MAP = LinearSegmentedColormap.from_list(
    "depth error", matplotlib.colormaps["PuOr"](np.linspace(0.12, 0.88, 65))
).with_extremes(under=SKY, over="black", bad=MISSING)
"""Signed errors: light blue below the limits, black above them."""


@contextmanager
def paper() -> Iterator[None]:
    """Sets the style file on top of matplotlib's defaults, not of the user's settings; a decorator too."""
    with matplotlib.style.context(["default", STYLE]):
        yield


def colour_map(name: str | Colormap, *, missing: str = MISSING) -> Colormap:
    """A colour map that shows NaN in the colour `missing`."""
    return matplotlib.colormaps.get_cmap(name).with_extremes(bad=missing)


class PaperFigure(Figure):
    """A figure that is drawn in the style wherever it is drawn, and that notebooks show although pyplot does not
    know it: ticks are made at the first drawing."""

    @paper()
    def draw(self, renderer: Any) -> None:
        super().draw(renderer)

    @paper()
    def savefig(self, fname: Any, **options: Any) -> None:
        super().savefig(fname, **options)

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=120)
        return buffer.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """An empty figure [inch]. Raises `ArgumentError` where the width cannot hold text or is no width."""
    width = check_real("width", width, "[2.5, 50]")
    return PaperFigure(figsize=(width, height), layout="constrained")


def columns_that_fit(count: int, width: float, least: float) -> int:
    """How many of `count` panels stand side by side when each needs this width [inch]."""
    return max(1, min(count, int(width / least + 1e-6)))


def panel_grid(
    count: int, width: float, *, least: float, height: float, more: float, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of `count` axes over light grids, as many in a line as fit, in lines of equal length.

    `least`: width of an axis, `height`: of a line, `more`: of titles and legends [inch]; `shared`: for `subplots`.
    """
    lines = math.ceil(count / columns_that_fit(count, width, least))
    figure = new_figure(width, height * lines + more)
    axes = list(figure.subplots(lines, math.ceil(count / lines), squeeze=False, **shared).ravel())
    for axis in axes[count:]:
        axis.remove()
    for axis in axes[:count]:
        plain_axis(axis)
    return figure, axes[:count]


def middle_text(axis: Axes, text: str, **style: Any) -> None:
    """Text in place of curves or of an image."""
    axis.text(0.5, 0.5, text, ha="center", va="center", transform=axis.transAxes, **style)


def wrapped(text: str, width: float, *, size: float = 8.0) -> str:
    """The text in lines of this width [inch] at a size [pt]."""
    return "\n".join(
        textwrap.fill(line, max(8, int(width * 72 / (0.53 * size))), break_long_words=False)
        for line in text.split("\n")
    )


def wrapped_items(text: str, width: float) -> str:
    """The same for items between commas and semicolons, which stay whole."""
    items = re.split("(?<=[,;]) ", text)
    return wrapped(" ".join(item.replace(" ", "\N{NO-BREAK SPACE}") for item in items), width)


def plain_axis(axis: Axes, *, grid: Literal["major", "both"] = "major") -> None:
    """A light grid behind the curves; no frame at the top and on the right."""
    axis.grid(which=grid)
    axis.spines[["top", "right"]].set_visible(False)


def log_axis(axis: Axes, side: Literal["x", "y"], *, most: int = 7) -> None:
    """A logarithmic axis with at most so many numbers, and a short tick for each digit or each power of ten.

    To be called when the limits are final; below two decades the digits 2 and 5 have numbers too.
    """
    getattr(axis, f"set_{side}scale")("log")
    line = getattr(axis, f"{side}axis")
    low, high = sorted(getattr(axis, f"get_{side}lim")())
    decades = math.log10(high / low)
    every = (
        [1.0] if decades > 2 else [1.0, 2.0, 5.0] if decades > 0.7 else [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]
    )
    line.set_major_locator(LogLocator(subs=every, numticks=most + 1 if decades > 2 else 20))
    stride = decades > most
    line.set_minor_locator(LogLocator(subs=[1.0] if stride else [float(digit) for digit in range(2, 10)], numticks=400))
    line.set_minor_formatter(NullFormatter())
    if low >= 1e-3 and high <= 2e4:
        line.set_major_formatter(lambda value, _: f"{value:g}")
    else:
        line.set_major_formatter(LogFormatterSciNotation(minor_thresholds=(math.inf, math.inf)))


def save(figure: Figure, path: str | os.PathLike[str], *, note: str = "") -> Path:
    """Writes a figure in the format of the file's ending, with a note below it; returns the path.

    Raises `FileError`.
    """
    if note:
        note = wrapped(note, figure.get_figwidth() - 0.3, size=7)
        figure.set_figheight(figure.get_figheight() + 0.13 * (note.count("\n") + 1))
        figure.supxlabel(note, fontsize=7, color="0.35")
    kind = Path(path).suffix.lstrip(".").lower() or "png"
    if kind not in (known := figure.canvas.get_supported_filetypes()):
        raise FileError(
            f"{path}: ending {Path(path).suffix!r} is not one of {', '.join(f'.{ending}' for ending in known)}"
        )
    # Without the date, so that the same figure makes the same file.
    metadata = {"CreationDate": None} if kind == "pdf" else None
    with atomic_path(Path(path)) as temporary, _without_a_date():
        figure.savefig(temporary, format=kind, metadata=metadata)  # type: ignore[arg-type]
    return Path(path)


@contextmanager
def _without_a_date() -> Iterator[None]:
    """Hides SOURCE_DATE_EPOCH from matplotlib, which fails where it is no number; our figures have no date."""
    date = os.environ.pop("SOURCE_DATE_EPOCH", None)
    try:
        yield
    finally:
        if date is not None:
            os.environ["SOURCE_DATE_EPOCH"] = date


def spaced(number: int) -> str:
    """A whole number with a thin space between thousands."""
    return f"{number:,}".replace(",", "\u2009")


_LEAST = 1.7  # width of a panel with its numbers [inch]
_LARGEST = 3.4


class Panels:
    """A figure of `count` images of `shape` (height, width), as many in a line as fit, each with its colour bar below.

    `width`: of the figure [inch]. `below`: height of one more axis over the whole width, `self.below` [inch].
    """

    def __init__(self, shape: tuple[int, ...], count: int, *, width: float = PAGE, below: float = 0.0) -> None:
        columns = columns_that_fit(count, width, _LEAST)
        columns = math.ceil(count / math.ceil(count / columns))  # lines of equal length
        lines = math.ceil(count / columns)
        self._cell = min(width / columns, _LARGEST)
        self._line = self._cell - 0.4  # of a label: its middle is that of the bar, which numbers and margins narrow
        height = float(np.clip((self._cell - 0.35) * shape[0] / shape[1], 0.5, 5.0))
        # Titles, numbers and labels; more below for its labels and a legend.
        self.figure = new_figure(width, lines * (height + 1.1) + (below + 0.7) * bool(below))
        self.figure.get_layout_engine().set(wspace=0.05, h_pad=0.05)  # type: ignore[call-arg,union-attr]
        ratios = [height, 0.1] * lines + [below] * bool(below)
        grid = self.figure.add_gridspec(len(ratios), columns, height_ratios=ratios)
        self._free = iter([(k, c, grid[2 * k, c], grid[2 * k + 1, c]) for k in range(lines) for c in range(columns)])
        self._last = grid[-1, :]

    def below(self) -> Axes:
        """The axis below the images."""
        return self.figure.add_subplot(self._last)

    def caption(self, text: str) -> None:
        """Writes what the figure shows above it."""
        text = wrapped_items(text, self.figure.get_figwidth() - 0.3)
        self.figure.set_figheight(self.figure.get_figheight() + 0.25 + 0.14 * text.count("\n"))
        self.figure.suptitle(text, color=TEXT)

    def place(self, title: str) -> tuple[Axes, Axes]:
        """The axis of the next image, and that of its colour bar."""
        _, column, *cells = next(self._free)
        axis, bar = map(self.figure.add_subplot, cells)
        axis.set_title(wrapped(title, self._cell - 0.2))
        axis.set(xlabel="column [pixel]", ylabel="" if column else "row [pixel]")
        for side in (axis.xaxis, axis.yaxis):
            side.set_major_locator(MaxNLocator(nbins=5, integer=True))
        return axis, bar

    def show(
        self,
        image: NDArray[Any],
        title: str,
        label: str,
        colours: str | Colormap,
        limits: tuple[float, float],
        scale: Literal["linear", "log"] = "linear",
    ) -> Axes:
        """The next image; returns its axis. Grey: NaN. Pointed ends of the colour bar: values beyond the limits."""
        axis, bar = self.place(title)
        (height, width), (low, high) = image.shape[:2], limits
        if max(height, width) > 5 * min(height, width):  # there is space for two numbers along the short side
            (axis.yaxis if height < width else axis.xaxis).set_major_locator(MaxNLocator(nbins=1, integer=True))
        shown = axis.imshow(image, cmap=colour_map(colours), norm=scale, clim=limits)
        extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[
            int((image < low).any()), int((image > high).any())
        ]
        label = wrapped(label, self._line)
        colour_bar = self.figure.colorbar(shown, cax=bar, orientation="horizontal", label=label, extend=extend)
        if scale == "log":
            ticks, digits = _log_ticks(low, high, (self._cell - 0.3) / 0.4)
            colour_bar.set_ticks(list(ticks), labels=list(ticks.values()))
            colour_bar.set_ticks(digits, minor=True, labels=[])
        else:
            colour_bar.locator = MaxNLocator(nbins=_numbers(low, high, self._cell - 0.4))
            colour_bar.formatter = ScalarFormatter(useOffset=False)
            bar.xaxis.minorticks_on()
        return axis

    def show_depth(
        self, image: NDArray[Any], title: str, limits: tuple[float, float], label: str = "depth z [m]"
    ) -> Axes:
        """Depth [m]."""
        return self.show(image, title, label, DEPTH_MAP, limits)

    def show_error(self, error: NDArray[Any], title: str) -> None:
        """Signed depth errors [m]; see `error_limit`. How many pixels are beyond the colours is written below."""
        reach = error_limit(error)
        factor, unit = (1e3, "mm") if reach < 0.1 else (1e2, "cm") if reach < 1.0 else (1.0, "m")
        known = max(1, int(np.isfinite(error).sum()))
        below, above = (100 * np.count_nonzero(side) / known for side in (error < -reach, error > reach))
        label = f"depth error [{unit}]"
        if below or above:
            label += "\n" + wrapped_items(f"{percent(below)} below, {percent(above)} above", self._line)
        self.show(factor * error, title, label, ERROR_MAP, (-factor * reach, factor * reach))

    def show_intensity(self, image: NDArray[Any], title: str, label: str) -> None:
        """From 0 to the 99.5th percentile, which single bright pixels exceed."""
        values = image.astype(np.float64)
        top = float(np.percentile(values, 99.5)) or float(values.max()) or 1.0
        factor, text = _power(top)
        self.show(values / factor, title, label + text, INTENSITY_MAP, (0.0, top / factor))

    def show_positive(self, values: NDArray[Any], title: str, label: str, colours: str = BOUND_MAP) -> None:
        """Positive values between their 5th and 95th percentile; on a logarithmic scale if these are far apart."""
        shown = np.where(np.isfinite(values) & (values > 0), values, np.nan)
        known = shown[np.isfinite(shown)]
        low, high = map(float, np.percentile(known, (5.0, 95.0))) if known.size else (0.1, 1.0)
        if high > 4.0 * low:
            self.show(shown, title, label, colours, (low, high), "log")
            return
        factor, text = _power(high)
        margin = 0.05 * high  # a single value has no interval
        self.show(shown / factor, title, label + text, colours, ((low - margin) / factor, (high + margin) / factor))


def error_limit(error: NDArray[Any]) -> float:
    """Largest error in colours [m]: twice the 68th percentile of the absolute errors, at most the 95th.

    Large errors of some pixels, at steps and where nothing returned, do not hide the millimetres of the others.
    """
    known = np.abs(error[np.isfinite(error)])
    if not known.size:
        return 1.0
    body, tail = np.percentile(known, (68.0, 95.0))
    reach = max(min(2.0 * body, tail), 1e-4)
    digit = 10.0 ** math.floor(math.log10(reach))
    return float(math.ceil(reach / digit * 2 - 1e-9) / 2 * digit)  # of two digits: 3.5 mm


def shown_limits(
    image: NDArray[Any], *, beyond: float = 0.0, margin: float = 0.0, weights: NDArray[Any] | None = None
) -> tuple[float, float]:
    """Lowest and highest value, at least 1 cm apart, without `beyond` percent at each end; the margin is relative.

    With `weights`, such as counts, percent of their sum: depths of pixels with hardly any counts are spread over the
    gate, and those of the target would have one colour.
    """
    known = np.isfinite(image)
    if weights is not None and weights[known].sum() > 0:
        known &= weights > 0
        each = weights[known].astype(np.float64)
        ends = np.quantile(image[known], (beyond / 100, 1.0 - beyond / 100), weights=each, method="inverted_cdf")
    else:
        ends = np.percentile(image[known], (beyond, 100.0 - beyond)) if known.any() else np.array([0.0, 1.0])
    low, high = ends
    spare = max(0.0, 0.01 - (high - low)) / 2
    spare += margin * (high - low + 2 * spare)
    return float(low - spare), float(high + spare)


def target_limits(truth: NDArray[Any], measured: NDArray[Any]) -> tuple[float, float]:
    """Limits that show the true depth and the errors about it, or the measured depth where no target is in view."""
    least, most = shown_limits(measured, beyond=1.0, margin=0.05)
    if not np.isfinite(truth).any():
        return least, most
    low, high = shown_limits(truth, margin=0.05)
    error = measured - truth
    spare = error_limit(error) if np.isfinite(error).any() else 0.0
    # Errors may all have one sign, and single ones may be as large as the gate.
    return max(low - spare, min(low, least)), min(high + spare, max(high, most))


def median_pixel(values: NDArray[Any], among: NDArray[np.bool_]) -> tuple[int, int]:
    """Row and column of the median value among these pixels, or among all where there are none."""
    choice = np.flatnonzero(among | ~among.any())
    order = choice[np.argsort(values.ravel()[choice], kind="stable")]
    row, column = divmod(int(order[(len(order) - 1) // 2]), values.shape[1])
    return row, column


def arrival_line(axis: Axes, arrival: float, edges: NDArray[np.float64]) -> None:
    """A line at the time at which the target's light arrives, where it is within the edges; all in [ns]."""
    if edges[0] <= arrival < edges[-1]:
        axis.axvline(arrival, color="0.2", linewidth=0.8, linestyle=DASHED, label="true arrival")


def strips(
    count: int, *, width: float, least: float, ratio: float, title: float, bars: int = 1
) -> tuple[Figure, list[Axes], list[Axes]]:
    """A figure of `count` axes without frames, as many in a line as fit, and of `bars` axes for colour bars below them.

    `least`: width of an axis, `title`: height of its title [inch]; `ratio`: its height over its width.
    """
    columns = columns_that_fit(count, width, least)
    lines = math.ceil(count / columns)
    height = (width / columns - 0.08) * ratio + title
    spare = 0.55 if bars == 1 else 0.65
    figure = new_figure(width, lines * height + spare)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, hspace=0.0, wspace=0.0)  # type: ignore[call-arg,union-attr]
    images, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(lines * height, spare)).ravel()
    axes = list(np.ravel(images.subplots(lines, columns, squeeze=False)))
    for axis in axes:
        axis.axis("off")
    grid = below.add_gridspec(2, 3 * bars, height_ratios=(0.1, 0.4), width_ratios=(1, 8, 1) * bars)
    return figure, axes, [below.add_subplot(grid[0, 3 * k + 1]) for k in range(bars)]


def coloured_depth(depth: NDArray[Any], scale: Normalize) -> NDArray[np.float64]:
    """RGB `[H, W, 3]` of a depth image; the background's colour where it is NaN."""
    return colour_map(DEPTH_MAP, missing=BACKGROUND)(scale(np.ma.masked_invalid(depth)))[..., :3]


def strip_bar(bar: Axes, scale: Normalize, colours: str, label: str, *, bars: int = 1) -> None:
    """The colour bar of strips, or one of `bars`."""
    figure = bar.get_figure(root=True)
    assert figure is not None
    label = wrapped(label, figure.get_figwidth() / bars - 0.2)
    shown = figure.colorbar(ScalarMappable(scale, colours), cax=bar, orientation="horizontal", label=label)
    shown.outline.set_visible(False)  # type: ignore[operator]
    bar.xaxis.minorticks_on()


def mark_pixels(axis: Axes, missed: NDArray[np.bool_], invented: NDArray[np.bool_]) -> None:
    """Colours pixels in which a target was missed black, in which one was invented red."""
    marks = np.zeros((*missed.shape, 4))
    marks[missed], marks[invented] = to_rgba("black"), to_rgba(RED)
    axis.imshow(marks)


def percent(value: float) -> str:
    """A part in percent, with two digits."""
    return f"{value:.2g} %" if value < 99.5 else "100 %"


def _numbers(low: float, high: float, width: float) -> int:
    """How many numbers of a scale fit into this width [inch]."""
    step = (high - low) / 4
    decimals = max(0, -math.floor(math.log10(step))) if step > 0 else 2
    digits = len(f"{max(abs(low), abs(high)):.{decimals}f}") + (low < 0)
    return int(np.clip(width / (0.065 * digits + 0.12), 2, 6))


def _power(top: float) -> tuple[float, str]:
    """A power of ten for values up to `top`, and its text for a label; 1 for numbers that are short by themselves."""
    exponent = int(np.floor(np.log10(top)))
    return (1.0, "") if -2 <= exponent <= 3 else (10.0**exponent, f" [{_power_text(exponent)}]")


def _log_ticks(low: float, high: float, most: float) -> tuple[dict[float, str], list[float]]:
    """Values between `low` and `high` with their texts, of which `most` would fill the scale; all digits of all powers.

    Powers of ten come first, then the other digits where there is space.
    """
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    every = [(digit, power) for power in powers for digit in range(1, 10) if low <= digit * 10.0**power <= high]
    gap = math.log10(high / low) / most
    ticks: dict[float, str] = {}
    for digit, power in sorted(every, key=lambda one: ((1, 3, 2, 5, 7, 4, 6, 8, 9).index(one[0]), one[1])):
        value = digit * 10.0**power
        if all(abs(math.log10(value / other)) >= gap for other in ticks):
            exponential = ("" if digit == 1 else f"{digit}·") + _power_text(power)
            ticks[value] = f"{value:g}" if -3 < power < 4 else exponential
    return ticks, [digit * 10.0**power for digit, power in every]


def _power_text(exponent: int) -> str:
    """A power of ten, such as 10⁻³."""
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
