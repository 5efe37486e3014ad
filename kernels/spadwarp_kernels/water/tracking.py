"""Flights through a grid: by the cells themselves, exact, or by blocks of them and chance, without bias.

Regular tracking adds up the optical depth of every cell on the way. Where cells are many, delta tracking (Woodcock et
al. 1965) flies through blocks of the largest extinction and rejects collisions, and residual ratio tracking (Novák et
al. 2014) estimates what a flight lets through from an extinction near the mean of each block and a few cells on the
way.
"""

import warp as wp

from spadwarp_kernels.base.native import load_float, load_vec2
from spadwarp_kernels.base.philox import begin_sequence, sequence_word, step_sequence, u01, u01_open

from .grid import block_line, cell_on_line, first_block, first_place, grid_cell, grid_line, next_block, next_place
from .medium import Layers, Medium, Profile, ProfileSample, Water

__all__ = ["DELTA_TRACKING", "REGULAR_TRACKING"]


@wp.func
def _over(depth: float, extinction: float) -> float:
    """Distance [m] to an optical depth; 1e30 in vacuum."""
    return wp.where(extinction > 0.0, depth / wp.max(extinction, 1.0e-30), 1.0e30)


@wp.func
def depth_along(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float) -> float:
    """Optical depth of the cells between x and x + length u."""
    grid = layers.grid
    line = grid_line(grid, x, u, length)
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
    line = grid_line(grid, x, u, 1.0e30)
    before = medium.extinction * line.begin
    if line.begin >= line.end or depth <= before:
        return _over(depth, medium.extinction)
    rest = depth - before
    place = first_place(line, grid.size)
    extinction = float(grid.extinction[place.cell])
    leave = wp.min(place.leave, line.end)
    while extinction * (leave - place.t) < rest and leave < line.end:
        rest -= extinction * (leave - place.t)
        place = next_place(line, place)
        extinction = grid.extinction[place.cell]
        leave = wp.min(place.leave, line.end)
    kept = extinction * (leave - place.t)
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
    sample.depth = depth_along(medium, layers, x, u, sample.s)
    cell = grid_cell(layers.grid, x + sample.s * u)
    extinction = float(medium.extinction)
    if cell >= 0:
        extinction = layers.grid.extinction[cell]
    sample.density = wp.where(thick, extinction * wp.exp(-sample.depth) / kept, 1.0 / width)
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
    # Apart, so that who asks for the phase function alone looks up nothing without it.
    if layers.grid.anisotropy.shape[0] > 0:
        cell = grid_cell(layers.grid, x)
        if cell >= 0:
            water.anisotropy = load_float(layers.grid.anisotropy, cell)
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
    line = block_line(grid, x, u, 1.0e30)
    rest = -wp.log(xi)
    before = medium.extinction * line.begin
    if line.begin >= line.end or rest <= before:
        return _over(rest, medium.extinction)
    rest -= before
    place = first_block(grid, line)
    majorant = load_float(grid.block_majorant, place.block)
    random = begin_sequence(seed)
    while place.t < line.end:
        # First through the blocks, then the collision: the lanes of a warp do either together.
        while majorant * (place.stop - place.t) < rest and place.stop < line.end:
            rest -= majorant * (place.stop - place.t)
            place = next_block(grid, line, place)
            majorant = load_float(grid.block_majorant, place.block)
        kept = majorant * (place.stop - place.t)
        if kept < rest:
            return line.end + _over(rest - kept, medium.extinction)
        place.t = wp.min(place.t + rest / wp.max(majorant, 1.0e-30), place.stop)
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
    line = block_line(grid, x, u, length)
    if line.begin >= line.end:
        return medium.extinction
    place = first_block(grid, line)
    control = load_vec2(grid.block_control, place.block)
    rate = float(control[1])
    depth = medium.extinction * (length - (line.end - line.begin)) + control[0] * (place.stop - place.t)
    while place.stop < line.end:
        place = next_block(grid, line, place)
        control = load_vec2(grid.block_control, place.block)
        depth += control[0] * (place.stop - place.t)
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
