"""Depth frames as denoisers take them: scaled over a gate, with what is known of the water."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ArgumentError

__all__ = ["LOG_DENSITY_LIMIT", "MARGIN", "POOLED", "SMALLEST_SIDE", "DepthFrames", "depth_frames", "fill_missing"]

LOG_DENSITY_LIMIT = 4.0
"""The logarithm of a backscatter density is cut at ± this."""

MARGIN = 0.25
"""Depths this part of the gate's width before or behind it are still taken: a gate in range is not one in depth."""

POOLED = 3
"""Of the clues of histograms, so many are depths: one for each window in which histograms were pooled."""

SMALLEST_SIDE = 8
"""Fewest rows or columns of a frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthFrames:
    """Depth frames with their gate.

    Attributes:
        depth: float32 `[N, H, W]` [m]; NaN where nothing was reported, or nothing near the gate.
        gate: (start, stop) in depth [m].
        density: Density of the water's backscatter at each depth, relative to a flat one over the gate, float32 of
            `depth`'s shape; 1 everywhere if it is not known.
        clues: What the histograms behind them tell, float32 `[N, CLUES, H, W]` as
            `spadwarp.denoise.histogram_features` has it,
            but with pooled depths in metres; None where there are none.
    """

    depth: NDArray[np.float32]
    gate: tuple[float, float]
    density: NDArray[np.float32]
    clues: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.depth)

    def __getitem__(self, part: slice) -> DepthFrames:
        clues = None if self.clues is None else self.clues[part]
        return replace(self, depth=self.depth[part], density=self.density[part], clues=clues)

    @property
    def scaled(self) -> NDArray[np.float32]:
        """Depth over the gate, 0 at its start and 1 at its end; NaN as in `depth`."""
        start, stop = self.gate
        return ((self.depth - start) / (stop - start)).astype(np.float32)

    def network_input(self, *, histograms: bool = False) -> NDArray[np.float32]:
        """`[N, 3, H, W]`, with `histograms` and their clues, as `spadwarp.denoise.networks` describes it.

        Without, a pixel that reported nothing stands for its nearest that did, where pixels about it report nearly as
        often as elsewhere: networks of depth learn from frames in which few are missing.
        """
        scaled, density = self.scaled, self.density
        if not histograms and np.isnan(scaled).any():
            density = density.copy()
            for depth, likely in zip(scaled, density, strict=True):
                places = _stand_ins(depth, likely)
                depth[:], likely[:] = depth[places], likely[places]
        reported = ~np.isnan(scaled)
        limit = LOG_DENSITY_LIMIT
        log_density = np.log(np.clip(density, math.exp(-limit), math.exp(limit)))
        channels = (np.where(reported, scaled, 1.0), reported, np.where(reported, log_density, 0.0))
        frame = np.stack([one.astype(np.float32) for one in channels], axis=1)
        if not histograms:
            return frame
        assert self.clues is not None
        start, stop = self.gate
        pooled = (self.clues[:, :POOLED] - start) / (stop - start) - 0.5
        return np.concatenate([frame, pooled, self.clues[:, POOLED:]], axis=1, dtype=np.float32)


def depth_frames(
    depth: ArrayLike,
    *,
    gate: tuple[float, float],
    profile: ArrayLike | None = None,
    density: ArrayLike | None = None,
    clues: NDArray[np.float32] | None = None,
) -> DepthFrames:
    """Checks depth and brings it into the form that denoisers take.

    Args:
        depth: `[H, W]` or `[N, H, W]` [m]; NaN, 0 and infinity mean that nothing was reported.
        gate: (start, stop) in depth [m].
        profile: Backscatter over the gate in any number of equal bins, `[bins]`, ≥ 0, in any unit.
        density: In its place, its density [1/m] at each depth, of `depth`'s shape; NaN for not known.
        clues: Of the histograms, `[N, CLUES, H, W]`, pooled depths in metres.

    What lies farther than `MARGIN` outside the gate counts as not reported, with a warning that gives the number.

    Raises:
        ArgumentError: Shapes, sizes or values that cannot be, or a gate without width.
    """
    values = np.asarray(depth)
    if values.dtype.kind not in "iuf" or values.ndim not in (2, 3):
        raise ArgumentError(f"depth is {values.dtype} {values.shape}; real numbers [H, W] or [N, H, W] are needed")
    values = values.astype(np.float32).reshape(-1, *values.shape[-2:])
    if min(values.shape[1:]) < SMALLEST_SIDE or len(values) == 0:
        raise ArgumentError(
            f"depth is {len(values)} frames of {values.shape[1]} x {values.shape[2]} pixels; one of "
            f"{SMALLEST_SIDE} x {SMALLEST_SIDE} is the least"
        )
    if clues is not None and (len(clues) != len(values) or clues.shape[2:] != values.shape[1:]):
        raise ArgumentError(f"histograms are {len(clues)} frames of {clues.shape[2:]} pixels, depth is {values.shape}")
    start, stop = map(float, gate)
    if not (math.isfinite(stop) and 0 <= start < stop):
        raise ArgumentError(f"gate = ({start}, {stop}) m is not (start, stop) with 0 <= start < stop")
    if (values[np.isfinite(values)] < 0).any():
        raise ArgumentError(f"depth {np.nanmin(values)} m is outside [0, inf)")
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
        bins = np.asarray(profile, np.float64)
        if bins.ndim != 1 or not (np.isfinite(bins).all() and (bins >= 0).all() and bins.sum() > 0):
            raise ArgumentError(
                f"profile has shape {bins.shape}; one dimension of numbers >= 0 that are not all 0 is needed"
            )
        place = np.nan_to_num((values - start) / (stop - start)) * bins.size
        relative = (bins / bins.mean())[np.clip(place.astype(np.int64), 0, bins.size - 1)].astype(np.float32)
    return DepthFrames(depth=values, gate=(start, stop), density=relative, clues=clues)


def _stand_ins(depth: NDArray[np.float32], density: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns `[H, W]` of the pixels that stand for each: itself, or the nearest that reported something.

    Where there is no target pixels report less often than on one, backscatter alone, and nothing should stand for them.
    So a missing pixel stands for itself where, of the 15 × 15 pixels about it or as many as hold 64 reports, fewer than
    half as many report as in the window that holds the most; and so do all, unless depths that follow each other agree
    more often than backscatter would.

    Args:
        depth: Over the gate, NaN where nothing was reported, `[H, W]`.
        density: Of backscatter at these depths, relative to a flat one, `[H, W]`.
    """
    from scipy.ndimage import distance_transform_edt, uniform_filter

    reported = ~np.isnan(depth)
    places = np.indices(depth.shape)
    agreeing = np.count_nonzero(np.abs(np.diff(depth[reported])) < 0.01)
    by_chance = np.minimum(0.02 * density[reported], 1.0).sum()
    side = 2 * round(max(7.0, 4.0 / math.sqrt(max(reported.mean(), 1e-4)))) + 1
    often = uniform_filter(reported.astype(np.float32), side, mode="constant")
    inside = uniform_filter(np.ones_like(often), side, mode="constant")  # part of the window that lies in the image
    missing = ~reported & (often >= 0.5 * often.max() * inside)
    if missing.any() and agreeing > 1.3 * by_chance + 10:
        nearest = distance_transform_edt(~reported, return_distances=False, return_indices=True)
        places = np.where(missing, nearest, places)
    return places[0], places[1]


def fill_missing(image: NDArray[np.float32], otherwise: float) -> NDArray[np.float32]:
    """An image `[H, W]` with each NaN replaced by its nearest number, or all by `otherwise` where there is none."""
    from scipy.ndimage import distance_transform_edt

    missing = np.isnan(image)
    if missing.all():
        return np.full_like(image, otherwise)
    if not missing.any():
        return image
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return image[tuple(nearest)]
