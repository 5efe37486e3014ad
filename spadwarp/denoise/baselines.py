"""Denoising without a network: filters of depth frames, and the names of the classical estimates from counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.frames import DepthFrames, fill_missing
from spadwarp.denoise.network_files import MODELS, weights_header
from spadwarp.io.paths import existing_file
from spadwarp.values import ArgumentError, FileError, SpadwarpError, check_choice

Frames = NDArray[np.float32]

MEDIAN_WINDOWS = (3, 5, 7, 9, 11)
"""Sides of the median's window that are tried [pixels]."""


def median_filter(frames: DepthFrames, *, window: int = 5) -> Frames:
    """Median of `window` × `window` pixels, `[N, H, W]` [m]; pixels without a depth take that of their nearest."""
    from scipy import ndimage

    filled = (fill_missing(depth, frames.gate_middle) for depth in frames.depth)
    return np.stack([ndimage.median_filter(image, window, mode="nearest") for image in filled])


def gated_filter(frames: DepthFrames) -> Frames:
    """Backscatter gating: keep depths where a frame has more of them than the water explains, `[N, H, W]` [m].

    The histogram of a frame's depths is compared with the backscatter's density, scaled to the depths in the nearest
    part of the gate that holds a tenth of that density. The target's gate is where 99 % of the significant excess lies;
    depths outside it are replaced by the nearest pixel inside, and a small median follows.
    """
    bins, out = 100, frames.depth.copy()
    for depth, scaled, density in zip(out, frames.scaled, frames.density, strict=True):
        valid = (scaled >= 0) & (scaled < 1)
        place = (scaled[valid] * bins).astype(np.int64)
        counts = np.bincount(place, minlength=bins).astype(np.float64)
        # Mean density of the depths in each bin; empty bins take that of the last one before.
        level = np.bincount(place, density[valid], minlength=bins) / np.maximum(counts, 1)
        filled = np.where(counts > 0, np.arange(bins), 0)
        level = np.maximum(level[np.maximum.accumulate(filled)], 1e-3)
        near = max(3, int(np.searchsorted(np.cumsum(level), 0.1 * level.sum())))
        expected = level * (counts[:near].sum() / level[:near].sum())
        excess = np.maximum(counts - expected - 4.0 * np.sqrt(expected) - 4.0, 0.0)
        if excess.any():
            within = np.cumsum(excess) / excess.sum()
            first, last = np.searchsorted(within, (0.005, 0.995))
            depth[(scaled < (first - 1) / bins) | (scaled > (last + 2) / bins)] = np.nan
    return median_filter(replace(frames, depth=out), window=3)


def bm3d_filter(frames: DepthFrames) -> Frames:
    """BM3D by the package `bmnd`, with a noise deviation σ taken from each frame, `[N, H, W]` [m].

    Dabov et al., IEEE TIP 16, 2080 (2007). σ is the root mean square of the differences from the 5 × 5 median: that of
    white noise with the power of what is to be removed. Takes seconds to a minute a frame.

    Raises `SpadwarpError` where `bmnd` is not installed.
    """
    try:
        from bmnd import BM3DProfile, bmnd
    except ModuleNotFoundError as error:
        raise SpadwarpError("bm3d needs the package bmnd: pip install 'spadwarp[bm3d]'") from error

    start, stop = frames.gate
    out = np.empty_like(frames.depth)
    for index, (depth, smooth) in enumerate(zip(frames.depth, median_filter(frames), strict=True)):
        image = (fill_missing(depth, frames.gate_middle) - start) / (stop - start)
        sigma = float(np.sqrt(np.mean((image - (smooth - start) / (stop - start)) ** 2)))
        if sigma > 1e-4:
            image = np.asarray(bmnd(image.astype(np.float32), BM3DProfile(), sigma=sigma), np.float32)
        out[index] = start + (stop - start) * image
    return out


BASELINES: dict[str, Callable[[DepthFrames], Frames]] = {
    "input": lambda frames: np.nan_to_num(frames.depth, nan=frames.gate_middle),
    "median": median_filter,
    "gating": gated_filter,
    "bm3d": bm3d_filter,
}
"""Baselines by name."""


# Names of the methods that estimate depth from counts, and of all.

Classical = Literal["likelihood", "pooled", "semi-global", "total-variation", "belief-propagation"]

CLASSICAL: tuple[Classical, ...] = get_args(Classical)
"""Classical estimates from histograms."""

METHODS = (*MODELS, *(name for name in BASELINES if name != "input"), *CLASSICAL)
"""Models of `spadwarp.denoise.estimate`."""

FROM_COUNTS = ("histograms", *CLASSICAL)
"""Those that use counts."""


def compared(models: Sequence[str], weights: str | Path | None, *, counts: bool = False) -> dict[str, dict[str, Any]]:
    """`model` and `weights` of each method of a comparison, by its name, the input first; of own weights it is "own".

    Raises `ArgumentError`: no such method; one, or weights, of histograms where there are no `counts`.
    """
    for name in models:
        if name in FROM_COUNTS and not counts:
            problem = "needs histograms with their background; evaluate a Monte Carlo result, which has them"
            raise ArgumentError(f"models: {name!r} {problem}")
        check_choice("models", name, [one for one in METHODS if counts or one not in FROM_COUNTS])
    methods: dict[str, dict[str, Any]] = {name: {"model": name, "weights": None} for name in ("input", *models)}
    if weights is None:
        return methods
    model = weights_header(existing_file(weights)).get("model")
    if model not in MODELS:
        raise FileError(f"{weights}: not weights of spadwarp train: its header names no network")
    if model == "histograms" and not counts:
        raise ArgumentError(f"weights = '{weights}' are of the network for histograms; evaluate a result with them")
    return methods | {"own": {"model": model, "weights": Path(weights)}}
