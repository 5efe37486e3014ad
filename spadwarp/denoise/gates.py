"""The part of a gate that holds the target: networks are more accurate in a gate that is not much wider than that."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.frames import LOG_DENSITY_LIMIT, MARGIN

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["bins_of_target", "gates_of_target", "narrowed_input"]

_BINS = 20  # into which a gate is divided
_NEAR = 0.01  # part of the gate within which two depths agree
_NEAR_SQUARE = float(np.float32(_NEAR) ** 2)  # in float32, whose squares tell all numbers about _NEAR apart
_AGREEING = 4  # of the 24 pixels around a pixel
_ROUNDS = 3
_KEPT = 0.7  # a gate is narrowed only to less than this part of its width


def gates_of_target(depth: Tensor, density: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The part of the gate in which depths agree with those around them more often than backscatter would.

    Args:
        depth: Frames of depth over the gate, NaN where nothing was reported, `[N, H, W]`.
        density: Of the backscatter at these depths, relative to a flat one over the gate, `[N, H, W]`.

    Returns:
        Its start and its width, with a margin, in widths of the gate, each `[N]`; 0 and 1, the whole gate, where
        nothing agrees, or where little would be gained. And the largest part of the frame that a target can take,
        `[N]`: 1, unless depths agree only as often as those of backscatter would by chance, and more would be noticed.
    """
    import torch

    start, width = depth.new_zeros(len(depth)), depth.new_ones(len(depth))
    frames = torch.arange(len(depth), device=depth.device)
    part = torch.ones_like(start)
    for turn in range(_ROUNDS):
        begin, extent = start[frames], width[frames]
        scaled = (depth - begin[:, None, None]) / extent[:, None, None]
        low, high, most = _narrowed(scaled, density * extent[:, None, None])
        part = most if turn == 0 else part  # by the whole gate
        narrower = high - low < _KEPT
        start[frames] = torch.where(narrower, begin + low * extent, begin)
        width[frames] = torch.where(narrower, (high - low) * extent, extent)
        frames, depth, density = (values[narrower] for values in (frames, depth, density))
        if len(frames) == 0:
            break
    return start, width, part


def narrowed_input(depth: Tensor, density: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Input of PyramidNet `[N, 3, H, W]` over the part of the gate that holds the target, and what `gates_of_target`
    returns, with the same arguments. Depths beyond `MARGIN` around that part count as not reported."""
    import torch

    start, width, part = gates_of_target(depth, density)
    scaled = (depth - start[:, None, None]) / width[:, None, None]
    reported = (scaled >= -MARGIN) & (scaled <= 1.0 + MARGIN)
    log_density = density.log().clamp(-LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT)
    channels = torch.where(reported, scaled, 1.0), reported.to(scaled.dtype), torch.where(reported, log_density, 0.0)
    return torch.stack(channels, dim=1), start, width, part


def _narrowed(scaled: Tensor, density: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Start and stop as parts of the gate, and the largest part of the frame that a target can take, `[N]`."""
    import torch

    reported = (scaled >= 0.0) & (scaled < 1.0)
    share = reported.flatten(1).float().mean(dim=1)
    agreeing = _agreeing(torch.where(reported, scaled, torch.nan))
    # Backscatter of this density, in as many pixels as report, agrees by chance.
    chance = (2.0 * _NEAR * share[:, None, None] * density).clamp(0.0, 1.0)
    place = torch.where(reported, scaled * _BINS, _BINS).long()
    one = torch.ones((), device=scaled.device)
    pixels, by_chance, observed = (_sums(each, place) for each in (one, chance, (agreeing >= _AGREEING).float()))
    part = by_chance / pixels.clamp_min(1.0)
    fewer = sum(math.comb(24, n) * part**n * (1.0 - part) ** (24 - n) for n in range(_AGREEING))
    expected = pixels * (1.0 - fewer)
    significant = observed > expected + 4.0 * expected.clamp_min(0.0).sqrt() + 6.0
    found = significant.any(dim=1) & (reported.flatten(1).sum(dim=1) >= 50)
    first, last = significant.int().argmax(dim=1), _BINS - 1 - significant.int().flip(1).argmax(dim=1)
    low, high = ((first - 1.5) / _BINS).clamp_min(0.0), ((last + 2.5) / _BINS).clamp_max(1.0)
    # Pairs of pixels within two of each other, those that chance makes agree, and how many more would be noticed.
    rows, columns = scaled.shape[1:]
    around = ((y, x) for y in range(-2, 3) for x in range(-2, 3) if (y, x) != (0, 0))
    pairs = sum(max(0, rows - abs(y)) * max(0, columns - abs(x)) for y, x in around)
    expected = by_chance.sum(dim=1) * (pairs / (rows * columns))
    noticed = 4.0 * (2.0 * expected).sqrt() + 12.0
    agrees = agreeing.flatten(1).sum(dim=1) > expected + noticed
    most = torch.where(agrees, 1.0, (noticed / (pairs * share.square() + 1.0)).clamp_max(1.0))
    return torch.where(found, low, 0.0), torch.where(found, high, 1.0), most.to(scaled.dtype)


def _agreeing(values: Tensor) -> Tensor:
    """How many of the 24 pixels around each pixel agree with it, uint8 `[N, H, W]`; none where either is NaN."""
    import torch
    import torch.nn.functional as F

    # With two missing pixels after each row, and two such rows after each frame, all are one line in which a neighbour
    # is a fixed number of places away. Pieces of a line take a GPU half the time of parts cut out of images.
    padded = F.pad(values, (0, 2, 0, 2), value=torch.nan)
    line, row = padded.flatten(), padded.shape[2]
    agreeing = torch.zeros_like(line, dtype=torch.uint8)
    for apart in (1, 2, *(row * down + right for down in (1, 2) for right in range(-2, 3))):
        # A square is one pass over memory less than a difference and its absolute value; this one is exact.
        near = (F.mse_loss(line[:-apart], line[apart:], reduction="none") < _NEAR_SQUARE).view(torch.uint8)
        agreeing[:-apart] += near
        agreeing[apart:] += near
    return agreeing.view_as(padded)[:, : values.shape[1], : values.shape[2]]


def _sums(values: Tensor, place: Tensor) -> Tensor:
    """Sums `[N, _BINS]`, float64, of values `[N, H, W]`, or one value, by the bin of each pixel; `_BINS` is in none.

    Column by column, and then of all columns: on a GPU, sums by index into few places wait for each other, and those
    of neighbouring pixels into neighbouring places do not.
    """
    frames, rows, columns = place.shape
    sums = values.new_zeros(frames, _BINS + 1, columns)
    sums.scatter_add_(1, place, values.expand(frames, rows, columns))
    return sums[:, :_BINS].sum(dim=2).double()


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
