"""A case of the validation: values over references, and their z values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spadwarp.viz.style import BLUE, PAGE, RED, new_figure, paper, plain_axis, save, wrapped

__all__ = ["draw_validation"]


@paper()
def draw_validation(rows: Sequence[Mapping[str, Any]], path: str | Path, *, title: str, width: float = PAGE) -> Path:
    """Draws the quantities of a case as a PNG; returns its path.

    `rows`: of each `quantity` its `value`, `reference`, `standard_error`, `z` and whether it `passed`. `width`: of the
    picture [inch]. Raises `FileError`.
    """
    names = [wrapped(row["quantity"], 0.36 * width, size=7) for row in rows]
    lines = sum(name.count("\n") + 1 for name in names)
    title = wrapped(title, width - 0.3)
    figure = new_figure(width, 0.9 + 0.15 * (lines + len(rows)) + 0.14 * title.count("\n"))
    ratio, deviation = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    for y, row in enumerate(rows):
        style: dict[str, Any] = {"color": BLUE if row["passed"] else RED, "marker": "o" if row["passed"] else "X"}
        reference = row["reference"]
        if reference:
            error = abs(row["standard_error"] / reference)
            ratio.errorbar(row["value"] / reference - 1.0, y, xerr=error, linestyle="none", **style)
        if math.isfinite(row["z"]):
            deviation.plot(row["z"], y, **style)
    ratio.axvline(0.0, color="0.6", linewidth=0.8)
    ratio.set_xlabel("value / reference − 1")
    ratio.set_yticks(range(len(rows)), names)
    ratio.set_ylim(len(rows) - 0.5, -0.5)
    deviation.axvspan(-2.0, 2.0, color="0.92", zorder=0)
    deviation.set_xlabel(wrapped("z [standard errors]", 0.22 * width))
    for axis in (ratio, deviation):
        axis.locator_params(axis="x", nbins=4)
        axis.xaxis.minorticks_on()
        plain_axis(axis)
    figure.suptitle(title)
    return save(figure, path)
