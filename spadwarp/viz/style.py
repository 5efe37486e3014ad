"""How all pictures look: the style file, colours, sizes, images with their colour bars; figures without pyplot, which
need no display."""

from __future__ import annotations

import io
import math
import os
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

try:
    import matplotlib
except ValueError as error:
    raise ImportError(f"MPLBACKEND = {os.environ.get('MPLBACKEND')}: {error}") from None
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullFormatter, ScalarFormatter
from numpy.typing import ArrayLike, NDArray

from spadwarp.io.paths import atomic_path
from spadwarp.result import Channel
from spadwarp.values import FileError, check_real, percent

STYLE = "spadwarp.viz.paper"
"""Name of the style file for `matplotlib.style.use`."""
COLUMN, PAGE = 3.5, 7.2
"""Widths of figures [inch]: one column of a journal (89 mm), the page (183 mm)."""

MOST_HATCHED = 0.9  # part of the pixels from which on hatching would hide the image: words alone say what they are
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
    "surface": ("surface of the sea", PURPLE),
}
"""Label and colour of the components of a result."""
CHANNEL_NAMES: dict[Channel, str] = {"co": "co-polarised", "cross": "cross-polarised", "raman": "Raman-scattered"}
CHANNEL_NAMES |= {"fluorescence": "fluorescent"}
"""Words for light of a channel."""

LABELS = {"depth": "depth z [m]", "range": "range along the line of sight [m]"}
DEPTH_MAP, INTENSITY_MAP = "viridis_r", "cividis"
BOUND_MAP, PROBABILITY_MAP, LIGHT_MAP = "magma_r", "inferno_r", "inferno"
# Orange to violet without the dark ends, which are the colours of what is beyond them.
ERROR_MAP = LinearSegmentedColormap.from_list(
    "depth error", matplotlib.colormaps["PuOr"](np.linspace(0.16, 0.84, 65))
).with_extremes(under="#4a1d00", over="#14002b", bad=MISSING)
"""Signed errors: dark brown below the limits, dark violet above them."""


@contextmanager
def paper() -> Iterator[None]:
    """Sets the style file on top of matplotlib's defaults, not of the user's settings; a decorator too."""
    with matplotlib.style.context(["default", STYLE]):
        yield


def colour_map(name: str | Colormap, *, missing: str = MISSING) -> Colormap:
    """A colour map that shows NaN in the colour `missing`."""
    return matplotlib.colormaps.get_cmap(name).with_extremes(bad=missing)


# Figures


class PaperFigure(Figure):
    """A figure that is drawn in the style wherever it is drawn (ticks are made at the first drawing), that grows by
    what is written around it, and that notebooks show although pyplot does not know it."""

    @paper()
    def draw(self, renderer: Any) -> None:
        super().draw(renderer)

    @paper()
    def savefig(self, fname: Any, **options: Any) -> None:
        # Matplotlib would draw the whole figure once more, to nowhere, only to lay it out.
        engine, dpi = self.get_layout_engine(), self.dpi
        if engine is not None:
            self.dpi = options.get("dpi", matplotlib.rcParams["savefig.dpi"])
            engine.execute(self)
            with matplotlib.rc_context({"figure.constrained_layout.use": False}):
                self.set_layout_engine(None)
        try:
            super().savefig(fname, **options)
        finally:
            self.dpi = dpi
            self.set_layout_engine(engine)

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=120)
        return buffer.getvalue()

    def grow(self, height: float) -> None:
        """Makes it higher [inch]."""
        self.set_figheight(self.get_figheight() + height)

    def caption(self, text: str) -> None:
        """Writes above it what it shows; items between commas and semicolons stay whole."""
        text = wrapped_items(text, self.get_figwidth() - 0.3)
        self.grow(0.35 + 0.14 * text.count("\n"))
        self.suptitle(text, color=TEXT)

    def note(self, text: str) -> None:
        """Writes something small below it."""
        text = wrapped(text, self.get_figwidth() - 0.3, size=7)
        self.grow(0.13 * (text.count("\n") + 1))
        self.supxlabel(text, fontsize=7, color="0.35")

    def key(
        self, axes: Iterable[Axes], width: float, *, place: Literal["lower", "upper"] = "lower", title: str = ""
    ) -> None:
        """Writes the legend of the curves of all axes below or above it, in columns of this width [inch]."""
        entries: dict[str, Any] = {}
        for axis in axes:
            entries |= dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
        lines, columns = arranged(len(entries), self.get_figwidth(), width)
        self.grow(0.1 + 0.14 * (lines + (title.count("\n") + 1) * bool(title)))
        loc: Any = f"outside {place} center"
        self.legend(entries.values(), entries.keys(), loc=loc, ncols=columns, title=title or None)


