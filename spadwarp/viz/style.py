"""How all pictures look: the style file, colours, colour maps, sizes; figures without pyplot, which need no display."""

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
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

from spadwarp.errors import FileError
from spadwarp.io.paths import atomic_path
from spadwarp.limits import check_real
from spadwarp.result import Channel

__all__ = [
    "BACKGROUND",
    "BLUE",
    "BOUND_MAP",
    "CHANNEL_NAMES",
    "COLUMN",
    "COMPONENTS",
    "DASHED",
    "DEPTH_MAP",
    "ERROR_MAP",
    "GREEN",
]
__all__ += ["INTENSITY_MAP", "LIGHT_MAP", "MISSING", "ORANGE", "PAGE", "PROBABILITY_MAP", "PURPLE", "RED"]
__all__ += ["SERIES", "SKY", "STYLE", "TEXT", "colour_map", "columns_that_fit", "log_axis", "new_figure", "paper"]
__all__ += ["plain_axis", "save", "spaced", "wrapped", "wrapped_items"]

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
        raise FileError(f"{path}: ending {Path(path).suffix!r} is not one of {', '.join(f'.{one}' for one in known)}")
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
