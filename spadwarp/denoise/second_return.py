"""A second surface in a pixel: what a histogram holds besides the return that was answered."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import on_host, real_array
from spadwarp.denoise.histogram_inputs import histogram_tensors
from spadwarp.denoise.network_files import require_torch
from spadwarp.values import ArgumentError

__all__ = ["second_return"]

_BY_CHANCE = 6.0  # log of the false second returns that are accepted, one in e^6 pixels


def second_return(
    depth: ArrayLike,
    counts: ArrayLike,
    *,
    background: ArrayLike,
    response: ArrayLike,
    side: int = 3,
    device: str | None = None,
) -> NDArray[np.float32]:
    """Depth over the gate of a second return `[N, H, W]`; NaN where there is no significant one.

    The first return is taken off each histogram: as many counts as lie in it, in the shape of the response. In what
    remains, beyond the response, the counts of `side` × `side` pixels within the response's width have to exceed the
    background by more than happens by chance in one of 400 pixels (Poisson likelihood ratio). Light that the water
    scatters into a pixel from a brighter part of the target is such an excess, too: with hundreds of detections a pixel
    most pixels have a second return.

    Args:
        depth: First return over the gate, 0 at its start and 1 at its end, `[H, W]` or `[N, H, W]`.
        counts, background, response: See `spadwarp.denoise.estimate`.
        side: Of the window over which histograms are pooled; 1 for each pixel alone.
        device: torch device.

    Raises:
        ArgumentError: Shapes or values that cannot be.
    """
    torch = require_torch()
    from spadwarp.denoise.histogram_features import highest, toeplitz

    first, cubes = real_array("depth", depth), np.asarray(on_host(counts))
    if first.shape != cubes.shape[:-1]:
        raise ArgumentError(f"depth has shape {first.shape}; {cubes.shape[:-1]} is needed")
    frames = first.reshape(-1, *first.shape[-2:])
    found = []
    with torch.inference_mode():
        for place, (cube, level, taps) in zip(
            frames, histogram_tensors(cubes, background, response, device), strict=True
        ):
            bins = cube.shape[-1]
            at = (torch.from_numpy(np.nan_to_num(place)).to(cube.device)[None] * bins).long().clamp(0, bins - 1)
            apart = torch.arange(taps.shape[1], device=cube.device) - taps.shape[1] // 2
            width = float((taps[0] * apart.square()).sum().clamp_min(0.1).sqrt())
            shape = toeplitz(taps, bins)[0].t()[at]  # of the first return in each pixel
            near = (torch.arange(bins, device=cube.device) - at[..., None]).abs() <= 3.0 * width + 1.0
            signal = ((cube - level) * near).sum(dim=-1, keepdim=True).clamp_min(0.0)
            rest = torch.where(near, level.expand_as(cube), cube - signal * shape).clamp_min(0.0)
            reach = 2 * round(1.5 * width) + 1
            found_counts, expected = (_sums(values, side, reach) for values in (rest, level.expand_as(cube)))
            excess = torch.xlogy(found_counts, found_counts / expected) - (found_counts - expected)
            score = torch.where(near | (found_counts <= expected), 0.0, excess)
            significant = score.amax(dim=-1) > math.log(bins) + _BY_CHANCE
            found.append(torch.where(significant, highest(score), math.nan)[0].cpu().numpy())
    return np.stack(found).astype(np.float32)


def _sums(cube: Any, side: int, reach: int) -> Any:
    """Sums over `side` × `side` pixels and `reach` bins, `[B, H, W, T]`."""
    import torch

    from spadwarp.denoise.histogram_features import pooled

    image = pooled(cube, side) * side**2
    return torch.nn.functional.avg_pool1d(image.flatten(0, 2)[:, None], reach, 1, reach // 2).view_as(image) * reach
