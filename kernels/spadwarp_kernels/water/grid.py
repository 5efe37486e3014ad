"""A box of cells of water, each with its own coefficients: straight lines through it, and flights of photons.

Lines are followed by the faces of the cells that they cross (Amanatides & Woo 1987), through the cells themselves or
through blocks of them. The position of a face is an integer and never a sum of steps: the lengths in the cells add up
to the length in the box, and a line leaves the last cell where it leaves the box.

Flights go by the cells themselves, exact, or by blocks of them and chance, without bias. Regular tracking adds up the
optical depth of every cell on the way. Where cells are many, delta tracking (Woodcock et al. 1965) flies through blocks
of the largest extinction and rejects collisions, and residual ratio tracking (Novák et al. 2014) estimates what a
flight lets through from an extinction near the mean of each block and a few cells on the way.
"""

import math
from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.native import fill, load_float, load_vec2
from spadwarp_kernels.base.philox import begin_sequence, sequence_word, step_sequence, u01, u01_open
from spadwarp_kernels.base.rotations import inverse_direction

from .medium import Grid, Layers, Medium, Profile, ProfileSample, Water, mixture_shares

__all__ = ["DELTA_TRACKING", "REGULAR_TRACKING", "make_grid", "voxel_values_kernel"]

# Cells of all grids are counted by int32, with room for the blocks.
LARGEST_CELL_COUNT = 1 << 30


@wp.struct
class GridLine:
    """A line x + t u through the cells of a grid, or through blocks of them."""

    # begin, end: t at which it enters and leaves the box, within [0, length] [m]; begin >= end where it misses it
    begin: float
    end: float
    p: wp.vec3  # p, d: x and u in cells
    d: wp.vec3
    inverse: wp.vec3  # inverse, shift: the plane of number k across an axis is met at t = k inverse + shift
    shift: wp.vec3
    first: wp.vec3  # the cell in which it begins
    stride: wp.vec3i  # what a step along each axis adds to the index of the cell
    last: int  # index of the last cell


@wp.struct
class GridPlace:
    """A place on a line."""

    t: float  # where the cell begins, or a place within it [m]
    leave: float  # where the line leaves the cell, or ends [m]
    cell: int  # its index
    ahead: wp.vec3  # numbers of the planes that the line meets next, by axis
    at: wp.vec3  # where it meets them [m]


@wp.func
def grid_line(grid: Grid, size: wp.vec3i, edge: int, x: wp.vec3, u: wp.vec3, length: float) -> GridLine:
    """The part of the line x + t u, 0 <= t <= length, in the box; by so many blocks with an edge of so many cells."""
    line = GridLine()
    line.p = grid.turn * x + grid.shift
    line.d = grid.turn * u
    inverse = inverse_direction(line.d)
    line.shift = -wp.cw_mul(line.p, inverse)
    line.end = length
    for i in range(3):
        low = line.shift[i]
        high = float(grid.size[i]) * inverse[i] + line.shift[i]
        line.begin = wp.max(line.begin, wp.min(low, high))
        line.end = wp.min(line.end, wp.max(low, high))
    cells = float(edge)
    for i in range(3):
        line.first[i] = wp.clamp(wp.floor((line.p[i] + line.begin * line.d[i]) / cells), 0.0, float(size[i] - 1))
    line.inverse = cells * inverse
    line.stride = wp.vec3i(
        wp.where(line.inverse[0] > 0.0, size[1] * size[2], -size[1] * size[2]),
        wp.where(line.inverse[1] > 0.0, size[2], -size[2]),
        wp.where(line.inverse[2] > 0.0, 1, -1),
    )
    line.last = size[0] * size[1] * size[2] - 1
    return line


@wp.func
def _sign(x: float) -> float:
    return wp.where(x > 0.0, 1.0, -1.0)


