"""The begin and the end of a photon's history, and the account of a thread."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.optics.laser import emit_along, emit_measured
from spadwarp_kernels.photon.sink import Sink, book, book_weight, reweigh
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import FLIGHT, PhotonState, Records, sum_bounces
from spadwarp_kernels.photon.world import World
from spadwarp_kernels.riders.riders import make_rider
from spadwarp_kernels.tally.ledger import (
    ABSORBED_SURFACE,
    ABSORBED_WATER,
    BEYOND_MAX_REFLECTIONS,
    CONTRIBUTIONS,
    DIRECTED,
    LASER_PORT,
    REFLECTIONS,
    SHADOW_QUERIES,
    SURFACE_EVENTS,
    SURFACE_QUERIES,
    WATER_COLLISIONS,
    atomic_add_int64,
    to_ledger,
)


@memoised
def make_prepare(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(world, thread, first_id, offset) -> uint64``: the id of a launch's first photon."""
    stepped, in_blocks = spec.stepped, bool(spec.blocks)

    @wp.func
    def prepare(world: wp.ref[World], thread: int, first_id: wp.uint64, offset: wp.array[wp.uint64]) -> wp.uint64:
        if wp.static(in_blocks):
            world.derivatives.blocks.thread = thread
        base = wp.uint64(first_id)
        if wp.static(stepped):
            base += offset[0]
        return base

    return prepare


@memoised
def make_emit(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(world, id) -> spatial_vector``: start position [m], then unit direction."""
    confocal = spec.confocal
    emit_from = emit_measured if spec.measured_beam else emit_along

    @wp.func
    def emit(world: wp.ref[World], id: wp.uint64) -> wp.spatial_vector:
        axis = world.laser.axis
        if wp.static(confocal):
            axis = world.scan.axis[int(id % wp.uint64(world.scan.count))]
        start, heading = emit_from(world.laser, axis, world.seed, id)
        return wp.spatial_vector(start, heading)

    return emit


@memoised
def make_begin(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, world, sink, emitted, id)``: the photon that `emit` has emitted, in the water."""
    confocal, has_port, begin_carried = spec.confocal, spec.laser_port is not None, make_rider(spec).begin
    enter = spec.laser_port.enter if spec.laser_port is not None else None

    @wp.func
    def begin(
        s: wp.ref[PhotonState], world: wp.ref[World], sink: wp.ref[Sink], emitted: wp.spatial_vector, id: wp.uint64
    ):
        if wp.static(confocal):
            s.target = int(id % wp.uint64(world.scan.count))
            s.view = world.scan.view[s.target]
        s.x = wp.spatial_top(emitted)
        s.u = wp.spatial_bottom(emitted)
        s.path = 0.0
        s.weight.value = 1.0
        s.weight.absorbed_water += to_ledger(1.0)
        if wp.static(has_port):
            passage = enter(world.laser.port, s.x, s.u)
            reweigh(s.weight, passage.transmission)
            if passage.transmission > 0.0:
                s.x = passage.x
                s.u = passage.u
                s.path = passage.path
            book_weight(s.weight, s.account, sink, LASER_PORT)
        s.analog_weight = s.weight.value
        s.collisions = 0
        s.surface_count = 0
        begin_carried(s.carried, world, s.target, emitted, s.x, s.u)
        s.stage = FLIGHT

    return begin


@memoised
def make_finish(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, sink, out)``: writes the photon's record, and the ledger entry that takes the rest of its
    weight."""
    records, derivatives = spec.records, len(spec.derivatives)

    @wp.func
    def finish(s: wp.ref[PhotonState], sink: wp.ref[Sink], out: Records):
        if wp.static(records):
            out.position[s.photon] = s.x
            out.direction[s.photon] = s.u
            out.weight[s.photon] = s.weight.value
            out.path[s.photon] = s.path
            out.collisions[s.photon] = s.collisions
            out.reason[s.photon] = s.reason
            for p in range(wp.static(derivatives)):
                out.log_derivatives[s.photon, p] = s.carried.log_derivatives[p]
        rest = to_ledger(s.weight.value)
        s.weight.absorbed_water -= rest
        book(s.account, sink, s.reason, rest)
        s.water_collisions += s.collisions - s.surface_count - s.bounces.count
        sum_bounces(s.bounces)
        s.surface_events += s.surface_count

    return finish


@memoised
def make_flush(adds: bool, reflecting: bool) -> wp.Function:
    """The Warp function ``(s, sink)``: adds what a thread has summed up to the ledger, and with `adds` to the tally
    what `add_pending` has left."""

    @wp.func
    def flush(s: wp.ref[PhotonState], sink: wp.ref[Sink]):
        if wp.static(adds):
            atomic_add_int64(sink.tally, int(s.account.pending[0]), s.account.pending[1])
        book(s.account, sink, ABSORBED_WATER, s.weight.absorbed_water - s.absorbed_surface - s.directed)
        book(s.account, sink, ABSORBED_SURFACE, s.absorbed_surface)
        book(s.account, sink, DIRECTED, s.directed)
        book(s.account, sink, WATER_COLLISIONS, wp.int64(s.water_collisions))
        book(s.account, sink, SURFACE_EVENTS, wp.int64(s.surface_events))
        book(s.account, sink, SURFACE_QUERIES, wp.int64(s.surface_queries))
        book(s.account, sink, SHADOW_QUERIES, wp.int64(s.shadow_queries))
        book(s.account, sink, CONTRIBUTIONS, wp.int64(s.contributions))
        if wp.static(reflecting):
            book(s.account, sink, REFLECTIONS, wp.int64(s.bounces.total))
            book(s.account, sink, BEYOND_MAX_REFLECTIONS, wp.int64(s.bounces.dropped))

    return flush
