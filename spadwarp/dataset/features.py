"""Numbers of a histogram that stand for it: where it is highest, where else, how much."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.scene import Scene
from spadwarp.scene.sight import depth_from_time

__all__ = ["FEATURE_NAMES", "histogram_features"]

FEATURE_NAMES = ("peak_depth", "peak_counts", "second_depth", "second_counts", "first_depth", "mean_depth")
"""Channels of `histogram_features`."""


def histogram_features(counts: ArrayLike, scene: Scene) -> NDArray[np.float32]:
    """Features of a frame's histograms `[6, H, W]`, by `FEATURE_NAMES`.

    Planar depth [m] and counts of the window with most counts, as long as pulse and jitter together (FWHM); the same of
    the best window that does not overlap with it; depth of the first count, and of the mean of all counts. NaN where
    there are no counts.

    Args:
        counts: `[T, H, W]`.
        scene: Of the frame.
    """
    cube = np.asarray(counts, np.float64)
    bins, total = len(cube), cube.sum(axis=0)
    fwhm = np.hypot(scene.laser.pulse_fwhm_ps, scene.detector.jitter_fwhm_ps) * 1e-12
    width = int(np.clip(round(fwhm / scene.gate.bin_width), 1, bins))
    sums = np.concatenate([np.zeros((1, *total.shape)), np.cumsum(cube, axis=0)])
    windows = sums[width:] - sums[:-width]  # of the bins k to k + width - 1
    number = np.arange(bins)[:, None, None]

    def depth(bin: NDArray[np.float64]) -> NDArray[np.float64]:
        return depth_from_time(scene.gate.start + (bin + 0.5) * scene.gate.bin_width, scene=scene)

    def mean_bin(weight: NDArray[np.float64]) -> NDArray[np.float64]:
        amount = weight.sum(axis=0)
        return np.divide((weight * number).sum(axis=0), amount, out=np.full(total.shape, np.nan), where=amount > 0)

    features = []
    for _ in range(2):
        start = windows.argmax(axis=0)
        inside = (number >= start) & (number < start + width)
        features += [depth(mean_bin(np.where(inside, cube, 0.0))), np.where(inside, cube, 0.0).sum(axis=0)]
        windows = np.where(np.abs(number[: len(windows)] - start) >= width, windows, -1.0)
        cube = np.where(inside, 0.0, cube)
    cube = np.asarray(counts, np.float64)
    first = np.where(total > 0, (cube > 0).argmax(axis=0), np.nan)
    return np.stack([*features, depth(first), depth(mean_bin(cube))]).astype(np.float32)
