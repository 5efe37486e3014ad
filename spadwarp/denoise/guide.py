"""What the number of counts of each pixel shows: edges of reflectance, at which depth may jump.

Surfaces differ in reflectance, and with it in their signal and in the ambient light that they reflect. Where two
neighbours differ in counts by more than chance, a jump in depth between them is more probable. The square root of
counts makes their noise equal everywhere (Anscombe, Biometrika 35, 246 (1948)).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from spadwarp.denoise.volumes import pooled

__all__ = ["GUIDES", "counts_level", "edge_penalties", "guide_channels"]

GUIDES = 2
"""Number of channels of `guide_channels`."""

_EDGES, _TEXTURE = 0.1, 0.1  # parts of the neighbours between which depth jumps, and of the others that differ as much


def guide_channels(total: Tensor) -> list[Tensor]:
    """Counts of each pixel and of 3 × 3 pixels against those of 15 × 15, in deviations, `[B, H, W]`, as asinh.

    `total`: counts of each pixel over all times, `[B, H, W]`.
    """
    level = counts_level(total)[..., None]
    around = pooled(level, 15)
    differences = 0.3 * (level - around), 0.6 * (pooled(level, 3) - around)
    return [torch.asinh(difference)[..., 0] for difference in differences]


def edge_penalties(total: Tensor) -> tuple[Tensor, Tensor]:
    """What the counts add to the penalty of a jump in depth [nats]: to the right `[B, H, W − 1]`, down `[B, H − 1, W]`.

    The log-likelihood of the two counts of neighbours on one surface less that of a jump. Differences by chance have
    variance 2; those at jumps and at edges of texture have an excess, which the mean of the frame gives. Where there is
    none, nothing is added.
    """
    level = counts_level(total)
    across, down = level.diff(dim=2), level.diff(dim=1)
    number = across[0].numel() + down[0].numel()
    mean = (across.square().sum(dim=(1, 2)) + down.square().sum(dim=(1, 2))) / number
    excess = ((mean - 2.0) / (_EDGES + _TEXTURE * (1.0 - _EDGES))).clamp_min(0.0)[:, None, None]

    def added(difference: Tensor) -> Tensor:
        far = -0.5 * difference.square() / (2.0 + excess) - 0.5 * (1.0 + 0.5 * excess).log()
        same = torch.logaddexp(math.log(1.0 - _TEXTURE) - 0.25 * difference.square(), math.log(_TEXTURE) + far)
        return same - far

    return added(across), added(down)


def counts_level(total: Tensor) -> Tensor:
    """Counts with noise of deviation 1."""
    return 2.0 * (total + 0.375).sqrt()
