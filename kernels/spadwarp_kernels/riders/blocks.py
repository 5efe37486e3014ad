"""Scores of a photon's history by block of a grid's cells: by the same addition to a coefficient of all its cells.

Per block -L for absorption, n/b - L for scattering at fixed absorption and n/c - L for extinction at fixed albedo: L
the path in the block, and over n, the scatterings there, the coefficient of the cell of each. They ask for nothing but
the way, so that they hold however the flights were drawn and what passes was estimated: by regular tracking, delta
tracking or ratio tracking.

A thread keeps them in `Blocks.memory`: in the first half of its rows those of the history, in the second half those of
the contribution that is scored, until it is added or, behind a surface, forgotten. Of many blocks light meets few, so
that the thread keeps a list of them.
"""

from typing import NamedTuple

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.tally.blocks import NOT_MET, Blocks, met_count, met_entry, score_entry
from spadwarp_kernels.tally.scores import Derivatives
from spadwarp_kernels.tally.tally import Scores
from spadwarp_kernels.water.grid import first_place, grid_cell, grid_line, next_place
from spadwarp_kernels.water.medium import Layers, Medium

from .derivatives import make_flight_scores


class BlockScores(NamedTuple):
    """What becomes of the scores of blocks, as Warp functions; `half`: 0 for the history, 1 for what is scored.

    Attributes:
        fly: ``(blocks, half, x, u, length)``, a way in the water.
        turn: ``(blocks, half, medium, layers, x)``, a scattering in the water at x.
        copy: ``(blocks)``, the history's to what is scored.
    """

    fly: wp.Function
    turn: wp.Function
    copy: wp.Function


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


@memoised
def make_block_scores(spec: TransportSpec) -> BlockScores | None:
    """Of a spec with blocks."""
    if not spec.blocks:
        return None
    kinds = len(spec.blocks)

    @wp.func
    def copy(blocks: Blocks):
        _forget(blocks, 1)
        count = met_count(blocks, 0)
        for i in range(count):
            block = blocks.memory[met_entry(blocks, 0, i)]
            blocks.memory[met_entry(blocks, 1, i)] = block
            for q in range(wp.static(kinds)):
                score = blocks.memory[score_entry(blocks, 0, q, int(block))]
                blocks.memory[score_entry(blocks, 1, q, int(block))] = score
        blocks.memory[met_entry(blocks, 1, blocks.count)] = float(count)

    return BlockScores(_make_fly(kinds), _make_turn(spec), copy)


def _make_fly(kinds: int) -> wp.Function:
    meet = _make_meet(kinds)

    @wp.func
    def add(blocks: Blocks, half: int, block: int, value: float):
        meet(blocks, half, block)
        for q in range(wp.static(kinds)):
            entry = score_entry(blocks, half, q, block)
            blocks.memory[entry] = blocks.memory[entry] + value

    @wp.func
    def fly(blocks: Blocks, half: int, x: wp.vec3, u: wp.vec3, length: float):
        line = grid_line(blocks.grid, x, u, length)
        if line.begin < line.end:
            place = first_place(line, blocks.grid.size)
            while place.leave < line.end:
                add(blocks, half, place.cell, place.t - place.leave)
                place = next_place(line, place)
            add(blocks, half, place.cell, place.t - line.end)

    return fly


def _make_turn(spec: TransportSpec) -> wp.Function:
    kinds, water_at, meet = len(spec.blocks), spec.water.at, _make_meet(len(spec.blocks))
    # Bits, since a `wp.static` that reads the index of a loop does not enter the hash of Warp's kernel cache.
    by_scattering, by_extinction = (
        sum(1 << q for q, kind in enumerate(spec.blocks) if kind == name) for name in ("scattering", "extinction")
    )

    @wp.func
    def turn(blocks: Blocks, half: int, medium: Medium, layers: Layers, x: wp.vec3):
        block = grid_cell(blocks.grid, x)
        if block >= 0:
            meet(blocks, half, block)
            water = water_at(medium, layers, x)
            for q in range(wp.static(kinds)):
                coefficient = float(0.0)
                if (wp.static(by_scattering) >> q) & 1 == 1:
                    coefficient = water.extinction * water.albedo
                if (wp.static(by_extinction) >> q) & 1 == 1:
                    coefficient = water.extinction
                if coefficient > 0.0:
                    entry = score_entry(blocks, half, q, block)
                    blocks.memory[entry] = blocks.memory[entry] + 1.0 / coefficient

    return turn


@memoised
def make_begin_history(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(derivatives) -> Scores`` of a photon that has met nothing; of blocks too."""
    in_blocks = bool(spec.blocks)

    @wp.func
    def begin_history(derivatives: Derivatives) -> Scores:
        if wp.static(in_blocks):
            _forget(derivatives.blocks, 0)
        return Scores()

    return begin_history


@memoised
def make_fly_history(spec: TransportSpec) -> wp.Function:
    """The Warp function of `make_flight_scores`, for a flight of the photon itself: of blocks too."""
    flight_scores, by_block = make_flight_scores(spec), make_block_scores(spec)
    if by_block is None:
        return flight_scores
    fly = by_block.fly

    @wp.func
    def fly_history(
        scores: Scores, derivatives: Derivatives, layers: Layers, x: wp.vec3, u: wp.vec3, length: float
    ) -> Scores:
        fly(derivatives.blocks, 0, x, u, length)
        return flight_scores(scores, derivatives, layers, x, u, length)

    return fly_history
