"""Depth frames as denoisers take them: over a gate, or the part of it that holds the target, with what is known of
the water."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import on_host, real_array
from spadwarp.values import ArgumentError, check_real, shown

if TYPE_CHECKING:
    from torch import Tensor

LOG_DENSITY_LIMIT = 4.0
"""The logarithm of a backscatter density is clipped at ± this."""

MARGIN = 0.25
"""Depths this part of the gate's width before or behind it are still taken: a gate in range is not one in depth."""

SMALLEST_SIDE = 8
"""Fewest rows or columns of a frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthFrames:
    """Depth frames `[N, H, W]` with their gate, and what is known of the water."""

    depth: NDArray[np.float32]  # [m]; NaN where nothing was reported, or nothing near the gate
    gate: tuple[float, float]  # start and stop in depth [m]
    density: NDArray[np.float32]  # of the water's backscatter at each depth, relative to a flat one; 1 if not known

    @property
    def gate_middle(self) -> float:
        """Depth in the middle of the gate [m], which stands for a depth that is not known."""
        return 0.5 * sum(self.gate)

    @property
    def scaled(self) -> NDArray[np.float32]:
        """Depth over the gate, 0 at its start and 1 at its end; NaN as in `depth`."""
        start, stop = self.gate
        return ((self.depth - start) / (stop - start)).astype(np.float32)

    def filled(self) -> NDArray[np.float32]:
        """`scaled` for a network that does not see which pixels reported; 1 where a depth is still missing.

        Missing ones get the nearest depth where those around them report nearly as often as elsewhere.
        """
        images = map(_filled, self.scaled, self.density)
        return np.stack([np.nan_to_num(image, nan=1.0) for image in images])


def checked_gate(gate: tuple[float, float]) -> tuple[float, float]:
    """(start, stop) [m] of a gate that has a width. Raises `ArgumentError`."""
    if not (isinstance(gate, tuple | list) and len(gate) == 2):
        raise ArgumentError(f"gate = {shown(gate)} is not (start, stop) [m]")
    start, stop = (check_real("gate", one, "[0, 1e6] m") for one in gate)
    if not start < stop:
        raise ArgumentError(f"gate = ({start}, {stop}) m is not (start, stop) with start < stop")
    return start, stop


def depth_values(depth: ArrayLike) -> NDArray[np.float32]:
    """Depth as float32, NaN where a masked array is masked. Raises `ArgumentError` for what is no array of numbers."""
    values = np.ma.asanyarray(on_host(depth))
    if values.dtype.kind not in "iuf":
        raise ArgumentError(f"depth is {values.dtype} {values.shape}; real numbers [H, W] or [N, H, W] are needed")
    return np.asarray(values.astype(np.float32).filled(np.nan))


def depth_frames(
    depth: ArrayLike,
    *,
    gate: tuple[float, float],
    profile: ArrayLike | None = None,
    density: ArrayLike | None = None,
) -> DepthFrames:
    """Checks depth `[H, W]` or `[N, H, W]` [m] and brings it into the form that denoisers take.

    NaN, 0 and infinity mean that nothing was reported. Depths farther than `MARGIN` outside the gate count as not
    reported, with a warning that gives their number. `profile`: backscatter over the gate in any number of equal bins,
    in any unit; or its `density` [1/m] at each depth, of `depth`'s shape, NaN where it is not known. Raises
    `ArgumentError`.
    """
    values = depth_values(depth)
    if values.ndim not in (2, 3):
        raise ArgumentError(f"depth has shape {values.shape}; [H, W] or [N, H, W] is needed")
    values = values if values.ndim == 3 else values[None]
    if min(values.shape[1:]) < SMALLEST_SIDE or len(values) == 0:
        raise ArgumentError(
            f"depth is {len(values)} frames of {values.shape[1]} x {values.shape[2]} pixels; at least one frame of "
            f"{SMALLEST_SIDE} x {SMALLEST_SIDE} pixels is needed"
        )
    start, stop = checked_gate(gate)
    if (values[np.isfinite(values)] < 0).any():
        raise ArgumentError(f"depth {np.nanmin(values)} m is outside [0, inf) m")
    present = np.isfinite(values) & (values > 0)
    slack = MARGIN * (stop - start)
    outside = present & ~((values >= start - slack) & (values <= stop + slack))
    if outside.any():
        warnings.warn(
            f"{outside.sum()} of {present.sum()} depths lie outside the gate of {start:g} to {stop:g} m and count as "
            "not reported",
            stacklevel=2,
        )
    values = np.where(present & ~outside, values, np.float32(np.nan))
    relative = np.ones_like(values)
    if density is not None:
        given = np.asarray(density, np.float32).reshape(-1, *values.shape[1:])
        if given.shape != values.shape or (given < 0).any():
            raise ArgumentError(f"density has shape {np.shape(density)}; {values.shape} is needed, of numbers >= 0")
        relative = np.nan_to_num(given * np.float32(stop - start), nan=1.0)
    elif profile is not None:
        bins = real_array("profile", profile, np.float64)
        if bins.ndim != 1 or not (np.isfinite(bins).all() and (bins >= 0).all() and bins.sum() > 0):
            raise ArgumentError(f"profile has shape {bins.shape}; [bins] of numbers >= 0, not all 0, is needed")
        index = np.nan_to_num((values - start) / (stop - start)) * bins.size
        relative = (bins / bins.mean())[np.clip(index.astype(np.int64), 0, bins.size - 1)].astype(np.float32)
    return DepthFrames(depth=values, gate=(start, stop), density=relative)


def _filled(depth: NDArray[np.float32], density: NDArray[np.float32]) -> NDArray[np.float32]:
    """A frame `[H, W]` of depth over the gate with missing pixels filled from the nearest, as far as they may be.

    Beside a target, where backscatter alone is reported, pixels report less often than on it, and must not be filled.
    So a missing pixel is filled only where, of the pixels in a window around it, at least half as many report as in the
    window that holds the most. The window has 15 × 15 pixels, or as many as hold 64 reports. No pixel is filled
    unless successive depths agree more often than backscatter would.
    """
    from scipy.ndimage import uniform_filter

    reported = ~np.isnan(depth)
    agreeing = np.count_nonzero(np.abs(np.diff(depth[reported])) < 0.01)
    by_chance = np.minimum(0.02 * density[reported], 1.0).sum()
    if agreeing <= 1.3 * by_chance + 10:
        return depth
    side = 2 * round(max(7.0, 4.0 / math.sqrt(max(reported.mean(), 1e-4)))) + 1
    frequency = uniform_filter(reported.astype(np.float32), side, mode="constant")
    inside = uniform_filter(np.ones_like(frequency), side, mode="constant")  # part of the window within the image
    return np.where(frequency >= 0.5 * frequency.max() * inside, fill_missing(depth, 1.0), depth)


def fill_missing(image: NDArray[np.float32], otherwise: float) -> NDArray[np.float32]:
    """An image `[H, W]` with each NaN replaced by its nearest number, or all by `otherwise` where there is none."""
    missing = np.isnan(image)
    if missing.all():
        return np.full_like(image, otherwise)
    return image[tuple(nearest(missing))] if missing.any() else image


def nearest(missing: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Of each element, the indices of the nearest that is not missing, `[dimensions, …]`."""
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(missing, return_distances=False, return_indices=True))


