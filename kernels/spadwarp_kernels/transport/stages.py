"""What becomes of a photon, from its emission to the end of its history: stages, made for a spec."""

import warp as wp

from spadwarp_kernels.base import philox
from spadwarp_kernels.base.philox import join_words, random_block_keyed, u01, u01_fine, u01_tail
from spadwarp_kernels.base.rotations import cos_sin_word, rotate_by, snap_from
from spadwarp_kernels.estimators.estimator import Direction
from spadwarp_kernels.optics.sea import FACETS, sample_passage
from spadwarp_kernels.photon import state
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import Launch, PhotonRef, PhotonState, SinkRef, WorldRef
from spadwarp_kernels.riders.riders import make_rider
from spadwarp_kernels.surface.bvh import NO_NODE, NOWHERE, segment_meets_box
from spadwarp_kernels.surface.patches import nearest_patch
from spadwarp_kernels.surface.ray_cast import intersect_surfaces, offset_from_surface, patch_hit
from spadwarp_kernels.surface.reflectance import (
    sample_cosine_law,
    sample_reflection,
    unshadowed,
)
from spadwarp_kernels.tally import ledger
from spadwarp_kernels.tally.ledger import slot_of_core, to_ledger
from spadwarp_kernels.tally.tally import atomic_add_int64
from spadwarp_kernels.water import limits

# ---- The begin and the end of a history, and the account of a thread.


def make_prepare(stepped: bool, in_blocks: bool, cuda: bool) -> wp.Function:
    """The Warp function ``(world, thread, launch) -> PhotonState`` of a thread before its first photon."""

    @wp.func
    def prepare(world: WorldRef, thread: int, launch: Launch) -> PhotonState:
        if wp.static(in_blocks):
            world.derivatives.blocks.thread = thread
        s = PhotonState()
        s.stage = state.START
        s.account.slot = thread if wp.static(cuda) else slot_of_core(launch.first_id)
        s.base = launch.first_id
        if wp.static(stepped):
            s.base += launch.offset[0]
        s.first = -1
        s.taken = 32
        s.albedo = world.medium.albedo
        s.view = world.camera.view
        s.target = -1
        s.hit.face = -1  # for good where there is no mesh: so a compiler leaves out what is done on faces
        s.walk.node = NO_NODE
        return s

    return prepare


