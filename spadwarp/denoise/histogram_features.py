"""Features of histograms: candidates for the depth of each pixel, their log-likelihoods, and the shape of the return.

A single pixel with one photon among twenty of the background says little; nine pixels, or 225, say more. Pooling blurs
sharp edges, so depth is estimated over windows of several sizes, by belief propagation and by total variation, and a
network chooses. The log-likelihoods let many photons of a pixel outweigh its neighbours. The shape of the return shows
how late the light arrives that water scattered forward. Depths, `place` and `anchor` are over the gate, `[B, H, W]`.
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
    aggregate,
    beliefs,
    edge_penalties,
    guide_channels,
    highest,
    mean_depth,
    pooled,
    total_variation,
)
from spadwarp.denoise.frames import POOLED, SCORED, SIDES

# What tells light that water scattered forward, beside a bright target, from a dim target. Both have the depth of a
# target and far more counts than backscatter. The scattered light is a few per cent as bright as the target beside it,
# and later: less of it arrives within the instrument response around its peak.

LIGHT = 14
"""Number of channels of `light_channels`."""

_NEAR, _FAR = 10, 30  # pixels within which the brightest neighbourhood is looked for
_WINDOWS = 3, 7  # sides of the windows whose counts are summed [pixels]
_REACHES = 2.0, 8.0  # half widths around the peak, in deviations of the instrument response


def light_channels(above: Tensor, background: Tensor, place: Tensor, response: Tensor) -> list[Tensor]:
    """Brightness and lateness of the light of each pixel, `LIGHT` times `[B, H, W]`.

    Logarithms of the excess over the background: of 3 × 3 pixels, relative to the background, and relative to the
    brightest 3 × 3 pixels around; the same of the pixel alone. Then the parts of the excess near the peak, in a wider
    interval around it, and after that, over 3 × 3 and 7 × 7 pixels; and the differences of these from the means around
    the pixel, in which bright pixels count most.

    `above`: counts less the expected background, `[B, H, W, T]`; `background`: of each bin, mean over the frame,
    `[B, T]`; `place`: of each pixel's peak; `response`: as in `extract_features`.
    """
    level = background.sum(dim=-1)[:, None, None]
    excess = above.sum(dim=-1)
    bright = _around(excess, 3).clamp_min(0.0)
    most = [_brightest(bright, reach) for reach in (_NEAR, _FAR)]
    parts = _parts(above, place, response)
    wide = [_around(part, side) for side in _WINDOWS for part in (excess, *parts)]
    shares = []
    for number, side in enumerate(_WINDOWS):
        whole, *some = wide[4 * number : 4 * number + 4]
        noise = (whole.clamp_min(0.0) + level + 0.5).sqrt() / side
        shares += [(part / (whole.clamp_min(0.0) + noise)).clamp(-1.0, 2.0) for part in some]
    weight = bright.square() + 1e-6
    far = 2 * _FAR + 1
    total = _around(weight, far)
    typical = [_around(weight * share, far) / total for share in shares[3:]]
    own = excess.clamp_min(0.0)
    return [
        0.2 * (bright + 0.1).log(),
        0.2 * ((bright + 0.3) / (level + 0.3)).log(),
        *(0.3 * ((bright + 0.2) / (one + 0.2)).log() for one in most),
        0.3 * ((own + 1.0) / (most[1] + 1.0)).log(),
        *shares,
        *(share - one for share, one in zip(shares[3:], typical, strict=True)),
    ]


def _parts(above: Tensor, place: Tensor, response: Tensor) -> list[Tensor]:
    """Excess within the nearer and the farther of `_REACHES` around the peak, and after the farther, `[B, H, W]`."""
    bins, radius = above.shape[-1], response.shape[-1] // 2
    offset = torch.arange(-radius, radius + 1, device=above.device)
    deviation = (response * offset.square()).sum(dim=1).clamp_min(0.25).sqrt()[:, None, None]
    cumulative, centre = above.cumsum(dim=-1), place * bins
    edges = [centre + sign * (reach * deviation + 0.5) for reach in _REACHES for sign in (-1.0, 1.0)]
    first, last, start, stop = _counts_before(cumulative, torch.stack(edges, dim=-1)).unbind(dim=-1)
    return [last - first, stop - start, cumulative[..., -1] - stop]


def _brightest(image: Tensor, reach: int) -> Tensor:
    """The highest value up to `reach` pixels away in rows and columns."""
    side = 2 * reach + 1
    highest = F.max_pool2d(image[:, None], (side, 1), 1, (reach, 0))
    return F.max_pool2d(highest, (1, side), 1, (0, reach))[:, 0]


def _around(image: Tensor, side: int) -> Tensor:
    return pooled(image[..., None], side)[..., 0]


# The two surfaces beside a depth edge. Nearly all of the squared error at few photons comes from pixels beside edges
# that are given to the wrong side. Named as two depths for each pixel, with the log-likelihood of each, the question
# becomes one of segmentation, at which a network is good.

REACHES = (2, 5)
"""Pixels up to which a side is looked for."""

_RIGID = 40.0  # penalty of a jump in semi-global matching that keeps to one of two returns [nats]


def beside_edges(score: Tensor, usual: Tensor) -> Tensor:
    """`SIDES` depths over the gate, `[B, H, W, SIDES]`.

    For each of `REACHES` the nearer and the farther surface; then, by the photons of the pixel, the most probable depth
    from the one to the other of the shorter reach, and the mean depth for each reach. Last, the depth of semi-global
    matching with a penalty that keeps a pixel to one of its two returns. `usual`: depth by belief propagation.
    """
    found = _nearer_and_farther(usual)
    inside = [_between(score, *found[place : place + 2]) for place in range(0, len(found), 2)]
    rigid = aggregate(score, jump=score.new_full((len(score), 1, 1, 1), _RIGID))
    return torch.stack([*found, inside[0][0], *(mean for _, mean in inside), highest(rigid)], dim=-1)


def _nearer_and_farther(depth: Tensor) -> list[Tensor]:
    """For each of `REACHES` the depths of the nearer and of the farther surface around a pixel.

    The depths `depth` `[B, H, W]` of a window are parted at the middle between its least and its largest; each part has
    the mean of its depths, of which the next to the pixel count most.
    """
    height, width = depth.shape[-2:]
    found = []
    for reach in REACHES:
        places = F.pad(depth[:, None], (reach,) * 4, mode="replicate")
        side = 2 * reach + 1
        low = -F.max_pool2d(F.max_pool2d(-places, (side, 1), 1), (1, side), 1)
        middle = 0.5 * (low + F.max_pool2d(F.max_pool2d(places, (side, 1), 1), (1, side), 1))
        nearer, farther = depth.new_zeros(2, len(depth), 2, height, width)  # sums of weights, and of weighted depths
        unit = torch.ones_like(middle)
        for y in range(side):
            for x in range(side):
                one = places[..., y : y + height, x : x + width]
                known = torch.cat([unit, one], dim=1) * (1.0 + (y - reach) ** 2 + (x - reach) ** 2) ** -2
                near = (one <= middle).to(one.dtype) * known
                nearer += near
                farther += known - near
        front, back = (part[:, 1] / part[:, 0].clamp_min(1e-6) for part in (nearer, farther))
        found += [front, torch.where(farther[:, 0] <= 1e-6, front, back)]  # or one depth everywhere
    return found


def _between(score: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
    """Highest place and mean place of a return that lies from `near` to `far`, by the photons of the pixel.

    Depth maps that were scaled down, and steep slopes, have depths between the surfaces on both sides.
    """
    bins = score.shape[-1]
    place = torch.arange(bins, device=score.device) + 0.5
    inside = (place >= near[..., None] * bins - 1.0) & (place <= far[..., None] * bins + 1.0)
    score = torch.where(inside, score, -1e4)
    return highest(score), torch.softmax(score, dim=-1) @ place / bins


# All features.

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

FEATURES = SEEN + POOLED + (2 + SCORED) * SIDES + LIGHT
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
        propagation with the other `JUMPS`, the total variation of the first, and the mean of sum-product beliefs. Then
        `SCORED` times `POOLED` scores at these depths less the highest one, and the `SCORED` highest ones, a tenth of
        each, down and up to `MOST`: of the pixel, of 3 × 3 and of 7 × 7 pixels, and beliefs. Then the excess over the
        background between `EDGES` around the depth of the largest window, as shares over 7 × 7 pixels; and how
        significant the excess is, in the pixel and in 7 × 7; and `GUIDES` channels of the counts. Last, beyond `SEEN`,
        the pixel's own scores at the depths, a tenth of them, which are not clipped; and of `beside_edges` the scores,
        `light_channels` and the depths.
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
    sides = beside_edges(score, found[2])
    beside = [_near(cube, sides) for cube in cubes]
    beside = [0.1 * beside[0], *(0.1 * (one - top).clamp_min(-MOST) for one, top in zip(beside, tops, strict=True))]
    scale = merged * bins / given  # the last of merged bins may reach beyond the gate
    guides = torch.stack(guide_channels(total), dim=-1)
    light = torch.stack(light_channels(above, background, found[2], response), dim=-1)
    return torch.cat(
        [scale * places, *scores, *peaks, *shares, guides, 0.1 * near[0], *beside, light, scale * sides],
        dim=-1,
    ).movedim(-1, 1)


def log_likelihood(counts: Tensor, background: Tensor, response: Tensor) -> Tensor:
    """Scores as in `extract_features`, `[B, H, W, T]`, but in every frame with the mean signal of the whole."""
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
    return _around(excess, 2 * _SURROUNDING + 1)


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
    """Shares of the excess between `EDGES` around the anchor, and its significances."""
    edges = (anchor[..., None] + _edges(above.device)) * above.shape[-1]
    ends = edges[..., :: len(EDGES) - 1]
    level = _counts_before(background[:, None, None, :].cumsum(dim=-1), ends).diff(dim=-1)[..., 0]
    pixel = _counts_before(above.cumsum(dim=-1), ends).diff(dim=-1)[..., 0] / (level + 1.0).sqrt()
    excess = 49.0 * _counts_before(pooled(above, 7).cumsum(dim=-1), edges).diff(dim=-1)
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


def _counts_before(cumulative: Tensor, place: Tensor) -> Tensor:
    """Of cumulative counts, those before places `[B, H, W, E]` [bins]."""
    bins = cumulative.shape[-1]
    cumulative = F.pad(cumulative, (1, 0)).expand(*place.shape[:-1], bins + 1)
    place = place.clamp(0.0, float(bins))
    below = place.long().clamp(max=bins - 1)
    return torch.lerp(cumulative.gather(-1, below), cumulative.gather(-1, below + 1), place - below)
