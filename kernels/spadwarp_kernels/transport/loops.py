"""The loops that take photons through their stages: three kernels, in which no physics stands.

`make_loop_alone`: each thread moves photon after photon, as a textbook has it; the reference, and the loop of a CPU.
`make_loop_flat` and `make_loop_tree`: the 32 threads of a CUDA warp meet to emit, to score and to walk down the tree of
a mesh together, so that none waits for another at work that is its own.
"""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import PREFETCHED_WORDS, hold_keys
from spadwarp_kernels.photon.lanes import (
    MOST_LEFT,
    READ_SIZE,
    SET_SIZE,
    count_lanes,
    exchange,
    queue_size,
    take_photons,
    vote,
)
from spadwarp_kernels.photon.sink import Sink
from spadwarp_kernels.photon.spec import TransportSpec, check_spec
from spadwarp_kernels.photon.state import (
    DONE,
    END,
    EVENT,
    FLIGHT,
    NO_RAY,
    RAY,
    SCATTER,
    SHADOW_RAY,
    START,
    SURFACE_RAY,
    PhotonState,
    Records,
    first_state,
    is_planned,
    shorten,
)
from spadwarp_kernels.photon.world import Draws, World
from spadwarp_kernels.surface.bvh import NO_NODE, Stack, inverse_direction, place, step_leaf, step_node
from spadwarp_kernels.surface.ray_cast import surface_hit
from spadwarp_kernels.tally.ledger import make_ledger_slot

from .compose import Stages, alone, compose, compose_queue, tries_every_face
from .history import make_prepare

__all__ = ["make_transport_kernel"]


@memoised
def make_transport_kernel(spec: TransportSpec, cuda: bool = False, split_accumulators: bool = False) -> wp.Kernel:
    """The transport kernel for a spec; launch grid: any number of threads, which share the photons among them.

    On CUDA they must be a multiple of the block size, since whole warps vote. `split_accumulators`: on CUDA, the low
    words of the tally are apart, see `tally.splitting_pays`.

    Raises:
        ArgumentError: An estimator that is not one of ESTIMATORS, or confocal with the plain lens.
    """
    check_spec(spec)
    if alone(spec, cuda):
        return make_loop_alone(spec, cuda)
    if spec.mesh and not tries_every_face(spec, cuda):
        return make_loop_tree(spec, split_accumulators)
    return make_loop_flat(spec, split_accumulators)


def _options(stages: Stages, cuda: bool) -> dict:
    return {
        "module": "unique",
        "module_options": {"fast_math": cuda},
        "enable_backward": False,
        "grid_stride": False,
        "cuda_max_registers": stages.max_registers,
    }


@memoised
def make_loop_alone(spec: TransportSpec, cuda: bool) -> wp.Kernel:
    """Each thread moves photon after photon from its emission to its end. Launch grid: threads, one on a CPU."""
    stages = compose(spec, cuda, False)
    emit, begin, fly, trace, cross, collide, scatter, finish, flush, score_flight, score_event = stages[:11]
    prepare, slot_of = make_prepare(spec), make_ledger_slot(cuda)

    @wp.kernel(**_options(stages, cuda))
    def transport(
        world: World,
        sink: Sink,
        out: Records,
        first_id: wp.uint64,
        photon_count: int,
        threads: int,
        cursor: wp.array[int],
        offset: wp.array[wp.uint64],
    ):
        draws = Draws()
        base = prepare(world, wp.tid(), first_id, offset)
        draws.base = base
        draws.keys = hold_keys(world.keys)
        if wp.static(cuda):  # noqa: SIM108, Warp has no such choice between arrays
            words = cursor  # any: it is not used
        else:
            words = wp.zeros(shape=PREFETCHED_WORDS, dtype=int)
        s = first_state(world, slot_of(wp.tid(), first_id))
        for number in range(wp.tid(), photon_count, threads):
            s.photon = number
            id = base + wp.uint64(number)
            begin(s, world, sink, emit(world, id), id)
            while s.stage != END:
                fly(s, world, draws, words)
                trace(s, world)
                score_flight(s, world, sink)
                cross(s, world, sink)
                collide(s, world)
                if s.stage == SCATTER:
                    score_event(s, world, sink)
                    scatter(s, world, sink, draws)
            finish(s, sink, out)
        flush(s, sink)

    return transport


# A warp takes new photons when so many of its lanes have ended; the second where nothing is scored, in grids, and in a
# tree with `next_event`.
START_LANES = 4
FEWER_START_LANES = 3


