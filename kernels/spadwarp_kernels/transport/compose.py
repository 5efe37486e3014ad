"""The stages of a spec: every choice of physics is made here and in the packages below, none in the loops."""

from typing import NamedTuple

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.estimators.contribution import Scored, make_point_of
from spadwarp_kernels.estimators.mirrored import make_score_images
from spadwarp_kernels.estimators.registry import make_estimator
from spadwarp_kernels.optics.visibility import may_be_hidden
from spadwarp_kernels.photon.queue import Request, long_queue_fits, make_queue
from spadwarp_kernels.photon.sink import Sink, make_deposit
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState, is_planned
from spadwarp_kernels.photon.world import World
from spadwarp_kernels.surface.bvh import segment_meets_box
from spadwarp_kernels.surface.ray_cast import intersect_surfaces, meets_faces

from .collide import make_collide, make_cross
from .fly import make_fly, make_trace
from .history import make_begin, make_emit, make_finish, make_flush
from .scatter import make_scatter


class Stages(NamedTuple):
    """What becomes of a photon, as Warp functions; states are changed in place.

    Attributes:
        emit: ``(world, id) -> spatial_vector``.
        begin: ``(s, world, sink, emitted, id)``, to FLIGHT.
        fly: ``(s, world, draws, words)``, to EVENT or RAY.
        trace: ``(s, world)``, from RAY to EVENT, without other threads.
        cross: ``(s, world, sink)``, what the photon itself brings on its flight.
        collide: ``(s, world)``, to SCATTER or END.
        scatter: ``(s, world, sink, draws)``, to FLIGHT or END.
        finish: ``(s, sink, out)``; flush: ``(s, sink)``, of a thread.
        score_flight, score_event: ``(s, world, sink)``, the contributions of a flight and of an event, at once.
        deposit: ``(account, sink, world, contribution)``.
        max_registers: Of a CUDA thread.
    """

    emit: wp.Function
    begin: wp.Function
    fly: wp.Function
    trace: wp.Function
    cross: wp.Function
    collide: wp.Function
    scatter: wp.Function
    finish: wp.Function
    flush: wp.Function
    score_flight: wp.Function
    score_event: wp.Function
    deposit: wp.Function
    max_registers: int


class Queue(NamedTuple):
    """How a warp shares its requests, as Warp functions.

    Attributes:
        used: Whether there is anything to score.
        two_requests: Whether a flight and the event at its end are asked for together; else one after the other.
        flights: Whether flights are scored.
        memory: ``() -> int``, see `make_warp_memory`.
        ask_flight, ask_event: ``(s, world, memory)``.
        pop: See `make_queue`.
        serve: ``(s, request, world, sink)``: a contribution is added, or waits in the state for its shadow ray.
    """

    used: bool
    two_requests: bool
    flights: bool
    memory: wp.Function
    ask_flight: wp.Function
    ask_event: wp.Function
    pop: wp.Function
    serve: wp.Function


def alone(spec: TransportSpec, cuda: bool) -> bool:
    """Whether a thread moves its photons without others: on a CPU, with Warp's own rays, and where blocks of cells keep
    what they score with the thread."""
    return not cuda or bool(spec.blocks) or (spec.mesh and spec.use_warp_bvh)


def tries_every_face(spec: TransportSpec, cuda: bool) -> bool:
    """Whether a handful of faces is tried on the spot. A core walks the tree of a box in a third of the time that its
    twelve faces take."""
    return spec.mesh and spec.brute_force and cuda and not spec.use_warp_bvh


@memoised
def compose(spec: TransportSpec, cuda: bool, split: bool) -> Stages:
    """The stages of a spec; `split`: on CUDA, the low words of the tally are apart."""
    estimator = make_estimator(spec)
    flies_on, brute_force = estimator.cross is not None, tries_every_face(spec, cuda)
    has_bvh = spec.mesh and not brute_force
    deposit = make_deposit(spec.signed, len(spec.blocks), split)
    score = make_serve(spec, cuda, split, waits=False) if estimator.score is not None else None
    return Stages(
        emit=make_emit(spec),
        begin=make_begin(spec),
        fly=make_fly(spec, estimator.plan_flight, brute_force, cuda),
        trace=make_trace(has_bvh),
        cross=make_cross(spec, estimator.cross, deposit),
        collide=make_collide(spec, flies_on),
        scatter=make_scatter(spec, estimator.direct, flies_on),
        finish=make_finish(spec),
        flush=make_flush(not cuda and estimator.scores, spec.reflecting),
        score_flight=_make_score_flight(spec, score),
        score_event=_make_score_event(spec, score),
        deposit=deposit,
        max_registers=estimator.max_registers[has_bvh],
    )


@memoised
def compose_queue(spec: TransportSpec, split: bool) -> Queue:
    """How the warps of a spec share requests on CUDA."""
    estimator = make_estimator(spec)
    flights, used = estimator.request_flight is not None, estimator.score is not None
    in_tree = spec.mesh and not spec.brute_force
    two_requests = flights and used and long_queue_fits(spec, in_tree)
    short = not (spec.mesh or flights or spec.confocal or spec.derivatives or spec.polarised or spec.grid)
    memory, push, pop = make_queue(
        flights, used, two_requests, in_tree, spec.confocal, len(spec.derivatives), spec.polarised, spec.points, short
    )
    ask_flight, ask_event = _make_asks(spec, push)
    serve = make_serve(spec, True, split, waits=in_tree) if used else None
    return Queue(used, two_requests, flights, memory, ask_flight, ask_event, pop, serve)


