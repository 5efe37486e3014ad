"""Weighted total variation of a depth map: min over d of Σ w |d − d₀| + λ TV(d), by primal-dual steps.

Rudin, Osher & Fatemi, Physica D 60, 259 (1992), with the L1 norm of Chan & Esedoḡlu, SIAM J. Appl. Math. 65, 1817
(2005), which leaves outliers behind; solved as Chambolle & Pock, J. Math. Imaging Vision 40, 120 (2011).
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["total_variation"]


def total_variation(
    depth: Tensor, weight: Tensor, *, strength: float = 1.0, iterations: int = 300, isotropic: bool = True
) -> Tensor:
    """The smoothed maps `[B, H, W]`.

    Args:
        depth: d₀ `[B, H, W]`, over the gate; finite.
        weight: w of each pixel `[B, H, W]`, ≥ 0; 0 where nothing was reported.
        strength: λ.
        iterations: Primal-dual steps.
        isotropic: Whether TV is the length of the gradient, else the sum of its two parts, which commutes with
            reflections of the image.
    """
    found, ahead = depth.clone(), depth.clone()
    down, right = torch.zeros_like(depth), torch.zeros_like(depth)
    step = 0.35
    far = step * weight
    for _ in range(iterations):
        down[:, :-1] += step * ahead.diff(dim=1)
        right[:, :, :-1] += step * ahead.diff(dim=2)
        if isotropic:
            length = torch.hypot(down, right).div_(strength).clamp_min_(1.0)
            down /= length
            right /= length
        else:
            down.clamp_(-strength, strength)
            right.clamp_(-strength, strength)
        moved = torch.add(found, down + right, alpha=step)
        moved[:, 1:] -= step * down[:, :-1]
        moved[:, :, 1:] -= step * right[:, :, :-1]
        apart = moved - depth
        new = moved - torch.maximum(torch.minimum(apart, far), -far)  # shrinks what is apart
        ahead = 2.0 * new - found
        found = new
    return found
