"""Which of a pixel's neighbours report the same depth, and the depth for which most of them vote."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from spadwarp.denoise.symmetric import GROUP, turned

__all__ = ["VOTES", "Votes", "neighbour_votes"]

VOTES = 4
"""Scalar channels among the votes: `near`, `wide`, `depth` and `support`."""

_SAME, _ALIKE = 0.012, 0.04  # depths this far apart do not agree, among 3 × 3 and 5 × 5 pixels [gate widths]
_FAR = 10.0  # behind any depth that is reported [gate widths]
_REACH = 3  # pixels of padding, more than those of a pair are apart
_RING = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0))
_SHARPNESS = 6.0  # a depth with one vote more counts exp(_SHARPNESS) times as much


class Votes(NamedTuple):
    """Agreement of reported depths: 1 where two are equal, falling to 0, and 0 where one is missing.

    Attributes:
        near, wide: Mean agreement of a pixel with the 8 and the 24 pixels around it, `[B, 1, H, W]`.
        depth: Of the eight pixels around it, the depth with which most of them agree, `[B, 1, H, W]`; 1 where none
            reports.
        support: How many of the eight agree with it, over 8, `[B, 1, H, W]`.
        agreement: With each of the eight, as two features whose channels turn with the image, `[B, 16, H, W]`.
    """

    near: Tensor
    wide: Tensor
    depth: Tensor
    support: Tensor
    agreement: Tensor


@torch.no_grad()
def neighbour_votes(depth: Tensor, reported: Tensor) -> Votes:
    """Votes of frames of depth over the gate and of which pixels reported, `[B, 1, H, W]`."""
    height, width = depth.shape[-2:]
    # Pixels that are missing, or beyond the border, agree with none: each has a depth of its own far behind the gate.
    image = F.pad(torch.where(reported > 0.5, depth, torch.nan), (_REACH,) * 4, value=torch.nan)
    image = torch.where(torch.isnan(image), _apart(*image.shape[-2:], image.device), image)

    def beside(values: Tensor, place: tuple[int, int]) -> Tensor:
        y, x = (_REACH + step for step in place)
        return values[..., y : y + height, x : x + width]

    agreeing: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}  # of all pixels with those so many rows, columns away
    # All images as one line, in which a neighbour is a fixed number of places away; what crosses a border is not used.
    line, row, pixels = image.flatten(), image.shape[3], image.numel()
    line = torch.cat([line, line[: 2 * row + 2]])
    for step in ((y, x) for y in range(3) for x in range(-2, 3) if (y, x) > (0, 0)):
        places = step[0] * row + step[1]
        apart = (line[:pixels] - line[places : places + pixels]).abs_().view_as(image)
        fine, coarse = (torch.rsub(apart, 1.0, alpha=1.0 / most).clamp_min_(0.0) for most in (_SAME, _ALIKE))
        agreeing[step] = fine, coarse

    def pair(one: tuple[int, int], other: tuple[int, int], kind: int = 0) -> Tensor:
        """Agreement of the pixels at two places beside each pixel."""
        first, second = sorted((one, other))
        return beside(agreeing[second[0] - first[0], second[1] - first[1]][kind], first)

    around = [(y, x) for y in range(-2, 3) for x in range(-2, 3) if (y, x) != (0, 0)]
    single = {place: pair((0, 0), place) for place in _RING}
    near = sum(single.values(), torch.zeros_like(depth)) / 8.0
    wide = sum((pair((0, 0), place, 1) for place in around), torch.zeros_like(depth)) / 24.0
    depths = [beside(image, place) for place in _RING]
    counts = [(value < _FAR).float() for value in depths]
    for first, one in enumerate(_RING):
        for second in range(first + 1, 8):
            agree = pair(one, _RING[second])
            counts[first].add_(agree)
            counts[second].add_(agree)
    count = torch.cat(counts, dim=1)
    most = count.amax(dim=1, keepdim=True)
    weight = torch.exp(_SHARPNESS * (count - most)) * (count > 0.0)
    ring = torch.cat(depths, dim=1)
    total = weight.sum(dim=1, keepdim=True)
    voted = torch.where(total > 0.0, (weight * ring).sum(dim=1, keepdim=True) / total.clamp_min(1e-9), 1.0)
    agreement = torch.cat([single[place] for place in _directions()], dim=1)
    return Votes(near, wide, voted, most / 8.0, agreement)


@lru_cache(maxsize=4)
def _apart(rows: int, columns: int, device: torch.device) -> Tensor:
    """Depths behind the gate of which no two within five rows and columns are equal, `[rows, columns]`."""
    with torch.inference_mode(False):
        row, column = torch.arange(rows, device=device) % 5, torch.arange(columns, device=device) % 5
        return _FAR + 5.0 * row[:, None] + column


@lru_cache(maxsize=1)
def _directions() -> tuple[tuple[int, int], ...]:
    """The neighbour beside a pixel, and the one at its corner, turned by each element of `GROUP`."""
    places = []
    for start in ((1, 2), (2, 2)):
        for element in range(GROUP):
            probe = np.zeros((3, 3), np.int64)
            probe[start] = 1
            row, column = np.argwhere(turned(probe, element))[0]
            places.append((int(row) - 1, int(column) - 1))
    return tuple(places)
