"""Stage scatter: the photon's weight after an event, the end of its history, or its new direction."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import STREAM_ROULETTE, STREAM_SURFACE, RoundKeys, random_block_keyed, u01, u01_fine
from spadwarp_kernels.base.rotations import cos_sin_word, rotate_by, snap_from
from spadwarp_kernels.estimators.estimator import Direction
from spadwarp_kernels.optics.camera import Camera
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import END, FLIGHT, PhotonState, Weight, give, reweigh
from spadwarp_kernels.riders.blocks import make_block_scores
from spadwarp_kernels.riders.derivatives import make_event_scores
from spadwarp_kernels.riders.polarisation import Polarisation, make_event_stokes, make_reflected_stokes
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.reflectance import (
    face_reflectance,
    pattern_reflectance,
    sample_cosine_law,
    sample_reflection,
    unshadowed,
)
from spadwarp_kernels.tally.ledger import DIRECTED, EXIT, MAX_COLLISIONS, ROULETTE, WEIGHT_CUTOFF
from spadwarp_kernels.tally.scores import Derivatives
from spadwarp_kernels.tally.tally import Scores
from spadwarp_kernels.water.limits import Limits, face_index, flipped, fresnel_reflectance
from spadwarp_kernels.water.medium import Layers, Medium
from spadwarp_kernels.water.phase_functions import Guiding


@wp.struct
class Survival:
    """What an event leaves of a photon: the part of its weight, and at a surface the part of that which is specular."""

    part: float
    lobe: float


@wp.struct
class Scattering:
    """A photon after an event.

    Attributes:
        u: Its new unit direction.
        weight, analog_weight: See `PhotonState`.
        surface_count: Events at surfaces so far.
        absorbed_surface, directed: For the ledger, in its units.
        reason: Ledger entry that ends the history here, or after the flight of its last event's light; else -1.
        scores, stokes: See `PhotonState`.
    """

    u: wp.vec3
    weight: Weight
    analog_weight: float
    surface_count: int
    absorbed_surface: wp.int64
    directed: wp.int64
    reason: int
    scores: Scores
    stokes: wp.vec4


@memoised
def make_survive(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, surfaces) -> Survival``: albedo of the water, or reflectance of the face."""
    has_mesh, specular = spec.mesh, spec.specular
    reflectance_at = pattern_reflectance if spec.pattern else face_reflectance

    @wp.func
    def survive(s: PhotonState, surfaces: Surfaces) -> Survival:
        survival = Survival()
        survival.part = s.albedo
        if wp.static(has_mesh):
            if s.hit.face >= 0:
                survival.part = reflectance_at(surfaces, s.hit.face, s.x)
                if wp.static(specular):
                    survival.part += surfaces.specular[s.hit.face]
                    survival.lobe = surfaces.specular[s.hit.face] / wp.max(survival.part, 1.0e-30)
        return survival

    return survive


@memoised
def make_turn(spec: TransportSpec, direct: wp.Function | None) -> wp.Function:
    """The Warp function ``(s, reflected, lobe, medium, layers, camera, surfaces, guiding, keys, id) -> Direction``.

    Directions follow the phase function and the surface's law, unless an estimator has a way of its own.
    """
    if direct is not None:
        return direct
    has_mesh, specular = spec.mesh, spec.specular
    phase_sample = spec.phase.sample
    water_at = spec.water.at

    @wp.func
    def turn(
        s: PhotonState,
        reflected: wp.vec3,
        lobe: float,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        surfaces: Surfaces,
        guiding: Guiding,
        keys: RoundKeys,
        id: wp.uint64,
    ) -> Direction:
        new = Direction()
        on_surface = False
        if wp.static(has_mesh):
            on_surface = s.hit.face >= 0
        axis = snap_from(s.u, medium.axis_threshold)
        t = phase_sample(u01_fine(s.flight.block[1]), water_at(medium, layers, s.x))
        if on_surface:
            axis = s.hit.normal
            t = sample_cosine_law(u01(s.flight.block[1]))
        new.u = rotate_by(axis, t, cos_sin_word(s.flight.block[2]))
        if wp.static(specular):
            if on_surface:
                new.u = reflected
        return new

    return turn


