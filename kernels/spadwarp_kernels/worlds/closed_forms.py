"""Rays against shapes in their own frame, in closed form: the nearest point at which a ray meets the surface.

Shapes are centred at the origin and stand along z, as in Newton and MuJoCo. Surfaces have two sides. Here a ray is
x + s u for s > `least`, which may be negative.
"""

import warp as wp

__all__ = ["SHAPE_KINDS"]

SHAPE_KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "cone", "mesh")
PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, CONE, MESH = (wp.constant(i) for i in range(len(SHAPE_KINDS)))

_FAR = wp.constant(1.0e30)


@wp.struct
class ShapeHit:
    """Where a ray meets a shape."""

    distance: float  # along the ray [m]; -1 for a miss
    normal: wp.vec3  # unit vector, either side, in the frame of the ray
    face: int  # of a mesh; -1 for other shapes
    corner: wp.vec2  # barycentric shares of the first two corners of the face


@wp.func
def _miss() -> ShapeHit:
    hit = ShapeHit()
    hit.distance = _FAR
    hit.face = -1
    return hit


@wp.func
def _nearer(hit: ShapeHit, least: float, distance: float, normal: wp.vec3) -> ShapeHit:
    """The nearer of a hit and a point of the ray beyond `least`."""
    if distance > least and distance < hit.distance:
        hit.distance = distance
        hit.normal = normal
    return hit


@wp.func
def _roots(a: float, b: float, c: float) -> wp.vec2:
    """Solutions of a s^2 + 2 b s + c = 0, without cancellation; far away twice if there are none."""
    disc = b * b - a * c
    if disc < 0.0 or a == 0.0:
        return wp.vec2(_FAR, _FAR)
    q = -(b + wp.where(b < 0.0, -1.0, 1.0) * wp.sqrt(disc))
    if q == 0.0:
        return wp.vec2(0.0, 0.0)
    return wp.vec2(q / a, c / q)


