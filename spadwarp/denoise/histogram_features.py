"""Features of histograms beyond the depth of each pixel: depth of pooled histograms, and the shape of the return.

A single pixel with one photon among twenty of the background says little; nine pixels, or 225, say more. Pooling blurs
sharp edges, so depth is estimated over windows of several sizes, and a network chooses. The shape of the return shows
how late the light arrives that water scattered forward.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.frames import POOLED

__all__ = ["EDGES", "FEATURES", "TAIL", "WINDOWS", "extract_features", "toeplitz"]

WINDOWS = (3, 7, 15)
"""Sides of the windows over which histograms are pooled [pixels]."""

EDGES = (-0.12, -0.06, -0.03, -0.01, 0.01, 0.03, 0.06, 0.12, 0.25)
"""Edges of the intervals around the return in which light is counted [gate widths]."""

TAIL = 0.04
"""Mean delay of the scattered light in the template of the largest window [gate widths]."""

assert len(WINDOWS) == POOLED
FEATURES = len(WINDOWS) + len(EDGES) - 1 + 2
"""Number of channels that `extract_features` gives."""

_UNIFORM_SHARE = 0.3  # part of the signal that may come at any time, so that photons far from the return say little
_MOST_BINS = 384  # finer histograms are rebinned: features need no finer bins


def extract_features(counts: Tensor, background: Tensor, response: Tensor) -> Tensor:
    """Depth of pooled histograms and the shape of the return.

    The score of a return in bin k is its log-likelihood ratio less what background alone gives on average,
    Σ_j (n_j − B_j) ln(1 + S h_{j−k} / B'_j), so that dim pixels are not drawn to where background is high. S is the
    mean signal of the frame; B' is B plus 0.3 S spread evenly over the gate. Scores of pixels add. The template h is
    the instrument response for the two smaller windows; for the largest it is that response with an exponential tail,
    as light arrives that was scattered forward.

    Args:
        counts: Histograms over the gate, `[B, H, W, T]`.
        background: Expected background counts, > 0, of each pixel `[B, H, W, T]` or the same for all `[B, 1, 1, T]`.
        response: Instrument response per bin centred on its time zero, sum 1, `[B, 2 r + 1]`.

    Returns:
        `[B, FEATURES, H, W]`: depth over the gate for each of `WINDOWS`; the excess over the background between
        `EDGES` around the last of these depths, as shares over 7 × 7 pixels; and how significant the excess is, in the
        pixel and in 7 × 7.
    """
    merged, given = -(-counts.shape[-1] // _MOST_BINS), counts.shape[-1]
    if merged > 1:
        counts, background, response = _rebinned(counts, background, response, merged)
    bins = counts.shape[-1]
    above = counts - background
    background = background.mean(dim=(1, 2))  # scores are sums over pixels: these have one template
    signal = above.sum(dim=-1).mean(dim=(1, 2)).clamp_min(0.05)
    narrow = toeplitz(response, bins)
    delays = torch.arange(bins, device=counts.device)
    tail = torch.exp(-delays / (TAIL * bins))
    distance = delays[:, None] - delays
    late = torch.where(distance >= 0, tail[distance.clamp_min(0)], 0.0) / tail.sum()
    floor = _UNIFORM_SHARE * signal[:, None] / bins
    ratio = signal[:, None, None] / (background + floor)[:, :, None]

    score = torch.bmm(above.flatten(1, 2), torch.log1p(ratio * narrow)).view_as(counts)
    found = [_highest(_pooled(score, side)) for side in WINDOWS[:-1]]
    score = torch.bmm(above.flatten(1, 2), torch.log1p(ratio * (late @ narrow))).view_as(counts)
    found.append(_highest(_pooled(score, WINDOWS[-1])))
    del score

    anchor = found[-1]
    edges = anchor[..., None] + torch.tensor(EDGES, device=counts.device)
    level = _within(background[:, None, None, :].cumsum(dim=-1), edges[..., [0, -1]])[..., 0]
    pixel = _within(above.cumsum(dim=-1), edges[..., [0, -1]])[..., 0] / (level + 1.0).sqrt()
    excess = 49.0 * _within(_pooled(above, 7).cumsum(dim=-1), edges)
    spread = ((excess.sum(dim=-1) + 49.0 * level).clamp_min(0.0) + 1.0).sqrt()
    shares = excess / (excess.abs().sum(dim=-1) + spread)[..., None]
    pooled = excess.sum(dim=-1) / (49.0 * level + 1.0).sqrt()
    significance = [0.5 * torch.asinh(pixel), 0.3 * torch.asinh(pooled)]
    found = [depth * (merged * bins / given) for depth in found]  # the last of merged bins may reach beyond the gate
    return torch.stack([*found, *shares.unbind(dim=-1), *significance], dim=1)


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


def _pooled(cube: Tensor, side: int) -> Tensor:
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


def _highest(score: Tensor) -> Tensor:
    """Place of the highest score over the gate, to fractions of a bin by the parabola through its neighbours."""
    bins = score.shape[-1]
    best = score.argmax(dim=-1, keepdim=True)
    inner = best.clamp(1, max(1, bins - 2))
    before, at, after = (score.gather(-1, (inner + step).clamp(0, bins - 1))[..., 0] for step in (-1, 0, 1))
    curvature = (2.0 * at - before - after).clamp_min(1e-9)
    offset = (0.5 * (after - before) / curvature).clamp(-0.5, 0.5)
    offset = torch.where(best[..., 0] == inner[..., 0], offset, 0.0)
    return (best[..., 0] + 0.5 + offset) / bins


def _within(cumulative: Tensor, edges: Tensor) -> Tensor:
    """Counts between edges over the gate `[B, H, W, E]`, from cumulative counts; `[B, H, W, E − 1]`."""
    bins = cumulative.shape[-1]
    cumulative = F.pad(cumulative, (1, 0)).expand(*edges.shape[:-1], bins + 1)
    place = edges.clamp(0.0, 1.0) * bins
    below = place.long().clamp(max=bins - 1)
    values = torch.lerp(cumulative.gather(-1, below), cumulative.gather(-1, below + 1), place - below)
    return values.diff(dim=-1)
