"""What events do to a Stokes vector: scattering in the water, surfaces, faces of the domain."""

import warp as wp

from spadwarp_kernels.intersect.triangle import face_in, face_normal
from spadwarp_kernels.math.once import made_once
from spadwarp_kernels.math.rotations import one_minus_cosine, set_apart
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.surface.ggx import ggx_brdf
from spadwarp_kernels.surface.lambert import lambert_brdf
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.reflectance import face_reflectance, pattern_reflectance

from .fresnel import facet_elements, fresnel_elements
from .request import Polarisation
from .stokes import table_elements, turn_stokes


@made_once
def make_event_stokes(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(stokes, polarisation, surfaces, slot, x, u, v) -> vec4`` of light that an event at x has
    turned from u to v, on the face of a slot of the mesh's tree or (-1) in the water.

    Water multiplies by L M L/m11. A Lambertian surface depolarises; a specular lobe has Fresnel's matrix of the facet
    between u and v, over its m11; both in proportion to what they send to v.
    """
    has_mesh, specular = spec.mesh, spec.specular
    reflectance_at = pattern_reflectance if spec.pattern else face_reflectance

    @wp.func
    def surface_stokes(
        stokes: wp.vec4, polarisation: Polarisation, surfaces: Surfaces, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3
    ) -> wp.vec4:
        left = wp.vec4(stokes[0], 0.0, 0.0, 0.0)
        if wp.static(specular):
            face = face_in(surfaces.order, slot)
            normal = face_normal(surfaces.faces, slot, u)
            lambert = lambert_brdf(reflectance_at(surfaces, face, x))
            lobe = surfaces.specular[face] * ggx_brdf(u, v, normal, surfaces.roughness[face])
            turned = turn_stokes(stokes, u, v, facet_elements(u, v, polarisation.facet_index[face]))
            left += (lobe / wp.max(lambert + lobe, 1.0e-30)) * (turned - left)
        return left

    @wp.func
    def event_stokes(
        stokes: wp.vec4, polarisation: Polarisation, surfaces: Surfaces, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3
    ) -> wp.vec4:
        before, after = set_apart(u), set_apart(v)
        if wp.static(has_mesh):
            if slot >= 0:
                return surface_stokes(stokes, polarisation, surfaces, slot, set_apart(x), before, after)
        m = table_elements(polarisation.first, polarisation.last, one_minus_cosine(before, after))
        return turn_stokes(stokes, before, after, m)

    return event_stokes


@made_once
def make_reflected_stokes() -> wp.Function:
    """The Warp function ``(stokes, u, v, index) -> vec4`` of light that a smooth boundary mirrors from u to v, for the
    index behind it over that of the water."""

    @wp.func
    def reflected_stokes(stokes: wp.vec4, u: wp.vec3, v: wp.vec3, index: float) -> wp.vec4:
        before, after = set_apart(u), set_apart(v)
        cosine = wp.sqrt(0.5 * wp.max(1.0 - wp.dot(before, after), 0.0))
        return turn_stokes(stokes, before, after, fresnel_elements(wp.min(cosine, 1.0), index))

    return reflected_stokes
