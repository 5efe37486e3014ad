"""The networks: layers, USDN, DnCNN, and PyramidNet, which also sees the water's backscatter; its input from frames.

All take `[batch, 3, height, width]`: depth over the gate (0 at its start, 1 at its end; 1 where nothing was reported),
1 where the pixel reported something, and the logarithm of the backscatter's density at the reported depth (mean 1; 0
for a flat profile), within ±`LOG_DENSITY_LIMIT`. They return denoised depth over the gate, `[batch, 1, height, width]`;
PyramidNet also three logits. Lengths in depth are in gate widths. The network for histograms is in
`spadwarp.denoise.histogram_network`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor, nn

from spadwarp.denoise.frames import LOG_DENSITY_LIMIT, MARGIN
from spadwarp.denoise.histogram_network import HistogramNet, filled_up
from spadwarp.denoise.network_files import Precision, weights_header, weights_path
from spadwarp.values import FileError

# Layers whose derivatives are summed in a fixed order. PyTorch adds those of interpolation, padding and indexing on a
# GPU with atomic operations, in the order in which threads happen to arrive. The values are PyTorch's own; a seed gives
# the same weights on a GPU, too.


def enlarged(image: Tensor, factor: int) -> Tensor:
    """Bilinear interpolation of `[B, C, H, W]` to `factor` times as many pixels, an even number."""
    return _Enlarged.apply(image, factor)  # type: ignore[no-any-return, no-untyped-call]


class _Enlarged(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, image: Tensor, factor: int) -> Tensor:
        context.factor = factor
        return F.interpolate(image, scale_factor=float(factor), mode="bilinear", align_corners=False)

    @staticmethod
    def backward(context: Any, *derivatives: Tensor) -> tuple[Tensor, None]:
        (found,), factor = derivatives, context.factor
        kind, half = found.dtype, factor // 2
        # A pixel has a part in `2 factor` of the larger image. Beyond a border the image is mirrored: what the mirrored
        # ones would add is what those at the border have more.
        parts = [(min(k, 2 * factor - 1 - k) + 0.5) / factor for k in range(2 * factor)]
        found = found.to(torch.promote_types(kind, torch.float32))
        for dim in (2, 3):
            first, last = (found.narrow(dim, place, half).flip(dim) for place in (0, -half))
            seen = torch.cat([first, found, last], dim).unfold(dim, 2 * factor, factor).unbind(dim=-1)
            found = seen[0] * parts[0]
            for part, one in zip(parts[1:], seen[1:], strict=True):
                found.add_(one, alpha=part)
        return found.to(kind), None


def edge_padded(image: Tensor, reach: int) -> Tensor:
    """`[B, C, H, W]` with `reach` more pixels on each side, which have the values of the nearest."""
    for dim in (3, 2):
        first, last = (image.narrow(dim, place, 1).repeat_interleave(reach, dim) for place in (0, -1))
        image = torch.cat([first, image, last], dim)
    return image


def permuted(values: Tensor, places: Tensor) -> Tensor:
    """`values[..., places]`, `[..., g, n]`, for g permutations `[g, n]`: no two derivatives go to the same place."""
    shape = *values.shape[:-1], *places.shape
    return values[..., None, :].expand(shape).gather(-1, places.expand(shape))


# Convolutions that commute with turns and reflections of a square. A feature has eight channels, one for each turn or
# reflection of its filter: turning the image turns the channels and permutes them. Cohen & Welling, ICML 2016
# (group-equivariant convolutional networks, p4m).

GROUP = 8
"""Turns and reflections of a square."""


def turned(image: NDArray[np.int64], element: int) -> NDArray[np.int64]:
    """An image `[..., k, k]` acted on by one of the eight elements."""
    return np.rot90(np.flip(image, -1) if element >= 4 else image, element % 4, axes=(-2, -1))


_TURNED = np.stack([turned(np.arange(9).reshape(3, 3), element) for element in range(GROUP)])  # places, by element


@lru_cache(maxsize=32)
def _expansion(size: int, channels: Literal[1, 8]) -> Tensor:
    """Places in a flat filter `[channels, size, size]` that each of the eight takes, `[8, channels size²]`."""
    elements = _TURNED.reshape(GROUP, -1)
    products = elements[:, elements]  # of each element, after each g
    quotients = (products[:, :, None] == elements).all(axis=-1).argmax(axis=0)  # index of g⁻¹ h for g and h
    places = np.arange(channels * size * size).reshape(channels, size, size)
    parts = [turned(places[quotients[g]] if channels == GROUP else places, g) for g in range(GROUP)]
    return torch.from_numpy(np.stack(parts)).flatten(1)


class SymmetricConv(nn.Module):
    """Convolution of features, or of an image's scalar channels with `lifts`, that commutes with `GROUP`.

    With a stride of 2 the symmetry is kept only for filters and images of even sides.
    """

    places: Tensor  # which are not saved with the weights

    def __init__(
        self, inputs: int, outputs: int, size: int, *, stride: int = 1, lifts: bool = False, bias: bool = True
    ) -> None:
        super().__init__()
        channels = 1 if lifts else GROUP
        self.size, self.stride, self.padding = size, stride, (size - stride + 1) // 2
        self.weight = nn.Parameter(torch.empty(outputs, inputs, channels * size * size))
        nn.init.normal_(self.weight, std=(2.0 / (inputs * channels * size * size)) ** 0.5)
        self.bias = nn.Parameter(torch.zeros(outputs)) if bias else None
        self.register_buffer("places", _expansion(size, channels), persistent=False)
        self._kept: Tensor | None = None

    def expanded(self) -> Tensor:
        """The filters of an ordinary convolution, `[8 outputs, inputs, size, size]`."""
        if self._kept is not None and not torch.is_grad_enabled():
            return self._kept
        filters = permuted(self.weight, self.places).unflatten(-1, (-1, self.size, self.size))
        filters = filters.transpose(1, 2).flatten(2, 3).flatten(0, 1)
        if torch.is_grad_enabled() or self.training:
            return filters
        self._kept = filters.detach().contiguous(memory_format=torch.channels_last)
        return self._kept

    def train(self, mode: bool = True) -> SymmetricConv:  # called before a network with new weights answers
        self._kept = None
        return super().train(mode)

    def forward(self, x: Tensor) -> Tensor:
        bias = None if self.bias is None else self.bias[:, None].expand(-1, GROUP).flatten()
        return F.conv2d(x, self.expanded(), bias, self.stride, self.padding)


class SymmetricWindow(nn.Module):
    """Values for the places of a `side` × `side` window around each pixel, which turn with the image."""

    places: Tensor
    classes: Tensor  # of places with the same bias

    def __init__(self, inputs: int, side: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(inputs, side * side) * (0.3 / (GROUP * inputs) ** 0.5))
        distance = (torch.arange(side) - side // 2).abs()
        classes = torch.stack([torch.minimum(distance[:, None], distance), torch.maximum(distance[:, None], distance)])
        _, index = torch.unique(classes.flatten(1), dim=1, return_inverse=True)
        self.bias = nn.Parameter(torch.zeros(int(index.max()) + 1))
        self.register_buffer("classes", index, persistent=False)
        self.register_buffer("places", _expansion(side, 1), persistent=False)

    def filters(self) -> tuple[Tensor, Tensor]:
        """Weights `[side², 8 inputs]` and biases `[side²]` of a layer of 1 × 1 pixels."""
        weight = permuted(self.weight, self.places).flatten(0, 1)
        chosen = self.classes[:, None] == torch.arange(len(self.bias), device=self.bias.device)
        return weight.t(), (chosen * self.bias).sum(dim=1)


class USDN(nn.Module):
    """DehazeNet (Cai et al., IEEE TIP 25, 5187, 2016) made fully convolutional, as the paper describes its denoiser.

    5×5 convolution, maxout, three scales, 7×7 maximum, one map, bounded ReLU; of one channel, depth.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(1, 16, 5, padding=2)
        self.scales = nn.ModuleList(nn.Conv2d(4, 16, size, padding=size // 2) for size in (3, 5, 7))
        self.last = nn.Conv2d(48, 1, 6)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight)
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        nn.init.constant_(self.last.bias, 0.5)  # type: ignore[arg-type]  # inside the bounds, where there is a slope

    def forward(self, frame: Tensor) -> Tensor:
        features = self.first(frame[:, :1]).unflatten(1, (4, 4)).amax(dim=2)
        features = torch.cat([scale(features) for scale in self.scales], dim=1)
        features = F.max_pool2d(features, 7, stride=1, padding=3)
        depth = self.last(edge_padded(features, 3)[..., 1:, 1:])
        return depth if self.training else depth.clamp(0.0, 1.0)  # what learns has a slope beyond the bounds, too


class DnCNN(nn.Module):
    """Residual learning of the noise, 17 layers of 64 channels: Zhang et al., IEEE TIP 26, 3142 (2017); depth only."""

    def __init__(self) -> None:
        super().__init__()
        body: list[nn.Module] = [nn.Conv2d(1, 64, 3, padding=1), nn.ReLU(inplace=True)]
        for _ in range(15):
            body += [nn.Conv2d(64, 64, 3, padding=1, bias=False), nn.BatchNorm2d(64), nn.ReLU(inplace=True)]
        self.body = nn.Sequential(*body, nn.Conv2d(64, 1, 3, padding=1))
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight)

    def forward(self, frame: Tensor) -> Tensor:
        return frame[:, :1] - self.body(frame[:, :1]).to(frame.dtype)


