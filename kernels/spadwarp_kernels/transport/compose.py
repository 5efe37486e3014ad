"""The stages of a spec: every choice of physics is made here and in the packages below, none in the loops."""

from typing import NamedTuple

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.estimators.contribution import Scored, make_point_of
from spadwarp_kernels.estimators.mirrored import make_score_images
from spadwarp_kernels.estimators.registry import make_estimator
from spadwarp_kernels.optics.visibility import may_be_hidden
from spadwarp_kernels.photon.queue import Request, long_queue_fits, make_queue
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonRef, SinkRef, WorldRef, is_planned, make_deposit
from spadwarp_kernels.surface.bvh import segment_meets_box
from spadwarp_kernels.surface.ray_cast import intersect_surfaces, meets_faces

from .stages import (
    make_begin,
    make_collide,
    make_cross,
    make_emit,
    make_finish,
    make_flush,
    make_fly,
    make_prepare,
    make_scatter,
    make_trace,
)


class Stages(NamedTuple):
    """What becomes of a photon, as Warp functions; states are changed in place."""

    prepare: wp.Function  # ``(draws, world, thread, launch) -> int``, of a thread
    emit: wp.Function  # ``(world, id) -> spatial_vector``
    begin: wp.Function  # ``(s, world, sink, emitted, id)``, to FLIGHT
    fly: wp.Function  # ``(s, world, draws, words)``, to EVENT or RAY
    trace: wp.Function  # ``(s, world)``, from RAY to EVENT, without other threads
    cross: wp.Function  # ``(s, world, sink)``, what the photon itself brings on its flight
    collide: wp.Function  # ``(s, world)``, to SCATTER or END
    scatter: wp.Function  # ``(s, world, sink, draws)``, to FLIGHT or END
    finish: wp.Function  # ``(s, sink)``
    flush: wp.Function  # ``(s, sink)``, of a thread
    # ``(s, world, sink, memory)``: the flight and the event are scored, or what is to be scored goes to the queue.
    ask_flight: wp.Function
    ask_event: wp.Function
    deposit: wp.Function  # ``(account, sink, world, contribution)``
    # A warp's queue:
    scores: bool  # whether requests are made
    flights: bool  # whether flights are scored
    two_requests: bool  # whether a flight and the event at its end are asked for together; else one after the other
    memory: wp.Function  # see `make_queue`, as `pop`
    pop: wp.Function
    serve: wp.Function  # ``(s, request, world, sink)``: adds a contribution, or leaves it to wait for its shadow ray
    # How the threads run:
    alone: bool  # each moves photon after photon, without others
    in_tree: bool  # rays walk down a tree
    fused: bool  # without a tree, a photon flies, collides and scatters in one branch
    drains: bool  # as many requests are scored in a turn as leave fewer than 32
    start_lanes: int  # a warp takes new photons when so many of its lanes have ended
    max_registers: int  # of a CUDA thread


