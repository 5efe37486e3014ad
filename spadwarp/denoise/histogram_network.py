"""The network for histograms: a distribution over the bins of the gate for each pixel.

Its volumes are log-likelihoods of a return in each bin of each pixel, `[B, H, W, T]` [nats]: of the pixel, summed over
windows, and together with the rest of the frame by belief propagation. The logarithm of the distribution is a weighted
sum of them and of a prior. A pyramid of three-dimensional convolutions, which sees all volumes in cells of `CELL` bins,
gives weights and prior. So a return keeps the place that the photons give it, to fractions of a bin; what is learned is
how much the photons of others tell, where depth jumps, and what light is of no target.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial, reduce
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.classical import beliefs, deviation, highest, interpolated, log_likelihood, pooled

CELL = 4
"""Bins of a cell."""

_MANY = 256  # images of a convolution
_AT_ONCE = 1 << 20  # values of a layer that are computed at once: they stay in the cache of a CPU

CLOSE = 0.01
"""A depth this near to the truth is right [gate widths]."""

WINDOWS = (3, 7, 15)
"""Sides of the windows over which log-likelihoods are summed [pixels]."""

_VOLUMES = 2 + len(WINDOWS)
_LIGHT = 14  # channels of `light_channels`
_CELLS, _IMAGES = _VOLUMES + 2, _VOLUMES + 3 + _LIGHT  # channels of cells, and of images, that the pyramid sees
_LEAST = 20.0  # differences of log-likelihoods within a pixel are clipped at this for the pyramid


def rebinned(counts: Tensor, background: Tensor, response: Tensor, merged: int) -> tuple[Tensor, Tensor, Tensor]:
    """The arguments with `merged` bins summed into one; the last may hold fewer."""

    def summed(values: Tensor) -> Tensor:
        return F.pad(values, (0, -values.shape[-1] % merged)).unflatten(-1, (-1, merged)).sum(dim=-1)

    radius = response.shape[-1] // 2
    around = -(-radius // merged) * merged + merged // 2 - radius
    if merged % 2 == 0:  # the middle is between two bins
        response, around = F.avg_pool1d(F.pad(response, (1, 1)), 2, 1), around - 1
    response = F.pad(response, (around, around))
    return summed(counts), summed(background), summed(response)


def halved(counts: Tensor, background: Tensor, response: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The arguments in bins of half the width, of which two share the counts, so that depths may differ within one."""
    counts, background = (0.5 * torch.stack([values, values], dim=-1).flatten(-2) for values in (counts, background))
    between = 0.5 * (F.pad(response, (1, 0)) + F.pad(response, (0, 1)))
    response = torch.stack([between, F.pad(response, (0, 1))], dim=-1).flatten(1)[:, :-1]
    return counts, background, 0.5 * response