# The part of a gate that holds the target: networks are more accurate in a gate that is not much wider than that.

_BINS = 200  # into which a gate is divided
_NEAR = (0.01, 0.04)  # parts of the gate within which two depths agree, on flat surfaces and on steep ones
_AGREEING = 4  # of the 24 pixels around a pixel
_CLUSTER = 5  # pixels that agree by chance agree together
_KEPT = 0.7  # a gate is narrowed only to less than this part of its width


def gates_of_target(depth: Tensor, density: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The part of the gate outside which depths agree with those around them no more often than backscatter would.

    Of depth over the gate, NaN where nothing was reported, and the density of backscatter there, each `[N, H, W]`: its
    start and width, with a margin, each `[N]`; 0 and 1, the whole gate, where nothing agrees, or where little would be
    gained. And the largest part of the frame that a target can take, `[N]`: 1, unless depths agree only as often as
    those of backscatter would by chance, and more would be noticed.
    """
    import torch
    import torch.nn.functional as F

    reported = (depth >= 0.0) & (depth < 1.0)
    inside = torch.where(reported, depth, torch.nan)
    share = reported.flatten(1).float().mean(dim=1)
    place = torch.where(reported, depth * _BINS, _BINS).long()
    one = torch.ones((), device=depth.device)
    pixels = _sums(one, place)

    def unnoticed(observed: Tensor, expected: Tensor) -> Tensor:
        """How many bins there are before the first that begin an excess, `[N]`: a cumulative sum with resets."""
        total = F.pad(expected.cumsum(1), (1, 0))
        excess = F.pad((observed - 1.1 * expected).cumsum(1), (1, 0))
        least, before = excess.cummin(1)
        deviation = (_CLUSTER * (total - total.gather(1, before))).clamp_min(0.0).sqrt()
        noticed = excess - least > 2.0 * deviation + 2.0
        begin = before.gather(1, noticed.int().argmax(dim=1, keepdim=True))[:, 0]
        return torch.where(noticed.any(dim=1), begin, _BINS)

    first, stop = (torch.full_like(share, bin) for bin in (_BINS, 0))
    for near in _NEAR[::-1]:
        agreeing = _agreeing(inside, near)
        # Backscatter of this density, in as many pixels as report, agrees by chance.
        chance = (2.0 * near * share[:, None, None] * density).clamp(0.0, 1.0)
        by_chance, observed = (_sums(each, place) for each in (chance, (agreeing >= _AGREEING).float()))
        part = by_chance / pixels.clamp_min(1.0)
        fewer = sum(math.comb(24, n) * part**n * (1.0 - part) ** (24 - n) for n in range(_AGREEING))
        expected = (pixels * (1.0 - fewer)).clamp_min(0.0)
        total = expected.sum(dim=1)
        found = observed.sum(dim=1) > total + 4.0 * total.sqrt() + 6.0  # of the last, where chance makes fewer agree
        first = torch.minimum(first, unnoticed(observed, expected))
        stop = torch.maximum(stop, _BINS - unnoticed(observed.flip(1), expected.flip(1)))
    margin = 2.0 + 0.1 * (stop - first)
    low, high = ((first - margin) / _BINS).clamp_min(0.0), ((stop + margin) / _BINS).clamp_max(1.0)
    narrower = found & (reported.flatten(1).sum(dim=1) >= 50) & (stop > first) & (high - low < _KEPT)
    start, width = torch.where(narrower, low, 0.0), torch.where(narrower, high - low, 1.0)
    # Pairs of pixels within two of each other, those that chance makes agree, and how many more would be noticed.
    rows, columns = depth.shape[1:]
    around = ((y, x) for y in range(-2, 3) for x in range(-2, 3) if (y, x) != (0, 0))
    pairs = sum(max(0, rows - abs(y)) * max(0, columns - abs(x)) for y, x in around)
    by_chance = by_chance.sum(dim=1) * (pairs / (rows * columns))
    noticed = 4.0 * (2.0 * by_chance).sqrt() + 12.0
    agrees = agreeing.flatten(1).sum(dim=1) > by_chance + noticed
    most = torch.where(agrees, 1.0, (noticed / (pairs * share.square() + 1.0)).clamp_max(1.0))
    return start.to(depth.dtype), width.to(depth.dtype), most.to(depth.dtype)


def narrowed_input(depth: Tensor, density: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Input of PyramidNet `[N, 3, H, W]` over `gates_of_target`, without what is beyond their `MARGIN`; its output."""
    import torch

    start, width, part = gates_of_target(depth, density)
    scaled = (depth - start[:, None, None]) / width[:, None, None]
    reported = (scaled >= -MARGIN) & (scaled <= 1.0 + MARGIN)
    log_density = density.log().clamp(-LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT)
    channels = torch.where(reported, scaled, 1.0), reported.to(scaled.dtype), torch.where(reported, log_density, 0.0)
    return torch.stack(channels, dim=1), start, width, part


def _agreeing(values: Tensor, near: float) -> Tensor:
    """How many of the 24 pixels around each pixel are as `near` to it, uint8 `[N, H, W]`; none where either is NaN."""
    import torch
    import torch.nn.functional as F

    # With two missing pixels after each row, and two such rows after each frame, all are one line in which a neighbour
    # is a fixed number of places away. Pieces of a line take a GPU half the time of parts cut out of images.
    padded = F.pad(values, (0, 2, 0, 2), value=torch.nan)
    line, row = padded.flatten(), padded.shape[2]
    agreeing = torch.zeros_like(line, dtype=torch.uint8)
    near_square = float(np.float32(near) ** 2)  # in float32, whose squares tell all numbers about `near` apart
    for apart in (1, 2, *(row * down + right for down in (1, 2) for right in range(-2, 3))):
        # A square is one pass over memory less than a difference and its absolute value; this one is exact.
        agree = (F.mse_loss(line[:-apart], line[apart:], reduction="none") < near_square).view(torch.uint8)
        agreeing[:-apart] += agree
        agreeing[apart:] += agree
    return agreeing.view_as(padded)[:, : values.shape[1], : values.shape[2]]


def _sums(values: Tensor, place: Tensor) -> Tensor:
    """Sums `[N, _BINS]` of values `[N, H, W]`, or one value, by the bin of each pixel; `_BINS` is in none.

    Column by column, and then of all columns: on a GPU, sums by index into few places wait for each other, and those
    of neighbouring pixels into neighbouring places do not.
    """
    frames, rows, columns = place.shape
    sums = values.new_zeros(frames, _BINS + 1, columns)
    sums.scatter_add_(1, place, values.expand(frames, rows, columns))
    return sums[:, :_BINS].sum(dim=2).double()
