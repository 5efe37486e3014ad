"""Stage finish: the account of a photon whose history has ended, and of a thread."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState, Records, Weight
from spadwarp_kernels.tally.ledger import (
    ABSORBED_SURFACE,
    ABSORBED_WATER,
    BEYOND_MAX_REFLECTIONS,
    CONTRIBUTIONS,
    DIRECTED,
    REFLECTIONS,
    SHADOW_QUERIES,
    SURFACE_EVENTS,
    SURFACE_QUERIES,
    WATER_COLLISIONS,
    add_to_ledger,
    atomic_add_int64,
    to_ledger,
)


@memoised
def make_finish(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, out, ledger, thread) -> Weight``: writes the photon's record, and the ledger entry that
    takes the rest of its weight."""
    records, derivatives = spec.records, len(spec.derivatives)

    @wp.func
    def finish(s: PhotonState, out: Records, ledger: wp.array(dtype=wp.int64), thread: int) -> Weight:
        if wp.static(records):
            out.position[s.photon] = s.x
            out.direction[s.photon] = s.u
            out.weight[s.photon] = s.weight.value
            out.path[s.photon] = s.path
            out.collisions[s.photon] = s.collisions
            out.reason[s.photon] = s.reason
            for p in range(wp.static(derivatives)):
                out.scores[s.photon, p] = s.scores[p]
        weight = s.weight
        rest = to_ledger(weight.value)
        weight.absorbed_water -= rest
        add_to_ledger(ledger, thread, s.reason, rest)
        return weight

    return finish


@memoised
def make_flush(adds: bool, reflecting: bool) -> wp.Function:
    """The Warp function ``(s, tally, ledger, thread)``: adds what a thread has summed up to the ledger, and with `adds`
    to the tally what `add_pending` has left."""

    @wp.func
    def flush(s: PhotonState, tally: wp.array(dtype=wp.int64), ledger: wp.array(dtype=wp.int64), thread: int):
        if wp.static(adds):
            atomic_add_int64(tally, int(s.pending_add[0]), s.pending_add[1])
        add_to_ledger(ledger, thread, ABSORBED_WATER, s.weight.absorbed_water - s.absorbed_surface - s.directed)
        add_to_ledger(ledger, thread, ABSORBED_SURFACE, s.absorbed_surface)
        add_to_ledger(ledger, thread, DIRECTED, s.directed)
        add_to_ledger(ledger, thread, WATER_COLLISIONS, wp.int64(s.water_collisions))
        add_to_ledger(ledger, thread, SURFACE_EVENTS, wp.int64(s.surface_events))
        add_to_ledger(ledger, thread, SURFACE_QUERIES, wp.int64(s.surface_queries))
        add_to_ledger(ledger, thread, SHADOW_QUERIES, wp.int64(s.shadow_queries))
        add_to_ledger(ledger, thread, CONTRIBUTIONS, wp.int64(s.contributions))
        if wp.static(reflecting):
            add_to_ledger(ledger, thread, REFLECTIONS, wp.int64(s.bounces.total))
            add_to_ledger(ledger, thread, BEYOND_MAX_REFLECTIONS, wp.int64(s.bounces.dropped))

    return flush
