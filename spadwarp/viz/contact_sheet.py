"""A contact sheet of a dataset: what is true and what is measured, side by side."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from spadwarp.dataset import FrameReader
from spadwarp.errors import ArgumentError
from spadwarp.io.atomic import atomic_path

__all__ = ["draw_dataset"]

_NOTHING = "#f2f4f5"  # no return, nothing hit


def draw_dataset(
    folder: str | os.PathLike[str], path: str | os.PathLike[str], *, split: str = "all", frames: int = 20
) -> Path:
    """Draws frames that lie evenly over a split into one PNG: true depth, measured depth, recorded photons.

    Args:
        folder: The dataset.
        path: The picture.
        split: "train", "validation", "test" or "all".
        frames: How many, ≥ 1; as many as there are if these are fewer.

    Raises:
        FileError: No dataset, or the picture cannot be written.
        ArgumentError: An argument out of range.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    if frames < 1:
        raise ArgumentError(f"frames = {frames} is outside [1, inf)")
    reader = FrameReader(folder, split, fields=("clean", "noisy", "intensity"))
    if not len(reader):
        raise ArgumentError(f"split = {split!r} holds no frames")
    number = min(frames, len(reader))
    chosen = ((np.arange(number) + 0.5) * len(reader) / number).astype(int)
    items = [reader[int(index)] for index in chosen]
    names = reader.manifest["targets"]
    splits = {name: one for one, value in reader.manifest["splits"].items() for name in value["targets"]}

    columns = min(3, number)
    lines = math.ceil(number / columns)
    height, width = reader.shape
    wide = 4.4
    figure = Figure(
        figsize=(wide * columns, (wide / 3 * height / width + 0.26) * lines + 0.75),
        facecolor="white",
        layout="constrained",
    )
    figure.get_layout_engine().set(w_pad=0.06, h_pad=0.04)  # type: ignore[call-arg,union-attr]
    axes = np.ravel(figure.subplots(lines, columns, squeeze=False))
    for axis in axes:
        axis.axis("off")
    near, far = _reach(items)
    scale = Normalize(near, far)
    for axis, item in zip(axes, items, strict=False):
        strip = np.concatenate([_coloured(item, name, scale) for name in ("clean", "noisy", "intensity")], axis=1)
        axis.imshow(strip, interpolation="nearest", aspect="equal")
        name = names[item["target"]]
        fraction = float(item["backscatter_fraction"])
        level = "" if math.isnan(fraction) else f", BS {fraction:.3g}"
        text = (
            f"{name.replace('_', ' ')} ({splits[name]}), {item['attenuation_lengths']:.2g} attenuation lengths{level}"
        )
        axis.set_title(text, fontsize=7.5, pad=2)
    bar = figure.colorbar(
        ScalarMappable(scale, "viridis_r"), ax=list(axes), orientation="horizontal", fraction=0.012, aspect=70, pad=0.01
    )
    bar.set_label("depth beyond the target's centre [m]: true, measured; beside them recorded photons", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    bar.outline.set_visible(False)
    with atomic_path(Path(path)) as temporary:
        figure.savefig(temporary, dpi=130, format="png")
    return Path(path)


def _reach(items: list[dict[str, Any]]) -> tuple[float, float]:
    """What the true depths span, seen from the targets' centres."""
    values = np.concatenate([(item["clean"] - item["distance"]).ravel() for item in items])
    values = values[np.isfinite(values)]
    if not values.size:
        return -1.0, 1.0
    low, high = np.percentile(values, [0.5, 99.5])
    margin = 0.1 * (high - low) + 0.05
    return float(low - margin), float(high + margin)


def _coloured(item: dict[str, Any], name: str, scale: Any) -> Any:
    import matplotlib
    from matplotlib.colors import to_rgb

    image = item[name][0]
    if name == "intensity":
        top = max(float(np.percentile(image, 99.5)), 1.0)
        colours = matplotlib.colormaps["cividis"](np.clip(image / top, 0.0, 1.0))[..., :3]
    else:
        depth = image - item["distance"]
        colours = matplotlib.colormaps["viridis_r"](scale(np.nan_to_num(depth)))[..., :3]
        colours = np.where(np.isfinite(depth)[..., None], colours, to_rgb(_NOTHING))
    edge = np.ones((image.shape[0], max(1, image.shape[1] // 48), 3))
    return colours if name == "intensity" else np.concatenate([colours, edge], axis=1)
