"""The two surfaces beside a depth edge: the nearer and the farther one around each pixel.

Nearly all of the squared error at few photons comes from pixels beside edges that are given to the wrong side. Named as
two depths for each pixel, with the log-likelihood of each, the question becomes one of segmentation, at which a network
is good.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.classical import aggregate, highest

__all__ = ["LIKENESS", "REACHES", "beside_edges"]

REACHES = (2, 5)
"""Pixels up to which a side is looked for."""

LIKENESS = 3 * len(REACHES)
"""Channels that tell whose counts those of a pixel are like: for each reach the nearer side's, the farther one's."""

_RIGID = 40.0  # penalty of a jump in semi-global matching that keeps to one of two returns [nats]


def beside_edges(score: Tensor, usual: Tensor, level: Tensor) -> tuple[Tensor, Tensor]:
    """`SIDES` depths over the gate, `[B, H, W, SIDES]`, and how like the counts are to those of both sides.

    For each of `REACHES` the nearer and the farther surface; then, by the photons of the pixel, the most probable depth
    from the one to the other of the shorter reach, and the mean depth for each reach. Last, the depth of semi-global
    matching with a penalty that keeps a pixel to one of its two returns. The likeness, `[B, H, W, LIKENESS]`: the
    difference from the mean of the nearer side, from that of the farther one, and which of the two squares is larger.

    Args:
        score: Log-likelihood of a return in each bin, of each pixel, `[B, H, W, T]` [nats].
        usual: Depth over the gate by belief propagation, `[B, H, W]`.
        level: Counts of each pixel, with noise of deviation 1, `[B, H, W]`.
    """
    found, like = _nearer_and_farther(usual, level)
    inside = [_between(score, *found[place : place + 2]) for place in range(0, len(found), 2)]
    rigid = aggregate(score, jump=score.new_full((len(score), 1, 1, 1), _RIGID))
    depths = torch.stack([*found, inside[0][0], *(mean for _, mean in inside), highest(rigid)], dim=-1)
    return depths, torch.stack(like, dim=-1)


def _nearer_and_farther(depth: Tensor, level: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """For each of `REACHES` the depths of the nearer and of the farther surface around a pixel, and the likeness.

    The depths `depth` `[B, H, W]` of a window are parted at the middle between its least and its largest; each part has
    the mean of its depths, of which the next to the pixel count most.
    """
    height, width = depth.shape[-2:]
    both, found, like = torch.stack([depth, level], dim=1), [], []
    for reach in REACHES:
        image = F.pad(both, (reach,) * 4, mode="replicate")
        side = 2 * reach + 1
        places = image[:, :1]
        low = -F.max_pool2d(F.max_pool2d(-places, (side, 1), 1), (1, side), 1)
        middle = 0.5 * (low + F.max_pool2d(F.max_pool2d(places, (side, 1), 1), (1, side), 1))
        # Sums of weights, weighted depths, weights and weighted counts; those of counts leave the pixel itself out.
        nearer, farther = both.new_zeros(2, len(both), 4, height, width)
        unit = torch.ones_like(middle)
        for y in range(side):
            for x in range(side):
                apart = (y - reach) ** 2 + (x - reach) ** 2
                one = image[..., y : y + height, x : x + width]
                near = (one[:, :1] <= middle).to(one.dtype)
                wide = (apart > 0) / (1.0 + apart)
                known = torch.cat([unit, one[:, :1], wide * unit, wide * one[:, 1:]], dim=1)
                known[:, :2] *= (1.0 + apart) ** -2
                nearer += near * known
                farther += known - near * known
        front, front_level = nearer[:, 1::2].div(nearer[:, ::2].clamp_min(1e-6)).unbind(dim=1)
        back, back_level = farther[:, 1::2].div(farther[:, ::2].clamp_min(1e-6)).unbind(dim=1)
        alone = farther[:, 0] <= 1e-6  # one depth everywhere
        back, back_level = torch.where(alone, front, back), torch.where(alone, front_level, back_level)
        found += [front, back]
        from_front, from_back = level - front_level, level - back_level
        like += [torch.asinh(0.3 * from_front), torch.asinh(0.3 * from_back)]
        like.append(0.3 * torch.asinh(from_back.square() - from_front.square()))
    return found, like


def _between(score: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
    """Highest place and mean place of a return that lies from `near` to `far` `[B, H, W]`, by the photons of the pixel.

    `score`: log-likelihood of a return in each bin, `[B, H, W, T]`. Depth maps that were scaled down, and steep slopes,
    have depths between the surfaces on both sides.
    """
    bins = score.shape[-1]
    place = torch.arange(bins, device=score.device) + 0.5
    inside = (place >= near[..., None] * bins - 1.0) & (place <= far[..., None] * bins + 1.0)
    score = torch.where(inside, score, -1e4)
    return highest(score), torch.softmax(score, dim=-1) @ place / bins
