"""Scores of a photon's history by block of a grid's cells: by the same addition to a coefficient of all its cells.

Per block -L for absorption, n/b - L for scattering at fixed absorption and n/c - L for extinction at fixed albedo: L
the path in the block, and over n, the scatterings there, the coefficient of the cell of each. They ask for nothing but
the way, so that they hold however the flights were drawn and what passes was estimated: by regular tracking, delta
tracking or ratio tracking.

A thread keeps them in `Blocks.memory`: in the first half of its rows those of the history, in the second half those of
the contribution that is scored, until it is added or, behind a surface, forgotten. Of many blocks light meets few, so
that the thread keeps a list of them.
"""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.photon.derivatives import NOT_MET, Blocks, met_count, met_entry, score_entry
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import CarriedRef, WorldRef
from spadwarp_kernels.water.grid import first_place, grid_cell, grid_line, next_place

from .rider import Rider


@wp.func
def _forget(blocks: Blocks, half: int):
    """No block has been met."""
    for i in range(met_count(blocks, half)):
        block = int(blocks.memory[met_entry(blocks, half, i)])
        blocks.memory[score_entry(blocks, half, 0, block)] = NOT_MET
    blocks.memory[met_entry(blocks, half, blocks.count)] = 0.0


@memoised
def _make_meet(kinds: int) -> wp.Function:
    @wp.func
    def meet(blocks: Blocks, half: int, block: int):
        """A block that light comes to, for the first time or again."""
        if blocks.memory[score_entry(blocks, half, 0, block)] == NOT_MET:
            for q in range(wp.static(kinds)):
                blocks.memory[score_entry(blocks, half, q, block)] = 0.0
            number = met_count(blocks, half)
            blocks.memory[met_entry(blocks, half, number)] = float(block)
            blocks.memory[met_entry(blocks, half, blocks.count)] = float(number + 1)

    return meet


def make_blocks_rider(spec: TransportSpec, beside: Rider) -> Rider:
    """Of the blocks of a spec, after what rides beside them."""
    kinds = len(spec.blocks)

    @wp.func
    def begin(c: CarriedRef, world: WorldRef, target: int, emitted: wp.spatial_vector, x: wp.vec3, u: wp.vec3):
        beside.begin(c, world, target, emitted, x, u)
        c.half = 0
        _forget(world.derivatives.blocks, 0)

    @wp.func
    def fork(c: CarriedRef, world: WorldRef):
        beside.fork(c, world)
        blocks = world.derivatives.blocks
        _forget(blocks, 1)
        count = met_count(blocks, 0)
        for i in range(count):
            block = blocks.memory[met_entry(blocks, 0, i)]
            blocks.memory[met_entry(blocks, 1, i)] = block
            for q in range(wp.static(kinds)):
                value = blocks.memory[score_entry(blocks, 0, q, int(block))]
                blocks.memory[score_entry(blocks, 1, q, int(block))] = value
        blocks.memory[met_entry(blocks, 1, blocks.count)] = float(count)
        c.half = 1

    return beside._replace(begin=begin, fork=fork, fly=_make_fly(kinds, beside), event=_make_event(spec, beside))


def _make_fly(kinds: int, beside: Rider) -> wp.Function:
    meet = _make_meet(kinds)

    @wp.func
    def add(blocks: Blocks, half: int, block: int, value: float):
        meet(blocks, half, block)
        for q in range(wp.static(kinds)):
            entry = score_entry(blocks, half, q, block)
            blocks.memory[entry] = blocks.memory[entry] + value

    @wp.func
    def fly(c: CarriedRef, world: WorldRef, x: wp.vec3, u: wp.vec3, length: float):
        beside.fly(c, world, x, u, length)
        blocks = world.derivatives.blocks
        line = grid_line(blocks.grid, x, u, length)
        if line.begin < line.end:
            place = first_place(line, blocks.grid.size)
            while place.leave < line.end:
                add(blocks, c.half, place.cell, place.t - place.leave)
                place = next_place(line, place)
            add(blocks, c.half, place.cell, place.t - line.end)

    return fly


def _make_event(spec: TransportSpec, beside: Rider) -> wp.Function:
    kinds, water_at, meet = len(spec.blocks), spec.water.at, _make_meet(len(spec.blocks))
    # Bits, since a `wp.static` that reads the index of a loop does not enter the hash of Warp's kernel cache.
    by_scattering, by_extinction = (
        sum(1 << q for q, kind in enumerate(spec.blocks) if kind == name) for name in ("scattering", "extinction")
    )

    @wp.func
    def event(c: CarriedRef, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3):
        beside.event(c, world, slot, x, u, v)
        blocks = world.derivatives.blocks
        block = grid_cell(blocks.grid, x)
        if slot < 0 and block >= 0:
            meet(blocks, c.half, block)
            water = water_at(world.medium, world.layers, x)
            for q in range(wp.static(kinds)):
                coefficient = float(0.0)
                if (wp.static(by_scattering) >> q) & 1 == 1:
                    coefficient = water.extinction * water.albedo
                if (wp.static(by_extinction) >> q) & 1 == 1:
                    coefficient = water.extinction
                if coefficient > 0.0:
                    entry = score_entry(blocks, c.half, q, block)
                    blocks.memory[entry] = blocks.memory[entry] + 1.0 / coefficient

    return event