def make_begin(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, world, sink, emitted, id)``: the photon that `Beam.emit` has emitted, in the water."""
    beam, rider, sight, surface = spec.beam, make_rider(spec), spec.sight, spec.sight.sea or FACETS
    has_port, sea = beam.port is not None, sight.sea is not None

    @wp.func
    def begin(s: PhotonRef, world: WorldRef, sink: SinkRef, emitted: wp.spatial_vector, id: wp.uint64):
        if wp.static(beam.scans):
            s.target = int(id % wp.uint64(world.scan.count))
            s.view = sight.scan_view(world.camera, world.scan, s.target)
        s.x = wp.spatial_top(emitted)
        s.u = wp.spatial_bottom(emitted)
        s.path = 0.0
        s.weight.value = 1.0
        s.weight.absorbed_water += to_ledger(1.0)
        if wp.static(has_port):
            passage = beam.port.enter(world.laser.port, s.x, s.u)
            state.reweigh(s.weight, passage.transmission)
            if passage.transmission > 0.0:
                s.x = passage.x
                s.u = passage.u
                s.path = passage.path
            state.book_weight(s.weight, s.account, sink, ledger.LASER_PORT)
        s.x = beam.pose.point_out(world.scan, s.target, s.x)
        s.u = beam.pose.turn_out(world.scan, s.target, s.u)
        if wp.static(sea):
            s.above = surface.is_above(world.sea, s.x)
        s.analog_weight = s.weight.value
        s.collisions = 0
        s.surface_count = 0
        rider.begin(s.carried, world, s.target, emitted, s.x, s.u)
        s.stage = state.FLIGHT

    return begin


def make_finish(records: bool, derivatives: int) -> wp.Function:
    """The Warp function ``(s, sink)``: writes the photon's record, with so many derivatives, and the ledger entry that
    takes the rest of its weight."""

    @wp.func
    def finish(s: PhotonRef, sink: SinkRef):
        if wp.static(records):
            sink.records.position[s.photon] = s.x
            sink.records.direction[s.photon] = s.u
            sink.records.weight[s.photon] = s.weight.value
            sink.records.path[s.photon] = s.path
            sink.records.collisions[s.photon] = s.collisions
            sink.records.reason[s.photon] = s.reason
            for p in range(wp.static(derivatives)):
                sink.records.log_derivatives[s.photon, p] = s.carried.log_derivatives[p]
        rest = to_ledger(s.weight.value)
        s.weight.absorbed_water -= rest
        state.book(s.account, sink, s.reason, rest)
        s.water_collisions += s.collisions - s.surface_count - s.bounces.count
        s.bounces.total += s.bounces.count
        s.bounces.count = 0
        s.bounces.leg = 0
        s.surface_events += s.surface_count

    return finish


def make_flush(adds: bool, reflecting: bool, sea: bool) -> wp.Function:
    """The Warp function ``(s, sink)``: adds what a thread has summed up to the ledger, and with `adds` to the tally
    what `add_pending` has left."""

    @wp.func
    def flush(s: PhotonRef, sink: SinkRef):
        if wp.static(adds):
            atomic_add_int64(sink.tally, int(s.account.pending[0]), s.account.pending[1])
        state.book(s.account, sink, ledger.ABSORBED_WATER, s.weight.absorbed_water - s.absorbed_surface - s.directed)
        state.book(s.account, sink, ledger.ABSORBED_SURFACE, s.absorbed_surface)
        state.book(s.account, sink, ledger.DIRECTED, s.directed)
        state.book(s.account, sink, ledger.WATER_COLLISIONS, wp.int64(s.water_collisions))
        state.book(s.account, sink, ledger.SURFACE_EVENTS, wp.int64(s.surface_events))
        state.book(s.account, sink, ledger.SURFACE_QUERIES, wp.int64(s.surface_queries))
        state.book(s.account, sink, ledger.SHADOW_QUERIES, wp.int64(s.shadow_queries))
        state.book(s.account, sink, ledger.CONTRIBUTIONS, wp.int64(s.contributions))
        if wp.static(sea):
            state.book(s.account, sink, ledger.ABSORBED_WATER, -s.absorbed_air)
            state.book(s.account, sink, ledger.ABSORBED_AIR, s.absorbed_air)
            state.book(s.account, sink, ledger.CROSSINGS, wp.int64(s.bounces.total))
        if wp.static(reflecting):
            state.book(s.account, sink, ledger.REFLECTIONS, wp.int64(s.bounces.total))
            state.book(s.account, sink, ledger.BEYOND_MAX_REFLECTIONS, wp.int64(s.bounces.dropped))

    return flush


# ---- Fly: how far the photon flies before it collides, and whether a surface stands before that.


def make_meet(choose: wp.Function | None) -> wp.Function:
    """The Warp function ``(s, world, distance) -> bool``: ends the flight on the face at that distance, or before it;
    whether on the face. `choose`: with the chance of an estimator."""

    @wp.func
    def meet(s: PhotonRef, world: WorldRef, distance: float) -> bool:
        meets = distance < s.flight.distance
        if wp.static(choose is not None):
            meeting = choose(s, world, distance)
            s.flight.factor = meeting.factor
            s.flight.distance = wp.where(meeting.meets, distance, s.flight.distance)
            meets = meeting.meets
        state.shorten(s.flight, distance)
        return meets

    return meet


def make_fly(
    spec: TransportSpec, plan_flight: wp.Function | None, meet: wp.Function, random_albedo: bool, cuda: bool
) -> wp.Function:
    """The Warp function ``(s, world, words)``: lets a photon fly, to EVENT or, where a tree of faces may be
    in its way, to RAY.

    On a CPU `words`, PREFETCHED_WORDS of them, keep the random words of the photon's next flights. They are drawn for
    several flights at once, so that it must be called for each flight of a photon in turn.
    """
    plans, tried, surface = plan_flight is not None, spec.faces.tried, spec.sight.sea or FACETS
    events, prefetch = philox.make_prefetch(philox.STREAM_TRANSPORT, *([philox.STREAM_FLIGHT_SAMPLE] if plans else []))
    last = events - 1
    has_bvh, sea = spec.faces.mesh and not tried, spec.sight.sea is not None

    @wp.func
    def fly(s: PhotonRef, world: WorldRef, words: wp.array[int]):
        id = s.base + wp.uint64(s.photon)
        event = wp.uint32(s.collisions + 1)
        if wp.static(cuda):
            s.flight.block = random_block_keyed(world.keys, id, event, philox.STREAM_TRANSPORT)
        else:
            k = s.collisions & last
            if k == 0:
                prefetch(words, world.keys, id, event)
            s.flight.block = philox.prefetched_block(words, k)
        seed = join_words(s.flight.block[0], s.flight.block[2])
        xi = u01_tail(s.flight.block[0], s.flight.block[2])
        s.flight.distance = spec.water.free_path(world.medium, world.layers, s.x, s.u, xi, seed)
        limit = world.limits.max_path - s.path
        if wp.static(sea):
            limit = wp.where(s.above, limit / world.sea.delay, limit)
            s.flight.sea = surface.distance(world.sea, s.x, s.u, s.above, limit)
            s.flight.distance = wp.min(wp.where(s.above, 1.0e30, s.flight.distance), s.flight.sea)
        s.flight.reach = wp.min(s.flight.distance, limit)
        if wp.static(plans):
            if wp.static(cuda):
                s.flight.sample_block = random_block_keyed(world.keys, id, event, philox.STREAM_FLIGHT_SAMPLE)
            else:
                s.flight.sample_block = philox.prefetched_block(words, events + k)
            plan = plan_flight(s, s.flight.sample_block, world)
            s.flight.lens = plan.lens
            s.flight.lens_weight = plan.lens_weight
            s.flight.interval = plan.interval
            if state.is_planned(s.flight):
                s.flight.reach = wp.max(s.flight.reach, s.flight.interval[1])
        s.hit.face = -1
        s.flight.factor = 1.0
        s.stage = state.EVENT
        if wp.static(random_albedo):
            s.albedo = world.medium.albedo * u01(random_block_keyed(world.keys, id, event, philox.STREAM_ROULETTE)[1])
        if wp.static(has_bvh):
            if segment_meets_box(s.x, s.u, s.flight.reach, world.surfaces.lower, world.surfaces.upper):
                s.stage = state.RAY
        if wp.static(spec.faces.tried):
            # Of any length: what lies beyond the reach shortens nothing that counts, as does no hit.
            met = nearest_patch(world.surfaces.patches, s.x, s.u, NOWHERE)
            s.surface_queries += 1
            if meet(s, world, met[0]) and met[0] < NOWHERE:  # in water as thin as vacuum a flight is longer than that
                s.hit = patch_hit(world.surfaces, met)

    return fly


def make_trace(meet: wp.Function, has_bvh: bool) -> wp.Function:
    """The Warp function ``(s, world)``: the surface before a photon that waits for a ray, without other threads."""

    @wp.func
    def trace(s: PhotonRef, world: WorldRef):
        if wp.static(has_bvh):
            if s.stage == state.RAY:
                s.surface_queries += 1
                hit = intersect_surfaces(world.surfaces, s.x, s.u, s.flight.reach, False)
                if hit.face >= 0:
                    if meet(s, world, hit.distance):
                        s.hit = hit
                s.stage = state.EVENT

    return trace


# ---- Collide: the end of a flight, in the water, on a surface or at a limit.


@wp.struct
class Collision:
    """The end of a flight."""

    distance: float  # length of the flight [m]
    reason: int  # ledger entry of the limit that ended the history, or of its last event; else -1
    mirror: int  # face of the domain that reflects the photon there; else 0


def make_collide(spec: TransportSpec, chosen: bool, flies_on: bool, score_flux: wp.Function | None) -> wp.Function:
    """The Warp function ``(s, world, sink)``: takes a photon to the end of its flight, and on to SCATTER or to END.

    `chosen`: an estimator chooses what ends a flight; `flies_on`: see `continues`; `score_flux`: see
    `make_flux_score`.
    """
    domain, rider, sea = spec.domain, make_rider(spec), spec.sight.sea is not None
    reflects, bounded = domain.reflects, domain.bounded and not domain.reflects
    tallies_flux = score_flux is not None

    @wp.func
    def end_of_flight(s: PhotonRef, world: WorldRef) -> Collision:
        c = Collision()
        c.distance = s.flight.distance
        c.reason = -1
        limit = world.limits.max_path - s.path
        if wp.static(sea):
            limit = wp.where(s.above, limit / world.sea.delay, limit)
        if s.flight.distance > limit:
            c.reason = ledger.MAX_PATH
            c.distance = limit
        if wp.static(bounded):
            if domain.is_outside(world.limits, s.x + c.distance * s.u):
                leaves = domain.exit(world.limits, s.x, s.u)
                c.reason = ledger.EXIT + leaves.face
                c.distance = wp.min(c.distance, leaves.distance)
        if wp.static(reflects):
            # By distance: a photon that has been reflected may be outside by a rounding error.
            leaves = domain.exit(world.limits, s.x, s.u)
            if leaves.distance < c.distance:
                c.distance = leaves.distance
                c.reason = -1
                if limits.face_index(world.limits.boundary, leaves.face) > 0.0:
                    c.mirror = leaves.face
                else:
                    c.reason = ledger.EXIT + leaves.face
        if wp.static(sea):
            if c.reason < 0 and s.hit.face < 0 and s.flight.distance == s.flight.sea:
                c.mirror = state.SEA_FACE
        if wp.static(flies_on):
            if s.collisions > 0 and s.reason >= 0:
                c.reason = s.reason
                if wp.static(reflects):
                    # The light of the last event ends at the next, or with the longest leg that may be scored.
                    c.mirror = wp.where(s.bounces.leg < world.limits.boundary.max_reflections, c.mirror, 0)
        return c

    @wp.func
    def collide(s: PhotonRef, world: WorldRef, sink: SinkRef):
        c = end_of_flight(s, world)
        if wp.static(chosen):
            state.reweigh(s.weight, s.flight.factor)
            s.directed += s.weight.taken
        rider.fly(s.carried, world, s.x, s.u, wp.where(s.above, 0.0, c.distance))
        if wp.static(tallies_flux):
            score_flux(s, world, sink, c.distance, c.reason < 0 and c.mirror == 0 and s.hit.face < 0)
        s.x = s.x + c.distance * s.u
        if wp.static(sea):
            if s.above:
                s.path -= (1.0 - world.sea.delay) * c.distance
                passed = wp.exp(-world.sea.extinction * c.distance)
                state.reweigh(s.weight, passed)
                s.absorbed_air += s.weight.taken
                s.analog_weight *= passed
        s.path += c.distance
        s.reason = c.reason
        s.stage = state.END
        if c.reason < 0:
            if wp.static(spec.local_albedo):
                s.albedo = spec.water.at(world.medium, world.layers, s.x).albedo
            if s.hit.face >= 0 and c.mirror == 0:
                s.x = offset_from_surface(s.x, s.hit.normal, c.distance)
        if wp.static(reflects or sea):
            s.bounces.face = c.mirror
            s.bounces.leg = wp.where(c.mirror > 0, s.bounces.leg + 1, 0)
            s.bounces.count += wp.where(c.mirror > 0, 1, 0)
        if c.reason < 0 or c.mirror > 0:
            s.stage = state.SCATTER

    return collide


def make_cross(spec: TransportSpec, cross: wp.Function | None, deposit: wp.Function) -> wp.Function:
    """The Warp function ``(s, world, sink)``: what a photon brings that flies through the aperture itself, if an
    estimator says so, with what rides along."""
    crosses, sight, pose, rider = cross is not None, spec.sight, spec.sight.pose, make_rider(spec)

    @wp.func
    def cross_aperture(s: PhotonRef, world: WorldRef, sink: SinkRef):
        if wp.static(crosses):
            c = cross(s, world)
            s.bounces.dropped += wp.where(c.index == state.TOO_LONG, 1, 0)
            if wp.static(rider.rides):
                if c.value > 0.0:
                    carried = s.carried
                    x, u = pose.point_in(world.scan, s.target, s.x), pose.turn_in(world.scan, s.target, s.u)
                    passage = sight.leave(world.camera, x, u)
                    rider.fork(carried, world)
                    rider.fly(carried, world, s.x, s.u, wp.where(s.above, 0.0, passage.water))
                    rider.deliver(c, carried, world, s.x, s.u, passage.u)
            if not c.value <= 0.0:
                s.contributions += 1
                deposit(s.account, sink, world, c)

    return cross_aperture


# ---- Scatter: the weight after an event, the end of the history, or the new direction.


@wp.struct
class Outcome:
    """What an event makes of a photon: see `PhotonState`, which takes it over once nothing asks for the old weight."""

    weight: state.Weight
    analog_weight: float
    reason: int


def make_sample_direction(spec: TransportSpec, direct: wp.Function | None) -> wp.Function:
    """The Warp function ``(s, reflected, lobe, world, id) -> Direction``.

    Directions follow the phase function and the surface's law, unless an estimator has a way of its own.
    """
    if direct is not None:
        return direct
    water = spec.water

    @wp.func
    def sample_direction(s: PhotonRef, reflected: wp.vec3, lobe: float, world: WorldRef, id: wp.uint64) -> Direction:
        new = Direction()
        on_surface = s.hit.face >= 0
        axis = snap_from(s.u, world.medium.axis_threshold)
        t = water.phase.sample(u01_fine(s.flight.block[1]), water.at(world.medium, world.layers, s.x))
        if on_surface:
            axis = s.hit.normal
            t = sample_cosine_law(u01(s.flight.block[1]))
        new.u = rotate_by(axis, t, cos_sin_word(s.flight.block[2]))
        if wp.static(spec.faces.specular):
            if on_surface:
                new.u = reflected
        return new

    return sample_direction


@wp.func
def continues(reason: int, flies_on: bool) -> bool:
    """Whether there is a flight after an event; `flies_on`: the light of a history's last event is scored as it flies,
    to where the next event would be."""
    return reason < 0 or (flies_on and reason != ledger.ROULETTE)


def make_terminate(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(new, s, world, sink, id)``: the end of a history for its analog weight or its events."""

    @wp.func
    def terminate(new: wp.ref[Outcome], s: PhotonRef, world: WorldRef, sink: SinkRef, id: wp.uint64):
        if new.analog_weight < world.limits.weight_cutoff:
            new.reason = ledger.WEIGHT_CUTOFF
            if wp.static(spec.roulette):
                chance = u01(random_block_keyed(world.keys, id, wp.uint32(s.collisions), philox.STREAM_ROULETTE)[0])
                new.reason = ledger.ROULETTE
                if chance < 0.1 and new.analog_weight > 0.0:
                    new.reason = -1
                    state.reweigh(new.weight, 10.0)
                    new.analog_weight *= 10.0
                    state.book_weight(new.weight, s.account, sink, ledger.ROULETTE)
        if new.reason < 0 and s.collisions >= world.limits.max_collisions:
            new.reason = ledger.MAX_COLLISIONS

    return terminate


