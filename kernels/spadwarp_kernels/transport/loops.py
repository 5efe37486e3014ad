"""The loops that take photons through their stages: three kernels, in which no physics stands.

`_make_loop_alone`: each thread moves photon after photon, as a textbook has it; the reference, and the loop of a CPU.
`_make_loop_flat` and `_make_loop_tree`: the 32 threads of a CUDA warp meet to emit, to score and to walk down the tree
of a mesh together, so that none waits for another at work that is its own.
"""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import PREFETCHED_WORDS
from spadwarp_kernels.base.rotations import inverse_direction
from spadwarp_kernels.photon import queue, state
from spadwarp_kernels.photon.spec import TransportSpec, check_spec
from spadwarp_kernels.photon.state import Launch, PhotonRef, Sink, SinkRef, World, WorldRef
from spadwarp_kernels.surface.bvh import NO_NODE, Stack, place, step_leaf, step_node
from spadwarp_kernels.surface.ray_cast import surface_hit

from .compose import Stages, compose

__all__ = ["make_transport_kernel"]


@memoised
def make_transport_kernel(spec: TransportSpec, cuda: bool = False) -> wp.Kernel:
    """The transport kernel for a spec; launch grid: any number of threads, which share the photons among them.

    On CUDA they must be a multiple of the block size, since whole warps vote.

    Raises:
        ArgumentError: An estimator that is not one of ESTIMATORS, or confocal with the plain lens.
    """
    check_spec(spec)
    if not cuda and spec != spec.on_cpu:
        return make_transport_kernel(spec.on_cpu)
    stages = compose(spec, cuda)
    options = {
        "module": "unique",
        "module_options": {"fast_math": cuda},
        "enable_backward": False,
        "grid_stride": False,
        "cuda_max_registers": stages.max_registers,
    }
    if stages.alone:
        return _make_loop_alone(stages, cuda, options)
    return (_make_loop_tree if stages.in_tree else _make_loop_flat)(stages, options)


def _make_loop_alone(stages: Stages, cuda: bool, options: dict) -> wp.Kernel:
    """Each thread moves photon after photon from its emission to its end. Launch grid: threads, one on a CPU."""

    @wp.kernel(**options)
    def transport(world: World, sink: Sink, launch: Launch):
        s = stages.prepare(world, wp.tid(), launch)
        if wp.static(cuda):  # noqa: SIM108, Warp has no such choice between arrays
            words = launch.cursor  # any: it is not used
        else:
            words = wp.zeros(shape=PREFETCHED_WORDS, dtype=int)
        for number in range(wp.tid(), launch.photon_count, launch.threads):
            s.photon = number
            id = s.base + wp.uint64(number)
            stages.begin(s, world, sink, stages.emit(world.laser, world.scan, world.seed, id), id)
            while s.stage != state.END:
                stages.fly(s, world, words)
                stages.trace(s, world)
                stages.ask_flight(s, world, sink, 0)
                stages.cross(s, world, sink)
                stages.collide(s, world, sink)
                if s.stage == state.SCATTER:
                    stages.ask_event(s, world, sink, 0)
                    stages.scatter(s, world, sink)
            stages.finish(s, sink)
        stages.flush(s, sink)

    return transport


@wp.struct
class WarpStatus:
    """What the lanes of a warp count in a turn of its loop; a struct for the reason of `PhotonState`."""

    # Lanes that wait for a ray or, where there are none, that have no photons left, 0 while requests are in the queue.
    waiting: int
    enough: int  # requests in the queue that are to be scored: 32 or, when no photons are left, any


def _make_renew(stages: Stages) -> wp.Function:
    """The Warp function ``(s, world, sink, launch, memory, lane)`` that finishes the photons of a warp that have
    ended and gives the next to their lanes. All lanes take part."""

    @wp.func
    def renew(s: PhotonRef, world: WorldRef, sink: SinkRef, launch: wp.ref[Launch], memory: int, lane: int):
        if s.stage == state.END:
            stages.finish(s, sink)
            s.stage = state.START
        wanting = s.stage == state.START
        votes = queue.vote(wanting)
        entry = votes[0]
        # All lanes emit a photon each, which those that have ended take one by one.
        if s.taken >= 32:
            s.first = queue.take_photons(launch.cursor)
            s.taken = 0
            own = stages.emit(world.laser, world.scan, world.seed, s.base + wp.uint64(s.first + lane))
            queue.exchange(memory, True, lane, own)
        entry += s.taken
        s.taken += votes[1]
        if wanting and entry < 32:
            s.photon = s.first + entry
            s.stage = state.DONE
            if s.photon < launch.photon_count:
                emitted = queue.exchange(memory, False, entry, wp.spatial_vector())
                stages.begin(s, world, sink, emitted, s.base + wp.uint64(s.photon))

    return renew


