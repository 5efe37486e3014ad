"""What a launch reads (World) and adds to (Sink), and the state of a photon and of the thread that carries it."""

from typing import TypeAlias

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import RoundKeys
from spadwarp_kernels.optics.camera import BEFORE, Camera, Gate, gate_bin
from spadwarp_kernels.optics.laser import Laser, Scan
from spadwarp_kernels.optics.polarisation import Polarisation
from spadwarp_kernels.optics.sea import Sea
from spadwarp_kernels.surface.bvh import TreeWalk
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.ray_cast import SurfaceHit
from spadwarp_kernels.tally import ledger
from spadwarp_kernels.tally.flux import Flux
from spadwarp_kernels.tally.ledger import add_to_ledger, to_ledger
from spadwarp_kernels.tally.tally import BACKSCATTER, add_pending, atomic_add_int64, tally_components
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import Layers, Lines, Medium
from spadwarp_kernels.water.phase_functions import Guiding

from .derivatives import Derivatives, LogDerivatives, met_count, met_entry, score_entry

__all__ = ["Records", "make_records"]


@wp.struct
class World:
    """The fields of a `Model`, and the seed with the keys that Philox makes of it. No stage writes to it."""

    medium: Medium
    layers: Layers
    laser: Laser
    camera: Camera
    gate: Gate
    limits: Limits
    guiding: Guiding
    surfaces: Surfaces
    scan: Scan
    derivatives: Derivatives
    polarisation: Polarisation
    lines: Lines
    flux: Flux
    sea: Sea
    seed: wp.uint64
    keys: RoundKeys


@wp.struct
class Records:
    """Terminal states by photon; arrays of length 0 where they are not asked for."""

    position: wp.array[wp.vec3]  # where the history ended [m]
    direction: wp.array[wp.vec3]  # unit vector of its last flight
    weight: wp.array[float]  # weight at the end
    path: wp.array[float]  # geometric path [m]
    collisions: wp.array[int]  # events, surfaces included
    reason: wp.array[int]  # ledger entry that took the rest of the weight
    log_derivatives: wp.array2d[float]  # of what the history has met, [photons, derivatives]; empty without them


def make_records(count: int, *, device: wp.DeviceLike = None, derivatives: int = 0) -> Records:
    """Room for the terminal states of `count` photons, with so many derivatives; raises `ArgumentError` for negative
    numbers."""
    count, derivatives = check.integer("count", count, 0), check.integer("derivatives", derivatives, 0)
    device, records = check.device("device", device), Records()
    for name, var in Records.vars.items():
        shape = (count, derivatives) if name == "log_derivatives" else count
        setattr(records, name, wp.zeros(shape, dtype=var.type.dtype, device=device))
    return records


@wp.struct
class Sink:
    """What photons add to; no stage writes to the struct itself, so that CUDA reads it where launches have put it."""

    tally: wp.array[wp.int64]  # histograms [component, pixel, bin], fixed point
    low: wp.array[wp.uint32]  # their low words, where those are apart, see `tally.splitting_pays`
    gradients: wp.array[wp.int64]  # the tallies that have signs [voxel, parameter]
    flux: wp.array[wp.int64]  # the tally of `World.flux`
    flux_halves: wp.array[wp.uint32]  # its low bits, see `tally.add_to_halves`, or of length 0
    ledger: wp.array[wp.int64]  # the energy balance and counters, see `add_to_ledger`
    records: Records
    scale: float  # tally units per emitted photon


@wp.struct
class Launch:
    """The photons of a launch."""

    first_id: wp.uint64
    photon_count: int
    threads: int
    cursor: wp.array[int]  # how many photons have been handed out to warps
    offset: wp.array[wp.uint64]  # added to the ids of a stepped spec


@wp.struct
class Account:
    """What a thread needs to add to a sink."""

    slot: int  # of the ledger, see `add_to_ledger`
    pending: wp.vec2l  # on a CPU the voxel and value that are still to be added, see `add_pending`