def make_lose(spec: TransportSpec, directed: bool, flies_on: bool) -> wp.Function:
    """The Warp function ``(s, world, sink, id, part, entry) -> bool``: a boundary sends on a part of the photon, and an
    entry of the ledger takes the rest; whether there is a flight.

    `directed`: weight and analog weight differ; `flies_on`: see `continues`.
    """
    terminate = make_terminate(spec)

    @wp.func
    def lose(s: PhotonRef, world: WorldRef, sink: SinkRef, id: wp.uint64, part: float, entry: int) -> bool:
        new = Outcome()
        new.reason = s.reason
        new.weight = s.weight
        state.reweigh(new.weight, part)
        # The light of an event that was the last is accounted for by what has ended the history.
        state.book_weight(new.weight, s.account, sink, wp.where(s.reason < 0, entry, s.reason))
        if s.reason < 0:
            new.analog_weight = wp.where(wp.static(directed), s.analog_weight * part, new.weight.value)
            terminate(new, s, world, sink, id)
        s.weight = new.weight
        s.analog_weight = new.analog_weight
        s.reason = new.reason
        return continues(new.reason, wp.static(flies_on))

    return lose


def make_bounce(spec: TransportSpec, lose: wp.Function) -> wp.Function:
    """The Warp function ``(s, world, sink, id)`` of a photon that a face of the domain reflects; what is not reflected
    leaves by the face. `lose`: see `make_lose`."""
    domain, rider = spec.domain, make_rider(spec)

    @wp.func
    def bounce(s: PhotonRef, world: WorldRef, sink: SinkRef, id: wp.uint64):
        face = s.bounces.face
        axis = (face - 1) // 2
        index = limits.face_index(world.limits.boundary, face)
        u = domain.turn(world.limits, s.u)
        part = limits.fresnel_reflectance(wp.min(wp.abs(u[axis]), 1.0), index)
        u = domain.turn_back(world.limits, limits.flipped(u, axis))
        if wp.static(domain.rotated):
            u = wp.normalize(u)
        rider.mirror(s.carried, s.u, u, index)
        if lose(s, world, sink, id, part, ledger.EXIT + face):
            s.u = u

    return bounce