def new_figure(width: float, height: float) -> PaperFigure:
    """An empty figure [inch]. Raises `ArgumentError` where the width cannot hold text or is no width."""
    return PaperFigure(figsize=(check_real("width", width, "[2.5, 50] inch"), height), layout="constrained")


def arranged(count: int, width: float, least: float) -> tuple[int, int]:
    """Lines of equal length and columns of `count` panels, each of which needs this width [inch]."""
    lines = math.ceil(max(count, 1) / max(1, int(width / least + 1e-6)))
    return lines, math.ceil(max(count, 1) / lines)


def panel_grid(
    count: int, width: float, *, least: float, height: float, ratio: float = 0.0, more: float = 0.0, **shared: Any
) -> tuple[PaperFigure, list[Axes]]:
    """A figure of `count` axes over light grids, as many in a line as fit.

    `least`: width of an axis, `height`: of a line, which has `ratio` of the axis' width besides, `more`: of what is
    around them [inch]; `shared`: for `subplots`.
    """
    lines, columns = arranged(count, width, least)
    figure = new_figure(width, lines * (height + ratio * width / columns) + more)
    axes = list(figure.subplots(lines, columns, squeeze=False, **shared).ravel())
    for axis in axes[count:]:
        axis.remove()
    for axis in axes[:count]:
        plain_axis(axis)
    return figure, axes[:count]


def save(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Writes a figure in the format of the file's ending; returns the path. Raises `FileError`."""
    kind = Path(path).suffix.lstrip(".").lower() or "png"
    if kind not in (known := figure.canvas.get_supported_filetypes()):
        raise FileError(
            f"{path}: ending {Path(path).suffix!r} is not one of {', '.join(f'.{ending}' for ending in known)}"
        )
    # Without the date, so that the same figure makes the same file, and since matplotlib fails where it is no number.
    date = os.environ.pop("SOURCE_DATE_EPOCH", None)
    try:
        with atomic_path(Path(path)) as temporary:
            figure.savefig(temporary, format=kind, metadata={"CreationDate": None} if kind == "pdf" else None)
    finally:
        if date is not None:
            os.environ["SOURCE_DATE_EPOCH"] = date
    return Path(path)


# Text and axes


def wrapped(text: str, width: float, *, size: float = 8.0) -> str:
    """The text in lines of at most this width [inch] at a size [pt], about as long as each other."""

    def filled(line: str, letters: int) -> str:
        return textwrap.fill(line, letters, break_long_words=False)

    def evenly(line: str) -> str:
        letters = max(8, int(width * 72 / (0.53 * size)))
        breaks = filled(line, letters).count("\n")
        while breaks and letters > 8 and filled(line, letters - 1).count("\n") == breaks:
            letters -= 1
        return filled(line, letters)

    return "\n".join(map(evenly, text.split("\n")))


def wrapped_items(text: str, width: float) -> str:
    """The same for items between commas and semicolons, which stay whole."""
    items = re.split("(?<=[,;]) ", text)
    return wrapped(" ".join(item.replace(" ", "\N{NO-BREAK SPACE}") for item in items), width).replace(";\n", "\n")


def power_text(value: float) -> str:
    """A number by its power of ten, such as 3·10⁻⁴."""
    digits, power = f"{value:.2e}".split("e")
    exponent = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{float(digits):g}·10{exponent}".removeprefix("1·")


def power_unit(largest: float) -> tuple[float, str]:
    """A power of ten in units of which values up to the largest are short, and what it adds to their label."""
    exponent = math.floor(math.log10(largest))
    factor = 1.0 if -2 <= exponent <= 3 else 10.0**exponent
    return factor, "" if factor == 1.0 else f" [{power_text(factor)}]"


def middle_text(axis: Axes, text: str, **style: Any) -> None:
    """Text in place of curves or of an image."""
    axis.text(0.5, 0.5, text, ha="center", va="center", transform=axis.transAxes, **style)


def plain_axis(axis: Axes) -> None:
    """A light grid behind the curves; no frame at the top and on the right."""
    axis.grid(which="major")
    axis.spines[["top", "right"]].set_visible(False)


_DIGITS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0), (1.0, 2.0, 3.0, 5.0, 7.0), (1.0, 2.0, 5.0), (1.0, 3.0), (1.0,)


