"""Depth frames: beside their intensity, or before and after denoising."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.viz.panels import Panels, shown_limits
from spadwarp.viz.style import save

__all__ = ["draw_denoised", "draw_depth"]


def draw_depth(
    image: NDArray[np.float64], intensity: NDArray[Any], path: str | Path, *, label: str, title: str
) -> Path:
    """A depth or range image `[H, W]` [m] beside the intensity; returns the path."""
    panels = Panels(image.shape, 2)
    panels.show_depth(image, title, shown_limits(image, beyond=1.0), label)
    panels.show_intensity(intensity, "Intensity", "sum over bins")
    return save(panels.figure, path)


def draw_denoised(
    noisy: NDArray[np.float32],
    denoised: NDArray[np.float32],
    path: str | Path,
    *,
    gate: tuple[float, float],
    title: str,
) -> Path:
    """A frame before and after, depth `[H, W]` [m] each; returns the path."""
    panels = Panels(noisy.shape, 2)
    low, high = shown_limits(denoised if np.isfinite(denoised).any() else noisy, beyond=1.0)
    limits = max(low, gate[0] - 1.0), min(high, gate[1] + 1.0)
    panels.show_depth(noisy, "Input", limits)
    panels.show_depth(denoised, "Denoised", limits)
    panels.caption(title)
    return save(panels.figure, path)
