"""Classical estimates: windows, guides, and smooth surfaces.

A `score` is the log-likelihood of a return in each bin of each pixel, `[B, H, W, T]` [nats].
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor


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


# What the number of counts of each pixel shows: edges of reflectance, at which depth may jump.


GUIDES = 2
"""Number of channels of `guide_channels`."""

_EDGES, _TEXTURE = 0.1, 0.1  # parts of the neighbours between which depth jumps, and of the others that differ as much


def guide_channels(total: Tensor) -> list[Tensor]:
    """Counts of each pixel and of 3 × 3 pixels against those of 15 × 15, in deviations, `[B, H, W]`, as asinh."""
    level = counts_level(total)[..., None]
    around = pooled(level, 15)
    differences = 0.3 * (level - around), 0.6 * (pooled(level, 3) - around)
    return [torch.asinh(difference)[..., 0] for difference in differences]


def edge_penalties(total: Tensor) -> tuple[Tensor, Tensor]:
    """The counts' part of the penalty of a jump in depth [nats]: to the right `[B, H, W − 1]`, down `[B, H − 1, W]`.

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


# Semi-global matching on a volume of log-likelihoods: Hirschmüller, IEEE TPAMI 30, 328 (2008).


_JUMPS = 12.0, 60.0  # limits of the usual penalty of any other depth [nats]


def usual_jump(score: Tensor) -> Tensor:
    """Penalty of any other depth: half the highest score of the median pixel, `[B, 1, 1, 1]`."""
    peaks = score.amax(dim=-1).flatten(1)
    return (0.5 * peaks.median(dim=1).values).clamp(*_JUMPS)[:, None, None, None]


def aggregate(score: Tensor, *, jump: Tensor) -> Tensor:
    """Sum over four directions, `[B, H, W, T]`; `jump`: penalty of any other depth `[B, 1, 1, 1]` [nats]."""
    send = partial(messages, slope=1.0)
    rows, columns = rows_and_columns(send, (score, score.transpose(1, 2)), (jump, jump))
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
    """Messages of the pixels of a row before and behind each about its depth, the sum of both, `[B, H, W, T]`.

    `jump` may differ between neighbours, `[B, H, W − 1, 1]`; `slope`: penalty of the next bin [nats]. The best depth
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


# Belief propagation on a volume of log-likelihoods: the depths that are most probable where neighbours mostly agree.


JUMPS = (4.0, 2.5, 8.0)
"""Penalties of any other depth [nats]: the usual one; one for thin things; one for few photons and second returns."""

_SLOPE = 0.5  # penalty of the next bin [nats]
_LEAST = 0.5  # penalty at an edge of the counts [nats]
_ROUNDS = 3  # more of them change little


def beliefs(score: Tensor, jump: Tensor, more: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Log-likelihood of each depth of each pixel together with the best depths of all others, `[B, H, W, T]`.

    `jump`: penalty of any other depth `[B, 1, 1, 1]` [nats]; `more`: what `edge_penalties` adds to it.
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


# Weighted total variation of a depth map: min over d of Σ w |d − d₀| + λ TV(d), by primal-dual steps.


def total_variation(
    depth: Tensor, weight: Tensor, *, strength: float = 1.0, iterations: int = 300, isotropic: bool = True
) -> Tensor:
    """The smoothed maps `[B, H, W]` of d₀, finite, with w ≥ 0 of each pixel, and λ = `strength`.

    TV is the length of the gradient, or without `isotropic` the sum of its two parts, which commutes with reflections
    of the image.
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


# Mean depth of each pixel by sum-product belief propagation: the estimate with the least mean square error.


_JUMP = 5.0  # penalty of any one other depth [nats]
_NEXT = 0.6  # probability of the next bin, relative to that of the same
_SUM_ROUNDS = 2
_TEMPERATURE = 1.5  # loops make the sums too certain


def mean_depth(score: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Mean depth over the gate, `[B, H, W]`; `across`, `down`: see `edge_penalties`."""
    rows = columns = score.new_zeros(())
    odds = [torch.exp(-(_JUMP + more).clamp_min(0.5))[..., None] for more in (across, down.transpose(1, 2))]
    for _ in range(_SUM_ROUNDS):
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
    # Views are made once, as in `messages`.
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