def _start_lanes(spec: TransportSpec, scores: bool, flights: bool, in_tree: bool) -> int:
    return START_LANES if scores and spec.grid is None and (flights or not in_tree) else FEWER_START_LANES


@wp.struct
class WarpStatus:
    """What the lanes of a warp count in a turn of its loop; a struct for the reason of `PhotonState`.

    Attributes:
        waiting: Lanes that wait for a ray or, where there are none, that have no photons left, 0 while requests are
            in the queue.
        enough: Requests in the queue that are to be scored: 32 or, when no photons are left, any.
    """

    waiting: int
    enough: int


@memoised
def _make_renew(stages: Stages) -> wp.Function:
    """The Warp function ``(s, world, sink, out, memory, lane, base, photon_count, cursor)`` that finishes the photons
    of a warp that have ended and gives the next to their lanes. All lanes take part."""
    emit, begin, finish = stages.emit, stages.begin, stages.finish

    @wp.func
    def renew(
        s: wp.ref[PhotonState],
        world: wp.ref[World],
        sink: wp.ref[Sink],
        out: Records,
        memory: int,
        lane: int,
        base: wp.uint64,
        photon_count: int,
        cursor: wp.array[int],
    ):
        if s.stage == END:
            finish(s, sink, out)
            s.stage = START
        wanting = s.stage == START
        votes = vote(wanting)
        entry = votes[0]
        # All lanes emit a photon each, which those that have ended take one by one.
        if s.taken >= 32:
            s.first = take_photons(cursor)
            s.taken = 0
            exchange(memory, True, lane, emit(world, base + wp.uint64(s.first + lane)))
        entry += s.taken
        s.taken += votes[1]
        if wanting and entry < 32:
            s.photon = s.first + entry
            s.stage = DONE
            if s.photon < photon_count:
                emitted = exchange(memory, False, entry, wp.spatial_vector())
                begin(s, world, sink, emitted, base + wp.uint64(s.photon))

    return renew


@memoised
def make_loop_flat(spec: TransportSpec, split: bool) -> wp.Kernel:
    """Warps without a tree to walk: what is scored waits for nothing but the other lanes."""
    stages, queue = compose(spec, True, split), compose_queue(spec, split)
    fly, cross, collide, scatter, flush = stages.fly, stages.cross, stages.collide, stages.scatter, stages.flush
    used, two_requests, flights, warp_memory, ask_flight, ask_event, pop, serve = queue
    prepare = make_prepare(spec)
    renew, start_lanes = _make_renew(stages), _start_lanes(spec, used, flights, False)
    # Where a flight and its event are asked for together, or nothing is, a photon flies, collides and scatters in one
    # branch, so that a warp pays for these once. Otherwise it scatters after its score: measured, which is faster.
    fused = two_requests or not used or (not flights and not spec.mesh and spec.grid is None)
    rounds = 2 if flights and not two_requests else 1
    # Where a round adds more requests than a warp scores at a time, it scores until fewer than that are left.
    drains = used and (two_requests or spec.points > 1)

    @wp.kernel(**_options(stages, True))
    def transport(
        world: World,
        sink: Sink,
        out: Records,
        first_id: wp.uint64,
        photon_count: int,
        threads: int,
        cursor: wp.array[int],
        offset: wp.array[wp.uint64],
    ):
        lane = wp.tid() % 32
        draws = Draws()
        base = prepare(world, wp.tid(), first_id, offset)
        draws.base = base
        draws.keys = hold_keys(world.keys)
        s = first_state(world, wp.tid())
        memory = warp_memory()
        status = WarpStatus()
        status.enough = 32
        queued = int(0)
        if wp.static(used):
            queued = queue_size(memory, SET_SIZE, 0)

        while status.waiting < 32:
            flying = s.stage == FLIGHT
            if wp.static(not fused) and flying:
                fly(s, world, draws, cursor)
            round = int(wp.static(2 - rounds))
            while round < 2:
                if wp.static(fused):
                    if flying:
                        fly(s, world, draws, cursor)
                        ask_flight(s, world, memory)
                        cross(s, world, sink)
                        collide(s, world)
                        if s.stage == SCATTER:
                            ask_event(s, world, memory)
                            scatter(s, world, sink, draws)
                elif s.stage == EVENT:
                    if round == 0:
                        ask_flight(s, world, memory)
                    else:
                        cross(s, world, sink)
                        collide(s, world)
                        if s.stage == SCATTER:
                            ask_event(s, world, memory)
                round += 1
                # ---- Scores, 32 together
                if wp.static(used):
                    queued = queue_size(memory, READ_SIZE, 0)
                    ready = queued >= status.enough
                    while ready:
                        request = pop(memory, lane, True, queued, 32)
                        queued = queue_size(memory, SET_SIZE, wp.max(queued - 32, 0))
                        ready = wp.static(drains) and queued >= 32
                        serve(s, request, world, sink)
            if wp.static(not fused) and s.stage == SCATTER:
                scatter(s, world, sink, draws)
            if count_lanes(s.stage >= START) >= wp.static(start_lanes):
                renew(s, world, sink, out, memory, lane, base, photon_count, cursor)
                done = count_lanes(s.stage == DONE)
                status.enough = wp.where(done == 32, 1, 32)
                status.waiting = wp.where(queued > 0, 0, done)

        flush(s, sink)

    return transport