@wp.struct
class Weight:
    """The weight of a photon, and its account.

    `absorbed_water` is what photons had, less what was left and what was booked. It is what water took once the
    thread's other sums for the ledger are subtracted, at its end.
    """

    value: float  # fraction of the photon that is left
    taken: wp.int64  # by which the last change lowered it, in ledger units
    absorbed_water: wp.int64  # sum over the thread's photons, in ledger units


# ---- The photon. Its structs are of attributes that are assigned in place: Warp merges a local that is set under a
# condition with a select, which keeps the values of both branches alive around the loop and doubles the registers.


# What a thread does next: a flight, the ray that looks for a surface along it, the event at its end, the scattering
# there, a photon of its own, the end of one; or no photons are left.
FLIGHT, RAY, EVENT, SCATTER, START, END, DONE = (wp.constant(i) for i in range(7))

# The ray that a thread traces.
NO_RAY, SURFACE_RAY, SHADOW_RAY = (wp.constant(i) for i in range(3))


@wp.struct
class Contribution:
    """What a photon adds to the tally."""

    value: float  # fraction of the emitted light; 0 for nothing
    path: float  # by which it has come [m], for spec.lines
    index: int  # of the voxel, see `tally_index`
    rounding_sample: float  # uniform in [0, 1), see `to_fixed_point`
    factors: LogDerivatives  # of the value for the tallies that have signs: log derivatives, or channels over I


@wp.struct
class Carried:
    """What rides along with light beside its weight, see `riders`."""

    log_derivatives: LogDerivatives  # of what the light has met, by the parameters of the spec; 0 without them
    stokes: wp.vec4  # of weight 1 when emitted, with respect to `orthonormal_basis` of the light's direction
    shifted: wp.vec4  # light at other wavelengths, for each unit of that of the laser's
    half: int  # of `Blocks.memory`: 0 for the history of a photon, 1 for a contribution


@wp.struct
class Flight:
    """The flight to the next event."""

    block: wp.vec4ui  # random words of that event
    sample_block: wp.vec4ui  # random words of the estimator's sample of the flight
    distance: float  # to the event [m]
    reach: float  # how far to look for surfaces [m]
    sea: float  # to the mean plane of the sea's surface [m]; 1e30 if it leads away from it
    interval: wp.vec2  # the part that an estimator wants to score [m]; empty for none
    lens: wp.vec3  # the point of the lens by which the flight is scored [m]
    lens_weight: float  # its density if it were uniform, over that of the draw
    factor: float  # by which the weight changes at its end, see `Meeting`


@wp.struct
class Bounces:
    """Reflections of a photon by faces of the domain or what the sea's surface does, and the account of the thread."""

    face: int  # that the photon has come to, see EXIT_FACES, or SEA_FACE; 0 at any other event
    count: int  # reflections of the photon
    leg: int  # those since the last other event
    total: int  # reflections of all photons that have ended
    dropped: int  # photons that came to the lens by too long a leg


@wp.struct
class PhotonState:
    """State of a thread between the stages."""

    stage: int  # FLIGHT ... DONE
    first: int  # number of the first of the warp's 32 new photons within the launch
    taken: int  # how many of them have been taken
    # The photon:
    base: wp.uint64  # id of the launch's first photon
    photon: int  # number within the launch
    x: wp.vec3  # position [m]
    u: wp.vec3  # unit direction
    above: bool  # whether it is in the air above a sea
    weight: Weight
    analog_weight: float  # the product of albedos and reflectances alone, at which histories end
    path: float  # geometric path [m]
    collisions: int  # events so far, reflections included
    surface_count: int  # those at surfaces
    reason: int  # ledger entry of the history's end; -1 after an event that is not the last
    bounces: Bounces
    carried: Carried
    target: int  # pixel that a scan scores the photon in, else -1
    view: wp.vec4  # tangents (left, top, right, bottom) of what it may be seen in
    # Its next event:
    flight: Flight
    hit: SurfaceHit  # face -1 in the water
    albedo: float  # of the water there
    # The ray that is traced, and the contribution, of any photon, that waits for one:
    ray: int  # NO_RAY, SURFACE_RAY or SHADOW_RAY
    walk: TreeWalk  # down the tree
    hidden: bool  # whether a contribution waits
    pending: Contribution
    origin: wp.vec3  # the scored point [m]
    lens: wp.vec3  # the point to which the shadow ray leads [m]
    # Sums for the ledger, in its units, and counters:
    account: Account
    absorbed_surface: wp.int64
    absorbed_air: wp.int64
    directed: wp.int64
    water_collisions: int
    surface_events: int
    surface_queries: int
    shadow_queries: int
    contributions: int


