"""Classical estimates: windows, guides, and smooth surfaces.

A `score` is the log-likelihood of a return in each bin of each pixel, `[B, H, W, T]` [nats].
"""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
import warp as wp
from torch import Tensor

from spadwarp.device import start_warp
from spadwarp_kernels.detection import launch_messages


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


# Semi-global matching on a volume of log-likelihoods: Hirschmüller, IEEE TPAMI 30, 328 (2008).


_JUMPS = 12.0, 60.0  # limits of the usual penalty of any other depth [nats]


def usual_jump(score: Tensor) -> float:
    """Penalty of any other depth: half the highest score of the median pixel [nats]."""
    return float((0.5 * score.amax(dim=-1).median()).clamp(*_JUMPS))


def aggregate(score: Tensor, *, jump: float) -> Tensor:
    """Sum over four directions, `[B, H, W, T]`; `jump`: penalty of any other depth [nats]."""
    rows, columns = (_messages(score, columns=columns, jump=jump, slope=1.0) for columns in (False, True))
    return (rows + columns).add_(score, alpha=4.0)


def _messages(score: Tensor, *, columns: bool, jump: float, slope: float) -> Tensor:
    """Messages of the pixels of a row, or column, on both sides of each about its depth, their sum, `[B, H, W, T]`.

    `jump`, `slope`: penalties of any other depth and of the next bin [nats]. The best depth has 0 in each of the two.
    """
    received = torch.zeros_like(score, memory_format=torch.contiguous_format)
    if score.is_cuda:
        start_warp()
        cubes = score.contiguous(), received
        sent, found = (cast(wp.array, wp.from_torch(cube.flatten(), requires_grad=False)) for cube in cubes)
        stream = wp.stream_from_torch(torch.cuda.current_stream(score.device))
        frames, height, width, bins = score.shape
        launch_messages(
            sent, found, (frames, height, width, bins), columns=columns, jump=jump, slope=slope, stream=stream
        )
        return received
    along = 1 if columns else 2
    _sweep(score.movedim(along, 0), received.movedim(along, 0), jump, slope)
    return received


def _sweep(lines: Tensor, sums: Tensor, jump: float, slope: float) -> None:
    """`_messages` to the places of lines, the first axis."""
    last = len(lines) - 1
    known = lines.new_empty(2, *lines.shape[1:])
    ahead = torch.zeros_like(known)  # the message sent last, forwards and backwards
    nearer, farther, from_nearer, from_farther = ahead[..., :-1], ahead[..., 1:], known[..., :-1], known[..., 1:]
    for place in range(last):
        torch.add(lines[place], ahead[0], out=known[0])
        torch.add(lines[last - place], ahead[1], out=known[1])
        best = known.amax(dim=-1, keepdim=True)
        torch.maximum(known, best - jump, out=ahead)
        known -= slope
        torch.maximum(farther, from_nearer, out=farther)
        torch.maximum(nearer, from_farther, out=nearer)
        ahead -= best
        sums[place + 1] += ahead[0]
        sums[last - place - 1] += ahead[1]


# Belief propagation on a volume of log-likelihoods: the depths that are most probable where neighbours mostly agree.


JUMP = 4.0
"""Usual penalty of any other depth [nats]."""

_SLOPE = 0.5  # penalty of the next bin [nats]
_ROUNDS = 3  # more of them change little


def beliefs(score: Tensor, jump: float = JUMP) -> Tensor:
    """Log-likelihood of each depth of each pixel together with the best depths of all others, `[B, H, W, T]`.

    `jump`: penalty of any other depth [nats].
    """
    rows = columns = score.new_zeros(())
    for _ in range(_ROUNDS):
        rows, columns = (
            _messages(score + others, columns=vertical, jump=jump, slope=_SLOPE)
            for others, vertical in ((columns, False), (rows, True))
        )
    return (rows + columns).add_(score)


# Weighted total variation of a depth map: min over d of Σ w |d − d₀| + λ TV(d), by primal-dual steps.


def total_variation(depth: Tensor, weight: Tensor, *, strength: float = 1.0, iterations: int = 300) -> Tensor:
    """The smoothed maps `[B, H, W]` of d₀, finite, with w ≥ 0 of each pixel, and λ = `strength`.

    TV is the length of the gradient.
    """
    found, ahead = depth.clone(), depth.clone()
    down, right = torch.zeros_like(depth), torch.zeros_like(depth)
    step = 0.35
    far = step * weight
    for _ in range(iterations):
        down[:, :-1] += step * ahead.diff(dim=1)
        right[:, :, :-1] += step * ahead.diff(dim=2)
        length = torch.hypot(down, right).div_(strength).clamp_min_(1.0)
        down /= length
        right /= length
        moved = torch.add(found, down + right, alpha=step)
        moved[:, 1:] -= step * down[:, :-1]
        moved[:, :, 1:] -= step * right[:, :, :-1]
        apart = moved - depth
        new = moved - torch.maximum(torch.minimum(apart, far), -far)  # shrinks what is apart
        ahead = 2.0 * new - found
        found = new
    return found
