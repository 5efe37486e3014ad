"""Blocks of a grid's cells by which a histogram is differentiated: where they are, and the memory of their scores."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from spadwarp_kernels.arguments import ArgumentError, check_integer, check_number, check_struct
from spadwarp_kernels.medium.grid import Grid

# What a derivative by block may be with respect to: a at fixed b, b at fixed a, or c at fixed albedo, the same addition
# [1/m] to every cell of the block.
BLOCK_DERIVATIVES = ("absorption", "scattering", "extinction")

# Derivatives of one run by block, over all kinds.
MOST_BLOCK_DERIVATIVES = 4096

# Numbers that the threads of a launch remember at most: 1 GiB. Where blocks are many, fewer threads run at a time.
_LARGEST_MEMORY = 1 << 28


@wp.struct
class Blocks:
    """Blocks of the cells of a grid, made by `make_blocks`; the order of their scores is kind, then block.

    Attributes:
        grid: The blocks as if they were the cells: its `turn`, `shift` and `size` alone are read.
        count: Number of blocks.
        scale: Tally units of the derivative per emitted photon, by kind.
        memory: Numbers by row and thread, of one launch.
        threads, thread: How many there are, and which one this is.
    """

    grid: Grid
    count: int
    scale: wp.vec3
    memory: wp.array(dtype=float)
    threads: int
    thread: int


@wp.func
def block_entry(blocks: Blocks, row: int) -> int:
    """Index into the memory: neighbouring threads have neighbouring addresses."""
    return row * blocks.threads + blocks.thread


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
    made.scale = wp.vec3(*scale, *[0.0] * (3 - kinds))
    factor = np.array(shape) / np.array(list(grid.size))
    made.grid.turn = wp.mat33(*(factor[:, None] * np.array(grid.turn).reshape(3, 3)).ravel().tolist())
    made.grid.shift = wp.vec3(*(factor * np.array(grid.shift)).tolist())
    made.grid.size = wp.vec3i(*shape)
    return made


def threads_of_blocks(threads: int, numbers: int) -> int:
    """How many threads of a launch there is memory for, so many numbers each; a multiple of 1024, or `threads`."""
    return min(threads, max(_LARGEST_MEMORY // max(numbers, 1) // 1024, 1) * 1024)
