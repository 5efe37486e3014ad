"""A contact sheet of a dataset: what is true and what is measured, side by side."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from spadwarp.dataset import FrameReader
from spadwarp.errors import ArgumentError
from spadwarp.limits import check_integer
from spadwarp.viz.panels import coloured_depth, depth_bar, strips
from spadwarp.viz.style import INTENSITY_MAP, save

__all__ = ["draw_dataset"]


def draw_dataset(
    folder: str | os.PathLike[str], path: str | os.PathLike[str], *, split: str = "all", frames: int = 20
) -> Path:
    """Draws frames that lie evenly over a split into one PNG: true depth, measured depth, recorded photons.

    Args:
        folder: The dataset.
        path: The picture.
        split: "train", "validation", "test" or "all".
        frames: At most so many, 1 to 1000.

    Raises:
        FileError: No dataset, or the picture cannot be written.
        ArgumentError: An argument out of range.
    """
    frames = check_integer("frames", frames, "[1, 1000]")
    reader = FrameReader(folder, split, fields=("clean", "noisy", "intensity"))
    if not len(reader):
        raise ArgumentError(f"split = {split!r} holds no frames")
    number = min(frames, len(reader))
    items = [reader[int((k + 0.5) * len(reader) / number)] for k in range(number)]
    splits = {name: split for split, value in reader.manifest["splits"].items() for name in value["targets"]}
    height, width = reader.shape
    figure, axes = strips(number, columns=3, size=(4.4, 4.4 / 3 * height / width + 0.26), spare=0.75, pads=(0.06, 0.04))
    scale = _depth_scale(items)
    gap = np.ones((height, max(1, width // 48), 3))
    for axis, item in zip(axes, items, strict=False):
        clean, noisy = (coloured_depth(item[name][0] - item["distance"], scale) for name in ("clean", "noisy"))
        strip = np.concatenate([clean, gap, noisy, gap, _coloured_intensity(item["intensity"][0])], axis=1)
        axis.imshow(strip, interpolation="nearest", aspect="equal")
        name, fraction = reader.manifest["targets"][item["target"]], float(item["backscatter_fraction"])
        level = "" if math.isnan(fraction) else f", backscatter fraction {fraction:.3g}"
        lengths = f"{item['attenuation_lengths']:.2g} attenuation lengths"
        axis.set_title(f"{name.replace('_', ' ')} ({splits[name]}), {lengths}{level}", fontsize=7.5, pad=2)
    label = "depth beyond the target's centre [m], true and measured; on the right of each frame recorded photons"
    depth_bar(figure, axes, scale, label, fontsize=8)
    return save(figure, path, dpi=130)


def _depth_scale(items: Sequence[dict[str, Any]]) -> Normalize:
    """The span of the true depths, seen from the targets' centres."""
    values = np.concatenate([(item["clean"] - item["distance"]).ravel() for item in items])
    values = values[np.isfinite(values)]
    if not values.size:
        return Normalize(-1.0, 1.0)
    low, high = np.percentile(values, [0.5, 99.5])
    margin = 0.1 * (high - low) + 0.05
    return Normalize(float(low - margin), float(high + margin))


def _coloured_intensity(image: NDArray[np.float32]) -> NDArray[np.float64]:
    top = max(float(np.percentile(image, 99.5)), 1.0)
    return matplotlib.colormaps[INTENSITY_MAP](np.clip(image / top, 0.0, 1.0))[..., :3]
