"""Depth frames as denoisers take them: over a gate, with what is known of the water."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import on_host, real_array
from spadwarp.values import ArgumentError, check_real, shown

LOG_DENSITY_LIMIT = 4.0
"""The logarithm of a backscatter density is clipped at ± this."""

MARGIN = 0.25
"""Depths this part of the gate's width before or behind it are still taken: a gate in range is not one in depth."""


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
        return np.nan_to_num(np.stack([*map(_filled, self.scaled, self.density)]), nan=1.0)


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
    if values.size == 0:
        raise ArgumentError(f"depth has shape {values.shape}; at least one frame of one pixel is needed")
    start, stop = checked_gate(gate)
    if (values[np.isfinite(values)] < 0).any():
        raise ArgumentError(f"depth {np.nanmin(values)} m is outside [0, inf) m")
    present = np.isfinite(values) & (values > 0)
    slack = MARGIN * (stop - start)
    outside = present & ~((values >= start - slack) & (values <= stop + slack))
    if outside.any():
        text = f"{outside.sum()} of {present.sum()} depths lie outside the gate of {start:g} to {stop:g} m"
        warnings.warn(f"{text} and count as not reported", stacklevel=2)
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