# Votes of neighbours: which reported depths agree.

_SCALARS = 4  # scalar channels among the votes: near, wide, depth and support
_SAME, _ALIKE = 0.012, 0.04  # depths this far apart do not agree, among 3 × 3 and 5 × 5 pixels
_FAR = 10.0  # behind any depth that is reported
_BORDER = 3  # pixels of padding, more than those of a pair are apart
_AROUND = tuple((y, x) for y in range(-2, 3) for x in range(-2, 3) if (y, x) != (0, 0))
_RING = tuple((y, x) for y, x in _AROUND if max(abs(y), abs(x)) == 1)
# The neighbour beside a pixel, and the one at its corner, turned by each element of `GROUP`.
_DIRECTIONS = [(int(y) - 1, int(x) - 1) for pixel in (5, 8) for _, y, x in np.argwhere(pixel == _TURNED)]
_SHARPNESS = 6.0  # a depth with one vote more counts exp(_SHARPNESS) times as much


class Votes(NamedTuple):
    """Agreement of reported depths, `[B, n, H, W]`: 1 where two are equal, falling to 0, and 0 where one is missing."""

    near: Tensor  # mean over the 8 pixels around
    wide: Tensor  # mean over the 24 pixels around
    depth: Tensor  # of the eight, with which most of them agree; 1 where none reports
    support: Tensor  # how many of the eight agree with it, over 8
    agreement: Tensor  # with each of the eight, as two features whose channels turn with the image, `[B, 16, H, W]`


