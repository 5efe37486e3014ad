"""Scores of a photon's history: the sum of d ln f/d parameter over the flights and the events f that its light has met.

With the density that photons are drawn from held fixed, the derivative of their expected light is the expectation of
light times score: -L for absorption, n/b - L for scattering (L the path in the water, n the scatterings there), the sum
of d ln p/dg over the scatterings, and one over the reflectance for each bounce.
"""

import warp as wp

from spadwarp_kernels.math.once import made_once
from spadwarp_kernels.math.rotations import one_minus_cosine, snap_from
from spadwarp_kernels.medium.layers import Layers, boundary_ahead, layer_index
from spadwarp_kernels.medium.water import Medium
from spadwarp_kernels.phase.henyey_greenstein import henyey_greenstein_score
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.surface.ggx import ggx_brdf
from spadwarp_kernels.surface.lambert import lambert_brdf
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.reflectance import face_reflectance, pattern_reflectance
from spadwarp_kernels.tally.scores import Derivatives
from spadwarp_kernels.tally.tally import Scores


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


@made_once
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


@made_once
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
                score = henyey_greenstein_score(t, derivatives.value[p])
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
