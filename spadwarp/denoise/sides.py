"""The two surfaces beside a depth edge: the nearer and the farther one around each pixel.

Nearly all of the squared error at few photons comes from pixels beside edges that are given to the wrong side. Named as
two depths for each pixel, with the log-likelihood of each, the question becomes one of segmentation, at which a network
is good.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.semi_global import aggregate

__all__ = ["REACHES", "beside_edges"]

REACHES = (2, 5)
"""Pixels up to which a side is looked for."""

_RIGID = 40.0  # penalty of a jump in semi-global matching that keeps to one of two returns [nats]


def beside_edges(score: Tensor, usual: Tensor) -> Tensor:
    """`SIDES` depths over the gate, `[B, H, W, SIDES]`.

    For each of `REACHES` the nearer and the farther surface; then, by the photons of the pixel, the most probable depth
    from the one to the other of the shorter reach, and the mean depth for each reach. Last, the depth of semi-global
    matching with a penalty that keeps a pixel to one of its two returns.

    Args:
        score: Log-likelihood of a return in each bin, of each pixel, `[B, H, W, T]` [nats].
        usual: Depth over the gate by belief propagation, `[B, H, W]`.
    """
    from spadwarp.denoise.histogram_features import highest

    found = _nearer_and_farther(usual)
    inside = [_between(score, *found[place : place + 2]) for place in range(0, len(found), 2)]
    rigid = aggregate(score, jump=score.new_full((len(score), 1, 1, 1), _RIGID))
    return torch.stack([*found, inside[0][0], *(mean for _, mean in inside), highest(rigid)], dim=-1)


def _nearer_and_farther(depth: Tensor) -> list[Tensor]:
    """For each of `REACHES` the depths of the nearer and of the farther surface around a pixel, `[B, H, W]`.

    The depths `depth` `[B, H, W]` of a window are parted at the middle between its least and its largest; each part has
    the mean of its depths, of which the next to the pixel count most.
    """
    height, width = depth.shape[-2:]
    found = []
    for reach in REACHES:
        image = F.pad(depth[:, None], (reach,) * 4, mode="replicate" if min(height, width) > reach else "constant")
        side = 2 * reach + 1
        low = -F.max_pool2d(F.max_pool2d(-image, (side, 1), 1), (1, side), 1)
        high = F.max_pool2d(F.max_pool2d(image, (side, 1), 1), (1, side), 1)
        middle = 0.5 * (low + high)
        sums = [torch.zeros_like(middle) for _ in range(4)]
        for y in range(side):
            for x in range(side):
                apart = (y - reach) ** 2 + (x - reach) ** 2
                weight = 1.0 / (1.0 + apart) ** 2
                one = image[..., y : y + height, x : x + width]
                near = (one <= middle).to(one.dtype) * weight
                sums[0] += near
                sums[1] += near * one
                sums[2] += weight - near
                sums[3] += (weight - near) * one
        front = sums[1] / sums[0].clamp_min(1e-9)
        back = torch.where(sums[2] > 0.0, sums[3] / sums[2].clamp_min(1e-9), front)
        found += [front[:, 0], back[:, 0]]
    return found


def _between(score: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
    """Highest place and mean place of a return that lies from `near` to `far` `[B, H, W]`, by the photons of the pixel.

    `score`: log-likelihood of a return in each bin, `[B, H, W, T]`. Depth maps that were scaled down, and steep slopes,
    have depths between the surfaces on both sides.
    """
    from spadwarp.denoise.histogram_features import highest

    bins = score.shape[-1]
    place = torch.arange(bins, device=score.device) + 0.5
    inside = (place >= near[..., None] * bins - 1.0) & (place <= far[..., None] * bins + 1.0)
    score = torch.where(inside, score, -1e4)
    return highest(score), torch.softmax(score, dim=-1) @ place / bins