# A warp traces rays when this many of its 32 lanes wait for one, or have ended: fewer leave lanes idle in the BVH, more
# in the water. It goes back to the water when fewer than so many still walk down the tree, and lets them wait for
# others. The second of each where flights are scored. All measured.
RAY_LANES, GUIDED_RAY_LANES = 20, 18
WALKING_LANES, GUIDED_WALKING_LANES = 6, 4

# It scores what its queue holds when so many have room for a contribution that waits for its shadow ray.
FREE_LANES = 12


@wp.struct
class Ray:
    """The ray that a photon waits for: origin [m], unit direction and length [m]."""

    origin: wp.vec3
    direction: wp.vec3
    length: float


@wp.func
def next_ray(s: wp.ref[PhotonState]) -> int:
    """The ray that a thread traces: that which it has begun, that of its photon, or a shadow ray."""
    ray = s.ray
    if ray == NO_RAY:
        ray = wp.where(s.stage == RAY, SURFACE_RAY, wp.where(s.hidden, SHADOW_RAY, NO_RAY))
    return ray


@memoised
def _make_ray_geometry(scores: bool) -> wp.Function:
    """The Warp function ``s -> Ray``: the flight, or the way from the scored point to the lens."""

    @wp.func
    def ray_geometry(s: wp.ref[PhotonState]) -> Ray:
        ray = Ray()
        ray.origin = s.x
        ray.direction = s.u
        ray.length = s.flight.reach
        if wp.static(scores):
            if s.ray == SHADOW_RAY:
                ray.origin = s.origin
                ray.direction = wp.normalize(s.lens - s.origin)
                ray.length = wp.length(s.lens - s.origin)
        return ray

    return ray_geometry


@memoised
def _make_end_walk(stages: Stages) -> wp.Function:
    """The Warp function ``(s, world, sink)`` at the end of a ray's walk down the tree."""
    deposit = stages.deposit

    @wp.func
    def end_walk(s: wp.ref[PhotonState], world: wp.ref[World], sink: wp.ref[Sink]):
        if s.ray == SURFACE_RAY:
            s.surface_queries += 1
            if s.walk.found >= 0:
                if s.walk.nearest < s.flight.distance:
                    s.hit = surface_hit(world.surfaces, s.walk, s.u)
                shorten(s.flight, s.walk.nearest)
            s.stage = EVENT
        else:
            s.shadow_queries += 1
            s.hidden = False
            if s.walk.found < 0:
                deposit(s.account, sink, world, s.pending)
        s.ray = NO_RAY

    return end_walk


