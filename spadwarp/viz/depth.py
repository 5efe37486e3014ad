"""Depth frames: beside their intensity, or before and after denoising."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.viz.panels import Panels, mark_pixels, percent, shown_limits
from spadwarp.viz.style import PAGE, paper, save

__all__ = ["draw_denoised", "draw_depth"]


@paper()
def draw_depth(
    image: NDArray[np.float64],
    intensity: NDArray[Any],
    path: str | Path,
    *,
    label: str,
    title: str,
    width: float = PAGE,
) -> Path:
    """A depth or range image `[H, W]` [m] beside the intensity; returns the path. `width`: of the picture [inch]."""
    panels = Panels(image.shape, 2, width=width)
    panels.show_depth(image, title, shown_limits(image, beyond=1.0, weights=intensity), label)
    panels.show_intensity(intensity, "Intensity", "sum over bins")
    return save(panels.figure, path)


@paper()
def draw_denoised(
    noisy: NDArray[np.float32],
    denoised: NDArray[np.float32],
    path: str | Path,
    *,
    gate: tuple[float, float],
    title: str,
    truth: NDArray[np.float32] | None = None,
    width: float = PAGE,
) -> Path:
    """A frame before and after, depth `[H, W]` [m] each; returns the path.

    With the truth also that, the error, and in colours of their own the pixels in which a target was missed or
    invented, and their parts of the target and of the water: NaN stands for no target. `width`: of the picture [inch].
    """
    known = truth is not None and np.isfinite(truth).any()
    scale = truth if truth is not None and known else denoised if np.isfinite(denoised).any() else noisy
    low, high = shown_limits(scale, beyond=1.0, margin=0.05 * known)
    limits = max(low, gate[0] - 1.0), min(high, gate[1] + 1.0)
    panels = Panels(noisy.shape, 2 if truth is None else 4, width=width)
    panels.show_depth(noisy, "Input", limits)
    if truth is None:
        panels.show_depth(denoised, "Denoised", limits)
    else:
        target, found = np.isfinite(truth), np.isfinite(denoised)
        missed, invented = target & ~found, found & ~target
        parts = (100 * some.sum() / max(1, of.sum()) for some, of in ((missed, target), (invented, ~target)))
        of_target, of_water = map(percent, parts)
        label = f"depth z [m]\nblack: missed, {of_target}\nred: invented, {of_water}"
        mark_pixels(panels.show_depth(denoised, "Denoised", limits, label), missed, invented)
        panels.show_depth(truth, "Truth", limits)
        panels.show_error(denoised - truth, "Denoised − truth")
    panels.caption(title)
    return save(panels.figure, path)
