"""The last choice of the network for histograms, with the view of a wide surrounding.

Where photons are few, nearly all of the squared error comes from pixels beside edges of depth. Which surface such a
pixel sees, the pixel and its nearest neighbours do not tell; the course of the edge does, and that of the counts. So
depths are written as parts of the way from the nearer to the farther surface around each pixel, with the
log-likelihoods of all, and a pyramid of features weighs them.
"""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.frames import POOLED, SCORED, SIDES
from spadwarp.denoise.histogram_features import SEEN
from spadwarp.denoise.repeatable import enlarged
from spadwarp.denoise.scattered_light import LIGHT
from spadwarp.denoise.sides import LIKENESS
from spadwarp.denoise.symmetric import GROUP, SymmetricConv

__all__ = ["ANSWERS", "Context", "answer"]

ANSWERS = 1 + POOLED + SIDES
"""Candidates: the network's answer before, the depths among the features, and those of both sides."""

_SEEN = ANSWERS + 2 + (SEEN - POOLED) + POOLED + SIDES * (1 + SCORED) + LIKENESS + 3 + 3 + 2
_LEAST = 0.01  # added to the way between both sides [gate widths]
_SURE = 12.0  # from such a highest log-likelihood of a pixel on, its answer is one surface [nats]
_SPREAD = 0.004  # candidates this near to the one chosen count, too [gate widths]


class _Residual(nn.Module):
    def __init__(self, features: int) -> None:
        super().__init__()
        self.first, self.second = (SymmetricConv(features, features, 3) for _ in range(2))
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(F.relu(self.first(F.relu(x))))


class Context(nn.Module):
    """Weights of `ANSWERS` depths for every pixel. With new weights the answer before keeps nearly all of it.

    Args:
        widths: Features of the levels, each of eight channels that turn with the image.
        hidden: Scalars of a pixel.
    """

    def __init__(self, widths: tuple[int, ...] = (8, 12, 16, 24), hidden: int = 64) -> None:
        super().__init__()
        self.pixel = nn.Sequential(nn.Conv2d(_SEEN, hidden, 1), nn.ReLU(), nn.Conv2d(hidden, hidden, 1), nn.ReLU())
        self.light = nn.Conv2d(LIGHT, hidden, 1, bias=False)
        self.enter = SymmetricConv(hidden, widths[0], 3, lifts=True)
        pairs = list(pairwise(widths))
        self.first = _Residual(widths[0])
        self.down = nn.ModuleList(SymmetricConv(wide, narrow, 4, stride=2) for wide, narrow in pairs)
        self.before = nn.ModuleList(_Residual(width) for width in widths[1:])
        self.deep = _Residual(widths[-1])
        self.up = nn.ModuleList(SymmetricConv(narrow, wide, 1, bias=False) for wide, narrow in pairs)
        self.after = nn.ModuleList(_Residual(width) for width in widths[:-1])
        self.last = SymmetricConv(widths[0], 8, 1)
        self.head = nn.Sequential(nn.Conv2d(16 + hidden, hidden, 1), nn.ReLU(), nn.Conv2d(hidden, ANSWERS, 1))
        self.target = nn.Sequential(nn.Conv2d(16 + hidden, hidden, 1), nn.ReLU(), nn.Conv2d(hidden, 1, 1))
        self.stride = 2 ** len(pairs)
        final, target = self.head[-1], self.target[-1]
        with torch.no_grad():
            for one in (self.light.weight, target.weight, target.bias):
                one.zero_()  # type: ignore[operator]
            final.weight.mul_(0.1)  # type: ignore[operator]
            final.bias.zero_()  # type: ignore[operator]
            final.bias[0] = 3.0  # type: ignore[index, operator]

    def forward(self, found: Tensor, logits: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Depths over the gate and their scores, each `[B, ANSWERS, H, W]`; what is added to the target's logit.

        Args:
            found: The answer before, over the gate, `[B, 1, H, W]`.
            logits: The network's three logits `[B, 3, H, W]`.
            features: See `spadwarp.denoise.histogram_features`, with 0.5 subtracted from the first depths.
        """
        depths, seen, light = _seen(found, logits, features)
        height, width = found.shape[-2:]
        bottom, right = -height % self.stride, -width % self.stride
        if bottom or right:
            seen, light = (F.pad(image, (0, right, 0, bottom), mode="replicate") for image in (seen, light))
        pixel = self.pixel[1:](self.pixel[0](seen) + self.light(light))
        x = self.first(self.enter(pixel))
        skipped = []
        for down, before in zip(self.down, self.before, strict=True):
            skipped.append(x)
            x = before(down(F.relu(x)))
        x = self.deep(x)
        for up, after, skip in reversed(list(zip(self.up, self.after, skipped, strict=True))):
            x = after(skip + enlarged(up(x), 2))
        x = F.relu(self.last(F.relu(x))).unflatten(1, (-1, GROUP))
        x = torch.cat([x.mean(dim=2), x.amax(dim=2), pixel], dim=1)
        scores, target = (head(x).float()[..., :height, :width] for head in (self.head, self.target))
        return depths, scores, target


def answer(depths: Tensor, scores: Tensor, features: Tensor) -> Tensor:
    """Mean of the depths where photons are few; else the one with the highest score, `[B, 1, H, W]`."""
    weight = torch.softmax(scores, dim=1)
    best = depths.gather(1, weight.argmax(dim=1, keepdim=True))
    peak = 10.0 * features[:, POOLED + SCORED * POOLED :][:, :1]
    spread = _SPREAD + torch.sigmoid(_SURE - peak)
    weight = weight * torch.exp(-((depths - best) / spread).square())
    return (weight * depths).sum(dim=1, keepdim=True) / weight.sum(dim=1, keepdim=True)


def _seen(found: Tensor, logits: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Candidates, and what the layers see; the last part of it apart."""
    rest, own = features[:, POOLED:SEEN], features[:, SEEN : SEEN + POOLED]
    beside, light, sides = features[:, SEEN + POOLED :].tensor_split([-SIDES - LIGHT, -SIDES], dim=1)
    depths = torch.cat([found, 0.5 + features[:, :POOLED], sides], dim=1)
    front, back = sides[:, 2:3], sides[:, 3:4]
    parts = ((depths - front) / (back - front + _LEAST)).clamp(-1.0, 2.0)
    steps = 0.3 * torch.log(torch.cat([back - front, sides[:, 1:2] - sides[:, :1]], dim=1).clamp_min(0.0) + 0.003) + 1.0
    scores = torch.cat([torch.asinh(own), torch.asinh(beside[:, :SIDES]), beside[:, SIDES:]], dim=1)
    places = 2.0 * torch.cat([found, front, back], dim=1) - 1.0
    peak = rest[:, SCORED * POOLED : SCORED * POOLED + 2]
    level = peak.mean(dim=(2, 3), keepdim=True).expand_as(peak)
    return depths, torch.cat([parts, steps, rest, scores, 0.25 * logits, places, level], dim=1), light