@memoised
def make_loop_tree(spec: TransportSpec, split: bool) -> wp.Kernel:
    """Warps that leave the water when enough of their lanes wait for a ray, and walk down the tree together."""
    stages, queue = compose(spec, True, split), compose_queue(spec, split)
    fly, cross, collide, scatter, flush = stages.fly, stages.cross, stages.collide, stages.scatter, stages.flush
    used, two_requests, flights, warp_memory, ask_flight, ask_event, pop, serve = queue
    prepare = make_prepare(spec)
    renew, start_lanes = _make_renew(stages), _start_lanes(spec, used, flights, True)
    ray_geometry, end_walk = _make_ray_geometry(used), _make_end_walk(stages)
    ray_lanes, walking_lanes = (GUIDED_RAY_LANES, GUIDED_WALKING_LANES) if flights else (RAY_LANES, WALKING_LANES)
    rounds = 2 if flights and not two_requests else 1
    scatter_first = used and rounds == 1

    @wp.kernel(**_options(stages, True))
    def transport(
        world: World,
        sink: Sink,
        out: Records,
        first_id: wp.uint64,
        photon_count: int,
        threads: int,
        cursor: wp.array[int],
        offset: wp.array[wp.uint64],
    ):
        lane = wp.tid() % 32
        draws = Draws()
        base = prepare(world, wp.tid(), first_id, offset)
        draws.base = base
        draws.keys = hold_keys(world.keys)
        s = first_state(world, wp.tid())
        stack = Stack()
        stack[0] = NO_NODE
        memory = warp_memory()
        status = WarpStatus()
        status.enough = 32
        queued = int(0)
        if wp.static(used):
            queued = queue_size(memory, SET_SIZE, 0)

        while count_lanes(s.stage == DONE and not s.hidden) < 32 or (wp.static(used) and queued > 0):
            # ---- Water: until enough lanes of the warp wait for a ray
            status.waiting = 0
            while status.waiting < wp.static(ray_lanes):
                if s.stage == FLIGHT:
                    fly(s, world, draws, cursor)
                round = int(wp.static(2 - rounds))
                while round < 2:
                    if s.stage == EVENT and (wp.static(not used) or queued <= MOST_LEFT):
                        if wp.static(flights):
                            if round == wp.static(2 - rounds):
                                ask_flight(s, world, memory)
                        if round == 1 and (wp.static(not flights) or not is_planned(s.flight)):
                            cross(s, world, sink)
                            collide(s, world)
                            if s.stage == SCATTER:
                                ask_event(s, world, memory)
                                if wp.static(scatter_first):
                                    scatter(s, world, sink, draws)
                    round += 1
                    # ---- Scores, by all lanes that have room for what they find
                    if wp.static(used):
                        queued = queue_size(memory, READ_SIZE, 0)
                        free = count_lanes(not s.hidden)
                        if queued >= status.enough and free >= wp.static(FREE_LANES):
                            request = pop(memory, lane, not s.hidden, queued, free)
                            queued = queue_size(memory, SET_SIZE, wp.max(queued - free, 0))
                            serve(s, request, world, sink)
                if wp.static(not scatter_first) and s.stage == SCATTER:
                    scatter(s, world, sink, draws)
                if count_lanes(s.stage >= START) >= wp.static(start_lanes):
                    renew(s, world, sink, out, memory, lane, base, photon_count, cursor)
                    status.enough = wp.where(count_lanes(s.stage == DONE) == 32, 1, 32)
                status.waiting = count_lanes(s.stage != FLIGHT)

            # ---- Surfaces: the warp traces its rays together
            s.ray = next_ray(s)
            ray = ray_geometry(s)
            if s.ray != NO_RAY and s.walk.node == NO_NODE:
                s.walk.node = 0
                s.walk.found = -1
                s.walk.nearest = ray.length
                s.walk.depth = 1  # below everything stands NO_NODE
            inverse = inverse_direction(ray.direction)
            shift = wp.cw_mul(ray.origin, inverse)
            # Until so few walk on that new rays should join them; all take steps of one kind.
            in_nodes = count_lanes(s.walk.node > NO_NODE)
            at_faces = count_lanes(s.walk.node < NO_NODE)
            least = int(1)
            while in_nodes + at_faces >= least:
                least = wp.static(walking_lanes)
                if in_nodes >= at_faces:
                    if s.walk.node > NO_NODE:
                        met = step_node(world.surfaces.nodes, s.walk, inverse, shift)
                        s.walk.node = met.child[0]
                        for k in range(3):
                            if met.entry[3 - k] <= met.reach:
                                stack[place(s.walk.depth)] = met.child[3 - k]
                                s.walk.depth += 1
                        if met.entry[0] > met.reach:
                            s.walk.depth -= 1
                            s.walk.node = stack[place(s.walk.depth)]
                elif s.walk.node < NO_NODE:
                    step = step_leaf(world.surfaces.faces, world.surfaces.order, s.walk, ray.origin, ray.direction)
                    s.walk.node = step.node
                    if step.node == NO_NODE:
                        s.walk.depth -= 1
                        s.walk.node = stack[place(s.walk.depth)]
                    if step.hit:
                        s.walk.nearest = step.distance
                        s.walk.found = step.slot
                        if s.ray == SHADOW_RAY:
                            s.walk.node = NO_NODE
                in_nodes = count_lanes(s.walk.node > NO_NODE)
                at_faces = count_lanes(s.walk.node < NO_NODE)
            if s.ray != NO_RAY and s.walk.node == NO_NODE:
                end_walk(s, world, sink)

        flush(s, sink)

    return transport
