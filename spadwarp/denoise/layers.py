"""Layers: derivatives summed in a fixed order, and convolutions that commute with turns and reflections of a square.

PyTorch adds the derivatives of interpolation, padding and indexing on a GPU with atomic operations, in the order in
which threads happen to arrive. The values of the functions here are PyTorch's own; their derivatives are sums in a
fixed order, so that a seed gives the same weights on a GPU, too.

A feature of the convolutions has eight channels, one for each turn or reflection of its filter: turning the image turns
the channels and permutes them. Cohen & Welling, ICML 2016 (group-equivariant convolutional networks, p4m).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn


@contextmanager
def fixed_order() -> Iterator[None]:
    """Convolutions and products of matrices on a GPU by algorithms that give the same bits each time.

    cuDNN otherwise tries several at the first call and keeps the fastest, which differs from one process to the next.
    TF32 stays allowed in products.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # read when a process first multiplies matrices
    cudnn, products = torch.backends.cudnn, torch.backends.cuda.matmul
    before = cudnn.benchmark, cudnn.deterministic, products.allow_tf32
    cudnn.benchmark, cudnn.deterministic, products.allow_tf32 = False, True, True
    try:
        yield
    finally:
        cudnn.benchmark, cudnn.deterministic, products.allow_tf32 = before


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


GROUP = 8
"""Turns and reflections of a square."""


def turned(image: NDArray[np.int64], element: int) -> NDArray[np.int64]:
    """An image `[..., k, k]` acted on by one of the eight elements."""
    return np.rot90(np.flip(image, -1) if element >= 4 else image, element % 4, axes=(-2, -1))


@lru_cache(maxsize=1)
def _left_quotients() -> NDArray[np.int64]:
    """Index of g⁻¹ h for elements g and h, `[8, 8]`."""
    places = np.stack([turned(np.arange(9).reshape(3, 3), element).ravel() for element in range(GROUP)])
    products = places[:, places]  # of each element, after each g
    return (products[:, :, None] == places).all(axis=-1).argmax(axis=0)


@lru_cache(maxsize=32)
def _expansion(size: int, channels: Literal[1, 8]) -> Tensor:
    """Places in a flat filter `[channels, size, size]` that each of the eight takes, `[8, channels size²]`."""
    places = np.arange(channels * size * size).reshape(channels, size, size)
    quotients = _left_quotients()
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

    def forward(self, x: Tensor) -> Tensor:
        weight, bias = self.filters()
        return F.conv2d(x, weight[:, :, None, None].contiguous(), bias)
