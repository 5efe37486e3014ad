"""Volumes of a value for each bin of each pixel: their means over windows, and where they are highest."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["highest", "pooled"]


def pooled(cube: Tensor, side: int) -> Tensor:
    """Mean over `side` × `side` pixels around each, of those within the frame; `[B, H, W, T]`.

    Windows on a CPU, products with banded matrices on a GPU: each is several times faster on its device.
    """
    half = side // 2
    if cube.device.type == "cpu":
        image = cube.permute(0, 3, 1, 2)
        image = F.avg_pool2d(image, (side, 1), stride=1, padding=(half, 0), count_include_pad=False)
        image = F.avg_pool2d(image, (1, side), stride=1, padding=(0, half), count_include_pad=False)
        return image.permute(0, 2, 3, 1)

    def band(length: int) -> Tensor:
        place = torch.arange(length, device=cube.device)
        inside = ((place[:, None] - place).abs() <= half).to(cube.dtype)
        return inside / inside.sum(dim=1, keepdim=True)

    height, width = cube.shape[1:3]
    return torch.matmul(band(width), torch.matmul(band(height), cube.flatten(2)).view_as(cube))


def highest(score: Tensor) -> Tensor:
    """Place of the highest score over the gate, to fractions of a bin by the parabola through its neighbours."""
    bins = score.shape[-1]
    best = score.argmax(dim=-1, keepdim=True)
    inner = best.clamp(1, max(1, bins - 2))
    before, at, after = (score.gather(-1, (inner + step).clamp(0, bins - 1))[..., 0] for step in (-1, 0, 1))
    curvature = (2.0 * at - before - after).clamp_min(1e-9)
    offset = (0.5 * (after - before) / curvature).clamp(-0.5, 0.5)
    offset = torch.where(best[..., 0] == inner[..., 0], offset, 0.0)
    return (best[..., 0] + 0.5 + offset) / bins