@memoised
def make_flies(flies_on: bool) -> wp.Function:
    """The Warp function ``reason -> bool``: whether there is a flight after an event.

    `flies_on`: the light of a history's last event is scored as it flies, to where the next event would be.
    """

    @wp.func
    def flies(reason: int) -> bool:
        return reason < 0 or (wp.static(flies_on) and reason != ROULETTE)

    return flies


@memoised
def make_leave(flies_on: bool) -> wp.Function:
    """The Warp function ``(s, new)`` that takes what an event has made of a photon into its state.

    `flies_on`: see `make_flies`.
    """
    flies = make_flies(flies_on)

    @wp.func
    def leave(s: wp.ref[PhotonState], new: Scattering):
        s.u = new.u
        s.weight = new.weight
        s.analog_weight = new.analog_weight
        s.surface_count = new.surface_count
        s.scores = new.scores
        s.stokes = new.stokes
        s.absorbed_surface += new.absorbed_surface
        s.directed += new.directed
        s.reason = new.reason
        s.stage = wp.where(flies(s.reason), FLIGHT, END)

    return leave


@memoised
def make_terminate(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(new, collisions, limits, keys, id, ledger, thread) -> Scattering``: the end of a history for
    its analog weight or its events."""
    roulette = spec.roulette

    @wp.func
    def terminate(
        new: Scattering,
        collisions: int,
        limits: Limits,
        keys: RoundKeys,
        id: wp.uint64,
        ledger: wp.array(dtype=wp.int64),
        thread: int,
    ) -> Scattering:
        if new.analog_weight < limits.weight_cutoff:
            new.reason = WEIGHT_CUTOFF
            if wp.static(roulette):
                chance = u01(random_block_keyed(keys, id, wp.uint32(collisions), STREAM_ROULETTE)[0])
                new.reason = ROULETTE
                if chance < 0.1 and new.analog_weight > 0.0:
                    new.reason = -1
                    new.weight = reweigh(new.weight, 10.0)
                    new.analog_weight *= 10.0
                    new.weight = give(new.weight, ledger, thread, ROULETTE)
        if new.reason < 0 and collisions >= limits.max_collisions:
            new.reason = MAX_COLLISIONS
        return new

    return terminate


@memoised
def make_bounce(spec: TransportSpec, directed: bool, flies_on: bool) -> wp.Function:
    """The Warp function ``(s, limits, keys, id, ledger, thread) -> Scattering`` of a photon that a face of the domain
    reflects; what is not reflected leaves by the face.

    `directed`: weight and analog weight differ; `flies_on`: see `make_flies`.
    """
    rotated, terminate, flies = spec.rotated_domain, make_terminate(spec), make_flies(flies_on)
    polarised, reflected_stokes = spec.polarised, make_reflected_stokes()

    @wp.func
    def bounce(
        s: PhotonState, limits: Limits, keys: RoundKeys, id: wp.uint64, ledger: wp.array(dtype=wp.int64), thread: int
    ) -> Scattering:
        face = s.bounces.face
        axis = (face - 1) // 2
        u = s.u
        if wp.static(rotated):
            u = limits.rotation * u
        part = fresnel_reflectance(wp.min(wp.abs(u[axis]), 1.0), face_index(limits.boundary, face))
        u = flipped(u, axis)
        if wp.static(rotated):
            u = wp.normalize(wp.transpose(limits.rotation) * u)
        new = Scattering()
        new.u = s.u
        new.weight = reweigh(s.weight, part)
        new.surface_count = s.surface_count
        new.scores = s.scores
        if wp.static(polarised):
            new.stokes = reflected_stokes(s.stokes, s.u, u, face_index(limits.boundary, face))
        new.reason = s.reason
        # The light of an event that was the last is accounted for by what has ended the history.
        new.weight = give(new.weight, ledger, thread, wp.where(s.reason < 0, EXIT + face, s.reason))
        if s.reason < 0:
            new.analog_weight = wp.where(wp.static(directed), s.analog_weight * part, new.weight.value)
            new = terminate(new, s.collisions, limits, keys, id, ledger, thread)
        if flies(new.reason):
            new.u = u
        return new

    return bounce


@memoised
def make_scatter(spec: TransportSpec, direct: wp.Function | None, flies_on: bool = False) -> wp.Function:
    """The Warp function ``(s, medium, layers, camera, limits, surfaces, guiding, derivatives, polarisation, keys,
    id, ledger, thread) -> Scattering``.

    `flies_on`: see `make_flies`.
    """
    has_mesh, specular, reflecting, directed = spec.mesh, spec.specular, spec.reflecting, direct is not None
    survive, turn, flies = make_survive(spec), make_turn(spec, direct), make_flies(flies_on)
    terminate, bounce = make_terminate(spec), make_bounce(spec, directed, flies_on)
    derives, event_scores = bool(spec.derivatives), make_event_scores(spec)
    by_block = make_block_scores(spec)
    in_blocks = by_block is not None
    if by_block is not None:
        turn_in_block = by_block.turn
    polarised, event_stokes = spec.polarised, make_event_stokes(spec)

    @wp.func
    def scatter(
        s: PhotonState,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        limits: Limits,
        surfaces: Surfaces,
        guiding: Guiding,
        derivatives: Derivatives,
        polarisation: Polarisation,
        keys: RoundKeys,
        id: wp.uint64,
        ledger: wp.array(dtype=wp.int64),
        thread: int,
    ) -> Scattering:
        if wp.static(reflecting):
            if s.bounces.face > 0:
                return bounce(s, limits, keys, id, ledger, thread)
        new = Scattering()
        new.u = s.u
        new.weight = s.weight
        new.surface_count = s.surface_count
        new.scores = s.scores
        new.reason = -1
        on_surface = False
        survival = survive(s, surfaces)
        if wp.static(has_mesh):
            on_surface = s.hit.face >= 0
        if on_surface:
            new.weight = reweigh(s.weight, survival.part)
            new.absorbed_surface = new.weight.taken
            new.surface_count += 1
        else:
            new.weight.value *= survival.part
        new.analog_weight = wp.where(wp.static(directed), s.analog_weight * survival.part, new.weight.value)
        new = terminate(new, s.collisions, limits, keys, id, ledger, thread)
        if not flies(new.reason):
            return new
        reflected = s.u
        if wp.static(specular):
            if on_surface:
                draw = random_block_keyed(keys, id, wp.uint32(s.collisions), STREAM_SURFACE)
                roughness = surfaces.roughness[s.hit.face]
                reflected = sample_reflection(s.u, s.hit.normal, roughness, survival.lobe, draw)
        heading = turn(s, reflected, survival.lobe, medium, layers, camera, surfaces, guiding, keys, id)
        new.u = heading.u
        if wp.static(derives):
            new.scores = event_scores(
                s.scores, derivatives, medium, layers, surfaces, s.hit.face, s.hit.normal, s.x, s.u, new.u
            )
        if wp.static(in_blocks):
            if not on_surface:
                turn_in_block(derivatives.blocks, 0, medium, layers, s.x)
        if wp.static(polarised):
            slot = wp.where(on_surface, s.hit.slot, -1)
            new.stokes = event_stokes(s.stokes, polarisation, surfaces, slot, s.x, s.u, new.u)
        if wp.static(directed):
            new.weight = reweigh(new.weight, heading.factor)
            new.directed = new.weight.taken
            if new.weight.value <= 0.0:
                new.reason = DIRECTED
        if wp.static(specular):
            if on_surface:
                # What one facet takes of another's light stays in the surface.
                leaving = unshadowed(s.u, new.u, s.hit.normal, surfaces.roughness[s.hit.face], survival.lobe)
                new.weight = reweigh(new.weight, leaving)
                new.analog_weight *= leaving
                if new.reason < 0:
                    new.absorbed_surface += new.weight.taken
                else:
                    new.weight = give(new.weight, ledger, thread, new.reason)
                if new.weight.value <= 0.0 and new.reason < 0:
                    new.reason = WEIGHT_CUTOFF
        return new

    return scatter
