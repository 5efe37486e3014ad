"""Mean depth of each pixel by sum-product belief propagation: the estimate with the least mean square error.

Where photons leave it open which of two surfaces a pixel sees, its mean lies between both. The messages are those of
`spadwarp.denoise.belief_propagation`, with sums in place of the highest values.
"""

from __future__ import annotations

import torch
from torch import Tensor

from spadwarp.denoise.semi_global import rows_and_columns

__all__ = ["mean_depth"]

_JUMP = 5.0  # penalty of any one other depth [nats]
_NEXT = 0.6  # probability of the next bin, relative to that of the same
_ROUNDS = 2
_TEMPERATURE = 1.5  # loops make the sums too certain


def mean_depth(score: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Mean depth over the gate, `[B, H, W]`.

    Args:
        score: Log-likelihood of a return in each bin, of each pixel, `[B, H, W, T]` [nats].
        across, down: Added to the penalty of a jump, see `spadwarp.denoise.guide`.
    """
    rows = columns = score.new_zeros(())
    odds = [torch.exp(-(_JUMP + more).clamp_min(0.5))[..., None] for more in (across, down.transpose(1, 2))]
    for _ in range(_ROUNDS):
        given = _probable(score + columns), _probable((score + rows).transpose(1, 2))
        rows, columns = rows_and_columns(_messages, given, (odds[0], odds[1]))
        columns = columns.transpose(1, 2)
    probability = torch.softmax((score + rows + columns) / _TEMPERATURE, dim=-1)
    bins = score.shape[-1]
    return (probability * (torch.arange(bins, device=score.device) + 0.5)).sum(dim=-1) / bins


def _probable(score: Tensor) -> Tensor:
    return (score - score.amax(dim=-1, keepdim=True)).exp_()


def _messages(probability: Tensor, odds: Tensor) -> Tensor:
    """Logarithms of what the pixels of a row before and behind each tell it, the sum of both, `[B, H, W, T]`."""
    lines, most = probability.flatten(0, 1), odds.flatten(0, 1)
    received, last = torch.ones_like(lines), lines.shape[1] - 1
    apart = torch.stack([most, most.flip(1)]).unbind(dim=2)  # forwards and backwards
    # Views are made once, as in `spadwarp.denoise.semi_global`.
    given, products = lines.unbind(dim=1), received.unbind(dim=1)
    known = lines.new_empty(2, len(lines), lines.shape[2])
    ahead = torch.ones_like(known)  # the message sent last, forwards and backwards
    now, sent = known.unbind(), ahead.unbind()
    nearer, farther, from_nearer, from_farther = ahead[..., :-1], ahead[..., 1:], known[..., :-1], known[..., 1:]
    for place in range(last):
        torch.mul(given[place], sent[0], out=now[0])
        torch.mul(given[last - place], sent[1], out=now[1])
        known /= known.sum(dim=-1, keepdim=True).clamp_min_(1e-30)
        ahead.copy_(known)
        farther.add_(from_nearer, alpha=_NEXT)
        nearer.add_(from_farther, alpha=_NEXT)
        ahead.mul_(1.0 / (1.0 + 2.0 * _NEXT)).add_(apart[place])
        ahead /= ahead.amax(dim=-1, keepdim=True)
        products[place + 1].mul_(sent[0])
        products[last - place - 1].mul_(sent[1])
    return received.clamp_min_(1e-30).log_().view_as(probability)