def log_axis(axis: Axes, side: Literal["x", "y"], *, most: int = 7) -> None:
    """A logarithmic axis with at most so many numbers, to be called when the limits are final."""
    getattr(axis, f"set_{side}scale")("log")
    log_ticks(getattr(axis, f"{side}axis"), most)


def log_ticks(line: Axis, most: float) -> None:
    """At most so many numbers, and a short tick for each digit or, where there are many, for each power of ten."""
    low, high = sorted(line.get_view_interval())
    exponents = np.arange(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    stride = math.ceil(len(exponents) / max(most, 1.0))

    def ticks(digits: Iterable[float], step: int = 1) -> list[float]:
        values = np.outer(10.0 ** exponents[exponents % step == 0], list(digits)).ravel()
        return values[(values > low * (1 - 1e-9)) & (values < high * (1 + 1e-9))].tolist()

    plain = low >= 1e-3 and high <= 2e4

    def fit(values: Sequence[float]) -> bool:  # also where they are close, such as 5000, 7000 and 10000
        apart = np.diff(np.log10(values)).min(initial=math.inf) / math.log10(high / low)
        return len(values) <= most and apart * most > 0.7

    choices = [ticks(digits) for digits in _DIGITS if plain or digits != (1.0, 3.0)] + [ticks((1.0,), stride)]
    line.set_major_locator(FixedLocator(next(filter(fit, choices), choices[-1])))
    line.set_minor_locator(FixedLocator(ticks((1.0,) if stride > 1 else range(1, 10))))
    line.set_major_formatter(lambda value, _: f"{value:g}" if plain else power_text(value))
    line.set_minor_formatter(NullFormatter())


def arrival_line(axis: Axes, arrival: float, edges: NDArray[np.float64]) -> None:
    """A line at the time at which the target's light arrives, where it is within the edges; all in [ns]."""
    if edges[0] <= arrival < edges[-1]:
        axis.axvline(arrival, color="0.2", linewidth=0.8, linestyle=DASHED, label="true arrival")


# Images


def coloured_depth(depth: NDArray[Any], scale: Normalize) -> NDArray[np.float64]:
    """RGB `[H, W, 3]` of a depth image; the background's colour where it is NaN."""
    return colour_map(DEPTH_MAP, missing=BACKGROUND)(scale(np.ma.masked_invalid(depth)))[..., :3]


# The colour matching functions of CIE 1931: height, wavelength, width below and above it [nm] of the lobes of each
# (Wyman, Sloan & Shirley, JCGT 2(2), 2013, table 1); and XYZ to linear sRGB (IEC 61966-2-1).
_LOBES: tuple[tuple[tuple[float, ...], ...], ...] = (
    ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
    ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
    ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
)
_SRGB_OF_XYZ = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))


