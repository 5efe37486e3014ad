"""Derivatives of the histogram: what they are with respect to, and the memory of those by block of a grid's cells.

The derivative of a contribution is the contribution times the derivative of the logarithm of what the light has met:
flights, scatterings, bounces (the score function or likelihood ratio method; Glynn 1990).
"""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.native import fill
from spadwarp_kernels.water.medium import MOST_CONSTITUENTS, Grid

__all__ = ["BLOCK_DERIVATIVES", "DERIVATIVES", "MOST_BLOCK_DERIVATIVES", "MOST_DERIVATIVES", "Blocks", "Derivatives"]
__all__ += ["make_blocks", "make_derivatives"]

# What a derivative may be with respect to, and the range of such a parameter: a at fixed b, b at fixed a, the mean
# cosine g of Henyey and Greenstein's phase function, a reflectance or a factor on one that varies, and the
# concentration of a constituent, of which the value is its scattering at concentration 1.
DERIVATIVES = {
    "absorption": "[0, inf)",
    "scattering": "(0, inf)",
    "anisotropy": "(-1, 1)",
    "reflectance": "(0, inf)",
    "concentration": "[0, inf)",
}

# What one by block may be: a at fixed b, b at fixed a, or c at fixed albedo, the same addition [1/m] to every cell.
BLOCK_DERIVATIVES = ("absorption", "scattering", "extinction")

MOST_DERIVATIVES = 8
MOST_BLOCK_DERIVATIVES = 4096  # of one run, over all kinds

LogDerivatives: TypeAlias = wp.types.vector(length=MOST_DERIVATIVES, dtype=float)
"""Derivatives of the logarithm of a photon's light with respect to the parameters of a spec, in its order."""

# In place of the first number of a block that the light has not met.
NOT_MET = wp.constant(1.0e30)

# Numbers that the threads of a launch remember at most: 1 GiB. Where blocks are many, fewer threads run at a time.
_LARGEST_MEMORY = 1 << 28


@wp.struct
class Blocks:
    """Blocks of the cells of a grid, made by `make_blocks`; the order of their scores is kind, then block."""

    grid: Grid  # the blocks as if they were the cells: its `turn`, `shift` and `size` alone are read
    count: int  # number of blocks
    kinds: int  # number of kinds of derivatives
    scale: wp.vec3  # tally units of the derivative per emitted photon, by kind
    memory: wp.array[float]
    """Numbers by row and thread, of one launch. Of the history, and once more of what is scored: by kind and block the
    score; the blocks that the light has met, in that order; how many they are."""
    threads: int  # how many there are
    thread: int  # which one this is


@wp.struct
class Derivatives:
    """The parameters of a spec with derivatives, in its order, or of its channels; made by `make_derivatives`."""

    value: LogDerivatives  # of each parameter; of a concentration the scattering at concentration 1 [1/m]
    extinction: LogDerivatives  # of a concentration the extinction at concentration 1 [1/m]
    constituent: wp.types.vector(length=MOST_DERIVATIVES, dtype=int)  # likewise its row in the tables of the mixture
    scale: LogDerivatives  # tally units of its derivative per emitted photon
    waters: wp.array[int]  # by layer, bit p set: parameter p is of this layer; not read without layers
    faces: wp.array[int]  # by face, bit p set: parameter p is this face's reflectance, or a factor on it
    blocks: Blocks  # of a spec with blocks, from `make_blocks`


def make_derivatives(
    kinds: Sequence[str],
    value: Sequence[float],
    scale: Sequence[float],
    *,
    channels: int = 0,
    extinction: Sequence[float] = (),
    constituent: Sequence[int] = (),
    waters: Sequence[int] = (),
    faces: Any = (),
    blocks: Any = None,
    device: wp.DeviceLike = None,
) -> Derivatives:
    """The parameters of a spec whose `derivatives` are `kinds`; see `Derivatives` for the others. Of one with
    `channels` so many, which have scales alone. `extinction` and `constituent`, read of concentrations: by parameter.

    `blocks`: from `make_blocks`, of a spec with blocks; without them, one kind at least. Raises `ArgumentError` for a
    kind that is not one of DERIVATIVES, or a number out of range.
    """
    channels = check.integer("channels", channels, 0, MOST_DERIVATIVES)
    kinds, device = check.items("kinds", kinds), check.device("device", device)
    count = check.integer("derivatives", len(kinds), 0, MOST_DERIVATIVES)
    least = 1 if blocks is None else 0
    tallies = check.integer("derivatives and channels", count + channels, least, MOST_DERIVATIVES)
    value = check.numbers("value", value, (count,))
    for p, kind in enumerate(kinds):
        check.choice(f"kinds[{p}]", kind, DERIVATIVES)
        check.number(f"value[{p}], {kind},", value[p], DERIVATIVES[kind])
    scale = check.numbers("scale", scale, (tallies,), "(0, inf)")
    both = (count if "concentration" in kinds else None,)
    extinction = check.numbers("extinction", extinction, both, "[0, inf)")
    rows = check.numbers("constituent", constituent, extinction.shape, f"[0, {MOST_CONSTITUENTS - 1}]", whole=True)
    numbers = {"value": value, "scale": scale, "extinction": extinction, "constituent": rows.astype(int)}
    padded = {name: np.pad(row, (0, MOST_DERIVATIVES - len(row))) for name, row in numbers.items()}
    derivatives = fill(Derivatives(), **padded)
    for name, parts in (("waters", waters), ("faces", faces)):
        whole = check.numbers(name, parts, (None,), "[-2147483648, 2147483647]", whole=True).astype(np.int32)
        fill(derivatives, device, **{name: whole})
    return derivatives if blocks is None else fill(derivatives, blocks=check.kind("blocks", blocks, Blocks))


