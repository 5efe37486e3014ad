"""Rays against triangles, laid out as planes."""

import warp as wp

# Boxes and faces are widened by this part of the coordinates and distances: a few units in the last place of float32.
WIDENING = wp.constant(4.0e-7)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(array.data) + index);
    return wp::vec4(v.x, v.y, v.z, v.w);
#else
    return reinterpret_cast<const wp::vec4*>(array.data)[index];
#endif
""")
def load_vec4(array: wp.array(dtype=wp.vec4), index: int) -> wp.vec4:
    """An entry of a contiguous array, in one load."""
    ...


@wp.func
def face_in(order: wp.array(dtype=int), slot: int) -> int:
    """Index of the face in a slot."""
    face = order[slot]
    return wp.where(face < 0, ~face, face)


@wp.kernel(enable_backward=False)
def pack_faces_kernel(mesh: wp.uint64, order: wp.array(dtype=int), faces: wp.array(dtype=wp.vec4)):
    """Launch: faces."""
    slot = wp.tid()
    face = face_in(order, slot)
    m = wp.mesh_get(mesh)
    p = m.points[m.indices[3 * face]]
    e1 = m.points[m.indices[3 * face + 1]] - p
    e2 = m.points[m.indices[3 * face + 2]] - p
    n = wp.cross(e1, e2)
    inverse = 1.0 / wp.dot(n, n)  # infinite for a face without area, which no ray then hits
    a = inverse * wp.cross(e2, n)
    b = inverse * wp.cross(n, e1)
    steepest = wp.max(wp.max(wp.length(a), wp.length(b)), wp.length(a + b))
    n = wp.normalize(n) / steepest
    faces[3 * slot] = wp.vec4(a[0], a[1], a[2], -wp.dot(a, p))
    faces[3 * slot + 1] = wp.vec4(b[0], b[1], b[2], -wp.dot(b, p))
    faces[3 * slot + 2] = wp.vec4(n[0], n[1], n[2], wp.dot(n, p))


@wp.func
def face_distance(faces: wp.array(dtype=wp.vec4), slot: int, x: wp.vec3, u: wp.vec3) -> float:
    """Distance from x along the unit vector u at which the ray meets a face, >= 0, or -1 for a miss.

    Of each face `faces` holds three planes, as normals and offsets: of its first two barycentric coordinates, and its
    own, with a normal as long as the least height of the triangle. A ray may pass a hair outside, measured across the
    ray, so that none slips between two faces; more than that beyond the short edges of a sliver, where its box ends it.
    """
    a = load_vec4(faces, 3 * slot)
    b = load_vec4(faces, 3 * slot + 1)
    n = load_vec4(faces, 3 * slot + 2)
    rate = n[0] * u[0] + n[1] * u[1] + n[2] * u[2]
    height = n[3] - (n[0] * x[0] + n[1] * x[1] + n[2] * x[2])
    distance = height / rate  # infinite or not a number for a ray in the plane, which fails below
    y = x + distance * u
    first = a[0] * y[0] + a[1] * y[1] + a[2] * y[2] + a[3]
    second = b[0] * y[0] + b[1] * y[1] + b[2] * y[2] + b[3]
    least = wp.min(wp.min(first, second), 1.0 - first - second)
    hair = WIDENING * (wp.abs(y[0]) + wp.abs(y[1]) + wp.abs(y[2]) + distance)
    if not (least * wp.abs(rate) >= -hair and distance >= 0.0):
        distance = -1.0
    return distance


@wp.func
def face_normal(faces: wp.array(dtype=wp.vec4), slot: int, u: wp.vec3) -> wp.vec3:
    """The unit normal of a face, against u."""
    n = load_vec4(faces, 3 * slot + 2)
    normal = wp.normalize(wp.vec3(n[0], n[1], n[2]))
    return wp.where(wp.dot(normal, u) > 0.0, -normal, normal)
