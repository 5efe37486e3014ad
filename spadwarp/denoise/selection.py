"""The last choice of the network for histograms: its answer, or another depth that the photons make more probable.

A few pixels with a wrong surface cost more than all the others together: a thin handle that its surroundings outvote, a
weaker second return that by chance has more photons. For each candidate a small network, the same for all pixels, sees
what speaks for it: the photons of the pixel and of those around it, how far it is from the other candidates, and
whether pixels around have the same depth.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.frames import POOLED, SCORED
from spadwarp.denoise.histogram_features import MOST, SEEN

__all__ = ["CHOICES", "Selection", "selected", "selected_depth"]

CHOICES = 1 + 2 + POOLED + 1
"""Candidates: the network's answer, its medians over 3 × 3 and 5 × 5 pixels, the depths among the features, and the
median of belief propagation over 3 × 3 pixels."""

_REACH = 2  # pixels around a pixel that its choice depends on
_PIXELS_AT_ONCE = 1 << 14  # of which candidates are held in memory
_CLOSE = 0.01  # a candidate this near to a pooled depth has its score [gate widths]
_SPREAD = 0.004  # candidates this near to the one chosen count, too [gate widths]
_OF_CHOICE = 19  # what is known of a candidate
_OF_PIXEL = 2 * SCORED + (SEEN - POOLED - SCORED * POOLED - SCORED) + 3 + 2  # and of its pixel


class Selection(nn.Module):
    """Scores of `CHOICES` for every pixel. With new weights the network's own answer has the highest.

    Args:
        hidden: Size of the two hidden layers.
    """

    def __init__(self, hidden: int = 24) -> None:
        super().__init__()
        self.choice, self.pixel = nn.Linear(_OF_CHOICE, hidden), nn.Linear(_OF_PIXEL, hidden, bias=False)
        self.kind = nn.Parameter(0.3 * torch.randn(CHOICES, hidden))
        self.middle, self.last = nn.Linear(hidden, hidden), nn.Linear(hidden, 1)
        self.bias = nn.Parameter(torch.zeros(CHOICES))
        with torch.no_grad():
            self.bias[0] = 3.0
            self.last.weight.mul_(0.3)

    def forward(
        self, found: Tensor, logits: Tensor, features: Tensor, typical: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Candidates over the gate and their scores, each `[B, CHOICES, H, W]`.

        Args:
            found: The network's answer over the gate `[B, 1, H, W]`.
            logits: Its three logits `[B, 3, H, W]`.
            features: See `spadwarp.denoise.histogram_features`, with 0.5 subtracted from depths.
            typical: Of the frames that these are parts of, `[B, 1 + SCORED, 1, 1]`; default: of these.
        """
        typical = _typical(features) if typical is None else typical
        candidates, of_choice, of_pixel = _evidence(found, logits, features, typical)
        known = self.choice(of_choice.movedim(2, -1)) + self.pixel(of_pixel.movedim(1, -1))[:, None]
        known = F.relu(known + self.kind[:, None, None])
        return candidates, self.last(F.relu(self.middle(known)))[..., 0] + self.bias[:, None, None]


