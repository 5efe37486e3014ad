"""Semi-global matching on a volume of log-likelihoods: Hirschmüller, IEEE TPAMI 30, 328 (2008).

Along four directions, the log-likelihood of each depth of a pixel is added to the best of the pixel before it: the same
depth, the next bin at a small penalty, or any other depth at a larger one. The sum over the directions has its highest
value at the answer. It is the strongest classical estimate where photons are few and surfaces large.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["SLOPE", "aggregate", "usual_jump"]

SLOPE = 1.0
"""Penalty of the next bin [nats]."""

_JUMPS = 12.0, 60.0  # limits of the usual penalty of any other depth [nats]


def usual_jump(score: Tensor) -> Tensor:
    """Penalty of any other depth: half the highest score of the median pixel, `[B, 1, 1, 1]`; `score` as below."""
    peaks = score.amax(dim=-1).flatten(1)
    return (0.5 * peaks.median(dim=1).values).clamp(*_JUMPS)[:, None, None, None]


def aggregate(score: Tensor, *, jump: Tensor, slope: float = SLOPE) -> Tensor:
    """Sum over four directions, `[B, H, W, T]`.

    Args:
        score: Log-likelihood of a return in each bin, of each pixel, `[B, H, W, T]` [nats].
        jump: Penalty of any other depth `[B, 1, 1, 1]` [nats].
        slope: Penalty of the next bin [nats].
    """
    turned = score.transpose(1, 2)
    parts = [
        _both_ways(lines.flatten(0, 1), slope, jump.expand(-1, lines.shape[1], 1, 1).flatten(0, 1)[:, 0]).view(
            lines.shape
        )
        for lines in (score, turned)
    ]
    return parts[0] + parts[1].transpose(1, 2)


def _both_ways(lines: Tensor, slope: float, jump: Tensor) -> Tensor:
    """Sum over the two directions along lines `[N, L, T]`, each with its jump `[N, 1]`."""
    pair = torch.stack([lines, lines.flip(1)])
    total = torch.empty_like(pair)
    state = pair[:, :, 0]
    total[:, :, 0] = state
    for place in range(1, lines.shape[1]):
        best = state.amax(dim=-1, keepdim=True)
        kept = torch.maximum(state, best - jump)
        kept[..., 1:] = torch.maximum(kept[..., 1:], state[..., :-1] - slope)
        kept[..., :-1] = torch.maximum(kept[..., :-1], state[..., 1:] - slope)
        state = kept.sub_(best).add_(pair[:, :, place])
        total[:, :, place] = state
    return total[0] + total[1].flip(1)