class _Convolution(torch.autograd.Function):
    """Two-dimensional convolution whose derivative by the filters is a product of matrices for each image.

    Of thousands of small images, over which no product has to sum at once.
    """

    @staticmethod
    def forward(context: Any, image: Tensor, filters: Tensor, bias: Tensor) -> Tensor:
        context.save_for_backward(image, filters)
        return F.conv2d(image, filters, bias, padding=1)

    @staticmethod
    def backward(context: Any, *derivatives: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        (found,), (image, filters) = derivatives, context.saved_tensors
        by_image = F.conv_transpose2d(found, filters, padding=1) if context.needs_input_grad[0] else None
        # In rows that end with the padding, a tap is a shift of the whole image.
        row = image.shape[3] + 2
        seen = F.pad(image.permute(0, 2, 3, 1), (0, 0, 1, 1, 1, 1)).flatten(1, 2)
        outside = F.pad(found.permute(0, 2, 3, 1), (0, 0, 0, 2, 0, 2)).flatten(1, 2)
        shifts = [row * y + x for y in range(3) for x in range(3)]
        pairs = ((outside[:, : len(outside[0]) - shift], seen[:, shift:]) for shift in shifts)
        taps = [torch.bmm(after.mT, before).sum(dim=0, dtype=torch.float32) for after, before in pairs]
        by_filters = torch.stack(taps, dim=-1).unflatten(-1, (3, 3)).to(filters.dtype)
        return by_image, by_filters, outside.sum(dim=(0, 1), dtype=torch.float32).to(filters.dtype)


def _at_once(x: Tensor) -> int:
    """How many cells of features `[B, N, H, W, n]` are computed at once, an even number; all of them in training."""
    count = x.shape[1]
    return count if torch.is_grad_enabled() else 2 * max(1, _AT_ONCE * count // (2 * x.numel()))


class _Conv(nn.Conv3d):
    """Convolution over cells, rows and columns `[B, N, H, W, n]`, by one over rows and columns of which cells beside
    each other are channels: several times faster, on a GPU too, than one over three dimensions."""

    def forward(self, x: Tensor) -> Tensor:
        if self.kernel_size[2] == 1:
            return self._convolved(x)
        count, step, x = x.shape[1], _at_once(x), F.pad(x, (0, 0, 0, 0, 0, 0, 1, 1))
        beside = zip(*(x[:, first : first + count].split(step, dim=1) for first in range(3)), strict=True)
        found = [self._convolved(torch.cat(cells, dim=-1)) for cells in beside]
        return found[0] if len(found) == 1 else torch.cat(found, dim=1)

    def _convolved(self, x: Tensor) -> Tensor:
        filters, bias = self.weight.permute(0, 4, 1, 2, 3).flatten(1, 2), self.bias
        image, device = x.flatten(0, 1).permute(0, 3, 1, 2), x.device.type
        kind = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else x.dtype
        assert bias is not None
        convolved: Any = _Convolution.apply if len(image) > _MANY else partial(F.conv2d, padding=1)
        found = convolved(image.to(kind), filters.to(kind), bias.to(kind))
        return found.permute(0, 2, 3, 1).unflatten(0, x.shape[:2])


class _Shrink(nn.Conv3d):
    """Half as many rows, columns and, of `length` 2, cells, as a product of matrices."""

    def forward(self, x: Tensor) -> Tensor:
        length = self.kernel_size[2]
        parts = x.unflatten(3, (-1, 2)).unflatten(2, (-1, 2)).unflatten(1, (-1, length))  # [B, N, ·, H, 2, W, 2, n]
        filters = self.weight.permute(0, 4, 2, 3, 1).flatten(1)
        return F.linear(parts.permute(0, 1, 3, 5, 2, 4, 6, 7).flatten(4), filters, self.bias)


class _Enlarge(nn.ConvTranspose3d):
    """Twice as many rows, columns and, of `length` 2, cells; as `_Shrink`."""

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]
        filters = self.weight.permute(0, 4, 2, 3, 1).flatten(1)
        parts = (x @ filters).unflatten(-1, (self.kernel_size[2], 2, 2, -1))  # [B, N, H, W, ·, 2, 2, n]
        found = parts.permute(0, 1, 4, 2, 5, 3, 6, 7).flatten(1, 2).flatten(2, 3).flatten(3, 4)
        return found + self.bias.to(found.dtype)  # type: ignore[union-attr]


class _Residual(nn.Module):
    def __init__(self, width: int, length: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(_Conv(width, width, (3, 3, length)) for _ in range(2))
        nn.init.zeros_(self.layers[-1].weight)  # type: ignore[arg-type]  # begins as the identity

    def forward(self, x: Tensor) -> Tensor:
        y = x
        for layer in self.layers:
            y = layer(F.relu(y))
        return x + y


class _Pyramid(nn.Module):
    """Levels of features `[B, N, H, W, n]`, each of half as many rows and columns and, of volumes, cells."""

    def __init__(self, widths: tuple[int, ...], *, volumes: bool) -> None:
        super().__init__()
        pairs, length, side = list(pairwise(widths)), 3 if volumes else 1, 2 if volumes else 1
        self.down = nn.ModuleList(_Shrink(wide, narrow, (2, 2, side)) for wide, narrow in pairs)
        self.before = nn.ModuleList(_Residual(width, length) for width in widths[1:])
        self.deep = _Residual(widths[-1], length)
        self.up = nn.ModuleList(_Enlarge(narrow, wide, (2, 2, side)) for wide, narrow in pairs)
        self.after = nn.ModuleList(_Residual(width, length if level else 1) for level, width in enumerate(widths[:-1]))
        self.stride, self.side = 2 ** len(pairs), side

    def forward(self, parts: list[Tensor]) -> Iterator[Tensor]:
        """Features of the first level in parts of an even number of cells: there, none sees the cells beside it."""
        x = self.before[0](torch.cat([self.down[0](F.relu(part)) for part in parts], dim=1))
        skipped = []
        for down, before in zip(self.down[1:], self.before[1:], strict=True):
            skipped.append(x)
            x = before(down(F.relu(x)))
        x = self.deep(x)
        for up, after, skip in reversed(list(zip(self.up[1:], self.after[1:], skipped, strict=True))):
            x = after(skip + up(F.relu(x)))
        some = x.split(parts[0].shape[1] // self.side, dim=1)
        return (F.relu(self.after[0](parts.pop(0) + self.up[0](F.relu(x)))) for x in some)


class HistogramNet(nn.Module):
    """Distribution over bins, and the logit of "the pixel sees a target"; arguments as those of `log_likelihood`.

    Returns the logarithm of the probabilities, `[B, H, W, T]`, and the logit, `[B, H, W]`. Sizes may be any.
    """

    def __init__(self, widths: tuple[int, ...] = (16, 32, 48, 64)) -> None:
        super().__init__()
        first, target_widths = widths[0], (48, 64, 96)
        self.enter = _Conv(_CELLS, first, (3, 3, 1))
        layers = nn.Conv2d(_IMAGES, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, first, 3, padding=1)
        self.enter_image = nn.Sequential(*layers)
        self.pyramid = _Pyramid(widths, volumes=True)
        self.head = nn.Linear(first, _VOLUMES + 1)
        self.enter_target = _Conv(2 * first + _IMAGES, target_widths[0], (3, 3, 1))
        self.target_pyramid = _Pyramid(target_widths, volumes=False)
        self.target = nn.Linear(target_widths[0], 1)
        self.stride = self.pyramid.stride
        with torch.no_grad():
            self.head.weight.mul_(0.1)
            self.head.bias.copy_(torch.tensor([-1.0, *(-2.0 - 0.2 * side for side in WINDOWS), 0.0, 0.0]))

    def forward(self, counts: Tensor, background: Tensor, response: Tensor) -> tuple[Tensor, Tensor]:
        bins, (height, width) = counts.shape[-1], counts.shape[1:3]
        exact = torch.autocast(counts.device.type, enabled=False)  # log-likelihoods need more than bfloat16
        with exact, torch.no_grad():
            score = log_likelihood(counts, background, response)
            # Of the pixel, of windows and of belief propagation.
            volumes = [score, *(side**2 * pooled(score, side) for side in WINDOWS), beliefs(score)]
            tops = [volume.amax(dim=-1) for volume in volumes]
            volumes = [volume.sub_(top[..., None]) for volume, top in zip(volumes, tops, strict=True)]
            cells, images = self._seen(volumes, tops, counts, background, response)
        found, target = self._weighed(cells, images)
        with exact:
            found = found[:, :, :height, :width].float().permute(4, 0, 2, 3, 1).contiguous()
            between = _interpolation(found.shape[-1], bins, found.device)
            score = found[-1] @ between
            for weight, volume in zip(F.softplus(found[:-1]), volumes, strict=True):
                score = torch.addcmul(score, weight @ between, volume)
            return score.log_softmax(dim=-1), target[:, :height, :width].float()

    def _weighed(self, cells: Tensor, images: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithms of weights, and the prior, of each cell `[B, N, H, W, n]`; the target's logit `[B, H, W]`."""
        image = self.enter_image(images).permute(0, 2, 3, 1)[:, None]
        cells, count = cells.permute(0, 4, 2, 3, 1), cells.shape[-1]
        at_once = _at_once(image.expand(-1, count, -1, -1, -1))
        parts = [self.enter(part.contiguous()) + image for part in cells.split(at_once, dim=1)]
        found = [(self.head(x), x.amax(dim=1, keepdim=True), x.sum(dim=1, keepdim=True)) for x in self.pyramid(parts)]
        heads, most, sums = (torch.cat(each, dim=1) for each in zip(*found, strict=True))
        whole = most.amax(dim=1, keepdim=True), sums.sum(dim=1, keepdim=True) / count
        ends = *whole, images.permute(0, 2, 3, 1)[:, None]
        (target,) = self.target_pyramid([self.enter_target(torch.cat(ends, dim=-1))])
        return heads, self.target(target)[:, 0, ..., 0]

    def _seen(
        self, volumes: list[Tensor], tops: list[Tensor], counts: Tensor, background: Tensor, response: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Channels of cells `[B, n, H, W, N]` and of images `[B, n, H, W]`, filled up to whole strides."""
        missing = -counts.shape[-1] % (CELL * self.stride)

        def in_cells(cube: Tensor, value: float) -> tuple[Tensor, ...]:
            """The first bins of all cells, the second ones, …: faster on a CPU than to reduce four neighbours."""
            return F.pad(cube, (0, missing), value=value).unflatten(-1, (-1, CELL)).unbind(dim=-1)

        scores = [0.1 * reduce(torch.maximum, in_cells(one, -_LEAST)).clamp_min(-_LEAST) for one in volumes]
        above, level = (reduce(torch.add, in_cells(one, 0.0)) for one in (counts - background, background))
        excess = 9.0 * pooled(above, 3) / (9.0 * level + 1.0).sqrt()
        profile = level.mean(dim=(1, 2), keepdim=True) + 1e-3
        profile = 0.25 * (profile / profile.mean(dim=-1, keepdim=True)).log()
        cells = torch.stack([*scores, 0.4 * torch.asinh(excess), profile.expand_as(above)], dim=1)
        total, around = above.sum(dim=-1), level.sum(dim=-1).expand(above.shape[:-1])
        width = deviation(response, 0.1)[:, None, None]
        images = [
            *(0.3 * torch.asinh(top) for top in tops),
            0.2 * (total.clamp_min(0.0) + 0.3).log(),
            0.2 * (around + 0.1).log(),
            0.5 * width.log().expand_as(around),
            *light_channels(counts - background, background.mean(dim=(1, 2)), highest(volumes[-1]), response),
        ]
        return filled_up(cells, self.stride), filled_up(torch.stack(images, dim=1), self.stride)


def filled_up(image: Tensor, stride: int) -> Tensor:
    """`[B, n, H, W, …]` with rows and columns that mirror those before the last, up to multiples of `stride`.

    Copies of the last one would agree in depth, as those of a target do.
    """
    for axis in (2, 3):
        length = image.shape[axis]
        if length % stride:
            period = max(1, 2 * length - 2)
            place = torch.arange(length + -length % stride, device=image.device) % period
            image = image.index_select(axis, torch.minimum(place, period - place))
    return image


# What tells light that water scattered forward, beside a bright target, from a dim target. Both have the depth of a
# target and far more counts than backscatter. The scattered light is a few per cent as bright as the target beside it,
# and later: less of it arrives within the instrument response around its peak.

_NEAR, _FAR = 10, 30  # pixels within which the brightest neighbourhood is looked for
_WINDOWS = 3, 7  # sides of the windows whose counts are summed [pixels]
_REACHES = 2.0, 8.0  # half widths around the peak, in deviations of the instrument response


def light_channels(above: Tensor, background: Tensor, place: Tensor, response: Tensor) -> list[Tensor]:
    """Brightness and lateness of the light of each pixel, `_LIGHT` times `[B, H, W]`.

    Logarithms of the excess over the background: of 3 × 3 pixels, relative to the background, and relative to the
    brightest 3 × 3 pixels around; the same of the pixel alone. Then the parts of the excess near the peak, in a wider
    interval around it, and after that, over 3 × 3 and 7 × 7 pixels; and the differences of these from the means around
    the pixel, in which bright pixels count most.

    `above`: counts less the expected background, `[B, H, W, T]`; `background`: of each bin, mean over the frame,
    `[B, T]`; `place`: of each pixel's peak over the gate; `response`: `[B, 2 r + 1]`, sum 1.
    """
    level, excess = background.sum(dim=-1)[:, None, None], above.sum(dim=-1)
    bright = _around(excess, 3).clamp_min(0.0)
    most = [_brightest(bright, reach) for reach in (_NEAR, _FAR)]
    parts = _near_and_late(above, place, response)
    wide = [_around(part, side) for side in _WINDOWS for part in (excess, *parts)]
    shares = []
    for number, side in enumerate(_WINDOWS):
        whole, *some = wide[4 * number : 4 * number + 4]
        noise = (whole.clamp_min(0.0) + level + 0.5).sqrt() / side
        shares += [(part / (whole.clamp_min(0.0) + noise)).clamp(-1.0, 2.0) for part in some]
    weight, far = bright.square() + 1e-6, 2 * _FAR + 1
    total = _around(weight, far)
    typical = [_around(weight * share, far) / total for share in shares[3:]]
    return [
        0.2 * (bright + 0.1).log(),
        0.2 * ((bright + 0.3) / (level + 0.3)).log(),
        *(0.3 * ((bright + 0.2) / (one + 0.2)).log() for one in most),
        0.3 * ((excess.clamp_min(0.0) + 1.0) / (most[1] + 1.0)).log(),
        *shares,
        *(share - one for share, one in zip(shares[3:], typical, strict=True)),
    ]


def _near_and_late(above: Tensor, place: Tensor, response: Tensor) -> list[Tensor]:
    """Excess within the nearer and the farther of `_REACHES` around the peak, and after the farther, `[B, H, W]`."""
    width = deviation(response, 0.25)[:, None, None]
    cumulative, centre = above.cumsum(dim=-1), place * above.shape[-1]
    edges = [centre + sign * (reach * width + 0.5) for reach in _REACHES for sign in (-1.0, 1.0)]
    first, last, start, stop = interpolated(F.pad(cumulative, (1, 0)), torch.stack(edges, dim=-1)).unbind(dim=-1)
    return [last - first, stop - start, cumulative[..., -1] - stop]


def _brightest(image: Tensor, reach: int) -> Tensor:
    """The highest value up to `reach` pixels away in rows and columns."""
    side = 2 * reach + 1
    highest = F.max_pool2d(image[:, None], (side, 1), 1, (reach, 0))
    return F.max_pool2d(highest, (1, side), 1, (0, reach))[:, 0]


def _around(image: Tensor, side: int) -> Tensor:
    return pooled(image[..., None], side)[..., 0]


def _interpolation(cells: int, bins: int, device: torch.device) -> Tensor:
    """Weights `[cells, bins]` of linear interpolation from the middles of cells to those of bins."""
    place = ((torch.arange(bins, device=device) + 0.5) / CELL - 0.5).clamp_min(0.0)
    return (1.0 - (place - torch.arange(cells, device=device)[:, None]).abs()).clamp_min(0.0)


_FINE = 13  # places over the three bins about the highest one


def mean_depth(log_probability: Tensor, probability: Tensor) -> Tensor:
    """Mean depth over the gate, `[B, H, W]`.

    Within the highest bin and its two neighbours the logarithm is a parabola: the return of many photons is narrower
    than a bin.
    """
    bins = log_probability.shape[-1]
    middle = log_probability.argmax(dim=-1, keepdim=True).clamp(1, max(1, bins - 2))
    steps = torch.arange(-1, 2, device=middle.device)
    before, at, after = log_probability.gather(-1, (middle + steps).clamp(0, bins - 1)).split(1, dim=-1)
    offset = torch.linspace(-1.5, 1.5, _FINE, device=middle.device)
    parabola = 0.5 * (after - before) * offset + (0.5 * (after + before) - at) * offset.square()
    fine = torch.softmax(parabola, dim=-1) @ offset
    early, late = before.exp()[..., 0], after.exp()[..., 0]
    return probability @ _places(probability) + ((early + at.exp()[..., 0] + late) * fine - (late - early)) / bins


def _places(probability: Tensor) -> Tensor:
    """Middles of bins over the gate."""
    bins = probability.shape[-1]
    return (torch.arange(bins, device=probability.device) + 0.5) / bins


def answer(log_probability: Tensor) -> tuple[Tensor, Tensor]:
    """Mean depth over the gate, and the probability that the depth is right to `CLOSE` of it, `[B, H, W]`."""
    probability = log_probability.exp()
    depth = mean_depth(log_probability, probability)
    near = (_places(probability) - depth[..., None]).abs() <= max(CLOSE, 0.5 / probability.shape[-1])
    return depth, probability.mul_(near).sum(dim=-1)
