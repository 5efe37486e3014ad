"""The stages of a spec: every choice of physics is made here and in the packages below, none in the loops."""

from typing import NamedTuple

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.estimators.contribution import Scored, make_point_of
from spadwarp_kernels.estimators.estimator import Estimator
from spadwarp_kernels.estimators.guided import leads_aside
from spadwarp_kernels.estimators.mirrored import make_score_images
from spadwarp_kernels.estimators.registry import make_estimator
from spadwarp_kernels.photon.queue import Request, long_queue_fits, make_queue
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonRef, SinkRef, WorldRef, is_planned, make_deposit
from spadwarp_kernels.riders.riders import make_flux_score
from spadwarp_kernels.surface.bvh import segment_meets_box

from . import stages


class Stages(NamedTuple):
    """What becomes of a photon, as Warp functions; states are changed in place."""

    prepare: wp.Function  # ``(world, thread, launch) -> PhotonState``, of a thread
    emit: wp.Function  # see `Beam.emit`
    begin: wp.Function  # ``(s, world, sink, emitted, id)``, to FLIGHT
    fly: wp.Function  # ``(s, world, words)``, to EVENT or RAY
    trace: wp.Function  # ``(s, world)``, from RAY to EVENT, without other threads
    meet: wp.Function  # ``(s, world, distance) -> bool``, whether the flight ends on the face at that distance [m]
    cross: wp.Function  # ``(s, world, sink)``, what the photon itself brings on its flight
    collide: wp.Function  # ``(s, world, sink)``, to SCATTER or END
    scatter: wp.Function  # ``(s, world, sink)``, to FLIGHT or END
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
def compose(spec: TransportSpec, cuda: bool) -> Stages:
    """The stages of a spec.

    A thread moves its photons alone on a CPU, with Warp's own rays, and where blocks of cells keep what they score with
    the thread. A handful of faces is tried on the spot; but a core walks the tree of a box in a third of the time that
    its twelve faces take.
    """
    estimator = make_estimator(spec)
    alone = not cuda or bool(spec.blocks) or (spec.mesh and spec.use_warp_bvh)
    in_tree, flies_on = spec.mesh and not spec.faces.tried, estimator.cross is not None
    flights, scores = estimator.request_flight is not None, estimator.score is not None
    two_requests = flights and scores and long_queue_fits(spec, in_tree)
    meet = stages.make_meet(estimator.meet)
    deposit = make_deposit(spec.signed, len(spec.blocks), spec.sea is not None, spec.lines)
    memory, push, pop = make_queue(spec, flights, scores, two_requests, in_tree)
    serve = _make_serve(spec, deposit, waits=in_tree and not alone) if scores else push
    ask_flight, ask_event = _make_asks(spec, _make_serve_now(serve) if alone and scores else push)
    return Stages(
        prepare=stages.make_prepare(spec.stepped, bool(spec.blocks), cuda),
        emit=spec.beam.emit,
        begin=stages.make_begin(spec),
        fly=stages.make_fly(spec, estimator.plan_flight, meet, spec.random_albedo, cuda),
        trace=stages.make_trace(meet, in_tree),
        meet=meet,
        cross=stages.make_cross(spec, estimator.cross, deposit),
        collide=stages.make_collide(spec, estimator.meet is not None, flies_on, make_flux_score(spec)),
        scatter=stages.make_scatter(spec, estimator.direct, flies_on),
        finish=stages.make_finish(spec.records, len(spec.derivatives)),
        flush=stages.make_flush(not cuda and estimator.scores, spec.reflecting, spec.sea is not None),
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
        max_registers=_max_registers(spec, estimator, in_tree),
    )


def _max_registers(spec: TransportSpec, estimator: Estimator, in_tree: bool) -> int:
    """Registers of a CUDA thread: fewer spill, more leave too few warps to hide latency. All measured."""
    if "track" in spec.flux:
        return 72
    if estimator.score is None:
        return 64 if in_tree or estimator.scores else 56
    if estimator.request_flight is not None:
        if spec.polarised:
            return 128
        return 96 if spec.grid is None else 72 if in_tree or spec.scores_collisions else 80
    if spec.polarised:
        return 96
    # In a tree, 72 keep more warps ready while others wait for nodes of a large mesh.
    return 64 if not in_tree else 80 if spec.derivatives or spec.grid is not None else 72


