"""Flights through a grid: by the cells themselves, exact, or by blocks of them and chance, without bias.

Regular tracking adds up the optical depth of every cell on the way. Where cells are many, delta tracking (Woodcock et
al. 1965) flies through blocks of the largest extinction and rejects collisions, and residual ratio tracking (Novák et
al. 2014) estimates what a flight lets through from the mean extinction of the blocks and a few cells on the way.
"""

import functools

import warp as wp

from spadwarp_kernels.random.philox import u01, u01_open
from spadwarp_kernels.random.splitmix import splitmix

from .grid import Grid, first_place, grid_block, grid_cell, grid_line, next_place
from .layers import Layers, Profile, Water
from .water import Medium


@wp.func
def _edge_of_cells(grid: Grid) -> int:
    return 1


@wp.func
def _size_in_cells(grid: Grid) -> wp.vec3i:
    return grid.size


@wp.func
def _edge_of_blocks(grid: Grid) -> int:
    return grid.block_edge


@wp.func
def _size_in_blocks(grid: Grid) -> wp.vec3i:
    return grid.block_size


@wp.func
def _cell_extinction(grid: Grid, cell: int) -> float:
    return grid.extinction[cell]


@wp.func
def _block_mean(grid: Grid, block: int) -> float:
    return grid.block_mean[block]


@wp.func
def _over(depth: float, extinction: float) -> float:
    """Distance [m] to an optical depth; 1e30 in vacuum."""
    return wp.where(extinction > 0.0, depth / wp.max(extinction, 1.0e-30), 1.0e30)


@functools.cache
def make_profile(blocks: bool) -> Profile:
    """Optical depth by the extinction of the cells, or the mean one of their blocks."""
    edge_of, size_of, extinction_of, index_of = (
        (_edge_of_blocks, _size_in_blocks, _block_mean, grid_block)
        if blocks
        else (_edge_of_cells, _size_in_cells, _cell_extinction, grid_cell)
    )

    @wp.func
    def depth_along(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float) -> float:
        grid = layers.grid
        size = size_of(grid)
        line = grid_line(grid, edge_of(grid), size, x, u, length)
        if line.begin >= line.end:
            return medium.extinction * length
        depth = medium.extinction * (length - (line.end - line.begin))
        place = first_place(line, size)
        while place.leave < line.end:
            depth += extinction_of(grid, place.cell) * (place.leave - place.t)
            place = next_place(line, place)
        return depth + extinction_of(grid, place.cell) * (line.end - place.t)

    @wp.func
    def distance_to(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, depth: float) -> float:
        grid = layers.grid
        size = size_of(grid)
        line = grid_line(grid, edge_of(grid), size, x, u, 1.0e30)
        before = medium.extinction * line.begin
        if line.begin >= line.end or depth <= before:
            return _over(depth, medium.extinction)
        rest = depth - before
        place = first_place(line, size)
        extinction = float(extinction_of(grid, place.cell))
        leave = wp.min(place.leave, line.end)
        while extinction * (leave - place.t) < rest and leave < line.end:
            rest -= extinction * (leave - place.t)
            place = next_place(line, place)
            extinction = extinction_of(grid, place.cell)
            leave = wp.min(place.leave, line.end)
        kept = extinction * (leave - place.t)
        if kept < rest:
            return line.end + _over(rest - kept, medium.extinction)
        return wp.min(place.t + _over(rest, extinction), line.end)

    @wp.func
    def extinction_at(medium: Medium, layers: Layers, x: wp.vec3) -> float:
        cell = index_of(layers.grid, x)
        extinction = float(medium.extinction)
        if cell >= 0:
            extinction = extinction_of(layers.grid, cell)
        return extinction

    return Profile(depth_along, distance_to, extinction_at, exact=not blocks)