def selected_depth(selection: Selection, found: Tensor, logits: Tensor, features: Tensor) -> Tensor:
    """`selected` of frames, strip by strip, `[B, 1, H, W]`; arguments are those of `Selection.forward`."""
    height, width = found.shape[-2:]
    rows = max(1, _PIXELS_AT_ONCE // width)
    answer = torch.empty_like(found)
    for frame in range(len(found)):
        whole = [image[frame : frame + 1] for image in (found, logits, features)]
        typical = _typical(whole[2])
        for top in range(0, height, rows):
            first, last = max(0, top - _REACH), top + rows + _REACH
            strip = selected(*selection(*(image[:, :, first:last] for image in whole), typical))
            answer[frame, :, top : top + rows] = strip[0, :, top - first : top - first + rows]
    return answer


def selected(candidates: Tensor, scores: Tensor) -> Tensor:
    """The candidate with the highest score, and what is very near to it; never the mean of two surfaces."""
    weight = torch.softmax(scores, dim=1)
    best = candidates.gather(1, weight.argmax(dim=1, keepdim=True))
    weight = weight * torch.exp(-((candidates - best) / _SPREAD).square())
    return (weight * candidates).sum(dim=1, keepdim=True) / weight.sum(dim=1, keepdim=True)


def _typical(features: Tensor) -> Tensor:
    """Medians over a frame of the second return's log-likelihood and of the highest scores, `[B, 1 + SCORED, 1, 1]`."""
    tops = features[:, POOLED + SCORED * POOLED : POOLED + SCORED * POOLED + SCORED]
    values = torch.cat([features[:, SEEN + 1 : SEEN + 2], tops], dim=1)
    return values.flatten(2).median(dim=2).values[:, :, None, None]


def _evidence(found: Tensor, logits: Tensor, features: Tensor, typical: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Candidates `[B, K, H, W]`, what is known of each `[B, K, C, H, W]`, and of the pixel `[B, P, H, W]`."""
    depths, own = 0.5 + features[:, :POOLED], features[:, SEEN : SEEN + POOLED]
    scores = features[:, POOLED : POOLED + SCORED * POOLED].unflatten(1, (SCORED, POOLED))
    tops, rest = features[:, POOLED + SCORED * POOLED : SEEN].tensor_split([SCORED], dim=1)
    near, wide = _around(found, 3), _around(found, 5)
    matched, first, second = (_around(depths[:, place : place + 1], 3) for place in (2, 0, 1))
    inner, outer = (around.median(dim=1, keepdim=True).values for around in (near, wide))
    candidates = torch.cat([found, inner, outer, depths, matched.median(dim=1, keepdim=True).values], dim=1)
    beside = (candidates[:, :, None] - depths[:, None]).abs() < _CLOSE

    def at(values: Tensor, otherwise: float) -> Tensor:
        """The highest value of the pooled depths near each candidate."""
        return torch.where(beside, values[:, None], otherwise).amax(dim=2)

    def agreeing(around: Tensor, reach: float) -> Tensor:
        """Part of the depths around that agree with each candidate."""
        agreeing = torch.zeros_like(candidates)
        for one in around.split(1, dim=1):
            agreeing += (candidates - one).abs_().mul_(-1.0 / reach).exp_()
        return agreeing / around.shape[1]

    usual, top, mine = typical[:, :1], own[:, :1], at(own, -1.0)
    apart = (candidates - found).abs()
    of_choice = [
        *(at(scores[:, window], -0.1 * MOST) for window in range(SCORED)),
        torch.asinh(mine - usual), torch.asinh(top - usual).expand_as(mine),
        *(torch.tanh(apart / reach) for reach in (0.003, 0.01, 0.1)),
        agreeing(wide, 0.004), agreeing(wide, 0.02), agreeing(matched, 0.004),
        agreeing(depths, 0.004), agreeing(depths, 0.02),
        torch.asinh(top - mine), (at(own, 0.0) / top.clamp_min(0.05)).clamp(-1.0, 1.5),
        agreeing(first, 0.006), agreeing(_around(depths[:, :1], 5), 0.006),
        agreeing(torch.cat([first, second], dim=1), 0.006),
    ]  # fmt: skip
    rough = [20.0 * (around - one).abs().mean(dim=1, keepdim=True) for around, one in ((wide, outer), (near, inner))]
    of_pixel = [tops, typical[:, 1:].expand_as(tops), rest, 0.25 * logits, *rough]
    return candidates, torch.stack(of_choice, dim=2), torch.cat(of_pixel, dim=1)


def _around(image: Tensor, side: int) -> Tensor:
    """The values of `side` × `side` pixels around each, `[B, side², H, W]`."""
    half, (height, width) = side // 2, image.shape[-2:]
    padded = F.pad(image, (half,) * 4, mode="replicate")
    parts = [padded[..., y : y + height, x : x + width] for y in range(side) for x in range(side)]
    return torch.cat(parts, dim=1)
