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

from spadwarp.dataset import FrameReader
from spadwarp.errors import ArgumentError
from spadwarp.limits import check_integer
from spadwarp.viz.panels import coloured_depth, strip_bar, strips
from spadwarp.viz.style import DEPTH_MAP, INTENSITY_MAP, PAGE, paper, save, spaced

__all__ = ["draw_dataset"]


@paper()
def draw_dataset(
    folder: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    split: str = "all",
    frames: int = 20,
    width: float = PAGE,
) -> Path:
    """Draws frames that lie evenly over a split into one PNG: true depth, measured depth, recorded photons.

    Photons are shown relative to the brightest 0.5 % of each frame, which the frame's title gives.

    Args:
        folder: The dataset.
        path: The picture.
        split: "train", "validation", "test" or "all".
        frames: At most so many, 1 to 1000.
        width: Of the picture [inch].

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
    height, across = reader.shape
    figure, axes, bars = strips(number, width=width, least=2.3, ratio=height / across / 3, title=0.34, bars=2)
    scale = _depth_scale(items)
    gap = np.ones((height, max(1, across // 48), 3))
    for axis, item in zip(axes, items, strict=False):
        clean, noisy = (coloured_depth(item[name][0] - item["distance"], scale) for name in ("clean", "noisy"))
        intensity = item["intensity"][0]
        top = max(float(np.percentile(intensity, 99.5)), 1.0)
        photons = matplotlib.colormaps[INTENSITY_MAP](np.clip(intensity / top, 0.0, 1.0))[..., :3]
        axis.imshow(np.concatenate([clean, gap, noisy, gap, photons], axis=1), aspect="equal")
        name = reader.manifest["targets"][item["target"]]
        axis.set_title(_title(item, f"{name.replace('_', ' ')} ({splits[name]})", top), fontsize=6.5, pad=2)
    strip_bar(bars[0], scale, DEPTH_MAP, "depth beyond the target's centre [m]", bars=2)
    strip_bar(bars[1], Normalize(0.0, 1.0), INTENSITY_MAP, "recorded photons, relative to the brightest", bars=2)
    note = (
        "Each frame: true depth, measured depth (light: none), recorded photons (brightest: their 99.5th percentile). "
        "c r: attenuation lengths one way, c being the water's extinction and r the range of the target."
    )
    if not all(math.isnan(float(item["backscatter_fraction"])) for item in items):
        note += " BS: backscatter fraction, the part of the pixels that report backscatter."
    return save(figure, path, note=note)


def _title(item: dict[str, Any], name: str, top: float) -> str:
    """Target, attenuation lengths, backscatter fraction where it is known, largest number of photons in colours."""
    fraction = float(item["backscatter_fraction"])
    level = "" if math.isnan(fraction) else f", BS = {fraction:.3g}"
    return f"{name}\nc r = {item['attenuation_lengths']:.2g}{level}, brightest {spaced(round(top))} photons"


def _depth_scale(items: Sequence[dict[str, Any]]) -> Normalize:
    """The span of the true depths, seen from the targets' centres."""
    values = np.concatenate([(item["clean"] - item["distance"]).ravel() for item in items])
    values = values[np.isfinite(values)]
    if not values.size:
        return Normalize(-1.0, 1.0)
    low, high = np.percentile(values, [0.5, 99.5])
    margin = 0.1 * (high - low) + 0.05
    return Normalize(float(low - margin), float(high + margin))
