"""Histograms from time tags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, FileError

__all__ = ["histogram_of_tags", "most_values"]

_MOST_BINS = 1_000_000  # as of a scene's gate
_MOST_VALUES = 1 << 29  # 2 GiB of counts


def histogram_of_tags(
    cells: NDArray[Any], *, unit: float, bin_width: float | None
) -> tuple[NDArray[np.int32], float, int]:
    """Counts from the tags of each pixel, from the first tag of the image to the last.

    Args:
        cells: Object array `[H, W]` of arrays of whole numbers of the unit.
        unit: Of the tags [s].
        bin_width: Of the histogram [s], a multiple of the unit; None: the unit.

    Returns:
        Counts `[H, W, T]`, the bins' width [s], the tag at which bin 0 begins.

    Raises:
        ArgumentError: A width that is no multiple of the unit, or more bins than can be held.
        FileError: Tags that are not whole numbers, or none at all.
    """
    width = unit if bin_width is None else bin_width
    step = round(width / unit)
    if step < 1 or abs(step * unit - width) > 1e-6 * width:
        raise ArgumentError(f"bin width = {width * 1e12:g} ps is not a multiple of the tags' unit, {unit * 1e12:g} ps")
    sizes = np.array([cell.size for cell in cells.flat])
    if not sizes.any():
        raise FileError("no pixel has a time tag")
    tags = np.concatenate([cell for cell in cells.flat if cell.size])
    if tags.dtype.kind == "f":
        if not (np.isfinite(tags).all() and (tags == np.rint(tags)).all() and np.abs(tags).max() < 2**53):
            raise FileError("time tags are not all whole numbers")
    elif tags.dtype.kind not in "iu":
        raise FileError(f"time tags are {tags.dtype}, not whole numbers")
    if not -(2**62) < int(tags.min()) <= int(tags.max()) < 2**62:
        raise FileError(f"time tags from {tags.min()} to {tags.max()} are beyond 2^62")
    tags = tags.astype(np.int64)
    first = int(tags.min()) // step * step
    bins = (int(tags.max()) - first) // step + 1
    wider = f"a wider bin than {step * unit * 1e12:g} ps (bin_width)"
    if bins > _MOST_BINS:
        raise ArgumentError(
            f"time tags from {tags.min()} to {tags.max()} are {bins} bins, more than {_MOST_BINS}; {wider} would help,"
            " unless a tag is wrong"
        )
    most_values((*cells.shape, bins), wider)
    counts = np.zeros(cells.size * bins, np.int32)
    np.add.at(counts, np.repeat(np.arange(cells.size), sizes) * bins + (tags - first) // step, 1)
    return counts.reshape(*cells.shape, bins), step * unit, first


def most_values(shape: Sequence[int], instead: str) -> None:
    """Refuses histograms that would not fit: `ArgumentError` that says what would help."""
    if math.prod(shape) > _MOST_VALUES:
        sizes = " x ".join(map(str, shape))
        raise ArgumentError(f"{sizes} counts are more than {_MOST_VALUES}, which can be held; {instead} would help")