@wp.func
def grid_water(medium: Medium, layers: Layers, x: wp.vec3) -> Medium:
    """The medium with the coefficients of the cell at x; itself outside the box."""
    water = medium
    cell = grid_cell(layers.grid, x)
    if cell >= 0:
        water.extinction = layers.grid.extinction[cell]
        water.albedo = layers.grid.albedo[cell]
        if layers.grid.anisotropy.shape[0] > 0:
            water.anisotropy = layers.grid.anisotropy[cell]
    return water


_CELLS = make_profile(False)
_BLOCKS = make_profile(True)
_depth_along, _distance_to = _CELLS.depth, _CELLS.distance


@wp.func
def regular_free_path(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, xi: float, seed: wp.uint64) -> float:
    """Free flight [m] for uniform xi in (0, 1]: where the optical depth of the cells reaches -ln(xi)."""
    return _distance_to(medium, layers, x, u, -wp.log(xi))


@wp.func
def regular_extinction(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float, seed: wp.uint64) -> float:
    """Mean extinction [1/m] between x and x + length u."""
    return _depth_along(medium, layers, x, u, length) / wp.max(length, 1.0e-30)


@wp.func
def delta_free_path(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, xi: float, seed: wp.uint64) -> float:
    """Free flight [m] by delta tracking: from xi the first tentative collision, from the seed the others."""
    grid = layers.grid
    line = grid_line(grid, grid.block_edge, grid.block_size, x, u, 1.0e30)
    rest = -wp.log(xi)
    before = medium.extinction * line.begin
    if line.begin >= line.end or rest <= before:
        return _over(rest, medium.extinction)
    rest -= before
    place = first_place(line, grid.block_size)
    number = int(0)
    while place.t < line.end:
        majorant = grid.block_majorant[place.cell]
        leave = wp.min(place.leave, line.end)
        kept = majorant * (leave - place.t)
        if kept < rest:
            rest -= kept
            place = next_place(line, place)
        else:
            place.t = wp.min(place.t + _over(rest, majorant), leave)
            number += 1
            words = splitmix(seed, number)
            cell = grid_cell(grid, x + place.t * u)
            extinction = grid.extinction[wp.max(cell, 0)]
            if cell >= 0 and u01(words[0]) * majorant < extinction:
                return place.t
            rest = -wp.log(u01_open(words[1]))
    return line.end + _over(rest, medium.extinction)


@wp.func
def ratio_extinction(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float, seed: wp.uint64) -> float:
    """Extinction [1/m] whose exp(-mean length) has the expectation of what passes between x and x + length u; by
    residual ratio tracking."""
    grid = layers.grid
    line = grid_line(grid, grid.block_edge, grid.block_size, x, u, length)
    if line.begin >= line.end:
        return medium.extinction
    depth = medium.extinction * (length - (line.end - line.begin))
    part = float(1.0)
    number = int(1)
    rest = -wp.log(u01_open(splitmix(seed, number)[1]))
    place = first_place(line, grid.block_size)
    while place.t < line.end:
        mean = grid.block_mean[place.cell]
        deviation = grid.block_deviation[place.cell]
        leave = wp.min(place.leave, line.end)
        kept = deviation * (leave - place.t)
        if kept < rest:
            rest -= kept
            depth += mean * (leave - place.t)
            place = next_place(line, place)
        else:
            t = wp.min(place.t + _over(rest, deviation), leave)
            depth += mean * (t - place.t)
            place.t = t
            number += 1
            cell = grid_cell(grid, x + t * u)
            if cell >= 0:
                part *= wp.clamp(1.0 - (grid.extinction[cell] - mean) / deviation, 0.0, 2.0)
            rest = -wp.log(u01_open(splitmix(seed, number)[1]))
    return (depth - wp.log(wp.max(part, 1.0e-30))) / wp.max(length, 1.0e-30)


REGULAR_TRACKING = Water(regular_free_path, regular_extinction, grid_water, _CELLS)
DELTA_TRACKING = Water(delta_free_path, ratio_extinction, grid_water, _BLOCKS)