def srgb(energy: NDArray[Any], wavelengths: ArrayLike) -> NDArray[np.float64]:
    """The colour of light of some wavelengths [nm], from its energy `[..., wavelength]`, as sRGB in [0, 1] `[..., 3]`.

    The brightest is as bright as the screen shows it; what no screen shows, such as light of one wavelength, is the
    colour beside it without what would be negative. Light that no eye sees is black.
    """
    nm = np.asarray(wavelengths, np.float64)
    xyz = np.zeros((nm.size, 3))
    for k, lobes in enumerate(_LOBES):
        for height, peak, below, above in lobes:
            xyz[:, k] += height * np.exp(-0.5 * ((nm - peak) / np.where(nm < peak, below, above)) ** 2)
    seen = energy * ((nm >= 380.0) & (nm <= 780.0))
    linear = np.maximum(seen @ xyz @ np.transpose(_SRGB_OF_XYZ), 0.0)
    linear = np.minimum(linear / max(float(np.percentile(linear.max(axis=-1), 99.5)), 1e-300), 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)


def mark_pixels(axis: Axes, missed: NDArray[np.bool_], invented: NDArray[np.bool_]) -> None:
    """Colours pixels in which a target was missed black, in which one was invented red."""
    marks = np.zeros((*missed.shape, 4))
    marks[missed], marks[invented] = to_rgba("black"), to_rgba(RED)
    axis.imshow(marks)


def hatch(axis: Axes, pixels: NDArray[np.bool_]) -> None:
    """Veils and hatches pixels that mean nothing."""
    if 0.0 < pixels.mean() < MOST_HATCHED:
        padded = np.pad(pixels, 1).repeat(2, axis=0).repeat(2, axis=1)[1:-1, 1:-1].astype(np.float64)
        height, width = pixels.shape  # corners of the pixels, so that one alone is a square
        x, y = (np.repeat(np.arange(n + 1) - 0.5, 2) + np.tile([-1e-3, 1e-3], n + 1) for n in (width, height))
        axis.autoscale(False)
        marks = axis.contourf(x, y, padded, levels=[0.5, 1.5], colors=[(1.0, 1.0, 1.0, 0.55)], hatches=["//////"])
        marks.set(edgecolor="0.35", linewidth=0.0)


