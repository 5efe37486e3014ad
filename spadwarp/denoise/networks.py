"""The networks: USDN, DnCNN, and PyramidNet, which also sees the water's backscatter.

All take `[batch, 3, height, width]`: depth over the gate (0 at its start, 1 at its end; 1 where nothing was reported),
1 where the pixel reported something, and the logarithm of the backscatter's density at the reported depth (0 for a flat
profile, see `spadwarp.denoise.synthetic_noise.log_density`). They return denoised depth over the gate,
`[batch, 1, height, width]`; PyramidNet also three logits. Lengths in depth are in gate widths. The network for
histograms is in `spadwarp.denoise.histogram_network`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

from spadwarp.denoise.histogram_network import HistogramNet, filled_up
from spadwarp.denoise.layers import GROUP, SymmetricConv, SymmetricWindow, edge_padded, enlarged, turned
from spadwarp.denoise.network_files import Precision, weights_header, weights_path
from spadwarp.values import FileError


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
        if not self.training:  # while it learns, values beyond the bounds must have a slope
            depth = depth.clamp(0.0, 1.0)
        return depth


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
_RING = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0))
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
    images = [turned(np.arange(9).reshape(3, 3), element) for element in range(GROUP)]
    places = (np.argwhere(image == pixel)[0] - 1 for pixel in (5, 8) for image in images)
    return tuple((int(row), int(column)) for row, column in places)


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
        last = 8
        widths = (4, 5, 8, 10, 14)  # features of the levels
        pairs, deep = list(pairwise(widths)), len(widths) - 1
        self.enter = SymmetricConv(6 + _SCALARS, widths[0], 3, lifts=True)
        self.enter_agreement = SymmetricConv(2, widths[0], 3, bias=False)
        self.down = nn.ModuleList(SymmetricConv(wide, narrow, 4, stride=2) for wide, narrow in pairs)
        self.up = nn.ModuleList(SymmetricConv(narrow, wide, 1, bias=False) for wide, narrow in pairs)
        self.before = nn.ModuleList(
            nn.Sequential(*(_Residual(width) for _ in range(1 + (level == deep - 1))))
            for level, width in enumerate(widths[1:])
        )
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
        x = self._entered([(self.enter, torch.cat(scalars, dim=1)), (self.enter_agreement, votes.agreement)])
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
        # In the precision of the layers, and with the channels of a pixel side by side.
        image = torch.cat(images, dim=1).to(self.enter.weight.dtype, memory_format=torch.channels_last)
        return F.conv2d(image, filters, bias, padding=self.enter.padding)

    def _heads(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Weights of all depths, the network's own depth, the three logits and the reach of refining, `[B, n, H, W]`.

        The layers that these come from are applied as one.
        """
        layers = [window.filters() for window in (self.near, *self.wide)]
        # Weights of the own depth and of the one voted for; then what is no weight. Slices, not a list of rows, which
        # would have to be copied to the GPU.
        order = [slice(0, 1), slice(-1, None), slice(1, 5), slice(5, 6)]
        assert self.scalars.bias is not None
        for rows in order:
            weight = self.scalars.weight[rows, :, 0, 0].repeat_interleave(GROUP, 1) / GROUP
            layers.append((weight, self.scalars.bias[rows]))
        filters, biases = (torch.cat(parts) for parts in zip(*layers, strict=True))
        # The product of matrices gives rows of images, which what follows is faster with than with rows of channels.
        pixels = x.permute(0, 2, 3, 1).flatten(1, 2).transpose(1, 2)
        found = torch.baddbmm(biases[:, None], filters.expand(len(x), -1, -1), pixels).float()
        found = found.unflatten(2, x.shape[2:])
        weights, own, logits, reach = found.split([found.shape[1] - 5, 1, 3, 1], dim=1)
        return weights, own, logits, reach


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