def _make_serve_now(serve: wp.Function) -> wp.Function:
    """What takes the place of `push` without a queue."""

    @wp.func
    def serve_now(s: PhotonRef, request: Request, world: WorldRef, sink: SinkRef, memory: int):
        if request.wanted:
            serve(s, request, world, sink)

    return serve_now


def _make_asks(spec: TransportSpec, take: wp.Function) -> tuple[wp.Function, wp.Function]:
    """Of a flight and of an event; `take`: ``(s, request, world, sink, memory)``."""
    estimator, point_of = make_estimator(spec), make_point_of(max(spec.points, 2))
    flights, events = estimator.request_flight is not None, estimator.request_event is not None

    @wp.func
    def ask_flight(s: PhotonRef, world: WorldRef, sink: SinkRef, memory: int):
        if wp.static(flights):
            if is_planned(s.flight):
                request = estimator.request_flight(s)
                aside = wp.static(spec.points > 1) and leads_aside(s)  # more points take no noise off
                request.weight *= wp.where(aside, 1.0, wp.static(1.0 / spec.points))
                take(s, request, world, sink, memory)
                for i in range(wp.static(spec.points - 1)):
                    other = point_of(request, i + 1)
                    other.wanted = not aside
                    take(s, other, world, sink, memory)
                s.flight.interval = wp.vec2(0.0, 0.0)

    @wp.func
    def ask_event(s: PhotonRef, world: WorldRef, sink: SinkRef, memory: int):
        if wp.static(events):
            take(s, estimator.request_event(s, world), world, sink, memory)

    return ask_flight, ask_event


def _make_serve(spec: TransportSpec, deposit: wp.Function, waits: bool) -> wp.Function:
    """See `Stages.serve`; with `waits` a contribution behind which a tree must be walked is left in the state, else the
    ray is traced here, and what a face hides is set to 0."""
    faces, sight, reflects, sea = spec.faces, spec.sight, spec.reflecting, spec.sea is not None
    score, score_images = make_estimator(spec).score, make_score_images(spec)

    @wp.func
    def is_seen(s: PhotonRef, found: wp.ref[Scored], world: WorldRef) -> bool:
        seen = bool(True)
        if wp.static(faces.mesh and sea):
            # The rest of the way, on the other side of the surface: few scenes have targets there.
            rest = found.behind - found.lens
            length = wp.length(rest)
            if segment_meets_box(found.lens, rest, 1.0, world.surfaces.lower, world.surfaces.upper) and length > 0.0:
                s.shadow_queries += 1
                if faces.hides(world.surfaces, found.lens, rest / length, length):
                    found.contribution.value = 0.0
        if wp.static(faces.mesh):
            if sight.may_hide(sight.view(world.camera, world.camera.view), world.surfaces.near_depth, found.origin):
                to = found.lens - found.origin
                seen = not segment_meets_box(found.origin, to, 1.0, world.surfaces.lower, world.surfaces.upper)
                if wp.static(not waits):
                    if not seen:
                        s.shadow_queries += 1
                        length = wp.length(to)
                        hidden = faces.hides(world.surfaces, found.origin, to / length, length)
                        found.contribution.value = wp.where(hidden, 0.0, found.contribution.value)
                        seen = True
        return seen

    @wp.func
    def serve(s: PhotonRef, request: Request, world: WorldRef, sink: SinkRef):
        found = score(request, world)
        if request.wanted and not found.contribution.value <= 0.0:  # NaN is counted as such
            s.contributions += 1
            if is_seen(s, found, world):
                if not found.contribution.value <= 0.0:
                    deposit(s.account, sink, world, found.contribution)
            else:
                s.hidden = True
                s.origin = found.origin
                s.lens = found.lens
                s.pending = found.contribution
        if wp.static(reflects):
            score_images(s, request, world, sink)

    return serve
