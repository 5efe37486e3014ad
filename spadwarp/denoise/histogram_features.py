"""Features of histograms: candidates for the depth of each pixel, their log-likelihoods, and the shape of the return.

A single pixel with one photon among twenty of the background says little; nine pixels, or 225, say more. Pooling blurs
sharp edges, so depth is estimated over windows of several sizes, by belief propagation and by total variation, and a
network chooses. The log-likelihoods let many photons of a pixel outweigh its neighbours. The shape of the return shows
how late the light arrives that water scattered forward.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.classical import (
    GUIDES,
    JUMPS,
    beliefs,
    counts_level,
    edge_penalties,
    guide_channels,
    highest,
    mean_depth,
    pooled,
    total_variation,
)
from spadwarp.denoise.frames import POOLED, SCORED, SIDES
from spadwarp.denoise.scattered_light import LIGHT, light_channels
from spadwarp.denoise.sides import LIKENESS, beside_edges

__all__ = ["EDGES", "FEATURES", "MOST", "SEEN", "TAIL", "WINDOWS", "extract_features", "highest"]
__all__ += ["log_likelihood", "pooled", "toeplitz"]

WINDOWS = (3, 7, 15)
"""Sides of the windows over which histograms are pooled [pixels]."""

EDGES = (-0.12, -0.06, -0.03, -0.01, 0.01, 0.03, 0.06, 0.12, 0.25)
"""Edges of the intervals around the return in which light is counted [gate widths]."""

TAIL = 0.04
"""Mean delay of the scattered light in the template of the largest window [gate widths]."""

MOST = 20.0
"""Differences of log-likelihoods are clipped at this."""

SEEN = POOLED + SCORED * POOLED + SCORED + len(EDGES) - 1 + 2 + GUIDES
"""Number of channels of `extract_features` that go through the network's layers."""

FEATURES = SEEN + POOLED + (2 + SCORED) * SIDES + LIKENESS + LIGHT
"""Number of channels that `extract_features` gives."""

_LEAST_SIGNAL, _SIGNAL_STEP = 0.05, math.log(1.1)  # counts; step of its logarithm, to which it is rounded
_WHOLE, _SURROUNDING = 128, 63  # pixels: frames up to this side have one signal, others that of so many to each side
_SMOOTHED, _STEPS = 0.75, 120  # strength and steps of the total variation among the depths
_UNIFORM_SHARE = 0.3  # part of the signal that may come at any time, so that photons far from the return say little
_MOST_BINS = 384  # finer histograms are rebinned: features need no finer bins


