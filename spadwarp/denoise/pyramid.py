"""PyramidNet: weighted means of depths that come from the target, with weights from a pyramid of features."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.context import Context, answer
from spadwarp.denoise.frames import POOLED, SCORED
from spadwarp.denoise.histogram_features import SEEN
from spadwarp.denoise.repeatable import edge_padded, enlarged
from spadwarp.denoise.selection import Selection, selected, selected_depth
from spadwarp.denoise.symmetric import GROUP, SymmetricConv, SymmetricWindow, symmetric_mean, turned

__all__ = ["OUTPUTS", "PyramidNet"]

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


# Pixels that see the same two surfaces: the one that nearly all of them take is that of each.


_VOTERS = 3  # pixels around that vote
_ONE_SURFACE, _APART = 0.01, 0.05  # depths this near are one surface, this far apart two [gate widths]
_LEAST, _TIMES = 4, 3.0  # votes for a surface, and how many times the pixels that took the other one, that move to it
_SURE = 4.0  # log-likelihood from which on a return is one [nats]
_PHOTON = 5.0  # log-likelihood of a photon, about the highest [nats]
_CHANCE = 2.0  # deviations by which the two returns may differ


@torch.no_grad()
def follow_the_others(found: Tensor, features: Tensor) -> Tensor:
    """The answers `[B, 1, H, W]` over the gate, some of them moved to a return of their pixel that is far away.

    `features`: see `spadwarp.denoise.histogram_features`, with 0.5 subtracted from the first depths.
    """
    pair, order = (0.5 + features[:, :2]).sort(dim=1)  # the highest return of a pixel and the second, the nearer first
    light = (10.0 * features[:, SEEN : SEEN + 2]).gather(1, order)
    two = (light > _SURE).all(dim=1, keepdim=True) & (pair.diff(dim=1) > _APART)
    pair = torch.where(two, pair, torch.nan)  # near to none
    height, width = found.shape[-2:]
    around = F.pad(torch.cat([pair, found], dim=1), (_VOTERS,) * 4, value=torch.nan)
    votes, taken = torch.zeros_like(pair), torch.zeros_like(pair)
    for y in range(2 * _VOTERS + 1):
        for x in range(2 * _VOTERS + 1):
            if (y, x) != (_VOTERS, _VOTERS):
                other, answer = around[..., y : y + height, x : x + width].split([2, 1], dim=1)
                alike = ((pair - other).abs() < _ONE_SURFACE).all(dim=1, keepdim=True)
                near = (answer - pair).abs() < _ONE_SURFACE
                taken += near
                votes += alike & near
    more = light.flip(1) - light  # of the other return
    by_chance = more <= _CHANCE * (_PHOTON * light.sum(dim=1, keepdim=True)).clamp_min(0.0).sqrt()
    outvoted = (votes >= _LEAST) & (votes >= _TIMES * taken.flip(1))
    moves = outvoted & by_chance & ((found - pair).abs() > _APART)
    return torch.where(moves.any(dim=1, keepdim=True), torch.where(moves, pair, 0.0).sum(dim=1, keepdim=True), found)


LONGEST_DELAY = 0.2
"""Largest delay of forward-scattered light that the network can correct [gate widths]."""

OUTPUTS = ("depth", "target", "confidence", "true")
"""The channels of the output: depth over the gate, and three logits."""

CLOSE = 0.01
"""Two depths this near belong to one return, and a depth this near to the truth is right [gate widths]."""

_WIDEST = 0.1  # depths this far from the first answer still count for the second [gate widths]


class _Residual(nn.Module):
    def __init__(self, features: int) -> None:
        super().__init__()
        self.first = SymmetricConv(features, features, 3)
        self.second = SymmetricConv(features, features, 3)
        nn.init.zeros_(self.second.weight)  # begins as the identity

    def forward(self, x: Tensor) -> Tensor:
        return self.second(F.relu(self.first(F.relu(x)), inplace=True)).add_(x)


class PyramidNet(nn.Module):
    """Weighted means of depths that come from the target, with weights from a pyramid of features.

    A pixel's depth is a convex combination of the 5×5 depths around it, of the mean depths of 3×3 wider windows (9 and
    36 pixels), and of one value of the network's own; with `refines`, what is far from it is then left out, so that two
    surfaces are not mixed. The weight of a depth is the product of two factors: one belongs to the pixel that it comes
    from (the probability that it is the target's depth), the other to the pixel that it goes to (whether the two belong
    together). Depths of signal photons are thereby used as they are, to the millimetre; where there are none, the
    network's own value is used. Kernel prediction: Bako et al., ACM TOG 36, 97 (2017); means weighted by certainty:
    Knutsson & Westin, CVPR 1993. All its layers commute with turns and reflections of the image. `widths` are the
    features of the levels, `last` those of the last layer.

    Its inputs: depth, which pixels reported, how probable backscatter is at the reported depth, and three order
    statistics of each 3×3 neighbourhood, which leave out the scattered photons. The pyramid has the full size, then
    blocks of 2, 4, 8 and 16 pixels.

    The output, `[batch, 4, height, width]`, is `OUTPUTS`: depth over the gate; the logits of "the pixel sees a target",
    of "the depth is right to `CLOSE`", and of "the reported depth is the target's".

    With `histograms` it also sees the channels of `spadwarp.denoise.histogram_features`. Each pixel then first gets a
    depth from the candidates among them, which replaces the reported one in all that follows: the most probable one,
    never the mean of two returns. The delay of scattered light, which the shape of the return shows, is subtracted from
    the result. Last, `spadwarp.denoise.selection` takes the answer or another candidate, and `spadwarp.denoise.context`
    weighs them with the view of a wide surrounding; then pixels with two returns follow those around that have the same
    two (`spadwarp.denoise.pyramid`). A fifth output is the depth of the candidates, and one for each candidate its
    logit. While it learns, there are also the candidates of the selection and their scores, those of the wide view, its
    answer and its logit of "sees a target"; depth and logits are those before the selection.
    """

    radius = 2
    boxes = (9, 36)  # sides of the wider windows
    steps = (6, 24)  # between them
    stride = 16  # sizes are padded to multiples of it

    def __init__(
        self,
        *,
        widths: tuple[int, ...] = (4, 5, 8, 10, 14),
        last: int = 8,
        fine: int = 1,
        refines: bool = True,
        votes: bool = True,
        histograms: bool = False,
    ) -> None:
        super().__init__()
        self.refines, self.votes = refines, votes
        pairs, deep = list(pairwise(widths)), len(widths) - 1
        self.enter = SymmetricConv(6 + VOTES * votes, widths[0], 3, lifts=True)
        self.enter_agreement = SymmetricConv(2, widths[0], 3, bias=False) if votes else None
        self.down = nn.ModuleList(SymmetricConv(wide, narrow, 4, stride=2) for wide, narrow in pairs)
        self.up = nn.ModuleList(SymmetricConv(narrow, wide, 1, bias=False) for wide, narrow in pairs)
        self.before = nn.ModuleList(
            nn.Sequential(*(_Residual(width) for _ in range(1 + (level == deep - 1))))
            for level, width in enumerate(widths[1:])
        )
        self.after = nn.ModuleList(_Residual(width) for width in widths[1:-1])
        self.finish = SymmetricConv(widths[0], widths[0], 3)
        self.polish = nn.ModuleList(_Residual(widths[0]) for _ in range(fine))
        self.spread = SymmetricConv(widths[0], last, 1)
        near = 2 * self.radius + 1
        self.near = SymmetricWindow(last, near)
        self.wide = nn.ModuleList(SymmetricWindow(last, 3) for _ in self.boxes)
        # Weight and value of the network's own depth; logits; reach of refining; weight of the depth voted for.
        self.scalars = nn.Conv2d(last, 5 + refines + votes, 1)
        self.enter_features: SymmetricConv | None = None
        with torch.no_grad():  # begins near the identity
            assert self.scalars.bias is not None
            self.near.bias[0] = 3.0  # of the pixel itself
            for window in self.wide:
                for bias in window.parameters(recurse=False):
                    if bias.ndim == 1:
                        bias.fill_(-2.0)
            self.scalars.weight.mul_(0.3)
            self.scalars.bias.copy_(torch.tensor([-2.0, 0.0, 2.0, 0.0, 2.0, *[-1.0] * refines, *[-2.0] * votes]))
            if self.enter_agreement is not None:
                # Begins with the depth voted for, and with features that count little: noise in the weights would at
                # first teach the features to vanish, after which they learn no more.
                self.scalars.bias[-1] = 3.0
                for layer in (self.scalars, self.near, *self.wide):
                    layer.weight.mul_(0.1)
                for layer in (self.enter_agreement, *self.up):
                    layer.weight.mul_(0.3)
                self.enter.weight[:, -VOTES:].mul_(0.3)
        if histograms:
            self.enter_features = SymmetricConv(SEEN, widths[0], 3, lifts=True, bias=False)
            self.choose = nn.Conv2d(last, 1 + POOLED + 1, 1)  # logits of the reported depth and the candidates; delay
            self.evidence = nn.Parameter(torch.tensor([0.5, 0.2, 0.1, 0.3]))  # weights of scores in these logits
            self.select = Selection()
            self.context: Context | None = Context()
            with torch.no_grad():
                assert self.choose.bias is not None
                self.enter_features.weight.mul_(0.3)
                self.choose.weight.mul_(0.3)
                self.choose.bias.zero_()
                self.choose.bias[-1] = -5.0

    def forward(self, frame: Tensor) -> Tensor:
        """See the class; `frame` as `spadwarp.denoise.networks` describes it."""
        height, width = frame.shape[-2:]
        bottom, right = -height % self.stride, -width % self.stride
        if bottom or right:
            frame = F.pad(frame, (0, right, 0, bottom), mode="replicate")
        depth, reported = frame[:, :1].float(), frame[:, 1:2].float()
        votes = neighbour_votes(depth, reported) if self.votes else None
        x = self._features(frame, votes)
        delay: Tensor | None = None
        extra: list[Tensor] = []
        if self.enter_features is not None:
            depth, delay, extra = self._chosen(depth, frame[:, 3:].float(), x)
            reported = torch.ones_like(depth)
        weights, own, others, reach = self._heads(x)
        values, trusts = _candidates(depth, reported, others[:, 2:], self.radius, self.boxes, self.steps)
        values, trusts = [*values, 0.5 + own], [*trusts, torch.zeros_like(depth)]
        if votes is not None:
            values, trusts = [*values, votes.depth], [*trusts, 1e4 * (votes.support > 0.0) - 1e4]
        parts = weights, torch.cat(trusts, dim=1), torch.cat(values, dim=1), reach
        if torch.is_grad_enabled():
            found = _answer(*parts)
        elif x.is_cuda:
            found = _answer_in_place(*parts)
        else:  # strips of a few rows stay in a CPU's cache
            strips = zip(*(part.split(8, 2) for part in parts), strict=True)
            found = torch.cat([_answer_in_place(*strip) for strip in strips], 2)
        if delay is not None:
            seen = found.detach(), others.detach(), frame[:, 3:].float()
            if torch.is_grad_enabled():
                extra += self._learnt(*seen, delay.detach())
            else:
                found, target = self._last(selected_depth(self.select, *seen), *seen[1:])
                inside = ..., slice(height), slice(width)
                found[inside] = follow_the_others(found[inside], seen[2][inside])
                others = torch.cat([others[:, :1] + target, others[:, 1:]], dim=1)
            found = found - delay
        return torch.cat([found, others, *extra], dim=1)[..., :height, :width]

    def _learnt(self, found: Tensor, logits: Tensor, features: Tensor, delay: Tensor) -> list[Tensor]:
        """Candidates of the selection and their scores; those of the wide view, its answer and its logit "target".

        What comes before is an input here: each learns from its own answer alone.
        """
        assert self.context is not None
        candidates, scores = self.select(found, logits, features)
        depths, weights, target = self.context(selected(candidates, scores).detach(), logits, features)
        last = answer(depths, weights, features)
        return [candidates - delay, scores, depths - delay, weights, last - delay, logits[:, :1] + target]

    def _last(self, before: Tensor, logits: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """The answer with the view of a wide surrounding, and what it adds to the logit of "sees a target".

        With weights of older files, which have no such view, the answer before and 0.
        """
        if self.context is None:
            return before, torch.zeros_like(before)
        depths, scores, target = self.context(before, logits, features)
        return answer(depths, scores, features), target

    def _features(self, frame: Tensor, votes: Votes | None) -> Tensor:
        """Features of every pixel, after a ReLU, `[B, 64, H, W]`."""
        depth, reported, density = (channel.contiguous() for channel in frame[:, :3].split(1, dim=1))
        ranked = [rank - depth for rank in ranks(depth)]
        scalars = [(depth - 0.5) * reported, reported, 0.25 * density, *ranked]
        if votes is not None:
            scalars += [votes.near, votes.wide, votes.depth - depth, votes.support]
        entering = [(self.enter, torch.cat(scalars, dim=1))]
        if votes is not None and self.enter_agreement is not None:
            entering.append((self.enter_agreement, votes.agreement))
        if self.enter_features is not None:
            entering.append((self.enter_features, frame[:, 3 : 3 + SEEN]))
        x = self._entered(entering)
        skipped = []
        for down, before in zip(self.down, self.before, strict=True):
            skipped.append(x)
            x = before(down(F.relu(x)))
        for level in reversed(range(len(skipped))):
            finer = enlarged(self.up[level](x), 2)
            x = finer.add_(skipped[level])
            x = self.after[level - 1](x) if level else x + self.finish(F.relu(x))
        for layer in self.polish:
            x = layer(x)
        return F.relu(self.spread(F.relu(x)), inplace=True)

    def _entered(self, parts: list[tuple[SymmetricConv, Tensor]]) -> Tensor:
        """The sum of convolutions of several images, as one; channels are filled up to a multiple of eight."""
        filters = torch.cat([layer.expanded() for layer, _ in parts], dim=1)
        images = [image.to(filters.dtype) for _, image in parts]
        missing = -filters.shape[1] % 8
        images.append(images[0].new_zeros(()).expand(len(images[0]), missing, *images[0].shape[2:]))
        filters = F.pad(filters, (0, 0, 0, 0, 0, missing)).contiguous(memory_format=torch.channels_last)
        assert self.enter.bias is not None
        bias = self.enter.bias.repeat_interleave(GROUP)
        return F.conv2d(self._as_image(torch.cat(images, dim=1)), filters, bias, padding=self.enter.padding)

    def _as_image(self, channels: Tensor) -> Tensor:
        """In the precision of the layers, and with the channels of a pixel side by side."""
        return channels.to(self.enter.weight.dtype, memory_format=torch.channels_last)

    def _heads(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Weights of all depths, the network's own depth, the three logits and the reach of refining, `[B, n, H, W]`.

        The layers that these come from are applied as one.
        """
        layers = [window.filters() for window in (self.near, *self.wide)]
        # Weights of the own depth and of the one voted for; then what is no weight. Slices, not a list of rows, which
        # would have to be copied to the GPU.
        order = [slice(0, 1), *[slice(-1, None)] * self.votes, slice(1, 5), *[slice(5, 6)] * self.refines]
        assert self.scalars.bias is not None
        for rows in order:
            weight = self.scalars.weight[rows, :, 0, 0].repeat_interleave(GROUP, 1) / GROUP
            layers.append((weight, self.scalars.bias[rows]))
        filters, biases = (torch.cat(parts) for parts in zip(*layers, strict=True))
        # The product of matrices gives rows of images, which what follows is faster with than with rows of channels.
        pixels = x.permute(0, 2, 3, 1).flatten(1, 2).transpose(1, 2)
        found = torch.baddbmm(biases[:, None], filters.expand(len(x), -1, -1), pixels).float()
        found = found.unflatten(2, x.shape[2:])
        logits = 3 + self.refines
        weights, own, others = found.split([found.shape[1] - 1 - logits, 1, logits], dim=1)
        return weights, own, others[:, :3], others[:, 3:]

    def _chosen(self, depth: Tensor, features: Tensor, x: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """A depth for each pixel, the delay of its light; and that depth and the candidates' logits as outputs."""
        candidates = torch.cat([depth, 0.5 + features[:, :POOLED]], dim=1)
        scores = features[:, POOLED : POOLED + SCORED * POOLED].unflatten(1, (SCORED, POOLED))
        scores = torch.cat([scores[:, :, :1], scores], dim=2)  # the reported depth has those of the own return
        head = self.choose(symmetric_mean(x)).float()
        logits = head[:, :-1] + 10.0 * (scores * self.evidence[:, None, None, None]).sum(dim=1)
        weight = torch.softmax(logits, dim=1)
        best = candidates.gather(1, weight.argmax(dim=1, keepdim=True))
        weight = weight * torch.exp(-((candidates - best) / CLOSE).square())
        chosen = (weight * candidates).sum(dim=1, keepdim=True) / weight.sum(dim=1, keepdim=True)
        return chosen, LONGEST_DELAY * torch.sigmoid(head[:, -1:]), [chosen, logits]


def _answer(weights: Tensor, trusts: Tensor, values: Tensor, reach: Tensor) -> Tensor:
    """Weighted mean of the values, then one in which those far from it count less, `[B, 1, H, W]`.

    What comes from another surface keeps little part in the answer. The fall with distance is a power, not an
    exponential: a depth that is not trusted stays so where it is near. At `_WIDEST` sigmoid(reach) it is a quarter.
    There is no second mean where `reach` has no channel.
    """
    weight = torch.softmax(weights + trusts, dim=1)
    found = (weight * values).sum(dim=1, keepdim=True)
    if reach.shape[1]:
        near = (values - found) * (1.0 / (0.002 + _WIDEST * torch.sigmoid(reach)))
        near = weight / torch.addcmul(torch.ones_like(reach), near, near).square()
        found = (near * values).sum(dim=1, keepdim=True) / (near.sum(dim=1, keepdim=True) + 1e-12)
    return found


def _answer_in_place(weights: Tensor, trusts: Tensor, values: Tensor, reach: Tensor) -> Tensor:
    """The same as `_answer` in less time, without derivatives."""
    weight = weights + trusts
    weight.sub_(weight.amax(dim=1, keepdim=True)).exp_()
    part = weight * values
    found = part.sum(dim=1, keepdim=True).div_(weight.sum(dim=1, keepdim=True))
    if reach.shape[1]:
        near = torch.sub(values, found, out=part).mul_(reach.sigmoid().mul_(_WIDEST).add_(0.002).reciprocal_())
        weight.div_(near.square_().add_(1.0).square_())
        found = torch.mul(weight, values, out=part).sum(dim=1, keepdim=True)
        found.div_(weight.sum(dim=1, keepdim=True).add_(1e-12))
    return found


def _candidates(
    depth: Tensor, reported: Tensor, true: Tensor, radius: int, boxes: tuple[int, ...], steps: tuple[int, ...]
) -> tuple[list[Tensor], list[Tensor]]:
    """Depths around each pixel and the logarithms of their certainty, each `[B, 1, H, W]`."""
    certainty = torch.sigmoid(true) * reported
    values = _windows(depth, 2 * radius + 1, 1)
    trusts = _windows(F.logsigmoid(true) + 1e4 * (reported - 1.0), 2 * radius + 1, 1)
    both = torch.cat([certainty * depth, certainty], dim=1)
    for box, step in zip(boxes, steps, strict=True):
        coarse = 1 if box < 16 else 4
        mean = F.avg_pool2d(both, coarse) if coarse > 1 else both
        side = box // coarse
        mean = F.avg_pool2d(mean, (side, 1), 1, (side // 2, 0))
        mean = F.avg_pool2d(mean, (1, side), 1, (0, side // 2))
        if coarse > 1:
            mean = enlarged(mean, coarse)
        share = mean[:, 1:] + 1e-6
        values += _windows(mean[:, :1] / share, 3, step)
        trusts += _windows(torch.log(share), 3, step)
    return values, trusts


def _windows(image: Tensor, side: int, step: int) -> list[Tensor]:
    """The values of an image `[B, 1, H, W]` at `side`² places `step` pixels apart around each pixel."""
    height, width = image.shape[-2:]
    reach = side // 2 * step
    padded = edge_padded(image, reach)
    starts = range(0, 2 * reach + 1, step)
    return [padded[..., y : y + height, x : x + width] for y in starts for x in starts]


def ranks(depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The third, fifth and seventh of the nine sorted values of each 3×3 neighbourhood.

    Columns are sorted, then rows, after which columns are still so: what can be third is the second in size of two
    sorted pairs, and the fifth is the middle one of the diagonal (Paeth, Graphics Gems, 1990).
    """
    height, width = depth.shape[-2:]
    padded = F.pad(depth, (1, 1, 1, 1), mode="replicate")
    column = _sorted(*(padded[..., row : row + height, :] for row in range(3)))
    least, middle, most = (_sorted(*(line[..., first : first + width] for first in range(3))) for line in column)
    third = torch.minimum(torch.maximum(least[1], middle[0]), torch.minimum(least[2], most[0]))
    fifth = _sorted(least[2], middle[1], most[0])[1]
    seventh = torch.maximum(torch.minimum(middle[2], most[1]), torch.maximum(least[2], most[0]))
    return third, fifth, seventh


def _sorted(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    a, b = torch.minimum(a, b), torch.maximum(a, b)
    b, c = torch.minimum(b, c), torch.maximum(b, c)
    return torch.minimum(a, b), torch.maximum(a, b), c
