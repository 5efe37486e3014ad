"""Counts as the network for histograms and the classical estimates take them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import on_host, real_array
from spadwarp.denoise.frames import POOLED, SIDES
from spadwarp.denoise.gates import bins_of_target
from spadwarp.denoise.network_files import require_torch, torch_device
from spadwarp.frames.measured import Histograms
from spadwarp.values import ArgumentError, percent

__all__ = ["checked_histograms", "dim_pixels", "features_of_histograms", "histogram_tensors", "target_bins"]


def features_of_histograms(
    counts: ArrayLike,
    *,
    background: ArrayLike,
    response: ArrayLike,
    device: str | None = None,
    total: ArrayLike | None = None,
    to_depth: Callable[[NDArray[np.float32]], NDArray[Any]] | None = None,
) -> NDArray[np.float32]:
    """Features of histograms over the gate, as `spadwarp.denoise.histogram_features` makes them, frame by frame.

    Args:
        counts: `[H, W, T]` or `[N, H, W, T]`, not negative.
        background: Expected background counts, the same for all pixels `[T]`, or of each pixel `[H, W, T]`.
        response: Instrument response per bin centred on its time zero, `[2 r + 1]`.
        device: torch device.
        total: Counts of each pixel, also beyond the bins given here, `[H, W]` or `[N, H, W]`.
        to_depth: Converts parts of the gate `[N, n, H, W]` to depths [m].

    Returns:
        float32 `[N, FEATURES, H, W]`; first the pooled depths, as parts of the gate where `to_depth` is not given.

    Raises:
        ArgumentError: Shapes or values that cannot be.
    """
    torch = require_torch()
    from spadwarp.denoise.histogram_features import extract_features

    with torch.inference_mode():
        parts = histogram_tensors(counts, background, response, device)
        images = None if total is None else np.asarray(total, np.float32).reshape(-1, *np.shape(counts)[-3:-1])
        found = []
        for number, part in enumerate(parts):
            image = None if images is None else torch.from_numpy(images[number : number + 1]).to(part[0].device)
            found.append(extract_features(*part, image).cpu().numpy())
        features = np.concatenate(found)
    if to_depth is not None:
        for channels in (slice(0, POOLED), slice(-SIDES, None)):
            features[:, channels] = to_depth(features[:, channels])
    return features


def histogram_tensors(
    counts: ArrayLike, background: ArrayLike, response: ArrayLike, device: str | None
) -> Iterator[tuple[Any, Any, Any]]:
    """Counts `[1, H, W, T]`, background and response of each frame as `extract_features` takes them.

    Arguments and errors are those of `features_of_histograms`.
    """
    torch = require_torch()
    cubes, levels, taps = checked_histograms(counts, background, response)
    place = torch_device(device)
    tap = torch.from_numpy((taps / taps.sum())[None]).to(place)
    level = torch.from_numpy(levels if levels.ndim == 3 else levels[None, None])[None].to(place)
    level = level.clamp_min(1e-6 * float(level.mean()) + 1e-9)
    for cube in cubes.reshape(-1, *cubes.shape[-3:]):
        yield torch.from_numpy(cube.astype(np.float32)[None]).to(place), level, tap


def checked_histograms(
    counts: ArrayLike, background: ArrayLike, response: ArrayLike
) -> tuple[NDArray[Any], NDArray[np.float32], NDArray[np.float32]]:
    """Counts, background and response as arrays. Arguments and errors are those of `features_of_histograms`."""
    cubes = np.asarray(on_host(counts))
    if cubes.ndim not in (3, 4) or cubes.dtype.kind not in "biuf" or cubes.size == 0:
        raise ArgumentError(f"counts are {cubes.dtype} {cubes.shape}; numbers [H, W, T] or [N, H, W, T] are needed")
    low, high = cubes.min(), cubes.max()
    if not (low >= 0 and high < np.inf):
        raise ArgumentError(f"counts = {low} … {high} are outside [0, inf)")
    levels, taps = real_array("background", background), real_array("response", response)
    one, each = cubes.shape[-1:], cubes.shape[-3:]
    if levels.shape not in (one, each) or not (np.isfinite(levels).all() and (levels >= 0).all()):
        raise ArgumentError(f"background has shape {levels.shape}; {one} or {each} is needed, of numbers >= 0")
    if taps.ndim != 1 or taps.size % 2 == 0 or not (np.isfinite(taps).all() and taps.sum() > 0):
        raise ArgumentError(f"response has shape {taps.shape}; an odd number of values centred on time zero is needed")
    return cubes, levels, taps


def target_bins(
    counts: NDArray[Any], background: NDArray[Any], response: NDArray[Any], gate: tuple[float, float]
) -> tuple[int, int, tuple[float, float]]:
    """First and last bin of the part of the gate that holds the target, and that part in depth [m]."""
    cubes, levels, taps = checked_histograms(counts, background, response)
    first, stop = bins_of_target(cubes, levels, taps)
    width = (gate[1] - gate[0]) / cubes.shape[-1]
    return first, stop, (gate[0] + first * width, gate[0] + stop * width)


def dim_pixels(histograms: Histograms) -> list[str]:
    """A note where pixels of expected histograms receive little light, but more than backscatter; none below 1 %.

    Expected light has no threshold: a pixel beside a target has the depth of the little light that water scattered into
    it, as smooth as that of the target, where a camera would report nothing.
    """
    values, known = histograms.values, histograms.background_per_bin
    signal, background = values.sum(axis=-1, dtype=np.float64), np.zeros(())
    if known is not None:
        background = known.sum(axis=-1, dtype=np.float64)
        signal = signal - background
    dim = float(((signal < 0.05 * np.quantile(signal, 0.9)) & (signal > background)).mean())
    if dim < 0.01:
        return []
    return [
        f"{percent(dim)} % of the pixels receive less than 5 % of the light of the bright ones: a depth there may be "
        "that of light scattered from beside, and count as a target; spadwarp detect draws the counts of a camera"
    ]
