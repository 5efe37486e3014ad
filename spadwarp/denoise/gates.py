"""The part of a gate that holds the target: networks are more accurate in a gate that is not much wider than that."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["bins_of_target", "gate_of_target"]

_BINS = 20  # into which a gate is divided
_NEAR = 0.01  # part of the gate within which two depths agree
_AGREEING = 4  # of the 24 pixels around a pixel
_ROUNDS = 3
_KEPT = 0.7  # a gate is narrowed only to less than this part of its width


def gate_of_target(
    depth: NDArray[np.float32], density: NDArray[np.float32], gate: tuple[float, float]
) -> tuple[float, float]:
    """The part of the gate in which depths agree with those around them more often than backscatter would.

    Args:
        depth: One frame `[H, W]` [m], NaN where nothing was reported.
        density: Of the backscatter at these depths, relative to a flat one over the gate, `[H, W]`.
        gate: (start, stop) [m].

    Returns:
        (start, stop) [m], with a margin; the whole gate where nothing agrees, or where little would be gained.
    """
    found = gate
    for _ in range(_ROUNDS):
        start, stop = found
        scale = (stop - start) / (gate[1] - gate[0])
        narrower = _narrowed((depth - start) / (stop - start), density * scale)
        if narrower[1] - narrower[0] >= _KEPT:
            break
        found = start + narrower[0] * (stop - start), start + narrower[1] * (stop - start)
    return found


def _narrowed(scaled: NDArray[np.float32], density: NDArray[np.float32]) -> tuple[float, float]:
    """(start, stop) as parts of the gate."""
    from scipy.special import bdtrc

    with np.errstate(invalid="ignore"):
        reported = (scaled >= 0.0) & (scaled < 1.0)
    if reported.sum() < 50:
        return 0.0, 1.0
    values = np.where(reported, scaled, np.float32(np.nan))
    agreeing = np.zeros(scaled.shape, np.uint8)
    height, width = scaled.shape
    for down, right in [(0, 1), (0, 2), *((y, x) for y in (1, 2) for x in range(-2, 3))]:
        one = np.s_[: height - down, max(0, -right) : width - max(0, right)]
        other = np.s_[down:, max(0, right) : width - max(0, -right)]
        with np.errstate(invalid="ignore"):
            near = np.abs(values[one] - values[other]) < _NEAR
        agreeing[one] += near
        agreeing[other] += near
    place = (scaled[reported] * _BINS).astype(np.int64)
    observed = np.bincount(place[agreeing[reported] >= _AGREEING], minlength=_BINS)
    # Backscatter of this density, in as many pixels as report, agrees by chance.
    chance = np.clip(2.0 * _NEAR * density[reported] * reported.mean(), 0.0, 1.0)
    by_bin = np.bincount(place, chance, minlength=_BINS) / np.maximum(np.bincount(place, minlength=_BINS), 1)
    expected = np.bincount(place, minlength=_BINS) * bdtrc(_AGREEING - 1, 24, by_bin)
    significant = np.flatnonzero(observed > expected + 4.0 * np.sqrt(expected) + 6.0)
    if len(significant) == 0:
        return 0.0, 1.0
    return max(0.0, (significant[0] - 1.5) / _BINS), min(1.0, (significant[-1] + 2.5) / _BINS)


def bins_of_target(
    counts: NDArray[np.float32], background: NDArray[np.float32], response: NDArray[np.float32]
) -> tuple[int, int]:
    """(first, stop) of the bins that hold the excess of all pixels together over the background.

    Args:
        counts: `[..., T]`.
        background: Expected counts of a pixel, `[T]`, or of each, `[..., T]`.
        response: Instrument response per bin `[2 r + 1]`.

    Returns:
        With a margin; (0, T) where little would be gained, or where the excess is not significant.
    """
    bins = counts.shape[-1]
    total = counts.reshape(-1, bins).sum(axis=0, dtype=np.float64)
    pixels = counts.size // bins
    level = np.asarray(background, np.float64).reshape(-1, bins)
    level = level.mean(axis=0) * pixels
    window = np.ones(max(len(response), bins // 64) | 1)
    excess = np.convolve(total - level, window, mode="same")
    spread = np.sqrt(np.convolve(np.maximum(level, 1.0), window, mode="same"))
    significant = np.flatnonzero(excess > 5.0 * spread)
    if len(significant) == 0:
        return 0, bins
    first, stop = int(significant[0]), int(significant[-1]) + 1
    beyond = (total - level)[: max(0, first)].sum() + (total - level)[stop:].sum()
    if beyond > 0.02 * (total - level)[first:stop].sum() + 3.0 * np.sqrt(level.sum()):
        return 0, bins
    margin = len(window) + (stop - first) // 8
    first, stop = max(0, first - margin), min(bins, stop + margin)
    return (first, stop) if stop - first < _KEPT * bins else (0, bins)