def _make_loop_flat(stages: Stages, options: dict) -> wp.Kernel:
    """Warps without a tree to walk: what is scored waits for nothing but the other lanes."""
    used, fused, renew = stages.scores, stages.fused, _make_renew(stages)
    rounds = 2 if stages.flights and not stages.two_requests else 1

    @wp.kernel(**options)
    def transport(world: World, sink: Sink, launch: Launch):
        lane = wp.tid() % 32
        s = stages.prepare(world, wp.tid(), launch)
        memory = stages.memory()
        status = WarpStatus()
        status.enough = 32
        queued = int(0)
        if wp.static(used):
            queued = queue.queue_size(memory, queue.SET_SIZE, 0)

        while status.waiting < 32:
            flying = s.stage == state.FLIGHT
            if wp.static(not fused) and flying:
                stages.fly(s, world, launch.cursor)
            round = int(wp.static(2 - rounds))
            while round < 2:
                if wp.static(fused):
                    if flying:
                        stages.fly(s, world, launch.cursor)
                        stages.ask_flight(s, world, sink, memory)
                        stages.cross(s, world, sink)
                        stages.collide(s, world, sink)
                        if s.stage == state.SCATTER:
                            stages.ask_event(s, world, sink, memory)
                            stages.scatter(s, world, sink)
                elif s.stage == state.EVENT:
                    if round == 0:
                        stages.ask_flight(s, world, sink, memory)
                    else:
                        stages.cross(s, world, sink)
                        stages.collide(s, world, sink)
                        if s.stage == state.SCATTER:
                            stages.ask_event(s, world, sink, memory)
                round += 1
                # ---- Scores, 32 together
                if wp.static(used):
                    queued = queue.queue_size(memory, queue.READ_SIZE, 0)
                    ready = queued >= status.enough
                    while ready:
                        request = stages.pop(memory, lane, True, queued, 32)
                        queued = queue.queue_size(memory, queue.SET_SIZE, wp.max(queued - 32, 0))
                        ready = wp.static(stages.drains) and queued >= 32
                        stages.serve(s, request, world, sink)
            if wp.static(not fused) and s.stage == state.SCATTER:
                stages.scatter(s, world, sink)
            if queue.count_lanes(s.stage >= state.START) >= wp.static(stages.start_lanes):
                renew(s, world, sink, launch, memory, lane)
                done = queue.count_lanes(s.stage == state.DONE)
                status.enough = wp.where(done == 32, 1, 32)
                status.waiting = wp.where(queued > 0, 0, done)

        stages.flush(s, sink)

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
def next_ray(s: PhotonRef, scores: bool) -> Ray:
    """The ray that a thread traces: that which it has begun, its photon's flight, or the way to the lens."""
    if s.ray == state.NO_RAY:
        s.ray = wp.where(s.stage == state.RAY, state.SURFACE_RAY, wp.where(s.hidden, state.SHADOW_RAY, state.NO_RAY))
    ray = Ray()
    ray.origin = s.x
    ray.direction = s.u
    ray.length = s.flight.reach
    if scores:
        if s.ray == state.SHADOW_RAY:
            ray.origin = s.origin
            ray.direction = wp.normalize(s.lens - s.origin)
            ray.length = wp.length(s.lens - s.origin)
    return ray


def _make_end_walk(stages: Stages) -> wp.Function:
    """The Warp function ``(s, world, sink)`` at the end of a ray's walk down the tree."""

    @wp.func
    def end_walk(s: PhotonRef, world: WorldRef, sink: SinkRef):
        if s.ray == state.SURFACE_RAY:
            s.surface_queries += 1
            if s.walk.found >= 0:
                if stages.meet(s, world, s.walk.nearest):
                    s.hit = surface_hit(world.surfaces, s.walk, s.u)
            s.stage = state.EVENT
        else:
            s.shadow_queries += 1
            s.hidden = False
            if s.walk.found < 0:
                stages.deposit(s.account, sink, world, s.pending)
        s.ray = state.NO_RAY

    return end_walk


