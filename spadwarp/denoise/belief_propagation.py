"""Belief propagation on a volume of log-likelihoods: the depths that are most probable where neighbours mostly agree.

Each pixel tells its four neighbours how probable each depth is, by its own photons and by what the other three told it:
the same depth, the next bin at a small penalty, or any other depth at a larger one (max-product; Tappen & Freeman, ICCV
2003). Unlike in semi-global matching, rows and columns hear of each other, and no message returns to the pixel that it
came from: photons count once, so that the penalty is that of an edge and need not grow with the photons. Turned or
reflected frames give the same answer.
"""

from __future__ import annotations

from functools import partial

from torch import Tensor

from spadwarp.denoise.semi_global import messages, rows_and_columns

__all__ = ["JUMPS", "beliefs"]

JUMPS = (4.0, 2.5, 8.0)
"""Penalties of any other depth [nats]: the usual one; one for thin things; one for few photons and second returns."""

_SLOPE = 0.5  # penalty of the next bin [nats]
_LEAST = 0.5  # penalty at an edge of the counts [nats]
_ROUNDS = 3  # more of them change little


def beliefs(score: Tensor, jump: Tensor, more: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Log-likelihood of each depth of each pixel together with the best depths of all others, `[B, H, W, T]`.

    Args:
        score: Log-likelihood of a return in each bin, of each pixel, `[B, H, W, T]` [nats].
        jump: Penalty of any other depth `[B, 1, 1, 1]` [nats].
        more: Added to it between neighbours in rows and in columns, see `spadwarp.denoise.guide`.
    """
    ahead = beside = jump
    if more is not None:
        ahead = (jump + more[0][..., None]).clamp_min(_LEAST)
        beside = (jump + more[1].transpose(1, 2)[..., None]).clamp_min(_LEAST)
    rows = columns = score.new_zeros(())
    send = partial(messages, slope=_SLOPE)
    for _ in range(_ROUNDS):
        scores = score + columns, (score + rows).transpose(1, 2)
        rows, columns = rows_and_columns(send, scores, (ahead, beside))
        columns = columns.transpose(1, 2)
    return (rows + columns).add_(score)
