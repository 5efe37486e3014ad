"""Monte Carlo transport of photons from a pulsed laser through water and against a mesh into a camera.

One kernel, specialised by a hashable `TransportSpec`. A thread moves photon after photon through the stages

    FLIGHT -> EVENT -> SCATTER -> FLIGHT -> ... -> END

and leaves the inner loop only when it has a ray to trace, so that the tree of the mesh is walked by all threads of a
warp at once. A warp emits 32 photons at a time; a thread whose photon has ended takes the next. Each stage is a
function made for the spec: it takes the state of the photon and returns a small struct, from which the loop updates the
state.
"""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import PREFETCHED_WORDS, RoundKeys, hold_keys
from spadwarp_kernels.estimators.contribution import Asked
from spadwarp_kernels.estimators.derived import make_derived_cross, make_derived_score
from spadwarp_kernels.estimators.mirrored import make_score_images
from spadwarp_kernels.estimators.points import make_ask_flight, make_push_points, make_score_points
from spadwarp_kernels.estimators.queue import long_queue_fits, make_queue
from spadwarp_kernels.estimators.registry import make_estimator
from spadwarp_kernels.optics.camera import Camera, Gate
from spadwarp_kernels.optics.laser import Laser, Scan
from spadwarp_kernels.photon.lanes import READ_SIZE, SET_SIZE, count_lanes, exchange, queue_size, take_photons, vote
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import (
    DONE,
    END,
    EVENT,
    FLIGHT,
    NO_RAY,
    SCATTER,
    SHADOW_RAY,
    START,
    SURFACE_RAY,
    Records,
    Turn,
    first_state,
    is_planned,
    next_bounce,
    shorten,
    sum_bounces,
)
from spadwarp_kernels.riders.blocks import make_begin_history, make_fly_history
from spadwarp_kernels.riders.polarisation import Polarisation, make_first_stokes
from spadwarp_kernels.surface.bvh import NO_NODE, Stack, inverse_direction, place, step_leaf, step_node
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.ray_cast import surface_hit
from spadwarp_kernels.tally.ledger import make_ledger_slot
from spadwarp_kernels.tally.scores import Derivatives, make_deposit
from spadwarp_kernels.tally.tally import TOO_LONG
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import Layers, Medium
from spadwarp_kernels.water.phase_functions import Guiding

from .checks import check_spec
from .collide import make_arrives, make_collide
from .emit import make_emit, make_enter, make_first_photon, make_take_emitted
from .finish import make_finish, make_flush
from .flight import make_depart
from .scatter import make_leave, make_scatter
from .traverse import make_aim, make_begin_walk, make_free_lanes, make_look, next_ray

__all__ = ["make_transport_kernel"]

# A warp traces rays when this many of its 32 lanes wait for one, or have ended: fewer leave lanes idle in the BVH, more
# in the water.
RAY_LANES = 20
GUIDED_RAY_LANES = 18

# It scores what its queue holds when so many have room for a contribution that waits for its shadow ray.
FREE_LANES = 12

# It goes back to the water when fewer than this many still walk down the tree, and lets them wait for company.
WALKING_LANES = 6
GUIDED_WALKING_LANES = 4

# It takes new photons when this many lanes have ended; the second where nothing is scored, in grids, and in a tree with
# `next_event`. All measured.
START_LANES = 4
FEWER_START_LANES = 3


