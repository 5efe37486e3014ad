"""A fit: counts beside what the model expects, and what is left over."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from spadwarp.units import rounded
from spadwarp.viz.panels import Panels, shown_limits
from spadwarp.viz.style import BLUE, ERROR_MAP, PAGE, RED, TEXT, log_axis, paper, save, spaced

if TYPE_CHECKING:
    from spadwarp.inverse import Fit

__all__ = ["draw_fit", "fit_figure"]

_MOST_POINTS = 160  # bins are added up to at most so many


def draw_fit(fit: Fit, path: str | Path, *, width: float = PAGE) -> Path:
    """Counts, fit and residuals of a fit: over the image and over time; `width` [inch]; returns the path."""
    return save(fit_figure(fit, width), path)


@paper()
def fit_figure(fit: Fit, width: float = PAGE) -> Figure:
    """The figure of `draw_fit`."""
    counts, expected = fit.counts.sum(axis=2), fit.expected.sum(axis=2, dtype=np.float64)
    images = 2 if fit.depth is None else 3
    panels = Panels(counts.shape, images, width=width, below=2.6)
    panels.show_intensity(counts, "Counts", "counts in the exposure")
    residual = (counts - expected) / np.sqrt(np.maximum(expected, 1e-12))
    panels.show(np.where(expected > 0, residual, np.nan), "Residual", "(counts − fit) / √fit", ERROR_MAP, (-3.0, 3.0))
    if fit.depth is not None:
        panels.show_depth(fit.depth, "Depth", shown_limits(fit.depth))
    below = panels.below()
    below.set_axis_off()
    top = below.inset_axes((0.0, 0.42, 1.0, 0.58))
    bottom = below.inset_axes((0.0, 0.0, 1.0, 0.32), sharex=top)
    bins = fit.counts.shape[2]
    factor = max(1, -(-bins // _MOST_POINTS))
    starts = np.arange(0, bins, factor)
    measured = np.add.reduceat(fit.counts.sum(axis=(0, 1)).astype(np.float64), starts)
    mean = np.add.reduceat(fit.expected.sum(axis=(0, 1), dtype=np.float64), starts)
    edges = 1e9 * np.append(fit.edges[starts], fit.edges[-1])
    top.stairs(measured, edges, fill=True, color="0.72", label="counts, all pixels")
    top.stairs(mean, edges, baseline=None, color=BLUE, linewidth=1.0, label="fit")
    seen = mean[mean > 0]
    low = max(0.5, float(seen.min()) if seen.size else 0.5)
    top.set_ylim(0.5 * low, 3.0 * max(float(measured.max()), 2.0 * low))
    log_axis(top, "y", most=5)
    top.set(xlim=edges[[0, -1]], ylabel="counts")
    top.tick_params(labelbottom=False)
    top.legend(loc="upper right", ncols=2)
    left = (measured - mean) / np.sqrt(np.maximum(mean, 1.0))
    bottom.axhline(0.0, color=TEXT, linewidth=0.6)
    bottom.plot(0.5 * (edges[:-1] + edges[1:]), left, ".", color=RED, markersize=2.5)
    reach = max(3.5, 1.1 * float(np.abs(left).max()))
    bottom.set(ylim=(-reach, reach), xlabel="time of flight [ns]", ylabel="residual\n/ √fit")
    values = "; ".join(
        f"{one.name} = {rounded(one.value, one.standard_error)} ± {one.standard_error:.2g} {one.unit}".rstrip()
        for one in fit.estimates.values()
    )
    panels.caption(f"{values}; {spaced(fit.pulses)} pulses" if values else f"{spaced(fit.pulses)} pulses")
    return panels.figure