# The face of `Bounces`, and the slot of a request, of light at the sea's surface.
SEA_FACE, SEA_SLOT = wp.constant(7), wp.constant(-2)


# Arguments by reference: they cost nothing, and may be changed in place.
WorldRef: TypeAlias = wp.ref[World]
SinkRef: TypeAlias = wp.ref[Sink]
AccountRef: TypeAlias = wp.ref[Account]
CarriedRef: TypeAlias = wp.ref[Carried]
PhotonRef: TypeAlias = wp.ref[PhotonState]


@wp.func
def is_planned(flight: Flight) -> bool:
    """Whether an estimator wants to score a part of the flight."""
    return flight.interval[0] < flight.interval[1]


@wp.func
def shorten(flight: wp.ref[Flight], distance: float):
    """Ends the flight at a surface at a distance [m]."""
    flight.distance = wp.min(flight.distance, distance)
    flight.interval = wp.vec2(flight.interval[0], wp.min(flight.interval[1], distance))


# ---- The weight of a photon, and where it goes.


@wp.func
def reweigh(w: wp.ref[Weight], factor: float):
    """Multiplies the weight by a factor.

    The ledger is written where weight changes hands; water takes what is missing there. What is taken is to be added to
    one of the thread's sums for the ledger, or to be booked by `book_weight`.
    """
    before = to_ledger(w.value)
    w.value *= factor
    w.taken = before - to_ledger(w.value)


@wp.func
def book_weight(w: wp.ref[Weight], account: AccountRef, sink: SinkRef, entry: int):
    """What the last change has taken goes to an entry of the ledger."""
    book(account, sink, entry, w.taken)
    w.absorbed_water -= w.taken


@wp.func
def book(account: AccountRef, sink: SinkRef, entry: int, value: wp.int64):
    """Adds to an entry of the ledger."""
    add_to_ledger(sink.ledger, account.slot, entry, value)


# ---- Contributions to the tally.


# Index of light that has come to the lens by more reflections than count.
TOO_LONG = wp.constant(-4)

# Largest single contribution, in tally units, 2^58: what is above it is clipped and counted.
DEPOSIT_LIMIT = wp.constant(2.8823037615171174e17)


@wp.func
def tally_index(camera: Camera, gate: Gate, pixel: int, path: float, component: int) -> int:
    """Index into the tally [component, pixel, bin], or BEFORE or AFTER the gate."""
    k = gate_bin(gate, path)
    if k < 0:
        return k
    return (component * camera.width * camera.height + pixel) * gate.bins + k


@wp.func
def merged_index(camera: Camera, gate: Gate, pixel: int, path: float, component: int) -> int:
    """`tally_index` for a tally [2, pixel, bin] of light that has met a surface, and of backscatter."""
    return tally_index(camera, gate, pixel, path, component / BACKSCATTER)


@wp.func
def to_fixed_point(units: float, rounding_sample: float) -> wp.int64:
    """units >= 0, rounded up with probability equal to its fraction, for rounding_sample uniform in [0, 1).

    For samples on the grid k / 2^24 the mean is kept to 2^-25 unit, or 2^-24 of the value where that is more.
    """
    return wp.int64(units + rounding_sample)


