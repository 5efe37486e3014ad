"""Stage fly: how far the photon flies before it collides, and whether a surface stands before that."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import (
    STREAM_FLIGHT_SAMPLE,
    STREAM_ROULETTE,
    STREAM_TRANSPORT,
    join_words,
    make_prefetch,
    prefetched_block,
    random_block_keyed,
    u01,
    u01_tail,
)
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import EVENT, RAY, PhotonState, is_planned, shorten
from spadwarp_kernels.photon.world import Draws, World
from spadwarp_kernels.surface.bvh import NOWHERE, segment_meets_box
from spadwarp_kernels.surface.patches import nearest_patch
from spadwarp_kernels.surface.ray_cast import intersect_surfaces, patch_hit


@memoised
def make_fly(spec: TransportSpec, plan_flight: wp.Function | None, brute_force: bool, cuda: bool) -> wp.Function:
    """The Warp function ``(s, world, draws, words)``: lets a photon fly, to EVENT or, where a tree of faces may be
    in its way, to RAY.

    On a CPU `words`, PREFETCHED_WORDS of them, keep the random words of the photon's next flights. They are drawn for
    several flights at once, so that it must be called for each flight of a photon in turn. `brute_force`: every face
    is tried on the spot.
    """
    plans, random_albedo, water_free_path = plan_flight is not None, spec.random_albedo, spec.water.free_path
    events, prefetch = make_prefetch(STREAM_TRANSPORT, *([STREAM_FLIGHT_SAMPLE] if plans else []))
    last = events - 1
    has_bvh = spec.mesh and not brute_force

    @wp.func
    def fly(s: wp.ref[PhotonState], world: wp.ref[World], draws: wp.ref[Draws], words: wp.array[int]):
        id = draws.base + wp.uint64(s.photon)
        event = wp.uint32(s.collisions + 1)
        if wp.static(cuda):
            s.flight.block = random_block_keyed(draws.keys, id, event, STREAM_TRANSPORT)
        else:
            k = s.collisions & last
            if k == 0:
                prefetch(words, draws.keys, id, event)
            s.flight.block = prefetched_block(words, k)
        seed = join_words(s.flight.block[0], s.flight.block[2])
        xi = u01_tail(s.flight.block[0], s.flight.block[2])
        s.flight.distance = water_free_path(world.medium, world.layers, s.x, s.u, xi, seed)
        s.flight.reach = wp.min(s.flight.distance, world.limits.max_path - s.path)
        if wp.static(plans):
            if wp.static(cuda):
                s.flight.sample_block = random_block_keyed(draws.keys, id, event, STREAM_FLIGHT_SAMPLE)
            else:
                s.flight.sample_block = prefetched_block(words, events + k)
            plan = plan_flight(s, s.flight.sample_block, world)
            s.flight.lens = plan.lens
            s.flight.lens_weight = plan.lens_weight
            s.flight.interval = plan.interval
            if is_planned(s.flight):
                s.flight.reach = wp.max(s.flight.reach, s.flight.interval[1])
        s.hit.face = -1
        s.stage = EVENT
        if wp.static(random_albedo):
            s.albedo = world.medium.albedo * u01(random_block_keyed(draws.keys, id, event, STREAM_ROULETTE)[1])
        if wp.static(has_bvh):
            if segment_meets_box(s.x, s.u, s.flight.reach, world.surfaces.lower, world.surfaces.upper):
                s.stage = RAY
        if wp.static(brute_force):
            # Of any length: what lies beyond the reach shortens nothing that counts, as does no hit.
            met = nearest_patch(world.surfaces.patches, s.x, s.u, NOWHERE)
            s.surface_queries += 1
            if met[0] < wp.min(s.flight.distance, NOWHERE):  # in water as thin as vacuum a flight is longer than that
                s.hit = patch_hit(world.surfaces, met)
            shorten(s.flight, met[0])

    return fly


@memoised
def make_trace(has_bvh: bool) -> wp.Function:
    """The Warp function ``(s, world)``: the surface before a photon that waits for a ray, without other threads."""

    @wp.func
    def trace(s: wp.ref[PhotonState], world: wp.ref[World]):
        if wp.static(has_bvh):
            if s.stage == RAY:
                s.surface_queries += 1
                hit = intersect_surfaces(world.surfaces, s.x, s.u, s.flight.reach, False)
                if hit.face >= 0:
                    if hit.distance < s.flight.distance:
                        s.hit = hit
                    shorten(s.flight, hit.distance)
                s.stage = EVENT

    return trace
