"""The riders of a spec; derivatives of the logarithm of what light has met, and of that by block of a grid's cells.

Derivatives are by the water's coefficients and the surfaces' reflectances: per flight -length for absorption and
scattering; per event 1/b, the derivative of the phase function, and the part of the Lambertian reflectance. By the
concentration n of a constituent with coefficients a' and b' at n = 1, per flight -(a' + b') length, and per event, as
b p = sum n b' p', b' p' / (b p): whichever constituent the angle was drawn from.

Those by block are by the same addition to a coefficient of all its cells. Per block -L for absorption, n/b - L for
scattering at fixed absorption and n/c - L for extinction at fixed albedo: L the path in the block, and over n, the
scatterings there, the coefficient of the cell of each. They ask for nothing but the way, so that they hold however the
flights were drawn and what passes was estimated: by regular tracking, delta tracking or ratio tracking. A thread keeps
them in `Blocks.memory`: in the first half of its rows those of the history, in the second half those of the
contribution that is scored, until it is added or, behind a surface, forgotten. Of many blocks light meets few, so that
the thread keeps a list of them.
"""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import u01
from spadwarp_kernels.base.rotations import one_minus_cosine, snap_from
from spadwarp_kernels.photon.derivatives import NOT_MET, Blocks, LogDerivatives, met_count, met_entry, score_entry
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import SEA_SLOT, Carried, CarriedRef, Contribution, PhotonRef, SinkRef, WorldRef
from spadwarp_kernels.surface.triangle import face_in
from spadwarp_kernels.tally.flux import Leg, add_flux_collision, add_flux_crossings, add_flux_track
from spadwarp_kernels.water.grid import first_place, grid_cell, grid_line, next_place
from spadwarp_kernels.water.medium import boundary_ahead, layer_index
from spadwarp_kernels.water.phase_functions import henyey_greenstein_log_derivative

from .polarisation import make_polarisation_rider
from .rider import NOTHING, Rider


@memoised
def make_rider(spec: TransportSpec) -> Rider:
    """All that rides along for a spec; `NOTHING` where nothing does."""
    rider = NOTHING
    if spec.polarised:
        rider = make_polarisation_rider(spec)
    if spec.lines:
        rider = _make_lines_rider(spec)
    if spec.derivatives:
        rider = _make_derivatives_rider(spec)
    if spec.blocks:
        rider = _make_blocks_rider(spec, rider)
    return rider


# ---- Light of other wavelengths.


def _make_lines_rider(spec: TransportSpec) -> Rider:
    """Light of other wavelengths on the same paths: of other lines of the laser, and what has become such light by one
    inelastic scattering at any of the events so far.

    Photons fly and scatter as light of the laser does; what would have been scattered inelastically at an event, in
    place of elastically, is carried on with the coefficients of its own wavelength over those, and so is light of a
    line of the laser from the start. Thus no photon is spent on what few of them do, and each brings light of all
    wavelengths.
    """
    count = spec.channels

    @wp.func
    def begin(c: CarriedRef, world: WorldRef, target: int, emitted: wp.spatial_vector, x: wp.vec3, u: wp.vec3):
        c.shifted = world.lines.elastic

    @wp.func
    def fade(c: CarriedRef, world: WorldRef, layer: int, length: float):
        more = world.lines.more[layer]
        for k in range(wp.static(count)):
            c.shifted[k] = c.shifted[k] * wp.exp(-more[k] * length)

    @wp.func
    def event(c: CarriedRef, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3):
        if slot == -1:
            water = spec.water.at(world.medium, world.layers, x)
            layer = int(0)
            if wp.static(spec.water.layered):
                layer = layer_index(world.layers, wp.dot(world.layers.axis, x))
            source = world.lines.source[layer]
            again = world.lines.again[layer]
            t = one_minus_cosine(snap_from(u, world.medium.axis_threshold), v)
            elastic = wp.max(water.extinction * water.albedo * spec.water.phase.pdf(t, water), 1.0e-30)
            square = (1.0 - t) * (1.0 - t)
            for k in range(wp.static(count)):
                turned = source[k] * (world.lines.even[k] + world.lines.squared[k] * square)
                before = wp.where(world.lines.elastic[k] > 0.0, c.shifted[k], 1.0)
                c.shifted[k] = c.shifted[k] * again[k] + before * turned / elastic

    @wp.func
    def deliver(k: wp.ref[Contribution], c: Carried, world: WorldRef, end: wp.vec3, u: wp.vec3, inside: wp.vec3):
        for channel in range(wp.static(spec.channels)):
            k.factors[channel] = world.lines.passed[channel] * c.shifted[channel]

    return NOTHING._replace(begin=begin, fly=_make_by_layer(spec, fade), event=event, deliver=deliver)