@wp.func
def _intersect_plane(size: wp.vec3, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    """The plane z = 0."""
    hit = _miss()
    s = -x[2] / u[2]  # infinite or not a number for a ray along the plane, which fails below
    y = x + s * u
    inside = (size[0] <= 0.0 or wp.abs(y[0]) <= 0.5 * size[0]) and (size[1] <= 0.0 or wp.abs(y[1]) <= 0.5 * size[1])
    if inside:
        hit = _nearer(hit, least, s, wp.vec3(0.0, 0.0, 1.0))
    return hit


@wp.func
def _intersect_ball(
    hit: ShapeHit, z: float, radius: float, cut: float, x: wp.vec3, u: wp.vec3, least: float
) -> ShapeHit:
    """A sphere at a height z, of which counts what lies beyond |z| = cut on its side."""
    centre = wp.vec3(0.0, 0.0, z)
    y = x - centre
    along = -wp.dot(y, u)
    rest = y + along * u
    half2 = radius * radius - wp.dot(rest, rest)
    if half2 > 0.0:
        for k in range(2):
            s = along + (2.0 * float(k) - 1.0) * wp.sqrt(half2)
            height = x[2] + s * u[2]
            if cut <= 0.0 or (height * z >= 0.0 and wp.abs(height) >= cut):
                hit = _nearer(hit, least, s, (y + s * u) / radius)
    return hit


@wp.func
def _intersect_side(hit: ShapeHit, radius: float, half: float, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    """The side of a cylinder, |z| < half."""
    roots = _roots(u[0] * u[0] + u[1] * u[1], x[0] * u[0] + x[1] * u[1], x[0] * x[0] + x[1] * x[1] - radius * radius)
    for k in range(2):
        y = x + roots[k] * u
        if wp.abs(y[2]) < half:
            hit = _nearer(hit, least, roots[k], wp.vec3(y[0], y[1], 0.0) / radius)
    return hit


@wp.func
def _intersect_cap(hit: ShapeHit, radius: float, z: float, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    """A disc at a height z."""
    s = (z - x[2]) / u[2]
    y = x + s * u
    if y[0] * y[0] + y[1] * y[1] <= radius * radius:
        hit = _nearer(hit, least, s, wp.vec3(0.0, 0.0, 1.0))
    return hit


@wp.func
def _intersect_capsule(size: wp.vec3, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    hit = _intersect_side(_miss(), size[0], size[1], x, u, least)
    hit = _intersect_ball(hit, size[1], size[0], size[1], x, u, least)
    return _intersect_ball(hit, -size[1], size[0], size[1], x, u, least)


@wp.func
def _intersect_ellipsoid(size: wp.vec3, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    stretched = wp.cw_div(u, size)
    length = wp.length(stretched)
    hit = _intersect_ball(_miss(), 0.0, 1.0, 0.0, wp.cw_div(x, size), stretched / length, least * length)
    if hit.distance < _FAR:
        hit.distance = hit.distance / length
        hit.normal = wp.normalize(wp.cw_div(hit.normal, size))
    return hit


@wp.func
def _intersect_cylinder(size: wp.vec3, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    hit = _intersect_side(_miss(), size[0], size[1], x, u, least)
    hit = _intersect_cap(hit, size[0], size[1], x, u, least)
    return _intersect_cap(hit, size[0], -size[1], x, u, least)


@wp.func
def _intersect_box(size: wp.vec3, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    enter = -float(_FAR)
    leave = float(_FAR)
    enter_axis = int(0)
    leave_axis = int(0)
    for k in range(3):
        low = (-size[k] - x[k]) / u[k]
        high = (size[k] - x[k]) / u[k]
        if u[k] == 0.0:
            low = wp.where(wp.abs(x[k]) <= size[k], -_FAR, _FAR)
            high = float(_FAR)
        if wp.min(low, high) > enter:
            enter = wp.min(low, high)
            enter_axis = k
        if wp.max(low, high) < leave:
            leave = wp.max(low, high)
            leave_axis = k
    hit = _miss()
    if enter <= leave:
        normal = wp.vec3(0.0)
        normal[enter_axis] = 1.0
        hit = _nearer(hit, least, enter, normal)
        normal = wp.vec3(0.0)
        normal[leave_axis] = 1.0
        hit = _nearer(hit, least, leave, normal)
    return hit


@wp.func
def _intersect_cone(size: wp.vec3, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    """Its tip is up."""
    half = size[1]
    k2 = 0.25 * size[0] * size[0] / (half * half)
    below = half - x[2]
    a = u[0] * u[0] + u[1] * u[1] - k2 * u[2] * u[2]
    b = x[0] * u[0] + x[1] * u[1] + k2 * below * u[2]
    roots = _roots(a, b, x[0] * x[0] + x[1] * x[1] - k2 * below * below)
    hit = _miss()
    for k in range(2):
        y = x + roots[k] * u
        if wp.abs(y[2]) <= half:
            hit = _nearer(hit, least, roots[k], wp.normalize(wp.vec3(y[0], y[1], k2 * (half - y[2]))))
    return _intersect_cap(hit, size[0], -half, x, u, least)


@wp.func
def _intersect_scaled_mesh(mesh: wp.uint64, size: wp.vec3, x: wp.vec3, u: wp.vec3, reach: float) -> ShapeHit:
    """A `wp.Mesh` whose points are multiplied by size."""
    stretched = wp.cw_div(u, size)
    length = wp.length(stretched)
    hit = _miss()
    query = wp.mesh_query_ray(mesh, wp.cw_div(x, size), stretched / length, reach * length)
    if query.result:
        hit.distance = query.t / length
        hit.normal = wp.normalize(wp.cw_div(query.normal, size))
        hit.face = query.face
        hit.corner = wp.vec2(query.u, query.v)
    return hit


@wp.func
def intersect_shape(kind: int, size: wp.vec3, mesh: wp.uint64, x: wp.vec3, u: wp.vec3, reach: float) -> ShapeHit:
    """The nearest point, up to `reach`, at which the ray x + s u meets a shape of `SHAPE_KINDS` in its own frame.

    `size` is that of `ShapeTable`; a mesh is an id of a `wp.Mesh`.
    """
    # From the point of the ray that is nearest the centre: differences of squares would cancel far away.
    start = -wp.dot(x, u)
    y = x + start * u
    least = -start
    hit = _miss()
    if kind == PLANE:
        hit = _intersect_plane(size, y, u, least)
    elif kind == SPHERE:
        hit = _intersect_ball(hit, 0.0, size[0], 0.0, y, u, least)
    elif kind == CAPSULE:
        hit = _intersect_capsule(size, y, u, least)
    elif kind == ELLIPSOID:
        hit = _intersect_ellipsoid(size, y, u, least)
    elif kind == CYLINDER:
        hit = _intersect_cylinder(size, y, u, least)
    elif kind == BOX:
        hit = _intersect_box(size, y, u, least)
    elif kind == CONE:
        hit = _intersect_cone(size, y, u, least)
    elif kind == MESH:
        start = float(0.0)
        hit = _intersect_scaled_mesh(mesh, size, x, u, reach)
    hit.distance += start
    if not hit.distance <= reach:
        hit.distance = -1.0
    return hit