def _make_loop_tree(stages: Stages, options: dict) -> wp.Kernel:
    """Warps that leave the water when enough of their lanes wait for a ray, and walk down the tree together."""
    used, flights = stages.scores, stages.flights
    renew, end_walk = _make_renew(stages), _make_end_walk(stages)
    ray_lanes, walking_lanes = (GUIDED_RAY_LANES, GUIDED_WALKING_LANES) if flights else (RAY_LANES, WALKING_LANES)
    rounds = 2 if flights and not stages.two_requests else 1
    scatter_first = used and rounds == 1

    @wp.kernel(**options)
    def transport(world: World, sink: Sink, launch: Launch):
        lane = wp.tid() % 32
        s = stages.prepare(world, wp.tid(), launch)
        stack = Stack()
        stack[0] = NO_NODE
        memory = stages.memory()
        status = WarpStatus()
        status.enough = 32
        queued = int(0)
        if wp.static(used):
            queued = queue.queue_size(memory, queue.SET_SIZE, 0)

        while queue.count_lanes(s.stage == state.DONE and not s.hidden) < 32 or (wp.static(used) and queued > 0):
            # ---- Water: until enough lanes of the warp wait for a ray
            status.waiting = 0
            while status.waiting < wp.static(ray_lanes):
                if s.stage == state.FLIGHT:
                    stages.fly(s, world, launch.cursor)
                round = int(wp.static(2 - rounds))
                while round < 2:
                    if s.stage == state.EVENT and (wp.static(not used) or queued <= queue.MOST_LEFT):
                        if wp.static(flights):
                            if round == wp.static(2 - rounds):
                                stages.ask_flight(s, world, sink, memory)
                        if round == 1 and (wp.static(not flights) or not state.is_planned(s.flight)):
                            stages.cross(s, world, sink)
                            stages.collide(s, world, sink)
                            if s.stage == state.SCATTER:
                                stages.ask_event(s, world, sink, memory)
                                if wp.static(scatter_first):
                                    stages.scatter(s, world, sink)
                    round += 1
                    # ---- Scores, by all lanes that have room for what they find
                    if wp.static(used):
                        queued = queue.queue_size(memory, queue.READ_SIZE, 0)
                        free = queue.count_lanes(not s.hidden)
                        if queued >= status.enough and free >= wp.static(FREE_LANES):
                            request = stages.pop(memory, lane, not s.hidden, queued, free)
                            queued = queue.queue_size(memory, queue.SET_SIZE, wp.max(queued - free, 0))
                            stages.serve(s, request, world, sink)
                if wp.static(not scatter_first) and s.stage == state.SCATTER:
                    stages.scatter(s, world, sink)
                if queue.count_lanes(s.stage >= state.START) >= wp.static(stages.start_lanes):
                    renew(s, world, sink, launch, memory, lane)
                    status.enough = wp.where(queue.count_lanes(s.stage == state.DONE) == 32, 1, 32)
                status.waiting = queue.count_lanes(s.stage != state.FLIGHT)

            # ---- Surfaces: the warp traces its rays together
            ray = next_ray(s, wp.static(used))
            if s.ray != state.NO_RAY and s.walk.node == NO_NODE:
                s.walk.node = 0
                s.walk.found = -1
                s.walk.nearest = ray.length
                s.walk.depth = 1  # below everything stands NO_NODE
            inverse = inverse_direction(ray.direction)
            shift = wp.cw_mul(ray.origin, inverse)
            # Until so few walk on that new rays should join them; all take steps of one kind.
            in_nodes = queue.count_lanes(s.walk.node > NO_NODE)
            at_faces = queue.count_lanes(s.walk.node < NO_NODE)
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
                        if s.ray == state.SHADOW_RAY:
                            s.walk.node = NO_NODE
                in_nodes = queue.count_lanes(s.walk.node > NO_NODE)
                at_faces = queue.count_lanes(s.walk.node < NO_NODE)
            if s.ray != state.NO_RAY and s.walk.node == NO_NODE:
                end_walk(s, world, sink)

        stages.flush(s, sink)

    return transport
