"""Stage scatter: the photon's weight after an event, the end of its history, or its new direction."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import STREAM_ROULETTE, STREAM_SURFACE, random_block_keyed, u01, u01_fine
from spadwarp_kernels.base.rotations import cos_sin_word, rotate_by, snap_from
from spadwarp_kernels.estimators.estimator import Direction
from spadwarp_kernels.photon.sink import Sink, Weight, book_weight, reweigh
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import END, FLIGHT, PhotonState
from spadwarp_kernels.photon.world import Draws, World
from spadwarp_kernels.riders.riders import make_rider
from spadwarp_kernels.surface.reflectance import (
    face_reflectance,
    pattern_reflectance,
    sample_cosine_law,
    sample_reflection,
    unshadowed,
)
from spadwarp_kernels.tally.ledger import DIRECTED, EXIT, MAX_COLLISIONS, ROULETTE, WEIGHT_CUTOFF
from spadwarp_kernels.water.limits import face_index, flipped, fresnel_reflectance, make_domain


@wp.struct
class Survival:
    """What an event leaves of a photon: the part of its weight, and at a surface the part of that which is specular."""

    part: float
    lobe: float


@wp.struct
class Outcome:
    """What an event makes of a photon: see `PhotonState`, which takes it over once nothing asks for the old weight."""

    weight: Weight
    analog_weight: float
    reason: int


@memoised
def make_survive(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, world) -> Survival``: albedo of the water, or reflectance of the face."""
    has_mesh, specular = spec.mesh, spec.specular
    reflectance_at = pattern_reflectance if spec.pattern else face_reflectance

    @wp.func
    def survive(s: wp.ref[PhotonState], world: wp.ref[World]) -> Survival:
        survival = Survival()
        survival.part = s.albedo
        if wp.static(has_mesh):
            if s.hit.face >= 0:
                survival.part = reflectance_at(world.surfaces, s.hit.face, s.x)
                if wp.static(specular):
                    specular_part = world.surfaces.specular[s.hit.face]
                    survival.part += specular_part
                    survival.lobe = specular_part / wp.max(survival.part, 1.0e-30)
        return survival

    return survive


@memoised
def make_sample_direction(spec: TransportSpec, direct: wp.Function | None) -> wp.Function:
    """The Warp function ``(s, reflected, lobe, world, id) -> Direction``.

    Directions follow the phase function and the surface's law, unless an estimator has a way of its own.
    """
    if direct is not None:
        return direct
    has_mesh, specular = spec.mesh, spec.specular
    phase_sample = spec.phase.sample
    water_at = spec.water.at

    @wp.func
    def sample_direction(
        s: wp.ref[PhotonState], reflected: wp.vec3, lobe: float, world: wp.ref[World], id: wp.uint64
    ) -> Direction:
        new = Direction()
        on_surface = False
        if wp.static(has_mesh):
            on_surface = s.hit.face >= 0
        axis = snap_from(s.u, world.medium.axis_threshold)
        t = phase_sample(u01_fine(s.flight.block[1]), water_at(world.medium, world.layers, s.x))
        if on_surface:
            axis = s.hit.normal
            t = sample_cosine_law(u01(s.flight.block[1]))
        new.u = rotate_by(axis, t, cos_sin_word(s.flight.block[2]))
        if wp.static(specular):
            if on_surface:
                new.u = reflected
        return new

    return sample_direction


@memoised
def make_continues(flies_on: bool) -> wp.Function:
    """The Warp function ``reason -> bool``: whether there is a flight after an event.

    `flies_on`: the light of a history's last event is scored as it flies, to where the next event would be.
    """

    @wp.func
    def continues(reason: int) -> bool:
        return reason < 0 or (wp.static(flies_on) and reason != ROULETTE)

    return continues