class Panels:
    """A figure of `count` images of `shape` (height, width), as many in a line as fit, each with its colour bar below.

    `width`: of the figure [inch]. `below`: heights of more axes over the whole width, `self.below()` [inch].
    """

    unclear: NDArray[np.bool_] | None = None  # pixels to hatch in the images that follow, see `unclear_pixels`

    def __init__(
        self, shape: tuple[int, ...], count: int, *, width: float = PAGE, below: tuple[float, ...] = ()
    ) -> None:
        lines, columns = arranged(count, width, 1.7)
        self._cell = min(width / columns, 3.4)
        self._line = self._cell - 0.4  # of a label: its middle is that of the bar, which numbers and margins narrow
        height = float(np.clip((self._cell - 0.35) * shape[0] / shape[1], 0.5, 5.0))
        # Titles, numbers and labels.
        self.figure = new_figure(width, lines * (height + 1.1) + sum(below) + 0.45 * bool(below))
        self.figure.get_layout_engine().set(wspace=0.05, h_pad=0.1)  # type: ignore[call-arg,union-attr]
        ratios = [*[height, 0.1] * lines, *below]
        grid = self.figure.add_gridspec(len(ratios), columns, height_ratios=ratios)
        self._free = iter([(grid[2 * k, c], grid[2 * k + 1, c]) for k in range(lines) for c in range(columns)])
        self._lines = [0] * len(ratios)  # of labels, beyond the first
        self._below = [grid[row, :] for row in range(2 * lines, len(ratios))]

    def below(self) -> list[Axes]:
        """The axes below the images."""
        return [self.figure.add_subplot(place) for place in self._below]

    def place(self, title: str) -> tuple[Axes, Axes]:
        """The axis of the next image, and that of its colour bar."""
        axis, bar = map(self.figure.add_subplot, next(self._free))
        axis.set_title(wrapped(title, self._cell - 0.2))
        axis.set(xlabel="column [pixel]", ylabel="row [pixel]")
        if not axis.get_subplotspec().is_first_col():  # type: ignore[union-attr]
            axis.set_ylabel("")
        for side in (axis.xaxis, axis.yaxis):
            side.set_major_locator(MaxNLocator(nbins=5, integer=True, min_n_ticks=1))
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
            short = axis.yaxis if height < width else axis.xaxis
            short.set_major_locator(MaxNLocator(nbins=1, integer=True, min_n_ticks=1))
        shown = axis.imshow(image, cmap=colour_map(colours), norm=scale, clim=limits)
        if self.unclear is not None and np.isfinite(image).any():
            hatch(axis, self.unclear)
        extend = ("neither", "min", "max", "both")[int((image < low).any()) + 2 * int((image > high).any())]
        label = wrapped(label, self._line)
        row, taller = axis.get_subplotspec().rowspan.start, label.count("\n")  # type: ignore[union-attr]
        self.figure.set_figheight(self.figure.get_figheight() + 0.17 * max(taller - self._lines[row], 0))
        self._lines[row] = max(taller, self._lines[row])
        colour_bar = self.figure.colorbar(shown, cax=bar, orientation="horizontal", label=label, extend=extend)
        if not np.isfinite(image).any():
            bar.set_visible(False)
            middle_text(axis, "no values")
        elif scale == "log":
            log_ticks(bar.xaxis, self._line / 0.4)
        else:
            digits = len(f"{abs(high):.0f}") + max(1, math.ceil(-math.log10(high - low or 1.0)) + 2)
            colour_bar.locator = MaxNLocator(nbins=max(1, min(6, int(self._line / max(0.45, 0.08 * digits)))))
            colour_bar.formatter = ScalarFormatter(useOffset=False)
            bar.xaxis.minorticks_on()
        return axis

    def show_depth(
        self, image: NDArray[Any], title: str, limits: tuple[float, float], label: str = LABELS["depth"]
    ) -> Axes:
        """Depth [m]; the label says what is grey."""
        grey = "\ngrey: no depth" * bool(np.isnan(image).any() and np.isfinite(image).any())
        return self.show(image, title, label + grey, DEPTH_MAP, limits)

    def show_error(self, error: NDArray[Any], title: str) -> None:
        """Signed depth errors [m]; see `error_limit`. How many pixels are beyond the colours is written below."""
        reach = error_limit(error)
        factor, unit = (1e3, "mm") if reach < 0.1 else (1e2, "cm") if reach < 1.0 else (1.0, "m")
        known = max(1, int(np.isfinite(error).sum()))
        below, above = (np.count_nonzero(side) / known for side in (error < -reach, error > reach))
        label = f"depth error [{unit}]"
        if below or above:
            label += "\n" + wrapped_items(f"{percent(below)} % below, {percent(above)} % above", self._line)
        self.show(factor * error, title, label, ERROR_MAP, (-factor * reach, factor * reach))

    def show_intensity(self, image: NDArray[Any], title: str, label: str) -> None:
        """From 0 to the 99.5th percentile, which single bright pixels exceed."""
        values = image.astype(np.float64)
        known = values[np.isfinite(values)]
        top = (float(np.percentile(known, 99.5)) or float(known.max()) or 1.0) if known.size else 1.0
        self.show_scaled(values, title, label, INTENSITY_MAP, (0.0, top))

    def show_positive(self, values: NDArray[Any], title: str, label: str, colours: str = BOUND_MAP) -> None:
        """Positive values between their 5th and 95th percentile; on a logarithmic scale if these are far apart."""
        shown = np.where(np.isfinite(values) & (values > 0), values, np.nan)
        known = shown[np.isfinite(shown)]
        low, high = map(float, np.percentile(known, (5.0, 95.0))) if known.size else (0.1, 1.0)
        if high > 4.0 * low:
            self.show(shown, title, label, colours, (low, high), "log")
        else:  # a single value has no interval
            self.show_scaled(shown, title, label, colours, (low - 0.05 * high, 1.05 * high))

    def show_scaled(
        self, values: NDArray[Any], title: str, label: str, colours: str | Colormap, limits: tuple[float, float]
    ) -> None:
        """Values in units of a power of ten, which the label names, unless they are short by themselves."""
        factor, unit = power_unit(limits[1])
        label += unit
        self.show(values / factor, title, label, colours, (limits[0] / factor, limits[1] / factor))


