"""The state of a photon and of the thread that carries it."""

import warp as wp

from spadwarp_kernels.base.arguments import check_device, check_integer
from spadwarp_kernels.surface.bvh import NO_NODE, TreeWalk
from spadwarp_kernels.surface.ray_cast import SurfaceHit
from spadwarp_kernels.tally.tally import Contribution, LogDerivatives

from .sink import Account, Weight
from .world import World

__all__ = ["Records", "make_records"]

# What a thread does next: a flight, the ray that looks for a surface along it, the event at its end, the scattering
# there, a photon of its own, the end of one; or no photons are left.
FLIGHT, RAY, EVENT, SCATTER, START, END, DONE = (wp.constant(i) for i in range(7))

# The ray that a thread traces.
NO_RAY, SURFACE_RAY, SHADOW_RAY = (wp.constant(i) for i in range(3))


@wp.struct
class Carried:
    """What rides along with light beside its weight, see `riders`.

    Attributes:
        log_derivatives: Of what the light has met, by the parameters of the spec; 0 without them.
        stokes: Of the light, of weight 1 when it was emitted, with respect to `orthonormal_basis` of its direction.
        half: Of `Blocks.memory`: 0 for the history of a photon, 1 for a contribution.
    """

    log_derivatives: LogDerivatives
    stokes: wp.vec4
    half: int


@wp.struct
class Flight:
    """The flight to the next event.

    Attributes:
        block: Random words of that event.
        sample_block: Random words of the estimator's sample of the flight.
        distance: To the event [m].
        reach: How far to look for surfaces [m].
        interval: The part that an estimator wants to score [m]; empty for none.
        lens: The point of the lens by which the flight is scored [m].
        lens_weight: Its density if it were uniform, over that of the draw.
    """

    block: wp.vec4ui
    sample_block: wp.vec4ui
    distance: float
    reach: float
    interval: wp.vec2
    lens: wp.vec3
    lens_weight: float


@wp.func
def is_planned(flight: Flight) -> bool:
    """Whether an estimator wants to score a part of the flight."""
    return flight.interval[0] < flight.interval[1]


@wp.func
def shorten(flight: wp.ref[Flight], distance: float):
    """Ends the flight at a surface at a distance [m]."""
    flight.distance = wp.min(flight.distance, distance)
    flight.interval = wp.vec2(flight.interval[0], wp.min(flight.interval[1], distance))


@wp.struct
class Bounces:
    """Reflections of a photon by faces of the domain, and the account of the thread.

    Attributes:
        face: That the photon has come to, see EXIT_FACES; 0 at any other event.
        count: Reflections of the photon.
        leg: Those since the last other event.
        total: Reflections of all photons that have ended.
        dropped: Photons that came to the lens by too long a leg.
    """

    face: int
    count: int
    leg: int
    total: int
    dropped: int


@wp.func
def next_bounce(b: wp.ref[Bounces], face: int):
    """After the photon has come to a face, or to another event (0)."""
    b.face = face
    b.leg = wp.where(face > 0, b.leg + 1, 0)
    b.count += wp.where(face > 0, 1, 0)


@wp.func
def sum_bounces(b: wp.ref[Bounces]):
    """After the photon has ended, for the next."""
    b.total += b.count
    b.count = 0
    b.leg = 0


@wp.struct
class PhotonState:
    """State of a thread between the stages.

    A struct and not local variables: Warp merges a local that is set under a condition with a select, which keeps the
    values of both branches alive around the loop and doubles the registers; attributes are assigned in place.

    Attributes:
        stage: FLIGHT ... DONE.
        first: Number of the first of the warp's 32 new photons within the launch.
        taken: How many of them have been taken.
        photon: Number of the photon within the launch.
        x, u: Position [m] and unit direction.
        weight, analog_weight: Weight; the product of albedos and reflectances alone, at which histories end.
        path: Geometric path [m].
        collisions, surface_count: Events so far, and those at surfaces.
        reason: Ledger entry of the history's end; -1 after an event that is not the last.
        bounces: Reflections by faces of the domain, which `collisions` counts too.
        carried: What rides along.
        target: Pixel that a scan scores the photon in, else -1.
        view: Tangents (left, top, right, bottom) of what it may be seen in.
        flight: To the next event.
        hit: The surface there; face -1 in the water.
        albedo: Of the water there.
        ray: NO_RAY, SURFACE_RAY or SHADOW_RAY.
        walk: Of the ray down the tree.
        hidden: Whether a contribution, of any photon, waits for its shadow ray.
        pending, origin, lens: That contribution, the scored point, and the point to which the ray leads [m].
        account: Of the thread.
        absorbed_surface, directed: Sums for the ledger, in its units.
        water_collisions, surface_events, surface_queries, shadow_queries, contributions: Counters.
    """

    stage: int
    first: int
    taken: int
    # The photon:
    photon: int
    x: wp.vec3
    u: wp.vec3
    weight: Weight
    analog_weight: float
    path: float
    collisions: int
    surface_count: int
    reason: int
    bounces: Bounces
    carried: Carried
    target: int
    view: wp.vec4
    # Its next event:
    flight: Flight
    hit: SurfaceHit
    albedo: float
    # The ray that is traced, and the contribution that waits for one:
    ray: int
    walk: TreeWalk
    hidden: bool
    pending: Contribution
    origin: wp.vec3
    lens: wp.vec3
    # Sums for the ledger, and counters:
    account: Account
    absorbed_surface: wp.int64
    directed: wp.int64
    water_collisions: int
    surface_events: int
    surface_queries: int
    shadow_queries: int
    contributions: int


@wp.func
def first_state(world: wp.ref[World], slot: int) -> PhotonState:
    """A thread before its first photon."""
    s = PhotonState()
    s.stage = START
    s.account.slot = slot
    s.first = -1
    s.taken = 32
    s.albedo = world.medium.albedo
    s.view = world.camera.view
    s.target = -1
    s.walk.node = NO_NODE
    return s


# ---- Terminal states of photons.


@wp.struct
class Records:
    """Terminal states by photon; arrays of length 0 where they are not asked for.

    Attributes:
        position: Where the history ended [m].
        direction: Unit vector of its last flight.
        weight: Weight at the end.
        path: Geometric path [m].
        collisions: Events, surfaces included.
        reason: Ledger entry that took the rest of the weight.
        log_derivatives: Of what the history has met, [photons, derivatives]; empty without them.
    """

    position: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    weight: wp.array[float]
    path: wp.array[float]
    collisions: wp.array[int]
    reason: wp.array[int]
    log_derivatives: wp.array2d[float]


def make_records(count: int, *, device: wp.DeviceLike = None, derivatives: int = 0) -> Records:
    """Room for the terminal states of `count` photons, with so many derivatives; raises `ArgumentError` for negative
    numbers."""
    count, derivatives = check_integer("count", count, 0), check_integer("derivatives", derivatives, 0)
    device = check_device("device", device)
    records = Records()
    records.position = wp.zeros(count, dtype=wp.vec3, device=device)
    records.direction = wp.zeros(count, dtype=wp.vec3, device=device)
    records.weight = wp.zeros(count, dtype=float, device=device)
    records.path = wp.zeros(count, dtype=float, device=device)
    records.collisions = wp.zeros(count, dtype=int, device=device)
    records.reason = wp.zeros(count, dtype=int, device=device)
    records.log_derivatives = wp.zeros((count, derivatives), dtype=float, device=device)
    return records
