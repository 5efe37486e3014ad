"""Semi-global matching on a volume of log-likelihoods: Hirschmüller, IEEE TPAMI 30, 328 (2008).

Along four directions, the log-likelihood of each depth of a pixel is added to the best of the pixel before it: the same
depth, the next bin at a small penalty, or any other depth at a larger one. The sum over the directions has its highest
value at the answer. It is the strongest classical estimate where photons are few and surfaces large.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["SLOPE", "aggregate", "messages", "usual_jump"]

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
    rows = messages(score, slope=slope, jump=jump)
    columns = messages(score.transpose(1, 2), slope=slope, jump=jump).transpose(1, 2)
    return (rows + columns).add_(score, alpha=4.0)


def messages(score: Tensor, *, slope: float, jump: Tensor) -> Tensor:
    """What the pixels of a row before and behind each tell it of its depth, the sum of both, `[B, H, W, T]`.

    Arguments are those of `aggregate`; `jump` may differ between neighbours, `[B, H, W − 1, 1]`. The best depth
    has 0 in each of the two.
    """
    lines = score.flatten(0, 1)
    most = jump.expand(-1, score.shape[1], max(1, score.shape[2] - 1), 1).flatten(0, 1)
    penalties = torch.stack([most, most.flip(1)]).unbind(dim=2)  # forwards and backwards
    received, last = torch.zeros_like(lines), lines.shape[1] - 1
    ahead = lines.new_zeros(2, len(lines), lines.shape[2])  # the message sent last, forwards and backwards
    for place in range(last):
        known = torch.stack([lines[:, place], lines[:, last - place]]).add_(ahead)
        best = known.amax(dim=-1, keepdim=True)
        ahead = torch.maximum(known, best - penalties[place])
        known -= slope
        torch.maximum(ahead[..., 1:], known[..., :-1], out=ahead[..., 1:])
        torch.maximum(ahead[..., :-1], known[..., 1:], out=ahead[..., :-1])
        ahead -= best
        received[:, place + 1] += ahead[0]
        received[:, last - place - 1] += ahead[1]
    return received.view_as(score)