def extract_features(counts: Tensor, background: Tensor, response: Tensor, total: Tensor | None = None) -> Tensor:
    """Candidates for depth, their log-likelihoods and the shape of the return.

    The score of a return in bin k is its log-likelihood ratio less what background alone gives on average,
    Σ_j (n_j − B_j) ln(1 + S h_{j−k} / B'_j), so that dim pixels are not drawn to where background is high. S is the
    mean signal of the frame, or in frames with more than 128 rows or columns that of the 127 × 127 pixels around; B' is
    B plus 0.3 S spread evenly over the gate. Scores of pixels add. The template h is the instrument response; for the
    largest window it is that response with an exponential tail, as light arrives that was scattered forward.

    Args:
        counts: Histograms over the gate, `[B, H, W, T]`.
        background: Expected background counts, > 0, of each pixel `[B, H, W, T]` or the same for all `[B, 1, 1, T]`.
        response: Instrument response per bin centred on its time zero, sum 1, `[B, 2 r + 1]`.
        total: Counts of each pixel, also beyond the bins given here, `[B, H, W]`; default: those in them.

    Returns:
        `[B, FEATURES, H, W]`. `POOLED` depths over the gate: of the highest score of the pixel, of its highest score
        elsewhere, of belief propagation with the usual penalty, of the highest scores over `WINDOWS`, of belief
        propagation with the other `JUMPS`, the total
        variation of the first, and the mean of sum-product beliefs. Then `SCORED` times `POOLED` scores at
        these depths less the highest one, and the `SCORED` highest ones, a tenth of each, down and up to `MOST`: of the
        pixel, of 3 × 3 and of 7 × 7 pixels, and beliefs. Then the excess over the background between `EDGES` around the
        depth of the largest window, as shares over 7 × 7 pixels; and how significant the excess is, in the pixel and in
        7 × 7; and `GUIDES` channels of the counts. Last,
        beyond `SEEN`, the pixel's own scores at the depths, a tenth of them, which are not clipped.
    """
    total = counts.sum(dim=-1) if total is None else total
    merged, given = -(-counts.shape[-1] // _MOST_BINS), counts.shape[-1]
    if merged > 1:
        counts, background, response = _rebinned(counts, background, response, merged)
    bins = counts.shape[-1]
    above = counts - background
    background = background.mean(dim=(1, 2))  # scores are sums over pixels: these have one template
    narrow = toeplitz(response, bins)
    signal = _signal(above)
    score = _correlated(above, background, narrow, signal)
    more = edge_penalties(total)
    usual, *connected = _connected(score, more)
    cubes = [score, *(pooled(score, side) * side**2 for side in WINDOWS[:-1]), usual]
    found = [highest(score), _elsewhere(score, response), *(highest(cube) for cube in (usual, *cubes[1:-1]))]
    delays = torch.arange(bins, device=counts.device)
    tail = torch.exp(-delays / (TAIL * bins))
    distance = delays[:, None] - delays
    late = torch.where(distance >= 0, tail[distance.clamp_min(0)], 0.0) / tail.sum()
    wide = _correlated(above, background, late @ narrow, signal)
    found.append(highest(pooled(wide, WINDOWS[-1])))
    del wide
    anchor, peak = found[-1], score.amax(dim=-1).clamp(0.0, MOST)
    weight = peak / peak.mean(dim=(1, 2), keepdim=True).clamp_min(1e-9)
    found += [*connected, total_variation(found[0], weight, strength=_SMOOTHED, iterations=_STEPS, isotropic=False)]
    found.append(mean_depth(score, *more))
    places = torch.stack(found, dim=-1)
    near = [_near(cube, places) for cube in cubes]
    tops = [cube.amax(dim=-1, keepdim=True) for cube in cubes]
    scores = [0.1 * (one - top).clamp_min(-MOST) for one, top in zip(near, tops, strict=True)]
    peaks = [0.1 * top.clamp(0.0, MOST) for top in tops]
    shares = _shape(above, background, anchor)
    sides, likeness = beside_edges(score, found[2], counts_level(total))
    beside = [_near(cube, sides) for cube in cubes]
    beside = [0.1 * beside[0], *(0.1 * (one - top).clamp_min(-MOST) for one, top in zip(beside, tops, strict=True))]
    scale = merged * bins / given  # the last of merged bins may reach beyond the gate
    guides = torch.stack(guide_channels(total), dim=-1)
    light = torch.stack(light_channels(above, background, found[2], response), dim=-1)
    return torch.cat(
        [scale * places, *scores, *peaks, *shares, guides, 0.1 * near[0], *beside, likeness, light, scale * sides],
        dim=-1,
    ).movedim(-1, 1)


def log_likelihood(counts: Tensor, background: Tensor, response: Tensor) -> Tensor:
    """Score of a return in each bin, as `extract_features` describes it, but in frames of every size with the mean
    signal of the whole frame, `[B, H, W, T]`; arguments as there."""
    above = counts - background
    narrow = toeplitz(response, counts.shape[-1])
    return _correlated(above, background.mean(dim=(1, 2)), narrow, above.sum(dim=-1).mean(dim=(1, 2)))


def _signal(above: Tensor) -> Tensor:
    """Mean excess over the background, of each frame `[B]`; in large frames around each pixel, `[B, H, W]`.

    With the mean of a whole large frame, which a bright target raises, the network takes water far from this target for
    a dim target: its training never had a bright target so far away.
    """
    excess = above.sum(dim=-1)
    if max(excess.shape[1:]) <= _WHOLE:
        return excess.mean(dim=(1, 2))
    return pooled(excess[..., None], 2 * _SURROUNDING + 1)[..., 0]


def _correlated(above: Tensor, background: Tensor, response: Tensor, signal: Tensor) -> Tensor:
    """Scores `[B, H, W, T]` with the template of the signal: that of each frame `[B]`, or of each pixel `[B, H, W]`,
    which is then rounded, by 5 % at most, so that pixels share templates."""
    signal = signal.clamp_min(_LEAST_SIGNAL)
    if signal.ndim == 1:
        return torch.bmm(above.flatten(1, 2), _template(signal, background, response)).view_as(above)
    levels = (signal.log() / _SIGNAL_STEP).round()
    scores = torch.empty_like(above)
    for level in levels.unique():
        templates = _template((level * _SIGNAL_STEP).exp().expand(len(above)), background, response)
        for score, counts, chosen, template in zip(scores, above, levels == level, templates, strict=True):
            score[chosen] = counts[chosen] @ template
    return scores


def _template(signal: Tensor, background: Tensor, response: Tensor) -> Tensor:
    """ln(1 + S h / B') in bin j for a return in bin k, `[B, j, k]`, for S counts of signal `[B]`."""
    floor = _UNIFORM_SHARE * signal[:, None] / response.shape[-1]
    return torch.log1p(signal[:, None, None] / (background + floor)[:, :, None] * response)


def _connected(score: Tensor, more: tuple[Tensor, Tensor]) -> list[Tensor]:
    """Beliefs with the usual penalty `[B, H, W, T]`, and depths over the gate with the other `JUMPS`."""
    jumps = [torch.full((len(score), 1, 1, 1), jump, device=score.device) for jump in JUMPS]
    if score.is_cuda:  # all at once: many small steps
        all_more = more[0].repeat(len(JUMPS), 1, 1), more[1].repeat(len(JUMPS), 1, 1)
        usual, *others = beliefs(score.repeat(len(JUMPS), 1, 1, 1), torch.cat(jumps), all_more).chunk(len(JUMPS))
        return [usual, *map(highest, others)]
    return [beliefs(score, jumps[0], more), *(highest(beliefs(score, jump, more)) for jump in jumps[1:])]


def _elsewhere(score: Tensor, response: Tensor) -> Tensor:
    """Place of the highest score beyond the response around the highest one."""
    bins = score.shape[-1]
    apart = torch.arange(-(response.shape[-1] // 2), response.shape[-1] // 2 + 1, device=score.device)
    width = (response * apart.square()).sum(dim=1).clamp_min(0.1).sqrt()
    best = score.argmax(dim=-1, keepdim=True)
    near = (torch.arange(bins, device=score.device) - best).abs() <= (3.0 * width + 1.0)[:, None, None, None]
    return highest(torch.where(near, score.amin(), score))


def _near(cube: Tensor, places: Tensor) -> Tensor:
    """The highest score within a bin of places over the gate, `[B, H, W, n]`."""
    bins = cube.shape[-1]
    middle = (places * bins).long()
    return torch.stack([cube.gather(-1, (middle + step).clamp(0, bins - 1)) for step in (-1, 0, 1)]).amax(dim=0)


@lru_cache(maxsize=4)
def _edges(device: torch.device) -> Tensor:
    """`EDGES` on a device; kept, so that a CUDA graph finds them there."""
    with torch.inference_mode(False):
        return torch.tensor(EDGES, device=device)


def _shape(above: Tensor, background: Tensor, anchor: Tensor) -> tuple[Tensor, Tensor]:
    """Shares of the excess between `EDGES` around the anchor over the gate `[B, H, W]`, and its significances."""
    edges = anchor[..., None] + _edges(above.device)
    level = _within(background[:, None, None, :].cumsum(dim=-1), edges[..., :: len(EDGES) - 1])[..., 0]
    pixel = _within(above.cumsum(dim=-1), edges[..., :: len(EDGES) - 1])[..., 0] / (level + 1.0).sqrt()
    excess = 49.0 * _within(pooled(above, 7).cumsum(dim=-1), edges)
    spread = ((excess.sum(dim=-1) + 49.0 * level).clamp_min(0.0) + 1.0).sqrt()
    shares = excess / (excess.abs().sum(dim=-1) + spread)[..., None]
    window = excess.sum(dim=-1) / (49.0 * level + 1.0).sqrt()
    return shares, torch.stack([0.5 * torch.asinh(pixel), 0.3 * torch.asinh(window)], dim=-1)


def _rebinned(counts: Tensor, background: Tensor, response: Tensor, merged: int) -> tuple[Tensor, Tensor, Tensor]:
    """The arguments with `merged` bins summed into one; the last may hold fewer."""

    def summed(values: Tensor) -> Tensor:
        return F.pad(values, (0, -values.shape[-1] % merged)).unflatten(-1, (-1, merged)).sum(dim=-1)

    radius = response.shape[-1] // 2
    half, reach = merged // 2, -(-radius // merged) * merged
    response = F.pad(response, (reach + half - radius, reach + merged - 1 - half - radius))
    return summed(counts), summed(background), summed(response)


def toeplitz(response: Tensor, bins: int) -> Tensor:
    """Response in bin j to a return in bin k, `[B, j, k]`."""
    radius = response.shape[-1] // 2
    place = torch.arange(bins, device=response.device)
    distance = place[:, None] - place
    inside = distance.abs() <= radius
    return torch.where(inside, response[:, (distance + radius).clamp(0, 2 * radius)], 0.0)


def _within(cumulative: Tensor, edges: Tensor) -> Tensor:
    """Counts between edges over the gate `[B, H, W, E]`, from cumulative counts; `[B, H, W, E − 1]`."""
    bins = cumulative.shape[-1]
    cumulative = F.pad(cumulative, (1, 0)).expand(*edges.shape[:-1], bins + 1)
    place = edges.clamp(0.0, 1.0) * bins
    below = place.long().clamp(max=bins - 1)
    values = torch.lerp(cumulative.gather(-1, below), cumulative.gather(-1, below + 1), place - below)
    return values.diff(dim=-1)