@torch.no_grad()
def neighbour_votes(depth: Tensor, reported: Tensor) -> Votes:
    """Votes of frames of depth over the gate and of which pixels reported, `[B, 1, H, W]`."""
    height, width = depth.shape[-2:]
    # Pixels that are missing, or beyond the border, agree with none: each has a depth of its own far behind the gate.
    image = F.pad(torch.where(reported > 0.5, depth, torch.nan), (_BORDER,) * 4, value=torch.nan)
    image = torch.where(torch.isnan(image), _apart(*image.shape[-2:], image.device), image)

    def beside(values: Tensor, place: tuple[int, int]) -> Tensor:
        y, x = (_BORDER + step for step in place)
        return values[..., y : y + height, x : x + width]

    agreeing: dict[tuple[int, int], tuple[Tensor, ...]] = {}  # of all pixels with those so many rows, columns away
    # All images as one line, in which a neighbour is a fixed number of places away; what crosses a border is not used.
    line, row, pixels = image.flatten(), image.shape[3], image.numel()
    line = torch.cat([line, line[: 2 * row + 2]])
    for step in (place for place in _AROUND if place > (0, 0)):
        places = step[0] * row + step[1]
        apart = (line[:pixels] - line[places : places + pixels]).abs_().view_as(image)
        agreeing[step] = tuple(torch.rsub(apart, 1.0, alpha=1.0 / most).clamp_min_(0.0) for most in (_SAME, _ALIKE))

    def pair(one: tuple[int, int], other: tuple[int, int], kind: int = 0) -> Tensor:
        """Agreement of the pixels at two places beside each pixel."""
        first, second = sorted((one, other))
        return beside(agreeing[second[0] - first[0], second[1] - first[1]][kind], first)

    single = {place: pair((0, 0), place) for place in _RING}
    near = sum(single.values(), torch.zeros_like(depth)) / 8.0
    wide = sum((pair((0, 0), place, 1) for place in _AROUND), torch.zeros_like(depth)) / 24.0
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
    agreement = torch.cat([single[place] for place in _DIRECTIONS], dim=1)
    return Votes(near, wide, voted, most / 8.0, agreement)


