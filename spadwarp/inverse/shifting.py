"""Histograms whose time axis each pixel shifts by a part of a bin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["shifted"]


def shifted(rows: NDArray[np.float32], delay: NDArray[np.float64]) -> NDArray[np.float32]:
    """Rows `[pixel, bin]` later by `delay` `[pixel]` bins, by a cubic through four bins (Lagrange); 0 comes in.

    For histograms that the instrument response has smoothed: of a Gaussian with a standard deviation of 1.5 bins, the
    largest error is 1 % of its height; sum and centroid are exact.
    """
    if not delay.any():
        return rows
    whole = np.floor(delay).astype(np.int64)
    x = (delay - whole)[:, None]
    # Of the values in bins k − whole + 1, + 0, − 1, − 2, for the place x bins before k − whole.
    weights = (
        x * (x - 1) * (x - 2) / -6.0,
        (x + 1) * (x - 1) * (x - 2) / 2.0,
        (x + 1) * x * (x - 2) / -2.0,
        (x + 1) * x * (x - 1) / 6.0,
    )
    bins = np.arange(rows.shape[1])
    result = np.zeros_like(rows)
    for offset, weight in zip((1, 0, -1, -2), weights, strict=True):
        source = bins - whole[:, None] + offset
        inside = (source >= 0) & (source < rows.shape[1])
        taken = np.take_along_axis(rows, np.clip(source, 0, rows.shape[1] - 1), axis=1)
        result += np.where(inside, taken, 0.0) * weight.astype(np.float32)
    return result
