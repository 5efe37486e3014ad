"""Blocks of a grid's cells by which a histogram is differentiated: where they are, and the memory of their scores."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_integer, check_items, check_number, check_struct
from spadwarp_kernels.water.medium import Grid

__all__ = ["BLOCK_DERIVATIVES", "MOST_BLOCK_DERIVATIVES", "Blocks", "make_blocks"]

# What a derivative by block may be with respect to: a at fixed b, b at fixed a, or c at fixed albedo, the same addition
# [1/m] to every cell of the block.
BLOCK_DERIVATIVES = ("absorption", "scattering", "extinction")

# Derivatives of one run by block, over all kinds.
MOST_BLOCK_DERIVATIVES = 4096

# In place of the first number of a block that the light has not met.
NOT_MET = wp.constant(1.0e30)

# Numbers that the threads of a launch remember at most: 1 GiB. Where blocks are many, fewer threads run at a time.
_LARGEST_MEMORY = 1 << 28


@wp.struct
class Blocks:
    """Blocks of the cells of a grid, made by `make_blocks`; the order of their scores is kind, then block.

    Attributes:
        grid: The blocks as if they were the cells: its `turn`, `shift` and `size` alone are read.
        count: Number of blocks.
        kinds: Number of kinds of derivatives.
        scale: Tally units of the derivative per emitted photon, by kind.
        memory: Numbers by row and thread, of one launch. Of the history, and once more of what is scored: by kind and
            block the score; the blocks that the light has met, in that order; how many they are.
        threads, thread: How many there are, and which one this is.
    """

    grid: Grid
    count: int
    kinds: int
    scale: wp.vec3
    memory: wp.array[float]
    threads: int
    thread: int


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


def make_blocks(grid: Grid, shape: Sequence[int], scale: Sequence[float]) -> Blocks:
    """The cells of a grid in blocks of equally many.

    Args:
        grid: From `make_grid`.
        shape: Number of blocks along the three edges; each divides the number of cells there.
        scale: Tally units of the derivative per emitted photon, by kind in `TransportSpec.blocks`.

    Raises:
        ArgumentError: A number that does not divide that of the cells, or is out of range; too many derivatives.
    """
    check_struct("grid", grid, Grid)
    shape, scale = check_items("shape", shape), check_items("scale", scale)
    kinds = check_integer("kinds of derivatives by block", len(scale), 1, len(BLOCK_DERIVATIVES))
    for q, value in enumerate(scale):
        check_number(f"scale[{q}]", value, "(0, inf)")
    if len(shape) != 3:
        raise ArgumentError(f"blocks = {list(shape)} has {len(shape)} numbers; 3 are needed")
    for edge, (blocks, cells) in enumerate(zip(shape, list(grid.size), strict=True)):
        check_integer(f"blocks[{edge}]", blocks, 1, cells)
        if cells % blocks:
            raise ArgumentError(
                f"blocks[{edge}] = {blocks} does not divide {cells}, the number of cells along that edge"
            )
    made = Blocks()
    made.count = shape[0] * shape[1] * shape[2]
    check_integer("number of derivatives by block", kinds * made.count, 1, MOST_BLOCK_DERIVATIVES)
    made.kinds = kinds
    made.scale = wp.vec3(*scale, *[0.0] * (3 - kinds))
    factor = np.array(shape) / np.array(list(grid.size))
    made.grid.turn = wp.mat33(*(factor[:, None] * np.array(grid.turn).reshape(3, 3)).ravel().tolist())
    made.grid.shift = wp.vec3(*(factor * np.array(grid.shift)).tolist())
    made.grid.size = wp.vec3i(*shape)
    return made


def threads_of_blocks(threads: int, blocks: Blocks) -> int:
    """How many threads of a launch there is memory for; a multiple of 1024, or `threads`."""
    return min(threads, max(_LARGEST_MEMORY // _numbers(blocks) // 1024, 1) * 1024)


def ready_blocks(copy: Blocks, blocks: Blocks, threads: int, device: wp.DeviceLike) -> None:
    """Readies a copy for a kernel with memory of so many threads, of which no light has met a block: of each launch its
    own, since several may run at a time."""
    copy.threads = threads
    half = _numbers(blocks) // 2 * threads
    copy.memory = wp.full(2 * half, NOT_MET, dtype=float, device=device)
    for end in (half, 2 * half):
        copy.memory[end - threads : end].zero_()


def _numbers(blocks: Blocks) -> int:
    """That a thread remembers."""
    return 2 * ((blocks.kinds + 1) * blocks.count + 1)