@memoised
def make_transport_kernel(spec: TransportSpec, cuda: bool = False, split_accumulators: bool = False) -> wp.Kernel:
    """The transport kernel for a spec; launch grid: any number of threads, which share the photons among them.

    On CUDA they must be a multiple of the block size, since whole warps vote. `split_accumulators`: on CUDA, those of
    the tally are apart, see `tally.split_accumulators`.

    Raises:
        ArgumentError: An estimator that is not one of ESTIMATORS, or confocal with the plain lens.
    """
    check_spec(spec)
    estimator = make_estimator(spec)
    cross, score = make_derived_cross(spec, estimator.cross), make_derived_score(spec, estimator.score)
    request_flight, request_event = estimator.request_flight, estimator.request_event
    crosses, flights, scores = estimator.cross is not None, request_flight is not None, estimator.score is not None
    has_mesh, reflecting, confocal = spec.mesh, spec.reflecting, spec.confocal
    # A handful of faces is tried on the spot; rays for a tree wait until the warp has enough of them. A core walks the
    # tree of a box in a third of the time that its twelve faces take.
    brute_force = has_mesh and spec.brute_force and cuda and not spec.use_warp_bvh
    has_bvh = has_mesh and not brute_force
    in_blocks = bool(spec.blocks)
    queues = scores and cuda and not in_blocks  # scores of blocks stay with the thread
    # A flight and the event at its end are asked for in one round where the queue has room for both, else in two.
    asks_twice = flights and queues and long_queue_fits(spec, has_bvh)
    apart = flights and not asks_twice
    # Where nothing waits for a shadow ray, a photon flies, collides and scatters in one branch, so that a warp pays for
    # these once. Otherwise a new direction comes before the score, or after it: measured, which of the two is faster.
    at_once = cuda and not has_bvh and (asks_twice or not scores)
    at_once = at_once or (queues and not flights and not has_mesh and spec.grid is None)
    short = not (has_mesh or flights or confocal or spec.derivatives or spec.polarised or spec.grid)
    # Where a round adds more requests than a warp scores at a time, it scores until fewer than that are left.
    drains = queues and not has_bvh and (asks_twice or spec.points > 1)
    early = at_once or (has_bvh and queues and not apart)
    ray_lanes = (GUIDED_RAY_LANES if flights else RAY_LANES) if has_bvh else 32
    walking_lanes = GUIDED_WALKING_LANES if flights else WALKING_LANES
    start_lanes = START_LANES if scores and spec.grid is None and (flights or not has_bvh) else FEWER_START_LANES
    emit, take_emitted, enter = make_emit(spec), make_take_emitted(spec, cuda), make_enter(spec.laser_port)
    depart, collide = make_depart(spec, estimator.plan_flight, brute_force, cuda), make_collide(spec, crosses)
    scatter, leave = make_scatter(spec, estimator.direct, crosses), make_leave(crosses)
    flown, arrives = make_arrives(flights, has_bvh, queues, at_once)
    free_lanes = make_free_lanes(has_bvh)
    aim, look, begin_walk = make_aim(spec, scores), make_look(spec, brute_force), make_begin_walk(spec, cuda)
    warp_memory, push, pop = make_queue(
        flights, queues, asks_twice, has_bvh, confocal, len(spec.derivatives), spec.polarised, spec.points, short
    )
    deposit = make_deposit(spec.signed, len(spec.blocks), split_accumulators)
    begin_history, fly_history, first_stokes = make_begin_history(spec), make_fly_history(spec), make_first_stokes(spec)
    ask_flight = make_ask_flight(request_flight, make_push_points(spec.points, push))
    score_more, scores_more = make_score_images(spec, flights, brute_force, split_accumulators), reflecting
    if spec.points > 1 and not queues:
        score_more, scores_more = make_score_points(spec, score, look, split_accumulators), True
    first_photon, ledger_slot = make_first_photon(spec), make_ledger_slot(cuda)
    finish, flush = make_finish(spec), make_flush(not cuda and (crosses or scores), reflecting)

    @wp.kernel(
        module="unique",
        module_options={"fast_math": cuda},
        enable_backward=False,
        cuda_max_registers=estimator.max_registers[has_bvh],
    )
    def transport(
        # Model:
        medium: Medium,
        layers: Layers,
        laser: Laser,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        guiding: Guiding,
        surfaces: Surfaces,
        scan: Scan,
        derivatives: Derivatives,
        polarisation: Polarisation,
        # Photons:
        seed: wp.uint64,
        keys: RoundKeys,
        first_id: wp.uint64,
        photon_count: int,
        # Data out:
        scale: float,
        tally: wp.array(dtype=wp.int64),
        gradients: wp.array(dtype=wp.int64),
        ledger: wp.array(dtype=wp.int64),
        out: Records,
        cursor: wp.array(dtype=int),
        offset: wp.array(dtype=wp.uint64),
        low: wp.array(dtype=wp.uint32),
    ):
        lane = wp.tid() % wp.static(32 if cuda else 1)  # on the CPU one thread moves all photons
        thread = ledger_slot(wp.tid(), first_id)
        base = first_photon(first_id, offset)
        s = first_state(medium, camera)
        kept = hold_keys(keys)
        if wp.static(in_blocks):
            derivatives.blocks.thread = wp.tid()
        if wp.static(has_bvh and cuda):
            stack = Stack()
            stack[0] = NO_NODE
        if wp.static(cuda):  # noqa: SIM108, Warp has no such choice between arrays
            words = cursor  # any: it is not used
        else:
            words = wp.zeros(shape=PREFETCHED_WORDS, dtype=int)
        memory = warp_memory()
        turn = Turn()
        turn.enough = 32
        queued = int(0)
        if wp.static(queues):
            queued = queue_size(memory, SET_SIZE, 0)

        while count_lanes(s.stage == DONE and not s.hidden) < 32 or (wp.static(has_bvh and queues) and queued > 0):
            # ---- Water: until enough lanes of the warp wait for a ray
            turn.waiting = 0
            while turn.waiting < wp.static(ray_lanes):
                flying = s.stage == FLIGHT
                if wp.static(not at_once) and flying:
                    id = base + wp.uint64(s.photon)
                    depart(s, medium, layers, camera, gate, limits, surfaces, kept, id, words)
                # Round 0 scores the flight and round 1 the event at its end, or round 1 both.
                round = int(wp.static(0 if apart else 1))
                while round < 2:
                    asked = Asked()
                    if wp.static(flights and not at_once):
                        if round == wp.static(0 if apart else 1) and flown(s, queued):
                            asked.request = ask_flight(s, memory)
                    if round == 1 and arrives(s, queued, flying):
                        if wp.static(at_once):
                            id = base + wp.uint64(s.photon)
                            depart(s, medium, layers, camera, gate, limits, surfaces, kept, id, words)
                            if wp.static(flights):
                                if is_planned(s.flight):
                                    asked.request = ask_flight(s, memory)
                        if wp.static(crosses):
                            crossing = cross(s, camera, gate, limits, layers, derivatives, polarisation)
                            if wp.static(reflecting):
                                s.bounces.dropped += wp.where(crossing.index == TOO_LONG, 1, 0)
                            if not crossing.value <= 0.0:
                                s.contributions += 1
                                s.pending_add = deposit(
                                    tally, low, gradients, ledger, s.pending_add, thread, scale, derivatives, crossing
                                )
                        end = collide(s, medium, layers, limits)
                        s.scores = fly_history(s.scores, derivatives, layers, s.x, s.u, end.distance)
                        s.x = end.x
                        s.path += end.distance
                        s.reason = end.reason
                        s.stage = END
                        if wp.static(reflecting):
                            s.bounces = next_bounce(s.bounces, end.mirror)
                        # A branch, since after a select a core waits for the flight before it draws the next words.
                        if s.reason < 0 or end.mirror > 0:
                            s.stage = SCATTER
                            s.collisions += 1
                            s.albedo = end.albedo
                            if wp.static(scores):
                                asked.request = request_event(s, camera)
                                push(memory, asked.request)
                            if wp.static(early):
                                new = scatter(
                                    s, medium, layers, camera, limits, surfaces, guiding, derivatives, polarisation,
                                    keys, base + wp.uint64(s.photon), ledger, thread)  # fmt: skip
                                leave(s, new)
                    round += 1
                    # ---- Scores: each lane its own or, from a queue, 32 together
                    if wp.static(scores):
                        ready = bool(asked.request.wanted)
                        if wp.static(queues):
                            queued = queue_size(memory, READ_SIZE, 0)
                            free = free_lanes(s)
                            ready = queued >= turn.enough and free >= wp.static(FREE_LANES)
                        while ready:
                            if wp.static(queues):
                                asked.request = pop(memory, lane, not s.hidden, queued, free)
                                queued = queue_size(memory, SET_SIZE, wp.max(queued - free, 0))
                            ready = wp.static(drains) and queued >= 32
                            found = score(
                                asked.request, medium, layers, camera, gate, surfaces, scan, derivatives, polarisation
                            )
                            if asked.request.wanted and not found.contribution.value <= 0.0:  # NaN is counted as such
                                s.contributions += 1
                                found = look(found, camera, surfaces)
                                s.shadow_queries += found.shadow_queries
                                if found.seen:
                                    c = found.contribution
                                    if not c.value <= 0.0:
                                        s.pending_add = deposit(
                                            tally, low, gradients, ledger, s.pending_add, thread, scale, derivatives, c
                                        )
                                else:
                                    s.hidden = True
                                    s.origin = found.origin
                                    s.lens = found.lens
                                    s.pending = found.contribution
                            if wp.static(scores_more):
                                more = score_more(
                                    asked.request, medium, layers, camera, gate, limits, surfaces, scan,
                                    derivatives, polarisation, tally, low, gradients, ledger, s.pending_add, thread,
                                    scale)  # fmt: skip
                                s.contributions += more.contributions
                                s.shadow_queries += more.shadow_queries
                                s.pending_add = more.pending_add
                # Now the photon's weight, its end or its new direction; a score of its own took it as it arrived.
                if wp.static(not early) and s.stage == SCATTER:
                    new = scatter(s, medium, layers, camera, limits, surfaces, guiding, derivatives, polarisation,
                                  keys, base + wp.uint64(s.photon), ledger, thread)  # fmt: skip
                    leave(s, new)

                # ---- The next photon for those that have ended
                if count_lanes(s.stage >= START) >= wp.static(start_lanes):
                    if s.stage == END:
                        s.weight = finish(s, out, ledger, thread)
                        s.water_collisions += s.collisions - s.surface_count - s.bounces.count
                        s.bounces = sum_bounces(s.bounces)
                        s.surface_events += s.surface_count
                        s.stage = START
                    wanting = s.stage == START
                    votes = vote(wanting)
                    entry = votes[0]
                    if wp.static(cuda):
                        # All lanes emit a photon each, which those that have ended take one by one.
                        if s.taken >= 32:
                            s.first = take_photons(cursor)
                            s.taken = 0
                            exchange(memory, True, lane, emit(laser, scan, seed, base + wp.uint64(s.first + lane)))
                        entry += s.taken
                        s.taken += votes[1]
                    elif wanting:
                        s.first += 1
                    if wanting and entry < 32:
                        s.photon = s.first + entry
                        s.stage = wp.where(s.photon < photon_count, FLIGHT, DONE)
                        if s.stage == FLIGHT:
                            id = base + wp.uint64(s.photon)
                            if wp.static(confocal):
                                s.target = int(id % wp.uint64(scan.count))
                                s.view = scan.view[s.target]
                            emitted = take_emitted(memory, laser, scan, seed, id, entry)
                            start = enter(laser, emitted, s, ledger, thread)
                            s.x = start.x
                            s.u = start.u
                            s.weight = start.weight
                            s.analog_weight = start.weight.value
                            s.path = start.path
                            s.collisions = 0
                            s.surface_count = 0
                            s.scores = begin_history(derivatives)
                            s.stokes = first_stokes(polarisation, laser, scan, s.target, emitted, s.x, s.u)

                    turn.done = count_lanes(s.stage == DONE)
                    turn.enough = wp.where(turn.done == 32, 1, 32)
                    turn.waiting = wp.where(queued > 0, 0, turn.done)
                if wp.static(has_bvh):
                    turn.waiting = count_lanes(s.stage != FLIGHT)

            # ---- Surfaces: the warp traces its rays together
            if wp.static(has_bvh):
                s.ray = next_ray(s)
                ray = aim(s)
                if s.ray != NO_RAY and s.walk.node == NO_NODE:
                    s.walk = begin_walk(surfaces, ray, s.ray == SHADOW_RAY)
                if wp.static(cuda):
                    inverse = inverse_direction(ray.direction)
                    shift = wp.cw_mul(ray.origin, inverse)
                    # Until so few walk on that new rays should join them; all take steps of one kind.
                    in_nodes = count_lanes(s.walk.node > NO_NODE)
                    at_faces = count_lanes(s.walk.node < NO_NODE)
                    company = int(1)
                    while in_nodes + at_faces >= company:
                        company = wp.static(walking_lanes)
                        if in_nodes >= at_faces:
                            if s.walk.node > NO_NODE:
                                met = step_node(surfaces.nodes, s.walk, inverse, shift)
                                s.walk.node = met.child[0]
                                for k in range(3):
                                    if met.entry[3 - k] <= met.reach:
                                        stack[place(s.walk.depth)] = met.child[3 - k]
                                        s.walk.depth += 1
                                if met.entry[0] > met.reach:
                                    s.walk.depth -= 1
                                    s.walk.node = stack[place(s.walk.depth)]
                        elif s.walk.node < NO_NODE:
                            step = step_leaf(surfaces.faces, surfaces.order, s.walk, ray.origin, ray.direction)
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
                    if s.ray == SURFACE_RAY:
                        s.surface_queries += 1
                        if s.walk.found >= 0:
                            if s.walk.nearest < s.flight.distance:
                                s.hit = surface_hit(surfaces, s.walk, s.u)
                            s.flight = shorten(s.flight, s.walk.nearest)
                        s.stage = EVENT
                    else:
                        s.shadow_queries += 1
                        s.hidden = False
                        if s.walk.found < 0:
                            s.pending_add = deposit(
                                tally, low, gradients, ledger, s.pending_add, thread, scale, derivatives, s.pending
                            )
                    s.ray = NO_RAY

        flush(s, tally, ledger, thread)

    return transport
