"""More points of a flight than one: each is scored with its part of the weight.

What a pixel's bin holds is noisy above all since few flights are scored in it; the points of a flight lie in others.
"""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.optics.camera import Camera, Gate
from spadwarp_kernels.optics.laser import Scan
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState
from spadwarp_kernels.riders.polarisation import Polarisation
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.ray_cast import intersect_surfaces
from spadwarp_kernels.tally.scores import Derivatives, make_deposit
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import Layers, Medium

from .contribution import Request
from .mirrored import AddedScores


@memoised
def make_point_of(points: int) -> wp.Function:
    """The Warp function ``(request, number) -> Request``: of a flight, that of another of its `points`, at least 2.

    Both random numbers of a point are a part of 1 further than those of the one before, modulo 1: those of each are
    uniform, and together they are spread evenly (systematic sampling).
    """
    step = wp.uint32((1 << 32) // points)

    @wp.func
    def point_of(request: Request, number: int) -> Request:
        other = request
        other.first = request.first + wp.uint32(number) * wp.static(step)
        other.second = request.second + wp.uint32(number) * wp.static(step)
        return other

    return point_of


@memoised
def make_push_points(points: int, push: wp.Function) -> wp.Function:
    """The Warp function ``(memory, request)``: `push` of `make_queue` for each of the points of a flight."""
    if points == 1:
        return push
    point_of = make_point_of(points)

    @wp.func
    def push_points(memory: int, request: Request):
        push(memory, request)
        for i in range(wp.static(points - 1)):
            push(memory, point_of(request, i + 1))

    return push_points


@memoised
def make_ask_flight(request_flight: wp.Function | None, push: wp.Function) -> wp.Function | None:
    """The Warp function ``(s, memory) -> Request`` that asks for a flight to be scored, once; None where none is."""
    if request_flight is None:
        return None

    @wp.func
    def ask_flight(s: wp.ref[PhotonState], memory: int) -> Request:
        request = request_flight(s)
        push(memory, request)
        s.flight.interval = wp.vec2(0.0, 0.0)
        return request

    return ask_flight


@memoised
def make_score_points(
    spec: TransportSpec, score: wp.Function, look: wp.Function, split_accumulators: bool
) -> wp.Function:
    """The Warp function with the arguments of `make_score_images` that scores a flight at all points but the first,
    where each thread scores its own requests; shadow rays are traced on the spot."""
    points, point_of = spec.points, make_point_of(spec.points)
    deposit = make_deposit(spec.signed, 0, split_accumulators)
    has_mesh = spec.mesh

    @wp.func
    def score_points(
        request: Request,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        surfaces: Surfaces,
        scan: Scan,
        derivatives: Derivatives,
        polarisation: Polarisation,
        tally: wp.array(dtype=wp.int64),
        low: wp.array(dtype=wp.uint32),
        gradients: wp.array(dtype=wp.int64),
        ledger: wp.array(dtype=wp.int64),
        pending_add: wp.vec2l,
        thread: int,
        scale: float,
    ) -> AddedScores:
        scores = AddedScores()
        scores.pending_add = pending_add
        if request.wanted and request.interval[0] < request.interval[1]:
            for i in range(wp.static(points - 1)):
                other = point_of(request, i + 1)
                found = score(other, medium, layers, camera, gate, surfaces, scan, derivatives, polarisation)
                if not found.contribution.value <= 0.0:  # NaN is counted as such
                    scores.contributions += 1
                    found = look(found, camera, surfaces)
                    scores.shadow_queries += found.shadow_queries
                    if wp.static(has_mesh):
                        if not found.seen:
                            to = found.lens - found.origin
                            way = wp.length(to)
                            scores.shadow_queries += 1
                            hit = intersect_surfaces(surfaces, found.origin, to / way, way, True)
                            found.seen = hit.face < 0
                    if found.seen and not found.contribution.value <= 0.0:
                        scores.pending_add = deposit(
                            tally,
                            low,
                            gradients,
                            ledger,
                            scores.pending_add,
                            thread,
                            scale,
                            derivatives,
                            found.contribution,
                        )
        return scores

    return score_points
