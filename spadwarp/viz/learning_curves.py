"""Learning curves of a training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spadwarp.viz.style import BLUE, TEXT, new_figure, plain_axis, save

__all__ = ["draw_learning_curves"]


def draw_learning_curves(log: Sequence[Mapping[str, Any]], path: str | Path, *, title: str) -> Path:
    """Loss and validation PSNR against steps; returns the picture's path.

    `log`: for each report its `step`, `loss` and `psnr` [dB], a mapping from the backscatter fraction, or from the
    signal photons per pixel (1 and more), to the PSNR there.
    """
    steps, losses = [line["step"] for line in log], [line["loss"] for line in log]
    style: dict[str, Any] = {"marker": "o", "markersize": 6.0 if len(log) == 1 else 3.0}  # one point has no line
    figure = new_figure(9.6, 3.4)
    loss, psnr = figure.subplots(1, 2)
    loss.plot(steps, losses, color=BLUE, **style)
    loss.set(yscale="log" if min(losses) > 0 else "linear", xlabel="step", ylabel="loss")  # "psnr" is a logarithm
    levels = list(log[-1]["psnr"])
    for level, shade in zip(levels, np.linspace(0.75, 0.0, len(levels)), strict=True):
        label = f"backscatter fraction {level}" if float(level) < 1 else f"{float(level):g} photons"
        psnr.plot(steps, [line["psnr"][level] for line in log], color=str(shade), label=label, **style)
    psnr.set(xlabel="step", ylabel="validation PSNR [dB]")
    psnr.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plain_axis(loss)
    plain_axis(psnr)
    figure.suptitle(title, fontsize=10, color=TEXT)
    return save(figure, path)
