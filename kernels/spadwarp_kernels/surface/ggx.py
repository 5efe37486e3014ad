"""A rough specular lobe: mirror-like facets with the GGX distribution of slopes and Smith's shadowing.

Walter et al. 2007 (GGX), Heitz 2014 (masking and shadowing that know of each other), Dupuy & Benyoub 2023 (sampling of
the visible facets). The facets reflect the same fraction at every angle, and so this fraction bounds the lobe's albedo.

`u` is the direction in which the light comes (towards the surface), `v` the one in which it leaves, both unit vectors;
`n` is the unit normal on the side of the light. `roughness` is Walter's width parameter alpha: half of the facets are
tilted by less than atan(alpha).
"""

import warp as wp

from spadwarp_kernels.math.rotations import cos_sin_turn, orthonormal_basis
from spadwarp_kernels.random.philox import u01

from .lambert import sample_lambert

_INV_PI = wp.constant(0.3183098861837907)


@wp.func
def ggx_slope_length(cosine: float, roughness: float) -> float:
    """sqrt(cos^2 + alpha^2 sin^2): with it Smith's 1 + Lambda = (cos + this)/(2 cos), finite at grazing incidence."""
    c2 = cosine * cosine
    return wp.sqrt(c2 + roughness * roughness * wp.max(1.0 - c2, 0.0))


@wp.func
def ggx_normals(h: wp.vec3, n: wp.vec3, roughness: float) -> float:
    """D(h), density of facet normals [1/sr]: the integral of D cos(theta_h) over the hemisphere is 1 (Walter eq 33).

    The sine comes from a cross product, so that narrow lobes keep their shape in float32.
    """
    cosine = wp.dot(h, n)
    if cosine <= 0.0:
        return 0.0
    across = wp.cross(h, n)
    a2 = roughness * roughness
    q = cosine * cosine + wp.dot(across, across) / a2
    return _INV_PI / (a2 * q * q)


@wp.func
def ggx_brdf(u: wp.vec3, v: wp.vec3, n: wp.vec3, roughness: float) -> float:
    """D G/(4 cos_in cos_out) [1/sr] of facets that reflect everything; 0 unless both directions lie on n's side."""
    cos_in = -wp.dot(u, n)
    cos_out = wp.dot(v, n)
    if cos_in <= 0.0 or cos_out <= 0.0:
        return 0.0
    h = wp.normalize(v - u)
    slopes = cos_out * ggx_slope_length(cos_in, roughness) + cos_in * ggx_slope_length(cos_out, roughness)
    return 0.5 * ggx_normals(h, n, roughness) / slopes


@wp.func
def ggx_pdf(u: wp.vec3, v: wp.vec3, n: wp.vec3, roughness: float) -> float:
    """Density [1/sr] of `sample_ggx` at v, which may lie below the surface; its integral over the sphere is 1."""
    cos_in = wp.max(-wp.dot(u, n), 0.0)
    h = wp.normalize(v - u)
    return 0.5 * ggx_normals(h, n, roughness) / (cos_in + ggx_slope_length(cos_in, roughness))


@wp.func
def sample_ggx(u: wp.vec3, n: wp.vec3, roughness: float, xi1: float, xi2: float) -> wp.vec3:
    """u mirrored by one of the facets that it sees, for uniform xi1, xi2 in [0, 1); the result may point into the
    surface, where other facets take the light."""
    b1, b2 = orthonormal_basis(n)
    cos_in = wp.max(-wp.dot(u, n), 0.0)
    # The facets are a squashed hemisphere: stretched back, the visible ones are a cap of the unit sphere moved by w.
    w = wp.normalize(wp.vec3(-roughness * wp.dot(u, b1), -roughness * wp.dot(u, b2), cos_in))
    z = (1.0 - xi1) * (1.0 + w[2]) - w[2]
    r = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    turn = cos_sin_turn(xi2)
    m = wp.vec3(r * turn[0], r * turn[1], z) + w
    h = wp.normalize((roughness * m[0]) * b1 + (roughness * m[1]) * b2 + wp.max(m[2], 1.0e-9) * n)
    return wp.normalize(u - (2.0 * wp.dot(u, h)) * h)


@wp.func
def sample_reflection(u: wp.vec3, n: wp.vec3, roughness: float, lobe: float, random: wp.vec4ui) -> wp.vec3:
    """A direction of `sample_ggx` with the chance `lobe`, else of `sample_lambert`."""
    xi1 = u01(random[1])
    xi2 = u01(random[2])
    if u01(random[0]) < lobe:
        return sample_ggx(u, n, roughness, xi1, xi2)
    return sample_lambert(n, xi1, xi2)


@wp.func
def reflection_pdf(u: wp.vec3, v: wp.vec3, n: wp.vec3, roughness: float, lobe: float) -> float:
    """Density [1/sr] of `sample_reflection` at v; its integral over the sphere is 1."""
    lambert = wp.max(wp.dot(v, n), 0.0) * _INV_PI
    return (1.0 - lobe) * lambert + lobe * ggx_pdf(u, v, n, roughness)


@wp.func
def unshadowed(u: wp.vec3, v: wp.vec3, n: wp.vec3, roughness: float, lobe: float) -> float:
    """Part of the light that `sample_reflection` sends to v that leaves the surface, in [0, 1]: BRDF times cosine over
    density, over the sum of both reflectances."""
    cos_out = wp.dot(v, n)
    if cos_out <= 0.0:
        return 0.0
    lambert = (1.0 - lobe) * cos_out * _INV_PI
    reflected = lambert + lobe * ggx_brdf(u, v, n, roughness) * cos_out
    return wp.min(reflected / wp.max(lambert + lobe * ggx_pdf(u, v, n, roughness), 1.0e-30), 1.0)
