"""Semi-global matching on a volume of log-likelihoods: Hirschmüller, IEEE TPAMI 30, 328 (2008).

Along four directions, the log-likelihood of each depth of a pixel is added to the best of the pixel before it: the same
depth, the next bin at a small penalty, or any other depth at a larger one. The sum over the directions has its highest
value at the answer. It is the strongest classical estimate where photons are few and surfaces large.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

__all__ = ["SLOPE", "aggregate", "messages", "rows_and_columns", "usual_jump"]

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
    rows, columns = rows_and_columns(partial(messages, slope=slope), (score, score.transpose(1, 2)), (jump, jump))
    return (rows + columns.transpose(1, 2)).add_(score, alpha=4.0)


def rows_and_columns(
    send: Callable[[Tensor, Tensor], Tensor], scores: tuple[Tensor, Tensor], jumps: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """`send(score, jump)` of the rows and of the columns; where they are as long and as many, both at once."""
    if scores[0].shape == scores[1].shape and jumps[0].shape == jumps[1].shape:
        rows, columns = send(torch.cat(scores), torch.cat(jumps)).chunk(2)
        return rows, columns
    return send(scores[0], jumps[0]), send(scores[1], jumps[1])


def messages(score: Tensor, jump: Tensor, *, slope: float) -> Tensor:
    """What the pixels of a row before and behind each tell it of its depth, the sum of both, `[B, H, W, T]`.

    Arguments are those of `aggregate`; `jump` may differ between neighbours, `[B, H, W − 1, 1]`. The best depth
    has 0 in each of the two.
    """
    lines = score.flatten(0, 1)
    received, last = torch.zeros_like(lines), lines.shape[1] - 1
    most = jump.expand(-1, score.shape[1], max(1, last), 1).flatten(0, 1)
    penalties = torch.stack([most, most.flip(1)]).unbind(dim=2)  # forwards and backwards
    # Views are made once: a GPU takes less time for the arithmetic of a place than Python for a view.
    scores, sums = lines.unbind(dim=1), received.unbind(dim=1)
    known = lines.new_empty(2, len(lines), lines.shape[2])
    ahead = torch.zeros_like(known)  # the message sent last, forwards and backwards
    best = known.new_empty(2, len(lines), 1)
    now, sent = known.unbind(), ahead.unbind()
    nearer, farther, from_nearer, from_farther = ahead[..., :-1], ahead[..., 1:], known[..., :-1], known[..., 1:]
    for place in range(last):
        torch.add(scores[place], sent[0], out=now[0])
        torch.add(scores[last - place], sent[1], out=now[1])
        torch.amax(known, dim=-1, keepdim=True, out=best)
        torch.maximum(known, best - penalties[place], out=ahead)
        known -= slope
        torch.maximum(farther, from_nearer, out=farther)
        torch.maximum(nearer, from_farther, out=nearer)
        ahead -= best
        sums[place + 1].add_(sent[0])
        sums[last - place - 1].add_(sent[1])
    return received.view_as(score)
