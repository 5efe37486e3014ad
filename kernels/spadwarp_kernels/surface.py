"""Rays against a triangle mesh and the Lambertian surface."""

import warp as wp

_INV_PI = wp.constant(0.3183098861837907)


@wp.struct
class SurfaceHit:
    """Nearest surface along a ray: distance [m], the unit normal on the ray's side, the face's index; `face` is -1 for
    a miss."""

    distance: float
    normal: wp.vec3
    face: int


@wp.func
def intersect_mesh(mesh: wp.uint64, x: wp.vec3, u: wp.vec3, max_distance: float) -> SurfaceHit:
    """Nearest hit of the ray x + s u, 0 <= s < max_distance, against the BVH of a `wp.Mesh`."""
    hit = SurfaceHit()
    hit.face = -1
    hit.distance = max_distance
    query = wp.mesh_query_ray(mesh, x, u, max_distance)
    if query.result:
        hit.face = query.face
        hit.distance = query.t
        hit.normal = wp.where(wp.dot(query.normal, u) > 0.0, -query.normal, query.normal)
    return hit


@wp.func
def intersect_faces(mesh: wp.uint64, x: wp.vec3, u: wp.vec3, max_distance: float) -> SurfaceHit:
    """As `intersect_mesh`, by trying every face: faster than a BVH for a handful of them (Möller & Trumbore 1997)."""
    hit = SurfaceHit()
    hit.face = -1
    hit.distance = max_distance
    faces = wp.mesh_get(mesh)
    for face in range(faces.indices.shape[0] // 3):
        p = faces.points[faces.indices[3 * face]]
        e1 = faces.points[faces.indices[3 * face + 1]] - p
        e2 = faces.points[faces.indices[3 * face + 2]] - p
        h = wp.cross(u, e2)
        inverse = 1.0 / wp.dot(e1, h)  # infinite for a ray in the plane, which then fails the comparisons
        to_x = x - p
        a = wp.dot(to_x, h) * inverse
        q = wp.cross(to_x, e1)
        b = wp.dot(u, q) * inverse
        distance = wp.dot(e2, q) * inverse
        # A hair more than the triangle, so that no ray slips between two.
        inside = a >= -1.0e-6 and b >= -1.0e-6 and a + b <= 1.000001
        if inside and distance >= 0.0 and distance < hit.distance:
            hit.face = face
            hit.distance = distance
            normal = wp.normalize(wp.cross(e1, e2))
            hit.normal = wp.where(wp.dot(normal, u) > 0.0, -normal, normal)
    return hit


@wp.func
def intersect_mesh_aimed(mesh: wp.uint64, x: wp.vec3, u: wp.vec3, max_distance: float) -> SurfaceHit:
    """`intersect_mesh` for rays that may be aimed exactly at vertices or edges: a miss is tried again with u nudged by
    1e-5.

    The slab test of the BVH walk is not conservative, so that a ray in the plane of a flat bounding box can slip
    through.
    Sampled rays meet such a plane with negligible probability and do without the second query.
    """
    hit = intersect_mesh(mesh, x, u, max_distance)
    if hit.face < 0:
        nudged = wp.normalize(u + wp.vec3(0.9e-5, -0.6e-5, 0.7e-5))
        hit = intersect_mesh(mesh, x, nudged, max_distance)
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