@lru_cache(maxsize=4)
def _apart(rows: int, columns: int, device: torch.device) -> Tensor:
    """Depths behind the gate of which no two within five rows and columns are equal, `[rows, columns]`."""
    with torch.inference_mode(False):
        row, column = torch.arange(rows, device=device) % 5, torch.arange(columns, device=device) % 5
        return _FAR + 5.0 * row[:, None] + column


class _Residual(nn.Module):
    def __init__(self, features: int) -> None:
        super().__init__()
        self.first = SymmetricConv(features, features, 3)
        self.second = SymmetricConv(features, features, 3)
        nn.init.zeros_(self.second.weight)  # begins as the identity

    def forward(self, x: Tensor) -> Tensor:
        return self.second(F.relu(self.first(F.relu(x)), inplace=True)).add_(x)


_WIDEST = 0.1  # depths this far from the first answer still count for the second
_NEAR = 5  # side of the window whose depths are taken as they are
_BOXES = (9, 6, 1), (36, 24, 4)  # sides of wider windows whose means are taken, pixels between them, and their grid


class PyramidNet(nn.Module):
    """Weighted means of depths that come from the target, with weights from a pyramid of features.

    A pixel's depth is a convex combination of the 5×5 depths around it, of the mean depths of 3×3 wider windows (9 and
    36 pixels), of the depth that neighbours vote for, and of one value of the network's own; what is far from it is
    then left out, so that two surfaces are not mixed. The weight of a depth is the product of two factors: the
    probability that it is the target's, and whether it belongs to the pixel that it goes to. Depths of signal photons
    are thereby used as they are, to the millimetre. Kernel prediction: Bako et al., ACM TOG 36, 97 (2017); means
    weighted by certainty: Knutsson & Westin, CVPR 1993. All its layers commute with turns and reflections of the image.

    The output, `[batch, 4, height, width]`: depth over the gate; the logits of "the pixel sees a target", of "the depth
    is right to `CLOSE`", and of "the reported depth is the target's".
    """

    stride = 16  # sizes are filled up to multiples of it

    def __init__(self) -> None:
        super().__init__()
        widths, last = (4, 5, 8, 10, 14), 8  # features of the levels, and of the heads
        pairs = list(pairwise(widths))
        self.enter = SymmetricConv(6 + _SCALARS, widths[0], 3, lifts=True)
        self.enter_agreement = SymmetricConv(2, widths[0], 3, bias=False)
        self.down = nn.ModuleList(SymmetricConv(wide, narrow, 4, stride=2) for wide, narrow in pairs)
        self.up = nn.ModuleList(SymmetricConv(narrow, wide, 1, bias=False) for wide, narrow in pairs)
        blocks = [*([width] for width in widths[1:-1]), [widths[-1]] * 2]  # their widths, by level below the first
        self.before = nn.ModuleList(nn.Sequential(*map(_Residual, level)) for level in blocks)
        self.after = nn.ModuleList(_Residual(width) for width in widths[1:-1])
        self.finish = SymmetricConv(widths[0], widths[0], 3)
        self.polish = nn.ModuleList([_Residual(widths[0])])
        self.spread = SymmetricConv(widths[0], last, 1)
        self.near = SymmetricWindow(last, _NEAR)
        self.wide = nn.ModuleList(SymmetricWindow(last, 3) for _ in _BOXES)
        # Weight and value of the network's own depth; logits; reach of refining; weight of the depth voted for.
        self.scalars = nn.Conv2d(last, 7, 1)
        with torch.no_grad():  # begins near the identity
            assert self.scalars.bias is not None
            self.near.bias[0] = 3.0  # of the pixel itself
            for window in self.wide:
                nn.init.constant_(window.bias, -2.0)  # type: ignore[arg-type]
            self.scalars.weight.mul_(0.3)
            self.scalars.bias.copy_(torch.tensor([-2.0, 0.0, 2.0, 0.0, 2.0, -1.0, 3.0]))
            # Begins with the depth voted for, and with features that count little: noise in the weights would at first
            # teach the features to vanish, after which they learn no more.
            for layer in (self.scalars, self.near, *self.wide):
                layer.weight.mul_(0.1)
            for layer in (self.enter_agreement, *self.up):
                layer.weight.mul_(0.3)
            self.enter.weight[:, -_SCALARS:].mul_(0.3)

    def forward(self, frame: Tensor) -> Tensor:
        """See the class; `frame` as the head of this file describes it."""
        height, width = frame.shape[-2:]
        frame = filled_up(frame, self.stride)
        depth, reported = frame[:, :1].float(), frame[:, 1:2].float()
        votes = neighbour_votes(depth, reported)
        x = self._features(frame, votes)
        weights, own, others, reach = self._heads(x)
        values, trusts = _candidates(depth, reported, others[:, 2:])
        values = [*values, 0.5 + own, votes.depth]
        trusts = [*trusts, torch.zeros_like(depth), 1e4 * (votes.support > 0.0) - 1e4]
        parts = weights, torch.cat(trusts, dim=1), torch.cat(values, dim=1), reach
        if torch.is_grad_enabled():
            found = _answer(*parts)
        elif x.is_cuda:
            found = _answer_in_place(*parts)
        else:  # strips of a few rows stay in a CPU's cache
            strips = zip(*(part.split(8, 2) for part in parts), strict=True)
            found = torch.cat([_answer_in_place(*strip) for strip in strips], 2)
        return torch.cat([found, others], dim=1)[..., :height, :width]

    def _features(self, frame: Tensor, votes: Votes) -> Tensor:
        """Features of every pixel, after a ReLU, `[B, 64, H, W]`."""
        depth, reported, density = (channel.contiguous() for channel in frame[:, :3].split(1, dim=1))
        ranked = [rank - depth for rank in ranks(depth)]
        scalars = [(depth - 0.5) * reported, reported, 0.25 * density, *ranked]
        scalars += [votes.near, votes.wide, votes.depth - depth, votes.support]
        # One convolution of both images, whose channels are filled up to a multiple of eight.
        filters = torch.cat([self.enter.expanded(), self.enter_agreement.expanded()], dim=1)
        missing = -filters.shape[1] % 8
        images = [torch.cat(scalars, dim=1).to(filters.dtype), votes.agreement.to(filters.dtype)]
        images.append(filters.new_zeros(()).expand(len(frame), missing, *frame.shape[2:]))
        filters = F.pad(filters, (0, 0, 0, 0, 0, missing)).contiguous(memory_format=torch.channels_last)
        assert self.enter.bias is not None
        bias = self.enter.bias.repeat_interleave(GROUP)
        # In the precision of the layers, and with the channels of a pixel side by side.
        image = torch.cat(images, dim=1).to(filters.dtype, memory_format=torch.channels_last)
        x = F.conv2d(image, filters, bias, padding=self.enter.padding)
        skipped = []
        for down, before in zip(self.down, self.before, strict=True):
            skipped.append(x)
            x = before(down(F.relu(x)))
        for level in reversed(range(len(skipped))):
            x = enlarged(self.up[level](x), 2).add_(skipped[level])
            x = self.after[level - 1](x) if level else x + self.finish(F.relu(x))
        return F.relu(self.spread(F.relu(self.polish[0](x))), inplace=True)

    def _heads(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Weights of all depths, the network's own depth, the three logits and the reach of refining, `[B, n, H, W]`.

        The layers that these come from are applied as one.
        """
        layers = [window.filters() for window in (self.near, *self.wide)]
        # Weights of the own depth and of the one voted for; then what is no weight. Slices, not a list of rows, which
        # would have to be copied to the GPU.
        order = [slice(0, 1), slice(-1, None), slice(1, 5), slice(5, 6)]
        weight, bias = self.scalars.weight[..., 0, 0].repeat_interleave(GROUP, 1) / GROUP, self.scalars.bias
        layers += [(weight[rows], bias[rows]) for rows in order]  # type: ignore[index]
        filters, biases = (torch.cat(parts) for parts in zip(*layers, strict=True))
        # The product of matrices gives rows of images, which what follows is faster with than with rows of channels.
        pixels = x.permute(0, 2, 3, 1).flatten(1, 2).transpose(1, 2)
        found = torch.baddbmm(biases[:, None], filters.expand(len(x), -1, -1), pixels).float()
        return found.unflatten(2, x.shape[2:]).split([found.shape[1] - 5, 1, 3, 1], dim=1)


def _answer(weights: Tensor, trusts: Tensor, values: Tensor, reach: Tensor) -> Tensor:
    """Weighted mean of the values, then one in which those far from it count less.

    What comes from another surface keeps little part in the answer. The fall with distance is a power, not an
    exponential: a depth that is not trusted stays so where it is near. At `_WIDEST` sigmoid(reach) it is a quarter.
    """
    weight = torch.softmax(weights + trusts, dim=1)
    found = (weight * values).sum(dim=1, keepdim=True)
    near = (values - found) * (1.0 / (0.002 + _WIDEST * torch.sigmoid(reach)))
    near = weight / torch.addcmul(torch.ones_like(reach), near, near).square()
    return (near * values).sum(dim=1, keepdim=True) / (near.sum(dim=1, keepdim=True) + 1e-12)


def _answer_in_place(weights: Tensor, trusts: Tensor, values: Tensor, reach: Tensor) -> Tensor:
    """The same as `_answer` in less time, without derivatives."""
    weight = weights + trusts
    weight.sub_(weight.amax(dim=1, keepdim=True)).exp_()
    part = weight * values
    found = part.sum(dim=1, keepdim=True).div_(weight.sum(dim=1, keepdim=True))
    near = torch.sub(values, found, out=part).mul_(reach.sigmoid().mul_(_WIDEST).add_(0.002).reciprocal_())
    weight.div_(near.square_().add_(1.0).square_())
    found = torch.mul(weight, values, out=part).sum(dim=1, keepdim=True)
    return found.div_(weight.sum(dim=1, keepdim=True).add_(1e-12))


def _candidates(depth: Tensor, reported: Tensor, true: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """Depths around each pixel and the logarithms of their certainty, each `[B, 1, H, W]`."""
    certainty = torch.sigmoid(true) * reported
    values = _windows(depth, _NEAR, 1)
    trusts = _windows(F.logsigmoid(true) + 1e4 * (reported - 1.0), _NEAR, 1)
    both = torch.cat([certainty * depth, certainty], dim=1)
    for box, step, coarse in _BOXES:
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


# The part of a gate that holds the target: networks are more accurate in a gate that is not much wider than that.

_GATE_BINS = 200  # into which a gate is divided
_CLOSE_BY = (0.01, 0.04)  # parts of the gate within which two depths agree, on flat surfaces and on steep ones
_AGREEING = 4  # of the 24 pixels around a pixel
_CLUSTER = 5  # pixels that agree by chance agree together
_KEPT = 0.7  # a gate is narrowed only to less than this part of its width


def gates_of_target(depth: Tensor, density: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The part of the gate outside which depths agree with those around them no more often than backscatter would.

    Of depth over the gate, NaN where nothing was reported, and the density of backscatter there, each `[N, H, W]`: its
    start and width, with a margin, each `[N]`; 0 and 1, the whole gate, where nothing agrees, or where little would be
    gained. And the largest part of the frame that a target can take, `[N]`: 1, unless depths agree only as often as
    those of backscatter would by chance, and more would be noticed.
    """
    reported = (depth >= 0.0) & (depth < 1.0)
    inside = torch.where(reported, depth, torch.nan)
    share = reported.flatten(1).float().mean(dim=1)
    place = torch.where(reported, depth * _GATE_BINS, _GATE_BINS).long()
    pixels = _sums(torch.ones((), device=depth.device), place)

    def unnoticed(observed: Tensor, expected: Tensor) -> Tensor:
        """How many bins there are before the first that begin an excess, `[N]`: a cumulative sum with resets."""
        total = F.pad(expected.cumsum(1), (1, 0))
        excess = F.pad((observed - 1.1 * expected).cumsum(1), (1, 0))
        least, before = excess.cummin(1)
        deviation = (_CLUSTER * (total - total.gather(1, before))).clamp_min(0.0).sqrt()
        noticed = excess - least > 2.0 * deviation + 2.0
        begin = before.gather(1, noticed.int().argmax(dim=1, keepdim=True))[:, 0]
        return torch.where(noticed.any(dim=1), begin, _GATE_BINS)

    first, stop = (torch.full_like(share, bin) for bin in (_GATE_BINS, 0))
    for near in _CLOSE_BY[::-1]:
        agreeing = _agreeing(inside, near)
        # Backscatter of this density, in as many pixels as report, agrees by chance.
        chance = (2.0 * near * share[:, None, None] * density).clamp(0.0, 1.0)
        by_chance, observed = (_sums(each, place) for each in (chance, (agreeing >= _AGREEING).float()))
        part = by_chance / pixels.clamp_min(1.0)
        fewer = sum(math.comb(24, n) * part**n * (1.0 - part) ** (24 - n) for n in range(_AGREEING))
        expected = (pixels * (1.0 - fewer)).clamp_min(0.0)
        total = expected.sum(dim=1)
        found = observed.sum(dim=1) > total + 4.0 * total.sqrt() + 6.0  # of the last, where chance makes fewer agree
        first = torch.minimum(first, unnoticed(observed, expected))
        stop = torch.maximum(stop, _GATE_BINS - unnoticed(observed.flip(1), expected.flip(1)))
    margin = 2.0 + 0.1 * (stop - first)
    low, high = ((first - margin) / _GATE_BINS).clamp_min(0.0), ((stop + margin) / _GATE_BINS).clamp_max(1.0)
    narrower = found & (reported.flatten(1).sum(dim=1) >= 50) & (stop > first) & (high - low < _KEPT)
    start, width = torch.where(narrower, low, 0.0), torch.where(narrower, high - low, 1.0)
    # Pairs of pixels within two of each other, those that chance makes agree, and how many more would be noticed.
    rows, columns = depth.shape[1:]
    pairs = sum(max(0, rows - abs(y)) * max(0, columns - abs(x)) for y, x in _AROUND)
    by_chance = by_chance.sum(dim=1) * (pairs / (rows * columns))
    noticed = 4.0 * (2.0 * by_chance).sqrt() + 12.0
    agrees = agreeing.flatten(1).sum(dim=1) > by_chance + noticed
    most = torch.where(agrees, 1.0, (noticed / (pairs * share.square() + 1.0)).clamp_max(1.0))
    return start.to(depth.dtype), width.to(depth.dtype), most.to(depth.dtype)


def narrowed_input(depth: Tensor, density: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Input of PyramidNet `[N, 3, H, W]` over `gates_of_target`, without what is beyond their `MARGIN`; its output."""
    start, width, part = gates_of_target(depth, density)
    scaled = (depth - start[:, None, None]) / width[:, None, None]
    reported = (scaled >= -MARGIN) & (scaled <= 1.0 + MARGIN)
    log_density = density.log().clamp(-LOG_DENSITY_LIMIT, LOG_DENSITY_LIMIT)
    channels = torch.where(reported, scaled, 1.0), reported.to(scaled.dtype), torch.where(reported, log_density, 0.0)
    return torch.stack(channels, dim=1), start, width, part


def _agreeing(values: Tensor, near: float) -> Tensor:
    """How many of the 24 pixels around each pixel are as `near` to it, uint8 `[N, H, W]`; none where either is NaN."""
    # With two missing pixels after each row, and two such rows after each frame, all are one line in which a neighbour
    # is a fixed number of places away. Pieces of a line take a GPU half the time of parts cut out of images.
    padded = F.pad(values, (0, 2, 0, 2), value=torch.nan)
    line, row = padded.flatten(), padded.shape[2]
    agreeing = torch.zeros_like(line, dtype=torch.uint8)
    near_square = float(np.float32(near) ** 2)  # in float32, whose squares tell all numbers about `near` apart
    for apart in (row * down + right for down, right in _AROUND if (down, right) > (0, 0)):
        # A square is one pass over memory less than a difference and its absolute value; this one is exact.
        agree = (F.mse_loss(line[:-apart], line[apart:], reduction="none") < near_square).view(torch.uint8)
        agreeing[:-apart] += agree
        agreeing[apart:] += agree
    return agreeing.view_as(padded)[:, : values.shape[1], : values.shape[2]]


def _sums(values: Tensor, place: Tensor) -> Tensor:
    """Sums `[N, _GATE_BINS]` of values `[N, H, W]`, or one value, by the bin of each pixel; `_GATE_BINS` is in none.

    Column by column, and then of all columns: on a GPU, sums by index into few places wait for each other, and those
    of neighbouring pixels into neighbouring places do not.
    """
    frames, rows, columns = place.shape
    sums = values.new_zeros(frames, _GATE_BINS + 1, columns)
    sums.scatter_add_(1, place, values.expand(frames, rows, columns))
    return sums[:, :_GATE_BINS].sum(dim=2).double()


# What the network is not given

_WATER = -2.2  # logits below it, and above 0, are sure enough to count how pixels of water, and of the target, report
_PRIOR = 30.0  # pixels of the target whose reports are assumed to be as those of the water
_LARGEST = 3.0  # correction of a logit


def corrected_target(logit: Tensor, depth: Tensor, reported: Tensor, share: Tensor) -> Tensor:
    """Logit of "sees a target", corrected by what the network is not given, `[N, H, W]`.

    The network sees the part of the gate that holds the target. It cannot tell pixels that reported nothing, which are
    mostly water, from those that reported backscatter outside that part. How often pixels of the target, and of the
    water, do one or the other is counted in the frame where the network is sure, and Bayes' rule does the rest. Nor
    does it see the whole of a large frame: where few pixels report and their depths agree no more often than those of
    backscatter, a target can take only a `share` of the frame, `[N]`, and its pixels are as much less probable.
    `reported`: which pixels reported a depth that the network was given, 1 or 0.
    """
    absent = depth.isnan()
    beyond = (reported < 0.5) & ~absent

    def without_report(chosen: Tensor, share: Tensor | float, pixels: float) -> Tensor:
        """Part of the chosen pixels that are absent or beyond, and of `pixels` assumed with a `share`, `[N]`."""
        none, some = ((chosen & kind).flatten(1).sum(1) for kind in (absent, beyond))
        return (none + pixels * share) / (none + some + pixels)

    water = without_report(logit < _WATER, 0.5, 1.0)
    target = without_report(logit > 0.0, water, _PRIOR)
    ratios = target / water, (1.0 - target) / (1.0 - water)
    of_absent, of_beyond = (one.log().clamp(-_LARGEST, _LARGEST)[:, None, None] for one in ratios)
    logit = logit + torch.where(absent, of_absent, torch.where(beyond, of_beyond, 0.0))
    return logit + share.log().clamp_min(-_LARGEST)[:, None, None]


NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "usdn": USDN,
    "dncnn": DnCNN,
    "pyramid": PyramidNet,
    "histograms": HistogramNet,
}
"""Networks by the name that recipes and commands use."""


@lru_cache(maxsize=8)
def load_network(
    model: str, weights: str | Path | None = None, device: str = "cpu", precision: Precision = "float32"
) -> Any:
    """A network with its weights, ready to run; `precision`: of the layers of PyramidNet."""
    path = weights_path(model, weights)
    named = weights_header(path).get("model", model)
    if named != model:
        raise FileError(f"{path}: weights of {named!r}, not of {model!r}")
    try:
        network: Any = NETWORKS[model]()
        values = {name: value.float() for name, value in load_file(path).items()}  # counters are cast back
        network.load_state_dict(values)
        if wrong := [name for name, value in values.items() if not torch.isfinite(value).all()]:
            raise ValueError(f"{wrong[0]} is not finite")
    except Exception as error:  # safetensors and torch have errors of their own
        raise FileError(f"{path}: not weights of {model!r}: {error}") from error
    # glibc returns memory to the system after each layer, and fresh pages take as long as the layer, unless a block
    # this large (at most 32 MiB) was freed before: M_TRIM_THRESHOLD in mallopt(3).
    torch.empty(31 << 20, dtype=torch.uint8)
    network = network.to(torch.device(device), getattr(torch, precision))
    if model != "histograms":
        network = network.to(memory_format=torch.channels_last)
    return network.eval().requires_grad_(False)
