"""Rays against a triangle mesh; the Lambertian surface and the pattern on it."""

import warp as wp

from spadwarp_kernels.intersect.bvh import (
    FINISHED,
    Stack,
    face_distance,
    face_in,
    face_normal,
    inverse_direction,
    walk_node,
)

_INV_PI = wp.constant(0.3183098861837907)


@wp.struct
class Textures:
    """Images on faces; arrays of length 0 where there are none.

    Attributes:
        face: Texture of each face, -1 for none.
        coordinates: (u, v) of the corners of each face, [faces, 3]; u to the right, v up, images repeat with period 1.
        region: (offset into `texels`, width, height) of each texture.
        texels: Reflectance factors in [0, 1], row after row from the top.
    """

    face: wp.array(dtype=int)
    coordinates: wp.array2d(dtype=wp.vec2)
    region: wp.array(dtype=wp.vec3i)
    texels: wp.array(dtype=float)


@wp.struct
class Surfaces:
    """The target as the kernels take it, see `make_surfaces`.

    Attributes:
        mesh: Id of a `wp.Mesh`.
        lower, upper: Its bounding box [m], padded against rounding.
        nodes, faces, order: The mesh's tree, see `bvh`.
        reflectance: Of each face, in [0, 1].
        near_depth: What the camera cannot miss, see `near_depth_map`; empty if nothing is known.
        corner_reflectance: At the three corners of each face, in place of `reflectance`; empty unless it varies.
        textures: Images that multiply the corners' reflectance.
        specular: Reflectance of the facets of the specular lobe, of each face; empty if there is none.
        roughness: Their width parameter, see `microfacet`.
    """

    mesh: wp.uint64
    lower: wp.vec3
    upper: wp.vec3
    nodes: wp.array(dtype=wp.vec4)
    faces: wp.array(dtype=wp.vec4)
    order: wp.array(dtype=int)
    reflectance: wp.array(dtype=float)
    near_depth: wp.array2d(dtype=float)
    corner_reflectance: wp.array(dtype=wp.vec3)
    textures: Textures
    specular: wp.array(dtype=float)
    roughness: wp.array(dtype=float)


@wp.struct
class SurfaceHit:
    """Nearest surface along a ray.

    Attributes:
        distance: [m].
        normal: Unit vector on the ray's side.
        face: Its index; -1 for a miss.
        slot: Its place in the order of the mesh's tree, where that was walked; -1 for a miss.
    """

    distance: float
    normal: wp.vec3
    face: int
    slot: int


@wp.func
def intersect_mesh(mesh: wp.uint64, x: wp.vec3, u: wp.vec3, max_distance: float) -> SurfaceHit:
    """Nearest hit of the ray x + s u, 0 <= s < max_distance, against the BVH of a `wp.Mesh`."""
    hit = SurfaceHit()
    hit.face = -1
    hit.slot = -1
    hit.distance = max_distance
    query = wp.mesh_query_ray(mesh, x, u, max_distance)
    if query.result:
        hit.face = query.face
        hit.distance = query.t
        hit.normal = wp.where(wp.dot(query.normal, u) > 0.0, -query.normal, query.normal)
    return hit


@wp.func
def intersect_faces(surfaces: Surfaces, x: wp.vec3, u: wp.vec3, max_distance: float) -> SurfaceHit:
    """As `intersect_mesh`, by trying every face: faster than a tree for a handful of them on a GPU."""
    hit = SurfaceHit()
    hit.face = -1
    hit.slot = -1
    hit.distance = max_distance
    nearest = int(-1)
    for slot in range(surfaces.order.shape[0]):
        distance = face_distance(surfaces.faces, slot, x, u)
        if distance >= 0.0 and distance < hit.distance:
            hit.distance = distance
            nearest = slot
    if nearest >= 0:
        hit.slot = nearest
        hit.face = face_in(surfaces.order, nearest)
        hit.normal = face_normal(surfaces.faces, nearest, u)
    return hit


@wp.func
def intersect_surfaces(surfaces: Surfaces, x: wp.vec3, u: wp.vec3, max_distance: float, any_hit: bool) -> SurfaceHit:
    """As `intersect_mesh`, with the tree of `make_surfaces`; `any_hit` is content with the first face that is found.

    Boxes and faces are a hair wider than they are, so that also rays aimed at vertices and along edges are caught.
    """
    hit = SurfaceHit()
    hit.face = -1
    hit.slot = -1
    distance = float(max_distance)
    found = int(-1)
    stack = Stack()
    stack[0] = FINISHED
    depth = int(1)
    node = int(0)
    inverse = inverse_direction(u)
    shift = wp.cw_mul(x, inverse)
    while node != FINISHED:
        if node > FINISHED:
            near, far = walk_node(surfaces.nodes, node, inverse, shift, distance)
            node = near
            if far != FINISHED:
                stack[depth] = far
                depth += 1
        else:
            slot = -2 - node
            struck = face_distance(surfaces.faces, slot, x, u)
            if struck >= 0.0 and struck < distance:
                distance = struck
                found = slot
                if any_hit:
                    depth = 1
            node = wp.where(surfaces.order[slot] < 0, node - 1, FINISHED)  # the next face of the leaf
        if node == FINISHED and depth > 0:
            depth -= 1
            node = stack[depth]
    hit.distance = distance
    if found >= 0:
        hit.slot = found
        hit.face = face_in(surfaces.order, found)
        hit.normal = face_normal(surfaces.faces, found, u)
    return hit


@wp.func
def segment_meets_box(x: wp.vec3, u: wp.vec3, length: float, lower: wp.vec3, upper: wp.vec3) -> bool:
    """False only if the segment x + s u, 0 <= s <= length, misses the box; the box must be padded against rounding."""
    near = float(0.0)
    far = float(length)
    for i in range(3):
        d = u[i]
        if wp.abs(d) < 1.0e-12:
            d = 1.0e-12
        inverse = 1.0 / d
        a = (lower[i] - x[i]) * inverse
        b = (upper[i] - x[i]) * inverse
        near = wp.max(near, wp.min(a, b))
        far = wp.min(far, wp.max(a, b))
    return near <= far


@wp.func
def offset_from_surface(x: wp.vec3, normal: wp.vec3, distance: float) -> wp.vec3:
    """x moved off the surface along the normal by a bound of its float32 error, so that a new ray does not hit the
    same face.

    The error of x + s u grows with the coordinates and with s: a few units in the last place of either.
    """
    magnitude = wp.max(wp.max(wp.abs(x[0]), wp.abs(x[1])), wp.abs(x[2]))
    return x + (5.0e-7 * (magnitude + distance)) * normal


@wp.func
def lambert_brdf(reflectance: float) -> float:
    """Lambertian f = reflectance/pi [1/sr]; times cos(theta_out) it is the density per steradian of the reflected
    weight."""
    return reflectance * _INV_PI


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