@wp.func
def first_place(line: GridLine, size: wp.vec3i) -> GridPlace:
    """Where a line that meets the box enters it."""
    place = GridPlace()
    place.t = line.begin
    place.cell = (int(line.first[0]) * size[1] + int(line.first[1])) * size[2] + int(line.first[2])
    place.ahead = wp.vec3(
        wp.where(line.inverse[0] > 0.0, line.first[0] + 1.0, line.first[0]),
        wp.where(line.inverse[1] > 0.0, line.first[1] + 1.0, line.first[1]),
        wp.where(line.inverse[2] > 0.0, line.first[2] + 1.0, line.first[2]),
    )
    place.at = wp.cw_mul(place.ahead, line.inverse) + line.shift
    place.leave = wp.min(wp.min(place.at[0], line.end), wp.min(place.at[1], place.at[2]))
    return place


@wp.func
def next_place(line: GridLine, here: GridPlace) -> GridPlace:
    """Where the line enters the next cell."""
    place = here
    place.t = here.leave
    x = here.at[0] <= here.leave
    y = not x and here.at[1] <= here.leave
    place.ahead = wp.vec3(
        wp.where(x, here.ahead[0] + _sign(line.inverse[0]), here.ahead[0]),
        wp.where(y, here.ahead[1] + _sign(line.inverse[1]), here.ahead[1]),
        wp.where(x or y, here.ahead[2], here.ahead[2] + _sign(line.inverse[2])),
    )
    place.at = wp.cw_mul(place.ahead, line.inverse) + line.shift
    place.leave = wp.min(wp.min(place.at[0], line.end), wp.min(place.at[1], place.at[2]))
    stride = wp.where(x, line.stride[0], wp.where(y, line.stride[1], line.stride[2]))
    # Rounding may let a line leave the box a step late: no index leaves the arrays.
    place.cell = wp.clamp(here.cell + stride, 0, line.last)
    return place


@wp.func
def grid_cell(grid: Grid, x: wp.vec3) -> int:
    """Index of the cell at a point [m]; -1 outside the box."""
    p = grid.turn * x + grid.shift
    i = int(wp.floor(p[0]))
    j = int(wp.floor(p[1]))
    k = int(wp.floor(p[2]))
    inside = i >= 0 and j >= 0 and k >= 0 and i < grid.size[0] and j < grid.size[1] and k < grid.size[2]
    return wp.where(inside, (i * grid.size[1] + j) * grid.size[2] + k, -1)


@wp.func
def cell_on_line(grid: Grid, p: wp.vec3, d: wp.vec3, t: float) -> int:
    """Index of the cell at p + t d, in cells, of a line within the box; the nearest one for what rounding puts beside
    it."""
    i = wp.min(int(p[0] + t * d[0]), grid.size[0] - 1)
    j = wp.min(int(p[1] + t * d[1]), grid.size[1] - 1)
    k = wp.min(int(p[2] + t * d[2]), grid.size[2] - 1)
    return wp.max((i * grid.size[1] + j) * grid.size[2] + k, 0)


# ---- Flights.


@wp.func
def _over(depth: float, extinction: float) -> float:
    """Distance [m] to an optical depth; 1e30 in vacuum."""
    return wp.where(extinction > 0.0, depth / wp.max(extinction, 1.0e-30), 1.0e30)


@wp.func
def depth_along(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float) -> float:
    """Optical depth of the cells between x and x + length u."""
    grid = layers.grid
    line = grid_line(grid, grid.size, 1, x, u, length)
    if line.begin >= line.end:
        return medium.extinction * length
    depth = medium.extinction * (length - (line.end - line.begin))
    place = first_place(line, grid.size)
    while place.leave < line.end:
        depth += grid.extinction[place.cell] * (place.leave - place.t)
        place = next_place(line, place)
    return depth + grid.extinction[place.cell] * (line.end - place.t)


@wp.func
def distance_to(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, depth: float) -> float:
    """Distance [m] from x along u to an optical depth of the cells; 1e30: there is none."""
    grid = layers.grid
    line = grid_line(grid, grid.size, 1, x, u, 1.0e30)
    before = medium.extinction * line.begin
    if line.begin >= line.end or depth <= before:
        return _over(depth, medium.extinction)
    rest = depth - before
    place = first_place(line, grid.size)
    extinction = float(grid.extinction[place.cell])
    while extinction * (place.leave - place.t) < rest and place.leave < line.end:
        rest -= extinction * (place.leave - place.t)
        place = next_place(line, place)
        extinction = grid.extinction[place.cell]
    kept = extinction * (place.leave - place.t)
    if kept < rest:
        return line.end + _over(rest - kept, medium.extinction)
    return wp.min(place.t + _over(rest, extinction), line.end)