def _make_by_layer(spec: TransportSpec, through: wp.Function) -> wp.Function:
    """The Warp function ``(c, world, x, u, length)`` of a way in the water, from that of a way in one of its layers, or
    in the medium (0), ``(c, world, layer, length)``."""

    @wp.func
    def fly(c: CarriedRef, world: WorldRef, x: wp.vec3, u: wp.vec3, length: float):
        if wp.static(not spec.water.layered):
            through(c, world, 0, length)
        else:
            along = wp.dot(world.layers.axis, x)
            slope = wp.dot(world.layers.axis, u)
            step = wp.where(slope > 0.0, 1, -1)
            layer = layer_index(world.layers, along)
            begin = float(0.0)
            boundary = boundary_ahead(world.layers, layer, step, along, slope)
            while boundary < length:
                through(c, world, layer, boundary - begin)
                layer += step
                begin = boundary
                boundary = boundary_ahead(world.layers, layer, step, along, slope)
            through(c, world, layer, length - begin)

    return fly


# ---- Derivatives.


def _bits(kinds: tuple[str, ...], *wanted: str) -> int:
    """Bit p is set where kind p is one of the wanted. Bits, since a `wp.static` that reads the index of a loop does not
    enter the hash of Warp's kernel cache."""
    return sum(1 << p for p, kind in enumerate(kinds) if kind in wanted)


def _make_derivatives_rider(spec: TransportSpec) -> Rider:
    """Of the parameters of a spec."""
    return NOTHING._replace(begin=_begin, fly=_make_fly(spec), event=_make_event(spec), deliver=_deliver)


@wp.func
def _begin(c: CarriedRef, world: WorldRef, target: int, emitted: wp.spatial_vector, x: wp.vec3, u: wp.vec3):
    c.log_derivatives = LogDerivatives()


@wp.func
def _deliver(k: wp.ref[Contribution], c: Carried, world: WorldRef, end: wp.vec3, u: wp.vec3, inside: wp.vec3):
    k.factors = c.log_derivatives


def _make_fly(spec: TransportSpec) -> wp.Function:
    count, by_concentration = len(spec.derivatives), _bits(spec.derivatives, "concentration")
    on_path = _bits(spec.derivatives, "absorption", "scattering") | by_concentration

    @wp.func
    def shorten(c: CarriedRef, world: WorldRef, layer: int, length: float):
        parameters = int(wp.static(on_path))
        if wp.static(spec.water.layered):
            parameters = parameters & world.derivatives.waters[layer]
        for p in range(wp.static(count)):
            if (parameters >> p) & 1 == 1:
                if (wp.static(by_concentration) >> p) & 1 == 1:
                    c.log_derivatives[p] = c.log_derivatives[p] - world.derivatives.extinction[p] * length
                else:
                    c.log_derivatives[p] = c.log_derivatives[p] - length

    return _make_by_layer(spec, shorten)


def _make_event(spec: TransportSpec) -> wp.Function:
    count = len(spec.derivatives)
    by_scattering, by_anisotropy, by_reflectance, by_concentration = (
        _bits(spec.derivatives, kind) for kind in ("scattering", "anisotropy", "reflectance", "concentration")
    )
    in_water = by_scattering | by_anisotropy | by_concentration
    add_concentrations = _make_add_concentrations(spec, by_concentration)

    @wp.func
    def in_the_water(d: LogDerivatives, world: WorldRef, x: wp.vec3, u: wp.vec3, v: wp.vec3) -> LogDerivatives:
        here = int(wp.static(in_water))
        if wp.static(spec.water.layered):
            here = here & world.derivatives.waters[layer_index(world.layers, wp.dot(world.layers.axis, x))]
        t = one_minus_cosine(snap_from(u, world.medium.axis_threshold), v)
        for p in range(wp.static(count)):
            if (wp.static(by_scattering) >> p) & 1 == 1:
                d[p] = d[p] + wp.where((here >> p) & 1 == 1, 1.0 / world.derivatives.value[p], 0.0)
            if (wp.static(by_anisotropy) >> p) & 1 == 1:
                slope = henyey_greenstein_log_derivative(t, world.derivatives.value[p])
                d[p] = d[p] + wp.where((here >> p) & 1 == 1, slope, 0.0)
        if wp.static(by_concentration > 0):
            d = add_concentrations(d, world, x, t, here)
        return d

    @wp.func
    def on_a_face(d: LogDerivatives, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3) -> LogDerivatives:
        part = spec.faces.shares(world.surfaces, slot, x, u, v)[0]
        here = world.derivatives.faces[face_in(world.surfaces.order, slot)]
        for p in range(wp.static(count)):
            if (wp.static(by_reflectance) >> p) & 1 == 1:
                d[p] = d[p] + wp.where((here >> p) & 1 == 1, part / world.derivatives.value[p], 0.0)
        return d

    @wp.func
    def event(c: CarriedRef, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3):
        if slot >= 0:
            if wp.static(by_reflectance > 0):
                c.log_derivatives = on_a_face(c.log_derivatives, world, slot, x, u, v)
        elif wp.static(in_water > 0):
            if wp.static(spec.sight.sea is None) or slot != SEA_SLOT:
                c.log_derivatives = in_the_water(c.log_derivatives, world, x, u, v)

    return event