def make_blocks(grid: Grid, shape: Sequence[int], scale: Sequence[float]) -> Blocks:
    """The cells of a grid in blocks of equally many.

    Args:
        grid: From `make_grid`.
        shape: Number of blocks along the three edges; each divides the number of cells there.
        scale: Tally units of the derivative per emitted photon, by kind in `TransportSpec.blocks`.

    Raises:
        ArgumentError: A number that does not divide that of the cells, or is out of range; too many derivatives.
    """
    check.kind("grid", grid, Grid)
    shape, scale = check.items("shape", shape), check.items("scale", scale)
    kinds = check.integer("kinds of derivatives by block", len(scale), 1, len(BLOCK_DERIVATIVES))
    check.numbers("scale", scale, None, "(0, inf)")
    check.numbers("blocks", shape, (3,))
    for edge, (blocks, cells) in enumerate(zip(shape, list(grid.size), strict=True)):
        check.integer(f"blocks[{edge}]", blocks, 1, cells)
        if cells % blocks:
            raise ArgumentError(
                f"blocks[{edge}] = {blocks} does not divide {cells}, the number of cells along that edge"
            )
    count = shape[0] * shape[1] * shape[2]
    check.integer("number of derivatives by block", kinds * count, 1, MOST_BLOCK_DERIVATIVES)
    factor = np.array(shape) / np.array(list(grid.size))
    turn, shift = factor[:, None] * np.array(grid.turn).reshape(3, 3), factor * np.array(grid.shift)
    blocks_as_cells = fill(Grid(), turn=turn, shift=shift, size=shape)
    return fill(Blocks(), grid=blocks_as_cells, count=count, kinds=kinds, scale=[*scale, *[0.0] * (3 - kinds)])


# ---- What a thread remembers of the blocks, see `Blocks.memory`.


@wp.func
def block_entry(blocks: Blocks, half: int, row: int) -> int:
    """Index into the memory: neighbouring threads have neighbouring addresses. `half`: 0 for the history, 1 for what is
    scored."""
    return (half * ((blocks.kinds + 1) * blocks.count + 1) + row) * blocks.threads + blocks.thread


@wp.func
def score_entry(blocks: Blocks, half: int, kind: int, block: int) -> int:
    """Index of the score of a block."""
    return block_entry(blocks, half, kind * blocks.count + block)


@wp.func
def met_entry(blocks: Blocks, half: int, number: int) -> int:
    """Index of the block that the light has met at this place of the order; at `blocks.count`: of how many they are."""
    return block_entry(blocks, half, blocks.kinds * blocks.count + number)


@wp.func
def met_count(blocks: Blocks, half: int) -> int:
    """How many blocks the light has met."""
    return int(blocks.memory[met_entry(blocks, half, blocks.count)])


def _half(blocks: Blocks) -> int:
    """Numbers of a thread in one of the halves."""
    return (blocks.kinds + 1) * blocks.count + 1


def threads_of_blocks(threads: int, blocks: Blocks) -> int:
    """How many threads of a launch there is memory for; a multiple of 1024, or `threads`."""
    return min(threads, max(_LARGEST_MEMORY // (2 * _half(blocks)) // 1024, 1) * 1024)


def ready_blocks(copy: Blocks, blocks: Blocks, threads: int, device: wp.DeviceLike) -> None:
    """Readies a copy for a kernel with memory of so many threads, of which no light has met a block: of each launch its
    own, since several may run at a time."""
    copy.threads = threads
    copy.memory = wp.full(2 * _half(blocks) * threads, NOT_MET, dtype=float, device=device)
    for end in (1, 2):
        copy.memory[(end * _half(blocks) - 1) * threads : end * _half(blocks) * threads].zero_()