@wp.func
def draw_by_cells(
    medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, width: float, given: float, xi: float
) -> ProfileSample:
    """A point of [0, width] by the optical depth of the cells; an even one where that is next to none."""
    sample = ProfileSample()
    whole = depth_along(medium, layers, x, u, width)
    thick = whole > 1.0e-4
    kept = 1.0 - wp.exp(-whole)
    sample.s = given
    if given < 0.0:
        sample.s = xi * width
        if thick:
            sample.s = wp.min(distance_to(medium, layers, x, u, -wp.log(1.0 - xi * kept)), width)
    # Its cell by the walk that drew it. A face belongs to the cell behind it, since what is drawn next to the face of a
    # dense cell rounds to it.
    line = grid_line(layers.grid, layers.grid.size, 1, x, u, width)
    sample.extinction = medium.extinction
    sample.depth = medium.extinction * sample.s
    if line.begin < line.end and line.begin <= sample.s:
        stop = wp.min(sample.s, line.end)
        sample.depth = medium.extinction * (sample.s - (stop - line.begin))
        place = first_place(line, layers.grid.size)
        while place.leave <= stop and place.leave < line.end:
            sample.depth += layers.grid.extinction[place.cell] * (place.leave - place.t)
            place = next_place(line, place)
        inside = float(layers.grid.extinction[place.cell])
        sample.depth += inside * (stop - place.t)
        if sample.s < line.end or line.end == width:
            sample.extinction = inside
    sample.density = wp.where(thick, sample.extinction * wp.exp(-sample.depth) / kept, 1.0 / width)
    return sample


@wp.func
def depth_by_block(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float) -> float:
    """A guess of the optical depth between x and x + length u, from the extinction of the block in the middle."""
    grid = layers.grid
    p = grid.turn * (x + (0.5 * length) * u) + grid.shift
    extinction = float(medium.extinction)
    size = wp.vec3(float(grid.size[0]), float(grid.size[1]), float(grid.size[2]))
    if wp.min(p[0], wp.min(p[1], p[2])) >= 0.0 and p[0] < size[0] and p[1] < size[1] and p[2] < size[2]:
        p /= float(grid.block_edge)
        extinction = grid.block_control[(int(p[0]) * grid.block_size[1] + int(p[1])) * grid.block_size[2] + int(p[2])][
            0
        ]
    return extinction * length


@wp.func
def grid_water(medium: Medium, layers: Layers, x: wp.vec3) -> Medium:
    """The medium with the coefficients of the cell at x; itself outside the box."""
    water = medium
    cell = grid_cell(layers.grid, x)
    if cell >= 0:
        water.extinction = load_float(layers.grid.extinction, cell)
        water.albedo = load_float(layers.grid.albedo, cell)
    # Apart, so that who asks for the phase function alone looks up nothing without them.
    if layers.grid.anisotropy.shape[0] > 0:
        cell = grid_cell(layers.grid, x)
        if cell >= 0:
            water.anisotropy = load_float(layers.grid.anisotropy, cell)
    if layers.grid.shares.shape[0] > 0:
        cell = grid_cell(layers.grid, x)
        if cell >= 0:
            water.shares = layers.grid.shares[cell]
    return water


@wp.func
def regular_free_path(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, xi: float, seed: wp.uint64) -> float:
    """Free flight [m] for uniform xi in (0, 1]: where the optical depth of the cells reaches -ln(xi)."""
    return distance_to(medium, layers, x, u, -wp.log(xi))


@wp.func
def regular_extinction(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float, seed: wp.uint64) -> float:
    """Mean extinction [1/m] between x and x + length u."""
    return depth_along(medium, layers, x, u, length) / wp.max(length, 1.0e-30)