@memoised
def compose(spec: TransportSpec, cuda: bool, split: bool) -> Stages:
    """The stages of a spec; `split`: on CUDA, the low words of the tally are apart.

    A thread moves its photons alone on a CPU, with Warp's own rays, and where blocks of cells keep what they score with
    the thread. A handful of faces is tried on the spot; but a core walks the tree of a box in a third of the time that
    its twelve faces take.
    """
    estimator = make_estimator(spec)
    alone = not cuda or bool(spec.blocks) or (spec.mesh and spec.use_warp_bvh)
    brute_force = spec.mesh and spec.tries_faces and cuda
    in_tree, flies_on = spec.mesh and not brute_force, estimator.cross is not None
    flights, scores = estimator.request_flight is not None, estimator.score is not None
    two_requests = flights and scores and long_queue_fits(spec, in_tree)
    deposit = make_deposit(spec.signed, len(spec.blocks), split)
    memory, push, pop = make_queue(spec, flights, scores, two_requests, in_tree)
    serve = _make_serve(spec, brute_force, split, deposit, waits=in_tree and not alone) if scores else push
    ask_flight, ask_event = _make_asks(spec, _make_serve_now(serve) if alone and scores else push)
    return Stages(
        prepare=make_prepare(spec, cuda),
        emit=make_emit(spec),
        begin=make_begin(spec),
        fly=make_fly(spec, estimator.plan_flight, brute_force, cuda),
        trace=make_trace(in_tree),
        cross=make_cross(spec, estimator.cross, deposit),
        collide=make_collide(spec, flies_on),
        scatter=make_scatter(spec, estimator.direct, flies_on),
        finish=make_finish(spec),
        flush=make_flush(not cuda and estimator.scores, spec.reflecting),
        ask_flight=ask_flight,
        ask_event=ask_event,
        deposit=deposit,
        scores=scores,
        flights=flights,
        two_requests=two_requests,
        memory=memory,
        pop=pop,
        serve=serve,
        alone=alone,
        in_tree=in_tree,
        # Where a flight and its event are asked for together, or nothing is, a warp pays for these once so. Otherwise
        # it scatters after its score: measured, which is faster.
        fused=two_requests or not scores or not (flights or spec.mesh or spec.grid),
        # Where a round adds more requests than a warp scores at a time.
        drains=scores and (two_requests or spec.points > 1),
        # Fewer where nothing is scored, in grids, and in a tree with `next_event`.
        start_lanes=4 if scores and not spec.grid and (flights or not in_tree) else 3,
        max_registers=estimator.max_registers[in_tree],
    )


def _make_serve_now(serve: wp.Function) -> wp.Function:
    """What takes the place of `push` without a queue."""

    @wp.func
    def serve_now(s: PhotonRef, request: Request, world: WorldRef, sink: SinkRef, memory: int):
        if request.wanted:
            serve(s, request, world, sink)

    return serve_now


def _make_asks(spec: TransportSpec, take: wp.Function) -> tuple[wp.Function, wp.Function]:
    """Of a flight and of an event; `take`: ``(s, request, world, sink, memory)``."""
    estimator, points = make_estimator(spec), spec.points
    request_flight, request_event = estimator.request_flight, estimator.request_event
    flights, events, point_of = request_flight is not None, request_event is not None, make_point_of(max(points, 2))

    @wp.func
    def ask_flight(s: PhotonRef, world: WorldRef, sink: SinkRef, memory: int):
        if wp.static(flights):
            if is_planned(s.flight):
                request = request_flight(s)
                take(s, request, world, sink, memory)
                for i in range(wp.static(points - 1)):
                    take(s, point_of(request, i + 1), world, sink, memory)
                s.flight.interval = wp.vec2(0.0, 0.0)

    @wp.func
    def ask_event(s: PhotonRef, world: WorldRef, sink: SinkRef, memory: int):
        if wp.static(events):
            take(s, request_event(s, world), world, sink, memory)

    return ask_flight, ask_event


@wp.func
def _may_hide_behind_port(view: wp.vec4, near_depth: wp.array2d[float], x: wp.vec3) -> bool:
    """True: the map is of straight lines to the lens."""
    return True


def _make_is_seen(spec: TransportSpec, brute_force: bool) -> wp.Function:
    """The Warp function ``(s, found, world) -> bool``: whether the lens sees a scored point for certain, without a walk
    down the tree; of a handful of faces each is tried, and what they hide is set to 0."""
    has_mesh, view_of = spec.mesh, spec.lens.view
    may_hide = may_be_hidden if spec.port is None else _may_hide_behind_port

    @wp.func
    def is_seen(s: PhotonRef, found: wp.ref[Scored], world: WorldRef) -> bool:
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


def _make_serve(spec: TransportSpec, brute_force: bool, split: bool, deposit: wp.Function, waits: bool) -> wp.Function:
    """See `Stages.serve`; with `waits` a contribution behind which a tree must be walked is left in the state, else the
    ray is traced here."""
    reflecting, traces = spec.reflecting, spec.mesh and not brute_force and not waits
    score, is_seen = make_estimator(spec).score, _make_is_seen(spec, brute_force)
    score_images = make_score_images(spec, brute_force, split)

    @wp.func
    def serve(s: PhotonRef, request: Request, world: WorldRef, sink: SinkRef):
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
