"""Scores of a next event: from what was asked for and the point that it has come to."""

import warp as wp

from spadwarp_kernels.intersect.triangle import face_in, face_normal
from spadwarp_kernels.math.once import made_once
from spadwarp_kernels.medium.layers import Layers
from spadwarp_kernels.medium.water import Medium
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.tally.scores import Derivatives
from spadwarp_kernels.tally.tally import Scores

from .history import make_event_scores, make_flight_scores


@made_once
def make_turn_scores(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(scores, x, u, v, slot, derivatives, medium, layers, surfaces) -> Scores`` after an event at
    x that turns light from u to v, on the face of a slot of the mesh's tree or (-1) in the water."""
    has_mesh = spec.mesh
    event_scores = make_event_scores(spec)

    @wp.func
    def turn_scores(
        scores: Scores,
        x: wp.vec3,
        u: wp.vec3,
        v: wp.vec3,
        slot: int,
        derivatives: Derivatives,
        medium: Medium,
        layers: Layers,
        surfaces: Surfaces,
    ) -> Scores:
        face = int(-1)
        normal = wp.vec3()
        if wp.static(has_mesh):
            if slot >= 0:
                face = face_in(surfaces.order, slot)
                normal = face_normal(surfaces.faces, slot, u)
        return event_scores(scores, derivatives, medium, layers, surfaces, face, normal, x, u, v)

    return turn_scores


@made_once
def make_request_scores(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(scores, x, u, slot, point, end, derivatives, medium, layers, surfaces) -> Scores`` of light
    that goes from x along u to the point that is scored, scatters there, and leaves the water at the end.

    `slot`: as of `make_turn_scores`; `x` and the point are one for events.
    """
    flight_scores, turn_scores = make_flight_scores(spec), make_turn_scores(spec)

    @wp.func
    def request_scores(
        scores: Scores,
        x: wp.vec3,
        u: wp.vec3,
        slot: int,
        point: wp.vec3,
        end: wp.vec3,
        derivatives: Derivatives,
        medium: Medium,
        layers: Layers,
        surfaces: Surfaces,
    ) -> Scores:
        length = wp.length(end - point)
        v = (end - point) / length
        scores = flight_scores(scores, derivatives, layers, x, u, wp.length(point - x))
        scores = turn_scores(scores, point, u, v, slot, derivatives, medium, layers, surfaces)
        return flight_scores(scores, derivatives, layers, point, v, length)

    return request_scores