@wp.func
def delta_free_path(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, xi: float, seed: wp.uint64) -> float:
    """Free flight [m] by delta tracking: from xi the first tentative collision, from the seed the others."""
    grid = layers.grid
    line = grid_line(grid, grid.block_size, grid.block_edge, x, u, 1.0e30)
    rest = -wp.log(xi)
    before = medium.extinction * line.begin
    if line.begin >= line.end or rest <= before:
        return _over(rest, medium.extinction)
    rest -= before
    place = first_place(line, grid.block_size)
    majorant = load_float(grid.block_majorant, place.cell)
    random = begin_sequence(seed)
    while place.t < line.end:
        # First through the blocks, then the collision: the lanes of a warp do either together.
        while majorant * (place.leave - place.t) < rest and place.leave < line.end:
            rest -= majorant * (place.leave - place.t)
            place = next_place(line, place)
            majorant = load_float(grid.block_majorant, place.cell)
        kept = majorant * (place.leave - place.t)
        if kept < rest:
            return line.end + _over(rest - kept, medium.extinction)
        place.t = wp.min(place.t + rest / wp.max(majorant, 1.0e-30), place.leave)
        random = step_sequence(random)
        extinction = load_float(grid.extinction, cell_on_line(grid, line.p, line.d, place.t))
        if u01(sequence_word(random)) * majorant < extinction:
            return place.t
        random = step_sequence(random)
        rest = -wp.log(u01_open(sequence_word(random)))
    return line.end + _over(rest, medium.extinction)


@wp.func
def ratio_extinction(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float, seed: wp.uint64) -> float:
    """Extinction [1/m] whose exp(-mean length) has the expectation of what passes between x and x + length u; by
    residual ratio tracking about an extinction near the mean of each block, with one rate: first all lanes of a warp go
    through blocks, then all look up cells."""
    grid = layers.grid
    line = grid_line(grid, grid.block_size, grid.block_edge, x, u, length)
    if line.begin >= line.end:
        return medium.extinction
    place = first_place(line, grid.block_size)
    control = load_vec2(grid.block_control, place.cell)
    rate = float(control[1])
    depth = medium.extinction * (length - (line.end - line.begin)) + control[0] * (place.leave - place.t)
    while place.leave < line.end:
        place = next_place(line, place)
        control = load_vec2(grid.block_control, place.cell)
        depth += control[0] * (place.leave - place.t)
        rate = wp.max(rate, control[1])
    part = float(1.0)
    mean_step = 1.0 / wp.max(rate, 1.0e-30)
    random = step_sequence(begin_sequence(seed))
    t = line.begin - wp.log(u01_open(sequence_word(random))) * mean_step
    while t < line.end:
        # Two at a time: a cell takes long to come from memory.
        residual = wp.vec2()
        for i in range(2):
            found = load_float(grid.residual, cell_on_line(grid, line.p, line.d, wp.min(t, line.end)))
            residual[i] = wp.where(t < line.end, found, 0.0)
            random = step_sequence(random)
            t -= wp.log(u01_open(sequence_word(random))) * mean_step
        for i in range(2):
            part *= wp.max(1.0 - residual[i] * mean_step, 0.0)
    return (depth - wp.log(wp.max(part, 1.0e-30))) / wp.max(length, 1.0e-30)


REGULAR_TRACKING = Water(regular_free_path, regular_extinction, grid_water, Profile(depth_along, draw_by_cells))
DELTA_TRACKING = Water(delta_free_path, ratio_extinction, grid_water, Profile(depth_by_block))


# ---- Grids from arrays.