def _make_add_concentrations(spec: TransportSpec, parameters: int) -> wp.Function:
    """Of an event in the water that turns light by t = 1 - cos(theta), where the parameters `here` are of the water."""
    count, mixed = len(spec.derivatives), spec.water.phase.part is not None
    part_of = spec.water.phase.part or spec.water.phase.pdf  # any: it is not called

    @wp.func
    def add_concentrations(d: LogDerivatives, world: WorldRef, x: wp.vec3, t: float, here: int) -> LogDerivatives:
        water = spec.water.at(world.medium, world.layers, x)
        for p in range(wp.static(count)):
            if (wp.static(parameters) >> p) & 1 == 1:
                slope = world.derivatives.value[p] / (water.extinction * water.albedo)
                if wp.static(mixed):
                    slope *= part_of(t, water, world.derivatives.constituent[p])
                d[p] = d[p] + wp.where((here >> p) & 1 == 1, slope, 0.0)
        return d

    return add_concentrations


# ---- Derivatives by block.


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


def _make_blocks_rider(spec: TransportSpec, beside: Rider) -> Rider:
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

    return beside._replace(
        begin=begin, fork=fork, fly=_make_block_fly(kinds, beside), event=_make_block_event(spec, beside)
    )


def _make_block_fly(kinds: int, beside: Rider) -> wp.Function:
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
        line = grid_line(blocks.grid, blocks.grid.size, 1, x, u, length)
        if line.begin < line.end:
            place = first_place(line, blocks.grid.size)
            while place.leave < line.end:
                add(blocks, c.half, place.cell, place.t - place.leave)
                place = next_place(line, place)
            add(blocks, c.half, place.cell, place.t - line.end)

    return fly


def _make_block_event(spec: TransportSpec, beside: Rider) -> wp.Function:
    kinds, meet = len(spec.blocks), _make_meet(len(spec.blocks))
    by_scattering, by_extinction = _bits(spec.blocks, "scattering"), _bits(spec.blocks, "extinction")

    @wp.func
    def event(c: CarriedRef, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3):
        beside.event(c, world, slot, x, u, v)
        blocks = world.derivatives.blocks
        block = grid_cell(blocks.grid, x)
        if slot < 0 and block >= 0:
            meet(blocks, c.half, block)
            water = spec.water.at(world.medium, world.layers, x)
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


# ---- The tally of flux: what the legs and collisions of a photon add to the sections of a spec's kinds.


@memoised
def make_flux_score(spec: TransportSpec) -> wp.Function | None:
    """The Warp function ``(s, world, sink, length, collides)``, of a leg of that length [m], which may end in a
    collision with the water; None without flux. Legs are drawn with the extinction itself, so that their weight is
    that of the light all the way. Legs in the air above a sea add nothing."""
    if not spec.flux:
        return None
    tracks, collisions, planes = (kind in spec.flux for kind in ("track", "collision", "planes"))

    @wp.func
    def score_flux(s: PhotonRef, world: WorldRef, sink: SinkRef, length: float, collides: bool):
        if wp.static(spec.sight.sea is not None):
            if s.above:
                return
        leg = Leg(s.x, s.u, length, s.path, s.weight.value, u01(s.flight.block[3]))
        if wp.static(tracks):
            for k in range(world.flux.tracks.shape[0]):
                add_flux_track(world.flux.tracks[k], sink.flux, sink.flux_halves, leg)
        if wp.static(planes):
            for k in range(world.flux.planes.shape[0]):
                add_flux_crossings(world.flux.planes[k], world.flux.positions, sink.flux, sink.flux_halves, leg)
        if wp.static(collisions):
            if collides:
                extinction = spec.water.at(world.medium, world.layers, leg.x + length * leg.u).extinction
                add_flux_collision(world.flux.collision, sink.flux, sink.flux_halves, leg, extinction)
                for k in range(1, world.flux.collisions.shape[0]):
                    add_flux_collision(world.flux.collisions[k], sink.flux, sink.flux_halves, leg, extinction)

    return score_flux
