"""The Lambertian surface: its reflectance distribution, and directions drawn from it."""

import warp as wp

from spadwarp_kernels.base.philox import u01
from spadwarp_kernels.base.rotations import cos_sin_turn, orthonormal_basis, rotate_direction

from .mesh import Surfaces, Textures

_INV_PI = wp.constant(0.3183098861837907)


@wp.func
def lambert_brdf(reflectance: float) -> float:
    """f = reflectance/pi [1/sr]; times cos(theta_out) it is the density of the reflected weight."""
    return reflectance * _INV_PI


@wp.func
def sample_cosine_law(xi: float) -> float:
    """t = 1 - cos(theta) of the angle to the normal, drawn from cos(theta)/pi [1/sr], for uniform xi in [0, 1)."""
    return xi / (1.0 + wp.sqrt(1.0 - xi))


@wp.func
def sample_lambert(normal: wp.vec3, xi1: float, xi2: float) -> wp.vec3:
    """A unit vector about the unit normal with density cos(theta)/pi, for uniform xi1, xi2 in [0, 1)."""
    return rotate_direction(normal, sample_cosine_law(xi1), xi2)


# ---- A rough specular lobe: mirror-like facets with the GGX distribution of slopes and Smith's shadowing.


@wp.func
def ggx_slope_length(cosine: float, roughness: float) -> float:
    """sqrt(cos^2 + alpha^2 sin^2): with it Smith's 1 + Lambda = (cos + this)/(2 cos), finite at grazing incidence."""
    c2 = cosine * cosine
    return wp.sqrt(c2 + roughness * roughness * wp.max(1.0 - c2, 0.0))


@wp.func
def ggx_normals(h: wp.vec3, n: wp.vec3, roughness: float) -> float:
    """D(h), density of facet normals [1/sr]: the integral of D cos(theta_h) over the hemisphere is 1 (Walter eq 33).
    The sine comes from a cross product, so that narrow lobes keep their shape in float32."""
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


# ---- Lambertian reflectance at a point of the target: by face, or a pattern of corners and textures.


@wp.func
def barycentric(mesh: wp.uint64, face: int, x: wp.vec3) -> wp.vec3:
    """Shares of a face's three corners in the point of its plane below x, each in [0, 1], sum 1."""
    m = wp.mesh_get(mesh)
    p = m.points[m.indices[3 * face]]
    e1 = m.points[m.indices[3 * face + 1]] - p
    e2 = m.points[m.indices[3 * face + 2]] - p
    n = wp.cross(e1, e2)
    inverse = 1.0 / wp.dot(n, n)
    b = wp.clamp(wp.dot(wp.cross(x - p, e2), n) * inverse, 0.0, 1.0)
    c = wp.clamp(wp.dot(wp.cross(e1, x - p), n) * inverse, 0.0, 1.0 - b)
    return wp.vec3(1.0 - b - c, b, c)


@wp.func
def texture_at(textures: Textures, face: int, shares: wp.vec3) -> float:
    """Bilinear value of a face's repeating texture at a point with these shares of its corners, 1 without a texture;
    its corners are at uv = (0, 0) and (1, 1), texel centres half a texel inside."""
    index = textures.face[face]
    if index < 0:
        return 1.0
    uv = shares[0] * textures.coordinates[face, 0]
    uv += shares[1] * textures.coordinates[face, 1]
    uv += shares[2] * textures.coordinates[face, 2]
    region = textures.region[index]
    width = region[1]
    height = region[2]
    column = (uv[0] - wp.floor(uv[0])) * float(width) - 0.5
    row = (1.0 - (uv[1] - wp.floor(uv[1]))) * float(height) - 0.5
    left = wp.floor(column)
    top = wp.floor(row)
    x0 = (int(left) + width) % width
    y0 = (int(top) + height) % height
    x1 = (x0 + 1) % width
    y1 = (y0 + 1) % height
    start = region[0]
    upper = wp.lerp(textures.texels[start + y0 * width + x0], textures.texels[start + y0 * width + x1], column - left)
    lower = wp.lerp(textures.texels[start + y1 * width + x0], textures.texels[start + y1 * width + x1], column - left)
    return wp.lerp(upper, lower, row - top)


@wp.func
def face_reflectance(surfaces: Surfaces, face: int, x: wp.vec3) -> float:
    """Lambertian reflectance of a face, the same all over it."""
    return surfaces.reflectance[face]


@wp.func
def pattern_reflectance(surfaces: Surfaces, face: int, x: wp.vec3) -> float:
    """Lambertian reflectance at the point x of a face: its corners' interpolated, times its texture."""
    shares = barycentric(surfaces.mesh, face, x)
    corners = surfaces.corner_reflectance[face]
    # Differences, so that equal corners give their value to the bit.
    value = corners[0] + shares[1] * (corners[1] - corners[0]) + shares[2] * (corners[2] - corners[0])
    if surfaces.textures.face.shape[0] > 0:
        value *= texture_at(surfaces.textures, face, shares)
    return value


@wp.func
def reflectance_at(surfaces: Surfaces, face: int, x: wp.vec3) -> float:
    """Lambertian reflectance at the point x of a face, whether it varies or not."""
    if surfaces.corner_reflectance.shape[0] > 0:
        return pattern_reflectance(surfaces, face, x)
    return surfaces.reflectance[face]
