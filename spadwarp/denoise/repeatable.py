"""Operations whose derivatives are sums in a fixed order, so that a seed gives the same weights on a GPU, too.

PyTorch adds the derivatives of interpolation, padding and indexing with atomic operations, in the order in which
threads happen to arrive. The values of these functions are PyTorch's own; only the derivatives are written here.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["edge_padded", "enlarged", "fixed_order", "permuted"]


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


def edge_padded(image: Tensor, reach: int) -> Tensor:
    """`[B, C, H, W]` with `reach` more pixels on each side, which have the values of the nearest."""
    return _EdgePadded.apply(image, reach)  # type: ignore[no-any-return, no-untyped-call]


def permuted(values: Tensor, places: Tensor, inverse: Tensor) -> Tensor:
    """`values[..., places]`, the last dimension g n.

    Args:
        values: `[..., n]`.
        places: g permutations of n places, `[g n]`.
        inverse: Their inverses, `[g, n]`.
    """
    return _Permuted.apply(values, places, inverse)  # type: ignore[no-any-return, no-untyped-call]


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
            length = found.shape[dim]
            first, last = found.narrow(dim, 0, half).flip(dim), found.narrow(dim, length - half, half).flip(dim)
            mirrored = torch.cat([first, found, last], dim)
            pieces = mirrored.unflatten(dim, (-1, factor))  # the parts of pixel i are in pieces i and i + 1
            pieces = pieces.movedim(dim + 1, 0)
            count, total = length // factor, None
            for k, part in enumerate(parts):
                one = pieces[k % factor].narrow(dim, k // factor, count)
                total = one * part if total is None else torch.add(total, one, alpha=part, out=total)
            assert total is not None
            found = total
        return found.to(kind), None


class _EdgePadded(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, image: Tensor, reach: int) -> Tensor:
        context.reach = reach
        return F.pad(image, (reach,) * 4, mode="replicate")

    @staticmethod
    def backward(context: Any, *derivatives: Tensor) -> tuple[Tensor, None]:
        (found,), reach = derivatives, context.reach
        for dim in (2, 3):
            length = found.shape[dim] - 2 * reach
            inner = found.narrow(dim, reach, length).clone()
            inner.narrow(dim, 0, 1).add_(found.narrow(dim, 0, reach).sum(dim, keepdim=True))
            inner.narrow(dim, length - 1, 1).add_(found.narrow(dim, reach + length, reach).sum(dim, keepdim=True))
            found = inner
        return found, None


class _Permuted(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, values: Tensor, places: Tensor, inverse: Tensor) -> Tensor:
        context.save_for_backward(inverse)
        return values.index_select(-1, places)

    @staticmethod
    def backward(context: Any, *derivatives: Tensor) -> tuple[Tensor, None, None]:
        (inverse,) = context.saved_tensors
        found = derivatives[0].unflatten(-1, inverse.shape)
        return found.gather(-1, inverse.expand_as(found)).sum(dim=-2), None, None