def make_grid(
    extinction: ArrayLike,
    albedo: ArrayLike,
    anisotropy: ArrayLike | None = None,
    *,
    size: Sequence[float],
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    rotation: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    block_edge: int | None = None,
    shares: ArrayLike = (),
    device: wp.DeviceLike = None,
) -> Grid:
    """Cells for `Layers.grid` of a spec with a grid.

    Args:
        extinction: c [1/m] >= 0, `[x, y, z]`, along the box's own axes.
        albedo: In [0, 1], of the same shape.
        anisotropy: g in (-1, 1), of the same shape; None: the medium's.
        size: Edges of the box [m].
        centre: Its middle, in the frame of the photons [m].
        rotation: Its own axes there, as columns.
        block_edge: Cells along the edges of the blocks that delta tracking flies through; None: 6 blocks along the
            longest edge, the fastest for 128^3 cells on an H200.
        shares: Of mixtures, `[x, y, z, constituent]`, see `mixture_shares`.

    Raises:
        ArgumentError: Another shape, a number out of range, or more than 2^30 cells.
    """
    device = check.device("device", device)
    arrays = {"extinction": check.numbers("extinction", extinction, (None,) * 3, "[0, inf)").astype(np.float32)}
    arrays["anisotropy"] = np.zeros(0, np.float32)
    shape = arrays["extinction"].shape
    check.integer("number of cells", math.prod(shape), 1, LARGEST_CELL_COUNT)
    arrays["albedo"] = check.numbers("albedo", albedo, shape, "[0, 1]").astype(np.float32)
    if anisotropy is not None:
        arrays["anisotropy"] = check.numbers("anisotropy", anisotropy, shape, "(-1, 1)").astype(np.float32)
    check.numbers("size", size, (3,), "(0, inf)")
    check.vector("centre", centre)
    axes = check.numbers("rotation", rotation, (3, 3))
    if not np.allclose(axes.T @ axes, np.eye(3), atol=1e-5):
        raise ArgumentError(f"rotation = {axes.tolist()} is not a rotation matrix")
    longest = max(shape)
    edge_cells = max(1, math.ceil(longest / 6)) if block_edge is None else block_edge
    edge_cells = check.integer("block_edge", edge_cells, 1, longest)

    turn = (np.array(shape) / np.array(size, np.float64))[:, None] * axes.T
    shift = 0.5 * np.array(shape) - turn @ np.asarray(centre, np.float64)
    majorant, mean, deviation = block_statistics(arrays["extinction"], edge_cells)
    control, blocks = np.stack([mean.ravel(), deviation.ravel()], axis=1), majorant.shape
    for axis, count in enumerate(shape):
        mean = np.repeat(mean, edge_cells, axis=axis).take(range(count), axis=axis)
    cells = {name: array.ravel() for name, array in arrays.items()} | {"shares": mixture_shares(shares, shape)}
    grid = fill(Grid(), device, turn=turn, shift=shift, size=shape, **cells)
    fill(grid, device, residual=(arrays["extinction"] - mean).ravel(), block_edge=edge_cells, block_size=blocks)
    return fill(grid, device, block_majorant=majorant.ravel(), block_control=control)


def block_statistics(extinction: NDArray[np.float32], edge: int) -> tuple[NDArray[np.float32], ...]:
    """Largest value, a value near the mean and largest difference from it in blocks of `edge` cells; the last may be
    incomplete."""
    starts = [np.arange(0, n, edge) for n in extinction.shape]

    def over_blocks(reduce: np.ufunc, values: NDArray[np.floating]) -> NDArray[np.floating]:
        for axis, start in enumerate(starts):
            values = reduce.reduceat(values, start, axis=axis)
        return values

    ones = [np.diff([*start, n]) for start, n in zip(starts, extinction.shape, strict=True)]
    counts = ones[0][:, None, None] * ones[1][None, :, None] * ones[2][None, None, :]
    low, high = over_blocks(np.minimum, extinction), over_blocks(np.maximum, extinction)
    mean = np.clip(over_blocks(np.add, extinction.astype(np.float64)) / counts, low, high).astype(np.float32)
    # Above the mean, since few cells are far above it, whose difference decides how many points ratio tracking takes.
    mean = (mean + np.float32(0.1) * (high - mean)).astype(np.float32)
    # Not below the true difference, whatever its rounding.
    deviation = np.maximum(high - mean, mean - low) * np.float32(1.0 + 2.0**-20)
    return high.astype(np.float32), mean, deviation.astype(np.float32)


# ---- Voxels of a NanoVDB grid.


@wp.kernel(enable_backward=False)
def voxel_values_kernel(volume: wp.uint64, voxels: wp.array[wp.vec3i], values: wp.array[float]):
    """Values of a `wp.Volume` of float32 at the indices of `Volume.get_voxels`. Launch: voxels."""
    i = wp.tid()
    v = voxels[i]
    values[i] = wp.volume_lookup_f(volume, v[0], v[1], v[2])