def make_meet_sea(spec: TransportSpec, lose: wp.Function) -> wp.Function:
    """The Warp function ``(s, world, sink, id)`` of a photon that the surface of a sea reflects or lets through.
    `lose`: see `make_lose`."""
    surface, rider = spec.sight.sea or FACETS, make_rider(spec)

    @wp.func
    def meet_sea(s: PhotonRef, world: WorldRef, sink: SinkRef, id: wp.uint64):
        draw = random_block_keyed(world.keys, id, wp.uint32(s.collisions), philox.STREAM_SURFACE)
        passage = sample_passage(surface.at(world.sea, s.x), s.u, s.above, draw)
        rider.event(s.carried, world, state.SEA_SLOT, s.x, s.u, passage.u)
        # The light of an event that was the last goes to the lens; what is reflected would come from an event here.
        scored_here = passage.reflected
        if wp.static(spec.waves):
            scored_here = passage.reflected or s.bounces.leg > 1
        part = wp.where(s.reason >= 0 and scored_here, 0.0, passage.part)
        if lose(s, world, sink, id, part, ledger.SURFACE_MASKING):
            s.u = passage.u
            s.above = s.above == passage.reflected

    return meet_sea


def make_scatter(spec: TransportSpec, direct: wp.Function | None, flies_on: bool) -> wp.Function:
    """The Warp function ``(s, world, sink)``: takes a photon from its event to FLIGHT, or to END.

    `flies_on`: see `continues`.
    """
    directed, sea, rider = direct is not None, spec.sight.sea is not None, make_rider(spec)
    sample_direction, terminate = make_sample_direction(spec, direct), make_terminate(spec)
    lose = make_lose(spec, directed, flies_on)
    bounce, meet_sea = make_bounce(spec, lose), make_meet_sea(spec, lose)

    @wp.func
    def turn(
        new: wp.ref[Outcome], s: PhotonRef, world: WorldRef, sink: SinkRef, id: wp.uint64, on_surface: bool, lobe: float
    ):
        reflected = s.u
        if wp.static(spec.faces.specular):
            if on_surface:
                draw = random_block_keyed(world.keys, id, wp.uint32(s.collisions), philox.STREAM_SURFACE)
                roughness = world.surfaces.roughness[s.hit.face]
                reflected = sample_reflection(s.u, s.hit.normal, roughness, lobe, draw)
        heading = sample_direction(s, reflected, lobe, world, id)
        rider.event(s.carried, world, wp.where(on_surface, s.hit.slot, -1), s.x, s.u, heading.u)
        if wp.static(directed):
            state.reweigh(new.weight, heading.factor)
            s.directed += new.weight.taken
            if new.weight.value <= 0.0:
                new.reason = ledger.DIRECTED
        if wp.static(spec.faces.specular):
            if on_surface:
                # What one facet takes of another's light stays in the surface.
                leaving = unshadowed(s.u, heading.u, s.hit.normal, world.surfaces.roughness[s.hit.face], lobe)
                state.reweigh(new.weight, leaving)
                new.analog_weight *= leaving
                if new.reason < 0:
                    s.absorbed_surface += new.weight.taken
                else:
                    state.book_weight(new.weight, s.account, sink, new.reason)
                if new.weight.value <= 0.0 and new.reason < 0:
                    new.reason = ledger.WEIGHT_CUTOFF
        s.u = heading.u

    @wp.func
    def collision(s: PhotonRef, world: WorldRef, sink: SinkRef, id: wp.uint64):
        new = Outcome()
        new.reason = -1
        new.weight = s.weight
        on_surface = s.hit.face >= 0
        survival = spec.faces.survival(world.surfaces, s.hit, s.x, s.albedo)
        if on_surface:
            state.reweigh(new.weight, survival[0])
            s.absorbed_surface += new.weight.taken
        else:
            new.weight.value *= survival[0]
        new.analog_weight = wp.where(wp.static(directed), s.analog_weight * survival[0], new.weight.value)
        terminate(new, s, world, sink, id)
        if continues(new.reason, wp.static(flies_on)):
            turn(new, s, world, sink, id, on_surface, survival[1])
        s.weight = new.weight
        s.analog_weight = new.analog_weight
        s.reason = new.reason
        s.surface_count += wp.where(on_surface, 1, 0)

    @wp.func
    def scatter(s: PhotonRef, world: WorldRef, sink: SinkRef):
        # Here, not in `collide`: there a select takes the place of the branch, and a core waits for the flight.
        s.collisions += 1
        id = s.base + wp.uint64(s.photon)
        bounced = False
        if wp.static(spec.domain.reflects):
            bounced = s.bounces.face > 0
            if bounced:
                bounce(s, world, sink, id)
        if wp.static(sea):
            bounced = s.bounces.face > 0
            if bounced:
                meet_sea(s, world, sink, id)
        if not bounced:
            collision(s, world, sink, id)
        s.stage = wp.where(continues(s.reason, wp.static(flies_on)), state.FLIGHT, state.END)

    return scatter
