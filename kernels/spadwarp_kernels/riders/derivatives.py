"""Scores of a next event: from what was asked for and the point that it has come to."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.rotations import one_minus_cosine, snap_from
from spadwarp_kernels.optics.camera import Camera
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.reflectance import face_reflectance, ggx_brdf, lambert_brdf, pattern_reflectance
from spadwarp_kernels.surface.triangle import face_in, face_normal
from spadwarp_kernels.tally.scores import Derivatives
from spadwarp_kernels.tally.tally import Scores
from spadwarp_kernels.water.medium import Layers, Medium, boundary_ahead, layer_index
from spadwarp_kernels.water.phase_functions import henyey_greenstein_log_derivative


@memoised
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


@memoised
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


# ---- Derivatives of a photon's history: the sum of d ln f/d parameter over the flights and events f of its light.


def parameters_of(spec: TransportSpec, *kinds: str) -> int:
    """Bit p is set where the derivative p of a spec is of one of these kinds.

    Bits, since a `wp.static` that reads the index of a loop does not enter the hash of Warp's kernel cache.
    """
    return sum(1 << p for p, kind in enumerate(spec.derivatives) if kind in kinds)


@wp.func
def _unchanged(
    scores: Scores, derivatives: Derivatives, layers: Layers, x: wp.vec3, u: wp.vec3, length: float
) -> Scores:
    return scores


@memoised
def make_flight_scores(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(scores, derivatives, layers, x, u, length) -> Scores`` after a way in the water."""
    if not spec.derivatives:
        return _unchanged
    count, layered = len(spec.derivatives), spec.layered
    on_path = parameters_of(spec, "absorption", "scattering")

    @wp.func
    def shorter(scores: Scores, parameters: int, length: float) -> Scores:
        for p in range(wp.static(count)):
            if (parameters >> p) & 1 == 1:
                scores[p] = scores[p] - length
        return scores

    @wp.func
    def flight_scores(
        scores: Scores, derivatives: Derivatives, layers: Layers, x: wp.vec3, u: wp.vec3, length: float
    ) -> Scores:
        if wp.static(not layered):
            return shorter(scores, wp.static(on_path), length)
        along = wp.dot(layers.axis, x)
        slope = wp.dot(layers.axis, u)
        step = wp.where(slope > 0.0, 1, -1)
        layer = layer_index(layers, along)
        begin = float(0.0)
        boundary = boundary_ahead(layers, layer, step, along, slope)
        while boundary < length:
            scores = shorter(scores, derivatives.waters[layer] & wp.static(on_path), boundary - begin)
            layer += step
            begin = boundary
            boundary = boundary_ahead(layers, layer, step, along, slope)
        return shorter(scores, derivatives.waters[layer] & wp.static(on_path), length - begin)

    return flight_scores


@memoised
def make_event_scores(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(scores, derivatives, medium, layers, surfaces, face, normal, x, u, v) -> Scores`` after an
    event at x that has turned light from u to v, on a face or (-1) in the water."""
    count, layered, has_mesh, specular = len(spec.derivatives), spec.layered, spec.mesh, spec.specular
    by_scattering, by_anisotropy, by_reflectance = (
        parameters_of(spec, kind) for kind in ("scattering", "anisotropy", "reflectance")
    )
    in_water = by_scattering | by_anisotropy
    reflectance_at = pattern_reflectance if spec.pattern else face_reflectance

    @wp.func
    def water_scores(
        scores: Scores, derivatives: Derivatives, medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, v: wp.vec3
    ) -> Scores:
        here = int(wp.static(in_water))
        if wp.static(layered):
            here = here & derivatives.waters[layer_index(layers, wp.dot(layers.axis, x))]
        t = one_minus_cosine(snap_from(u, medium.axis_threshold), v)
        for p in range(wp.static(count)):
            if (wp.static(by_scattering) >> p) & 1 == 1:
                scores[p] = scores[p] + wp.where((here >> p) & 1 == 1, 1.0 / derivatives.value[p], 0.0)
            if (wp.static(by_anisotropy) >> p) & 1 == 1:
                score = henyey_greenstein_log_derivative(t, derivatives.value[p])
                scores[p] = scores[p] + wp.where((here >> p) & 1 == 1, score, 0.0)
        return scores

    @wp.func
    def surface_scores(
        scores: Scores,
        derivatives: Derivatives,
        surfaces: Surfaces,
        face: int,
        normal: wp.vec3,
        x: wp.vec3,
        u: wp.vec3,
        v: wp.vec3,
    ) -> Scores:
        # The Lambertian part of the light that is reflected.
        part = float(1.0)
        if wp.static(specular):
            lambert = lambert_brdf(reflectance_at(surfaces, face, x))
            both = lambert + surfaces.specular[face] * ggx_brdf(u, v, normal, surfaces.roughness[face])
            part = lambert / wp.max(both, 1.0e-30)
        here = derivatives.faces[face]
        for p in range(wp.static(count)):
            if (wp.static(by_reflectance) >> p) & 1 == 1:
                scores[p] = scores[p] + wp.where((here >> p) & 1 == 1, part / derivatives.value[p], 0.0)
        return scores

    @wp.func
    def event_scores(
        scores: Scores,
        derivatives: Derivatives,
        medium: Medium,
        layers: Layers,
        surfaces: Surfaces,
        face: int,
        normal: wp.vec3,
        x: wp.vec3,
        u: wp.vec3,
        v: wp.vec3,
    ) -> Scores:
        if wp.static(has_mesh):
            if face >= 0:
                if wp.static(by_reflectance > 0):
                    scores = surface_scores(scores, derivatives, surfaces, face, normal, x, u, v)
                return scores
        if wp.static(in_water > 0):
            scores = water_scores(scores, derivatives, medium, layers, x, u, v)
        return scores

    return event_scores


# ---- Scores of a photon that enters the aperture itself.


@wp.func
def _to_lens(camera: Camera, x: wp.vec3, u: wp.vec3) -> float:
    return -x[2] / u[2]


@memoised
def make_to_lens(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(camera, x, u) -> float``: the way in water of a photon at x whose flight along u leads to
    the lens [m]."""
    if spec.port is None:
        return _to_lens
    leave = spec.port.leave

    @wp.func
    def to_port(camera: Camera, x: wp.vec3, u: wp.vec3) -> float:
        return leave(camera.port, x, u).water

    return to_port


@memoised
def make_crossing_scores(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, camera, layers, derivatives) -> Scores`` of a photon whose flight leads to the lens."""
    flight_scores, to_lens = make_flight_scores(spec), make_to_lens(spec)

    @wp.func
    def crossing_scores(s: PhotonState, camera: Camera, layers: Layers, derivatives: Derivatives) -> Scores:
        return flight_scores(s.scores, derivatives, layers, s.x, s.u, to_lens(camera, s.x, s.u))

    return crossing_scores
