"""A case of the validation: values over references, and their z values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spadwarp.viz.style import BLUE, RED, new_figure, save

__all__ = ["draw_validation"]


def draw_validation(rows: Sequence[Mapping[str, Any]], path: str | Path, *, title: str) -> Path:
    """Draws the quantities of a case as a PNG; returns its path.

    `rows`: of each `quantity` its `value`, `reference`, `standard_error`, `z` and whether it `passed`. Raises
    `FileError`.
    """
    figure = new_figure(11.0, 1.6 + 0.26 * len(rows))
    ratio, deviation = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
    for y, row in enumerate(rows):
        colour, reference = BLUE if row["passed"] else RED, row["reference"]
        if reference:
            error = abs(row["standard_error"] / reference)
            ratio.errorbar(row["value"] / reference - 1.0, y, xerr=error, fmt="o", ms=4, color=colour)
        if math.isfinite(row["z"]):
            deviation.plot(row["z"], y, "o", ms=4, color=colour)
    ratio.axvline(0.0, color="0.6", lw=0.8)
    ratio.set_xlabel("value / reference − 1")
    ratio.set_yticks(range(len(rows)), [row["quantity"] for row in rows], fontsize=8)
    ratio.invert_yaxis()
    deviation.axvspan(-2.0, 2.0, color="0.92")
    deviation.set_xlabel("z")
    figure.suptitle(title, fontsize=10)
    return save(figure, path)
