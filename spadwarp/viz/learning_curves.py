"""Learning curves of a training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.ticker import MaxNLocator

from spadwarp.viz.style import (
    BLUE,
    PAGE,
    TEXT,
    columns_that_fit,
    log_axis,
    new_figure,
    paper,
    plain_axis,
    save,
    wrapped,
)

__all__ = ["draw_learning_curves"]


@paper()
def draw_learning_curves(
    log: Sequence[Mapping[str, Any]], path: str | Path, *, title: str, width: float = PAGE
) -> Path:
    """Loss and validation PSNR against steps; returns the picture's path.

    `log`: for each report its `step`, `loss` and `psnr` [dB], a mapping from the backscatter fraction, or from the
    signal photons per pixel (1 and more), to the PSNR there. `width`: of the picture [inch].
    """
    steps, losses = [line["step"] for line in log], [line["loss"] for line in log]
    style: dict[str, Any] = {"marker": "o", "markersize": 5.0 if len(log) == 1 else 2.0}  # one point has no line
    columns = columns_that_fit(2, width, 3.0)
    levels = list(log[-1]["psnr"])
    counted = all(float(level) >= 1 for level in levels)
    in_line = columns_that_fit(len(levels) + 1, width, 0.8)
    figure = new_figure(width, 4.9 - 2.1 * (columns - 1) + 0.14 * (len(levels) // in_line))
    loss, psnr = figure.subplots(2 // columns, columns)
    loss.plot(steps, losses, color=BLUE, **style)
    loss.set(xlabel="step", ylabel="loss")
    if min(losses) > 0:  # "psnr" is a logarithm
        log_axis(loss, "y")
    for level, shade in zip(levels, np.linspace(0.85, 0.0, len(levels)), strict=True):
        colour = matplotlib.colormaps["viridis"](shade)
        label = f"{float(level):g}" if counted else level
        psnr.plot(steps, [line["psnr"][level] for line in log], color=colour, label=label, **style)
    psnr.set(xlabel="step", ylabel="validation PSNR [dB]")
    title_of_levels = "signal photons per pixel" if counted else "backscatter fraction"
    figure.legend(title=title_of_levels, loc="outside lower center", ncols=in_line)
    for axis in (loss, psnr):
        plain_axis(axis)
        axis.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    figure.suptitle(wrapped(title, width - 0.3), color=TEXT)
    return save(figure, path)
