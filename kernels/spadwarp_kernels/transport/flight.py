"""Stage flight: how far the photon flies before it collides."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import (
    STREAM_FLIGHT_SAMPLE,
    STREAM_ROULETTE,
    STREAM_TRANSPORT,
    RoundKeys,
    join_words,
    make_prefetch,
    prefetched_block,
    random_block_keyed,
    u01,
    u01_tail,
)
from spadwarp_kernels.optics.camera import Camera, Gate
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import EVENT, RAY, Flight, PhotonState, is_planned, shorten
from spadwarp_kernels.surface.bvh import NOWHERE, segment_meets_box, segment_meets_box_on_cpu
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.patches import nearest_patch
from spadwarp_kernels.surface.ray_cast import patch_hit
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import Layers, Medium


@memoised
def make_fly(spec: TransportSpec, plan_flight: wp.Function | None, cuda: bool) -> wp.Function:
    """The Warp function ``(s, medium, layers, camera, gate, limits, keys, id, words) -> Flight``.

    On a CPU `words`, PREFETCHED_WORDS of them, keep the random words of the photon's next flights. They are drawn for
    several flights at once, so that it must be called for each flight of a photon in turn.
    """
    plans = plan_flight is not None
    water_free_path = spec.water.free_path
    events, prefetch = make_prefetch(STREAM_TRANSPORT, *([STREAM_FLIGHT_SAMPLE] if plans else []))
    last = events - 1

    @wp.func
    def fly(
        s: PhotonState,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        keys: RoundKeys,
        id: wp.uint64,
        words: wp.array(dtype=int),
    ) -> Flight:
        f = Flight()
        if wp.static(cuda):
            f.block = random_block_keyed(keys, id, wp.uint32(s.collisions + 1), STREAM_TRANSPORT)
        else:
            k = s.collisions & last
            if k == 0:
                prefetch(words, keys, id, wp.uint32(s.collisions + 1))
            f.block = prefetched_block(words, k)
        seed = join_words(f.block[0], f.block[2])
        f.distance = water_free_path(medium, layers, s.x, s.u, u01_tail(f.block[0], f.block[2]), seed)
        f.reach = wp.min(f.distance, limits.max_path - s.path)
        if wp.static(plans):
            if wp.static(cuda):
                f.sample_block = random_block_keyed(keys, id, wp.uint32(s.collisions + 1), STREAM_FLIGHT_SAMPLE)
            else:
                f.sample_block = prefetched_block(words, events + k)
            plan = plan_flight(s, f.sample_block, medium, camera, gate, limits)
            f.lens = plan.lens
            f.lens_weight = plan.lens_weight
            f.interval = plan.interval
            if is_planned(f):
                f.reach = wp.max(f.reach, f.interval[1])
        return f

    return fly


@memoised
def make_draw_albedo(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, medium, keys, id) -> float``: the albedo of the next collision, that of the water or
    uniform in [0, medium.albedo)."""
    random_albedo = spec.random_albedo

    @wp.func
    def draw_albedo(s: PhotonState, medium: Medium, keys: RoundKeys, id: wp.uint64) -> float:
        if wp.static(random_albedo):
            return medium.albedo * u01(random_block_keyed(keys, id, wp.uint32(s.collisions + 1), STREAM_ROULETTE)[1])
        return s.albedo

    return draw_albedo


@memoised
def make_depart(spec: TransportSpec, plan_flight: wp.Function | None, brute_force: bool, cuda: bool) -> wp.Function:
    """The Warp function ``(s, medium, layers, camera, gate, limits, surfaces, keys, id, words)``: lets a photon fly, to
    EVENT or, where a tree of faces may be in its way, to RAY. `brute_force`: every face is tried on the spot."""
    fly, draw_albedo = make_fly(spec, plan_flight, cuda), make_draw_albedo(spec)
    has_bvh = spec.mesh and not brute_force
    meets_box = segment_meets_box if cuda else segment_meets_box_on_cpu

    @wp.func
    def depart(
        s: wp.ref[PhotonState],
        medium: Medium,
        layers: Layers,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        surfaces: Surfaces,
        keys: RoundKeys,
        id: wp.uint64,
        words: wp.array(dtype=int),
    ):
        s.flight = fly(s, medium, layers, camera, gate, limits, keys, id, words)
        s.hit.face = -1
        s.stage = EVENT
        s.albedo = draw_albedo(s, medium, keys, id)
        if wp.static(has_bvh):
            if meets_box(s.x, s.u, s.flight.reach, surfaces.lower, surfaces.upper):
                s.stage = RAY
        if wp.static(brute_force):
            # Of any length: what lies beyond the reach shortens nothing that counts, as does no hit.
            met = nearest_patch(surfaces.patches, s.x, s.u, NOWHERE)
            s.surface_queries += 1
            if met[0] < wp.min(s.flight.distance, NOWHERE):  # in water as thin as vacuum a flight is longer than that
                s.hit = patch_hit(surfaces, met)
            s.flight = shorten(s.flight, met[0])

    return depart
