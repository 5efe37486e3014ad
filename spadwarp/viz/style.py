"""How all pictures look: colours, colour maps, sizes; figures without pyplot, which need no display."""

from __future__ import annotations

import io
import os
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.figure import Figure

from spadwarp.errors import FileError
from spadwarp.io.atomic import atomic_path

__all__ = ["BACKGROUND", "BLUE", "BOUND_MAP", "COMPONENTS", "DASHED", "DEPTH_MAP", "ERROR_MAP", "GREEN", "GRID"]
__all__ += [
    "INTENSITY_MAP",
    "LIGHT_MAP",
    "MISSING",
    "ORANGE",
    "PROBABILITY_MAP",
    "PURPLE",
    "RED",
    "SERIES",
    "SKY",
    "TEXT",
]
__all__ += ["TEXT", "colour_map", "new_figure", "plain_axis", "save", "spaced"]

MISSING = "0.85"  # light grey: pixels without a value
BACKGROUND = "#eef1f3"  # around targets
TEXT = "0.25"
GRID = "0.92"
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

DEPTH_MAP, INTENSITY_MAP, ERROR_MAP = "viridis_r", "cividis", "PuOr"
BOUND_MAP, PROBABILITY_MAP, LIGHT_MAP = "magma_r", "inferno_r", "inferno"


def colour_map(name: str, *, missing: str = MISSING) -> Colormap:
    """A colour map that shows NaN in the colour `missing`."""
    return matplotlib.colormaps[name].with_extremes(bad=missing)


class NotebookFigure(Figure):
    """A figure that notebooks show although pyplot does not know it."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=96)
        return buffer.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """An empty figure [inch]."""
    return NotebookFigure(figsize=(width, height), layout="constrained", facecolor="white")


def plain_axis(axis: Axes, *, grid: str = "major") -> None:
    """A light grid behind the curves; no frame at the top and on the right."""
    axis.grid(color=GRID, which=grid)  # type: ignore[arg-type]
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def save(figure: Figure, path: str | os.PathLike[str], *, note: str = "", dpi: int = 150) -> Path:
    """Writes a figure in the format of the file's ending, with a note below it; returns the path.

    Raises `FileError`.
    """
    if note:
        figure.supxlabel(textwrap.fill(note, int(14 * figure.get_figwidth())), fontsize=8, color="0.35")
    kind = Path(path).suffix.lstrip(".").lower() or "png"
    if kind not in (known := figure.canvas.get_supported_filetypes()):
        raise FileError(f"{path}: ending {Path(path).suffix!r} is not one of {', '.join(f'.{one}' for one in known)}")
    # Without the date, so that the same figure makes the same file.
    metadata = {"CreationDate": None} if kind == "pdf" else None
    with atomic_path(Path(path)) as temporary, _without_a_date():
        figure.savefig(temporary, dpi=dpi, format=kind, metadata=metadata)  # type: ignore[arg-type]
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