def error_limit(error: NDArray[Any]) -> float:
    """Largest error in colours [m]: twice the 68th percentile of the absolute errors, between the 90th and the 95th.

    Large errors of some pixels, at steps and where nothing returned, do not hide the millimetres of the others.
    """
    known = np.abs(error[np.isfinite(error)])
    if not known.size:
        return 1.0
    body, most, tail = np.percentile(known, (68.0, 90.0, 95.0))
    reach = max(min(max(2.0 * body, most), tail), 1e-4)
    digit = 10.0 ** math.floor(math.log10(reach))
    return float(math.ceil(reach / digit * 2 - 1e-9) / 2 * digit)  # of two digits: 3.5 mm


def shown_limits(
    image: NDArray[Any], *, beyond: float = 0.0, margin: float = 0.0, weights: NDArray[Any] | None = None
) -> tuple[float, float]:
    """Lowest and highest value, at least 1 cm apart, without `beyond` percent at each end; the margin is relative.

    With `weights`, such as counts, percent of their sum: depths of pixels with hardly any counts are spread over the
    gate, and those of the target would have one colour. A single pixel decides neither end.
    """
    known = np.isfinite(image)
    if weights is not None and (weights[known] > 0).any():  # those of NaN count for nothing
        known &= weights > 0
        each = weights[known].astype(np.float64)
        for _ in range(3 * bool(beyond)):
            each = np.minimum(each, 0.005 * beyond * each.sum())
        low, high = np.percentile(image[known], (beyond, 100.0 - beyond), weights=each, method="inverted_cdf")
    else:
        low, high = np.percentile(image[known], (beyond, 100.0 - beyond)) if known.any() else (0.0, 1.0)
    spare = max(0.0, 0.01 - (high - low)) / 2
    spare += margin * (high - low + 2 * spare)
    return float(low - spare), float(high + spare)


def target_limits(truth: NDArray[Any], measured: NDArray[Any]) -> tuple[float, float]:
    """Limits that show the true depth and the errors about it, or the measured depth where no target is in view."""
    least, most = shown_limits(measured, beyond=1.0, margin=0.05)
    if not np.isfinite(truth).any():
        return least, most
    low, high = shown_limits(truth, margin=0.05)
    # Errors may all have one sign, and those of false peaks are as large as the gate: the target keeps its colours.
    error, span = np.abs(measured - truth), high - low
    spare = 0.0 if np.isnan(error).all() else min(error_limit(error), max(span, 2.0 * np.nanpercentile(error, 68)))
    return float(max(low - spare, min(low, least))), float(min(high + spare, max(high, most)))


def median_pixel(values: NDArray[Any], among: NDArray[np.bool_]) -> tuple[int, int]:
    """Row and column of a typical one of these pixels, or of all where there are none: of the third whose value is
    nearest to the median, as in a plan, the one nearest to the middle. Small changes of the values seldom move it."""
    choice = np.flatnonzero(among | ~among.any())
    off = np.abs(values.ravel()[choice] - np.nanmedian(values.ravel()[choice]))
    rows, columns = np.divmod(choice[np.argsort(off, kind="stable")[: max(1, len(choice) // 3)]], values.shape[1])
    at = np.hypot(rows - 0.5 * (values.shape[0] - 1), columns - 0.5 * (values.shape[1] - 1)).argmin()
    return int(rows[at]), int(columns[at])
