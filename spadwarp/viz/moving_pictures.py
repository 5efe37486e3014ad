"""A scene in motion, picture by picture: true depth, measured depth and counts of each frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from spadwarp.frames.file import SequenceFile
from spadwarp.viz.style import DEPTH_MAP, INTENSITY_MAP, colour_map, new_figure, paper

__all__ = ["moving_pictures"]

_DPI = 140


def moving_pictures(file: SequenceFile, most: int) -> Iterator[NDArray[np.uint8]]:
    """RGB pictures of evenly chosen frames, at most `most`; all have the same scales."""
    method = file.best_method
    chosen = range(0, file.frames, -(-file.frames // most))
    truth = [file.truth(number).depth for number in chosen]
    counts = [file.counts(number).sum(axis=-1, dtype=np.int64) for number in chosen]
    known = np.concatenate([image[np.isfinite(image)] for image in truth])
    near, far = np.percentile(known, (1, 99)) if known.size else (0.0, 1.0)
    margin = 0.1 * (far - near) + 0.05
    brightest = max(1.0, float(np.percentile(counts, 99.5)))
    figure, images, title = _figure(truth[0].shape, Normalize(near - margin, far + margin), brightest)
    canvas = FigureCanvasAgg(figure)
    for index, number in enumerate(chosen):
        measured = np.full(truth[index].shape, np.nan) if method is None else file.depth(method, number)
        for image, values in zip(images, (truth[index], measured, counts[index]), strict=True):
            image.set_data(values)
        title.set_text(f"frame {number}, {file.trajectory.times[number]:.4g} s")
        canvas.draw()
        if index == 0:
            figure.set_layout_engine("none")  # computed once, so that nothing moves between pictures
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


@paper()
def _figure(shape: tuple[int, ...], depth: Normalize, brightest: float) -> tuple[Figure, list[Any], Any]:
    """The figure of all pictures, with what changes between them."""
    height, width = shape[:2]
    image_height = float(np.clip(2.3 * height / width, 0.9, 4.5))
    figure = new_figure(7.2, image_height + 1.0)
    figure.set_dpi(_DPI)
    axes, bars = figure.subplots(2, 3, height_ratios=[image_height, 0.1])
    images = []
    counts = Normalize(0.0, brightest)
    kinds = (("true depth", depth, DEPTH_MAP), ("measured depth", depth, DEPTH_MAP), ("counts", counts, INTENSITY_MAP))
    for axis, bar, (name, scale, colours) in zip(axes, bars, kinds, strict=True):
        axis.set(xticks=[], yticks=[], title=name)
        images.append(axis.imshow(np.zeros((height, width)), cmap=colour_map(colours), norm=scale))
        label = "counts per pixel" if name == "counts" else "depth z [m]"
        figure.colorbar(images[-1], cax=bar, orientation="horizontal", label=label)
    return figure, images, figure.suptitle(" ")