@memoised
def _make_deposit_unsigned(count: int) -> wp.Function:
    """The Warp function ``(account, sink, contribution)`` for a tally of so many components."""

    @wp.func
    def deposit(account: AccountRef, sink: SinkRef, c: Contribution):
        """Adds a contribution to its voxel of the tally; the ledger counts BEFORE and AFTER, and what is
        below one unit."""
        exact = c.value * sink.scale
        units = to_fixed_point(exact, c.rounding_sample)
        if not exact <= DEPOSIT_LIMIT:
            book(account, sink, wp.where(exact > DEPOSIT_LIMIT, ledger.CLIPPED, ledger.INVALID), wp.int64(1))
        elif c.index >= 0:
            if exact >= 1.0:
                account.pending = add_pending(sink.tally, sink.low, account.pending, c.index, units)
            else:
                if units > wp.int64(0):
                    account.pending = add_pending(sink.tally, sink.low, account.pending, c.index, units)
                voxels = sink.tally.shape[0] // wp.static(count)
                component = wp.where(c.index >= voxels, 1, 0) + wp.where(c.index - voxels >= voxels, 1, 0)
                entry = ledger.BELOW_UNIT + component
                if wp.static(count > 3):
                    entry = wp.where(c.index // voxels == 3, ledger.BELOW_UNIT_SURFACE, entry)
                book(account, sink, entry, wp.int64(1))
        else:
            # Coarser, since light from right before the lens is far brighter than what the unit was chosen for.
            entry = wp.where(c.index == BEFORE, ledger.BEFORE_GATE, ledger.AFTER_GATE)
            book(account, sink, entry, (units + wp.int64(128)) >> ledger.OUTSIDE_SHIFT)

    return deposit


@wp.func
def _deposit_signed(account: AccountRef, sink: SinkRef, index: int, units: float, rounding_sample: float):
    """Adds to a tally that has signs; rounded down after the rounding sample is added, so that the mean is kept."""
    if wp.abs(units) <= DEPOSIT_LIMIT:
        whole = wp.int64(wp.floor(units + rounding_sample))
        if whole != wp.int64(0):
            atomic_add_int64(sink.gradients, index, whole)
    else:
        book(account, sink, wp.where(wp.abs(units) > DEPOSIT_LIMIT, ledger.CLIPPED, ledger.INVALID), wp.int64(1))


@memoised
def make_deposit(signed: int, kinds: int, sea: bool = False, lines: bool = False) -> wp.Function:
    """The Warp function ``(account, sink, world, contribution)`` that adds a contribution to the tally, with so many
    parameters or channels that have signs and so many kinds of derivatives by block; `sea`: the tally has a component
    of light that met the surface of the sea alone; `lines`: the channels are lines with delays of their own."""
    deposit_unsigned = _make_deposit_unsigned(len(tally_components(sea)))

    @wp.func
    def deposit(account: AccountRef, sink: SinkRef, world: WorldRef, c: Contribution):
        if wp.static(signed + kinds > 0):
            if c.index >= 0:
                blocks = world.derivatives.blocks
                width = wp.static(signed) + wp.static(kinds) * blocks.count
                for p in range(wp.static(signed)):
                    units = c.value * c.factors[p] * world.derivatives.scale[p]
                    index = int(c.index)
                    if wp.static(lines):
                        own = gate_bin(world.gate, c.path * world.lines.delay[p])
                        index = wp.where(own < 0, -1, c.index + own - gate_bin(world.gate, c.path))
                    if index >= 0:
                        _deposit_signed(account, sink, index * width + p, units, c.rounding_sample)
                if wp.static(kinds > 0):
                    for i in range(met_count(blocks, 1)):
                        k = int(blocks.memory[met_entry(blocks, 1, i)])
                        for q in range(wp.static(kinds)):
                            units = c.value * blocks.memory[score_entry(blocks, 1, q, k)] * blocks.scale[q]
                            p = wp.static(signed) + q * blocks.count + k
                            _deposit_signed(account, sink, c.index * width + p, units, c.rounding_sample)
        deposit_unsigned(account, sink, c)

    return deposit
