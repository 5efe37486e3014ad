"""Lambertian reflectance at a point of the target: by face, or a pattern of corners and textures."""

import warp as wp

from .mesh import Surfaces, Textures


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
def texture_at(textures: Textures, index: int, uv: wp.vec2) -> float:
    """Bilinear value of a repeating texture; its corners are at uv = (0, 0) and (1, 1), texel centres half a texel
    inside."""
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
        index = surfaces.textures.face[face]
        if index >= 0:
            uv = shares[0] * surfaces.textures.coordinates[face, 0]
            uv += shares[1] * surfaces.textures.coordinates[face, 1]
            uv += shares[2] * surfaces.textures.coordinates[face, 2]
            value *= texture_at(surfaces.textures, index, uv)
    return value


@wp.func
def reflectance_at(surfaces: Surfaces, face: int, x: wp.vec3) -> float:
    """Lambertian reflectance at the point x of a face, whether it varies or not."""
    if surfaces.corner_reflectance.shape[0] > 0:
        return pattern_reflectance(surfaces, face, x)
    return surfaces.reflectance[face]