@memoised
def make_terminate(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(new, s, world, sink, id)``: the end of a history for its analog weight or its events."""
    roulette = spec.roulette

    @wp.func
    def terminate(
        new: wp.ref[Outcome], s: wp.ref[PhotonState], world: wp.ref[World], sink: wp.ref[Sink], id: wp.uint64
    ):
        if new.analog_weight < world.limits.weight_cutoff:
            new.reason = WEIGHT_CUTOFF
            if wp.static(roulette):
                chance = u01(random_block_keyed(world.keys, id, wp.uint32(s.collisions), STREAM_ROULETTE)[0])
                new.reason = ROULETTE
                if chance < 0.1 and new.analog_weight > 0.0:
                    new.reason = -1
                    reweigh(new.weight, 10.0)
                    new.analog_weight *= 10.0
                    book_weight(new.weight, s.account, sink, ROULETTE)
        if new.reason < 0 and s.collisions >= world.limits.max_collisions:
            new.reason = MAX_COLLISIONS

    return terminate


@memoised
def make_bounce(spec: TransportSpec, directed: bool, flies_on: bool) -> wp.Function:
    """The Warp function ``(s, world, sink, id)`` of a photon that a face of the domain reflects; what is not reflected
    leaves by the face.

    `directed`: weight and analog weight differ; `flies_on`: see `make_continues`.
    """
    rotated, terminate, continues = spec.rotated_domain, make_terminate(spec), make_continues(flies_on)
    turn, turn_back = make_domain(rotated).turn, make_domain(rotated).turn_back
    mirror_carried = make_rider(spec).mirror

    @wp.func
    def bounce(s: wp.ref[PhotonState], world: wp.ref[World], sink: wp.ref[Sink], id: wp.uint64):
        face = s.bounces.face
        axis = (face - 1) // 2
        index = face_index(world.limits.boundary, face)
        u = turn(world.limits, s.u)
        part = fresnel_reflectance(wp.min(wp.abs(u[axis]), 1.0), index)
        u = turn_back(world.limits, flipped(u, axis))
        if wp.static(rotated):
            u = wp.normalize(u)
        new = Outcome()
        new.reason = s.reason
        new.weight = s.weight
        reweigh(new.weight, part)
        mirror_carried(s.carried, s.u, u, index)
        # The light of an event that was the last is accounted for by what has ended the history.
        book_weight(new.weight, s.account, sink, wp.where(s.reason < 0, EXIT + face, s.reason))
        if s.reason < 0:
            new.analog_weight = wp.where(wp.static(directed), s.analog_weight * part, new.weight.value)
            terminate(new, s, world, sink, id)
        if continues(new.reason):
            s.u = u
        s.weight = new.weight
        s.analog_weight = new.analog_weight
        s.reason = new.reason

    return bounce


@memoised
def make_scatter(spec: TransportSpec, direct: wp.Function | None, flies_on: bool) -> wp.Function:
    """The Warp function ``(s, world, sink, draws)``: takes a photon from its event to FLIGHT, or to END.

    `flies_on`: see `make_continues`.
    """
    has_mesh, specular, reflecting, directed = spec.mesh, spec.specular, spec.reflecting, direct is not None
    survive, sample_direction = make_survive(spec), make_sample_direction(spec, direct)
    terminate, bounce = make_terminate(spec), make_bounce(spec, directed, flies_on)
    continues, turn_carried = make_continues(flies_on), make_rider(spec).event

    @wp.func
    def turn(
        new: wp.ref[Outcome],
        s: wp.ref[PhotonState],
        world: wp.ref[World],
        sink: wp.ref[Sink],
        id: wp.uint64,
        on_surface: bool,
        lobe: float,
    ):
        reflected = s.u
        if wp.static(specular):
            if on_surface:
                draw = random_block_keyed(world.keys, id, wp.uint32(s.collisions), STREAM_SURFACE)
                roughness = world.surfaces.roughness[s.hit.face]
                reflected = sample_reflection(s.u, s.hit.normal, roughness, lobe, draw)
        heading = sample_direction(s, reflected, lobe, world, id)
        turn_carried(s.carried, world, wp.where(on_surface, s.hit.slot, -1), s.x, s.u, heading.u)
        if wp.static(directed):
            reweigh(new.weight, heading.factor)
            s.directed += new.weight.taken
            if new.weight.value <= 0.0:
                new.reason = DIRECTED
        if wp.static(specular):
            if on_surface:
                # What one facet takes of another's light stays in the surface.
                leaving = unshadowed(s.u, heading.u, s.hit.normal, world.surfaces.roughness[s.hit.face], lobe)
                reweigh(new.weight, leaving)
                new.analog_weight *= leaving
                if new.reason < 0:
                    s.absorbed_surface += new.weight.taken
                else:
                    book_weight(new.weight, s.account, sink, new.reason)
                if new.weight.value <= 0.0 and new.reason < 0:
                    new.reason = WEIGHT_CUTOFF
        s.u = heading.u

    @wp.func
    def collision(s: wp.ref[PhotonState], world: wp.ref[World], sink: wp.ref[Sink], id: wp.uint64):
        new = Outcome()
        new.reason = -1
        new.weight = s.weight
        on_surface = False
        if wp.static(has_mesh):
            on_surface = s.hit.face >= 0
        survival = survive(s, world)
        if on_surface:
            reweigh(new.weight, survival.part)
            s.absorbed_surface += new.weight.taken
        else:
            new.weight.value *= survival.part
        new.analog_weight = wp.where(wp.static(directed), s.analog_weight * survival.part, new.weight.value)
        terminate(new, s, world, sink, id)
        if continues(new.reason):
            turn(new, s, world, sink, id, on_surface, survival.lobe)
        s.weight = new.weight
        s.analog_weight = new.analog_weight
        s.reason = new.reason
        s.surface_count += wp.where(on_surface, 1, 0)

    @wp.func
    def scatter(s: wp.ref[PhotonState], world: wp.ref[World], sink: wp.ref[Sink], draws: wp.ref[Draws]):
        # Here, not in `collide`: there a select takes the place of the branch, and a core waits for the flight.
        s.collisions += 1
        id = draws.base + wp.uint64(s.photon)
        bounced = False
        if wp.static(reflecting):
            bounced = s.bounces.face > 0
            if bounced:
                bounce(s, world, sink, id)
        if not bounced:
            collision(s, world, sink, id)
        s.stage = wp.where(continues(s.reason), FLIGHT, END)

    return scatter
