"""Pixels that see the same two surfaces: the one that nearly all of them take is that of each.

Where a pixel sees two surfaces, through a net or at a veil of turbid water, the truth is the one with more light. The
parts of the light change little from pixel to pixel, but photons are few: by chance, some pixels have more of the
weaker surface. Their own photons then speak for it so clearly that no smoothing moves them; those of the pixels around
with the same two returns tell which is the stronger one. A pixel whose answer is neither of its two returns moves, too:
what neighbours show may have drawn it to a third depth. A pixel whose photons differ by more than chance stays as it
is, and so do answers near the surface that the others take, and edges of depth: there, pixels with both returns lie
along a line, and those of one side have its depth.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.histogram_features import SEEN

__all__ = ["follow_the_others"]

_REACH = 3  # pixels around that vote
_SAME, _APART = 0.01, 0.05  # depths this near are one surface, this far apart two [gate widths]
_LEAST, _TIMES = 4, 3.0  # votes for a surface, and how many times the pixels that took the other one, that move to it
_SURE = 4.0  # log-likelihood from which on a return is one [nats]
_PHOTON = 5.0  # log-likelihood of a photon, about the highest [nats]
_CHANCE = 2.0  # deviations by which the two returns may differ


@torch.no_grad()
def follow_the_others(found: Tensor, features: Tensor) -> Tensor:
    """The answers `[B, 1, H, W]` over the gate, some of them moved to a return of their pixel that is far away.

    `features`: see `spadwarp.denoise.histogram_features`, with 0.5 subtracted from the first depths.
    """
    pair, order = (0.5 + features[:, :2]).sort(dim=1)  # the highest return of a pixel and the second, the nearer first
    light = (10.0 * features[:, SEEN : SEEN + 2]).gather(1, order)
    two = (light > _SURE).all(dim=1, keepdim=True) & (pair.diff(dim=1) > _APART)
    pair = torch.where(two, pair, torch.nan)  # near to none
    height, width = found.shape[-2:]
    around = F.pad(torch.cat([pair, found], dim=1), (_REACH,) * 4, value=torch.nan)
    votes, taken = torch.zeros_like(pair), torch.zeros_like(pair)
    for y in range(2 * _REACH + 1):
        for x in range(2 * _REACH + 1):
            if (y, x) != (_REACH, _REACH):
                other, answer = around[..., y : y + height, x : x + width].split([2, 1], dim=1)
                alike = ((pair - other).abs() < _SAME).all(dim=1, keepdim=True)
                near = (answer - pair).abs() < _SAME
                taken += near
                votes += alike & near
    more = light.flip(1) - light  # of the other return
    by_chance = more <= _CHANCE * (_PHOTON * light.sum(dim=1, keepdim=True)).clamp_min(0.0).sqrt()
    outvoted = (votes >= _LEAST) & (votes >= _TIMES * taken.flip(1))
    moves = outvoted & by_chance & ((found - pair).abs() > _APART)
    return torch.where(moves.any(dim=1, keepdim=True), torch.where(moves, pair, 0.0).sum(dim=1, keepdim=True), found)
