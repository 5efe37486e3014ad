"""Classical estimates from counts: the likelihood of pixels, of windows, and of whole frames.

A `score` is the log-likelihood of a return in each bin of each pixel, `[B, H, W, T]` [nats].
"""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from spadwarp.denoise.baselines import Classical
from spadwarp.denoise.histograms import CountFrames
from spadwarp.device import start_warp
from spadwarp_kernels.detection import launch_messages

TUNINGS: dict[Classical, tuple[float, ...]] = {
    "likelihood": (1,),
    "pooled": (3, 5, 7, 11, 15),
    "semi-global": (5.0, 10.0, 20.0, 40.0),
    "total-variation": (0.5, 1.0, 2.0, 4.0),
    "belief-propagation": (2.5, 4.0, 8.0, 16.0),
}
"""Tuned values: sides of the window [pixels], penalties of a jump [nats], strengths."""


def classical_depth(
    frames: CountFrames, *, method: Classical, tuning: float | None = None, device: str | None = None
) -> NDArray[np.float32]:
    """Depth over the gate, `[N, H, W]`, 0 at its start and 1 at its end.

    `"likelihood"`: of each pixel alone. `"pooled"`: of windows of pixels. `"semi-global"`: matching of the likelihoods.
    `"total-variation"`: of the likelihood depth, each pixel weighted by how far its likelihood stands out.
    `"belief-propagation"`: on the likelihoods, the strongest of these in most cases.

    `tuning`: see `TUNINGS`; default: 7 pixels, `usual_jump`, strength 1, a penalty of 4 nats.
    """
    found = []
    with torch.inference_mode():
        for cube, level, tap in frames.tensors(device):
            score = log_likelihood(cube, level, tap)
            if method == "pooled":
                score = pooled(score, int(tuning or 7))
            elif method == "semi-global":
                score = aggregate(score, jump=usual_jump(score) if tuning is None else tuning)
            elif method == "belief-propagation":
                score = beliefs(score, JUMP if tuning is None else tuning)
            depth = highest(score)
            if method == "total-variation":
                weight = score.amax(dim=-1).clamp(0.0, 20.0)
                weight /= weight.mean().clamp_min(1e-9)
                depth = total_variation(depth, weight, strength=tuning or 1.0)
            found.append(depth[0].cpu().numpy())
    return np.stack(found).astype(np.float32)


_LEAST_SIGNAL = 0.05  # counts
_UNIFORM_SHARE = 0.3  # part of the signal that may come at any time, so that photons far from the return say little


def toeplitz(response: Tensor, bins: int) -> Tensor:
    """Response `[B, 2 r + 1]` in bin j to a return in bin k, `[B, j, k]`."""
    radius = response.shape[-1] // 2
    place = torch.arange(bins, device=response.device)
    distance = place[:, None] - place
    inside = distance.abs() <= radius
    return torch.where(inside, response[:, (distance + radius).clamp(0, 2 * radius)], 0.0)


def log_likelihood(counts: Tensor, background: Tensor, response: Tensor) -> Tensor:
    """Log-likelihood ratio of a return in each bin, less what background alone gives on average, `[B, H, W, T]`.

    Σ_j (n_j − B_j) ln(1 + S h_{j−k} / B'_j), so that dim pixels are not drawn to where background is high. S is the
    mean signal of the frame, h the response, B' the background plus 0.3 S spread evenly over the gate. The sum over
    pixels is that of the pixels together.

    Args:
        counts: Histograms over the gate, `[B, H, W, T]`.
        background: Expected background counts, > 0, of each pixel `[B, H, W, T]` or the same for all `[B, 1, 1, T]`.
        response: Instrument response per bin centred on its time zero, sum 1, `[B, 2 r + 1]`.
    """
    above, bins = counts - background, counts.shape[-1]
    signal = above.sum(dim=-1).mean(dim=(1, 2)).clamp_min(_LEAST_SIGNAL)
    floor = background.mean(dim=(1, 2)) + _UNIFORM_SHARE * signal[:, None] / bins
    template = torch.log1p(signal[:, None, None] / floor[:, :, None] * toeplitz(response, bins))
    return torch.bmm(above.flatten(1, 2), template).view_as(above)


def deviation(response: Tensor, least: float) -> Tensor:
    """Standard deviation of responses `[B, 2 r + 1]` about their time zero, `[B]` [bins]; its square is >= `least`."""
    offset = torch.arange(response.shape[-1], device=response.device) - response.shape[-1] // 2
    return (response * offset.square()).sum(dim=-1).clamp_min(least).sqrt()


def interpolated(cumulative: Tensor, place: Tensor) -> Tensor:
    """Of cumulative counts at the edges of bins `[..., T + 1]`, those before places `[..., E]` [bins]."""
    bins = cumulative.shape[-1] - 1
    place = place.clamp(0.0, float(bins))
    below = place.long().clamp(max=bins - 1)
    cumulative = cumulative.expand(*place.shape[:-1], bins + 1)
    return torch.lerp(cumulative.gather(-1, below), cumulative.gather(-1, below + 1), place - below)


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
        shape = cast(tuple[int, int, int, int], tuple(score.shape))
        launch_messages(sent, found, shape, columns=columns, jump=jump, slope=slope, stream=stream)
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
    cost = {"jump": jump, "slope": _SLOPE}
    for _ in range(_ROUNDS):
        rows, columns = _messages(score + columns, columns=False, **cost), _messages(score + rows, columns=True, **cost)
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