def _make_asks(spec: TransportSpec, push: wp.Function) -> tuple[wp.Function, wp.Function]:
    estimator = make_estimator(spec)
    request_flight, request_event = estimator.request_flight, estimator.request_event
    flights, events, points = request_flight is not None, request_event is not None, spec.points
    point_of = make_point_of(max(points, 2))

    @wp.func
    def ask_flight(s: wp.ref[PhotonState], world: wp.ref[World], memory: int):
        if wp.static(flights):
            if is_planned(s.flight):
                request = request_flight(s)
                push(memory, request)
                for i in range(wp.static(points - 1)):
                    push(memory, point_of(request, i + 1))
                s.flight.interval = wp.vec2(0.0, 0.0)

    @wp.func
    def ask_event(s: wp.ref[PhotonState], world: wp.ref[World], memory: int):
        if wp.static(events):
            push(memory, request_event(s, world))

    return ask_flight, ask_event


def _make_score_flight(spec: TransportSpec, score: wp.Function | None) -> wp.Function:
    request_flight, points = make_estimator(spec).request_flight, spec.points
    flights, point_of = request_flight is not None, make_point_of(max(points, 2))

    @wp.func
    def score_flight(s: wp.ref[PhotonState], world: wp.ref[World], sink: wp.ref[Sink]):
        if wp.static(flights):
            if is_planned(s.flight):
                request = request_flight(s)
                if request.wanted:
                    score(s, request, world, sink)
                    for i in range(wp.static(points - 1)):
                        score(s, point_of(request, i + 1), world, sink)

    return score_flight


def _make_score_event(spec: TransportSpec, score: wp.Function | None) -> wp.Function:
    request_event = make_estimator(spec).request_event
    events = request_event is not None

    @wp.func
    def score_event(s: wp.ref[PhotonState], world: wp.ref[World], sink: wp.ref[Sink]):
        if wp.static(events):
            request = request_event(s, world)
            if request.wanted:
                score(s, request, world, sink)

    return score_event


@wp.func
def _may_hide_behind_port(view: wp.vec4, near_depth: wp.array2d[float], x: wp.vec3) -> bool:
    """True: the map is of straight lines to the lens."""
    return True


@memoised
def _make_is_seen(spec: TransportSpec, brute_force: bool) -> wp.Function:
    """The Warp function ``(s, found, world) -> bool``: whether the lens sees a scored point for certain, without a walk
    down the tree; of a handful of faces each is tried, and what they hide is set to 0."""
    has_mesh, view_of = spec.mesh, spec.lens.view
    may_hide = may_be_hidden if spec.port is None else _may_hide_behind_port

    @wp.func
    def is_seen(s: wp.ref[PhotonState], found: wp.ref[Scored], world: wp.ref[World]) -> bool:
        seen = bool(True)
        if wp.static(has_mesh):
            if may_hide(view_of(world.camera, world.camera.view), world.surfaces.near_depth, found.origin):
                to = found.lens - found.origin
                seen = not segment_meets_box(found.origin, to, 1.0, world.surfaces.lower, world.surfaces.upper)
                if wp.static(brute_force):
                    if not seen:
                        s.shadow_queries += 1
                        length = wp.length(to)
                        hidden = meets_faces(world.surfaces, found.origin, to / length, length)
                        found.contribution.value = wp.where(hidden, 0.0, found.contribution.value)
                        seen = True
        return seen

    return is_seen


@memoised
def make_serve(spec: TransportSpec, cuda: bool, split: bool, waits: bool) -> wp.Function:
    """The Warp function ``(s, request, world, sink)`` that adds what a request comes to.

    `waits`: a contribution behind which a tree must be walked is left in the state; else the ray is traced here.
    """
    brute_force, reflecting = tries_every_face(spec, cuda), spec.reflecting
    traces = spec.mesh and not brute_force and not waits
    score, is_seen = make_estimator(spec).score, _make_is_seen(spec, brute_force)
    deposit = make_deposit(spec.signed, len(spec.blocks), split)
    score_images = make_score_images(spec, brute_force, split)

    @wp.func
    def serve(s: wp.ref[PhotonState], request: Request, world: wp.ref[World], sink: wp.ref[Sink]):
        found = score(request, world)
        if request.wanted and not found.contribution.value <= 0.0:  # NaN is counted as such
            s.contributions += 1
            seen = is_seen(s, found, world)
            if wp.static(traces):
                if not seen:
                    s.shadow_queries += 1
                    to = found.lens - found.origin
                    length = wp.length(to)
                    seen = intersect_surfaces(world.surfaces, found.origin, to / length, length, True).slot < 0
                    if not seen:
                        found.contribution.value = 0.0
                    seen = True
            if seen:
                if not found.contribution.value <= 0.0:
                    deposit(s.account, sink, world, found.contribution)
            else:
                s.hidden = True
                s.origin = found.origin
                s.lens = found.lens
                s.pending = found.contribution
        if wp.static(reflecting):
            score_images(s, request, world, sink)

    return serve
