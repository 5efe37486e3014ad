"""Rays against triangles, laid out as planes: see `meet_planes`.

On CUDA a face is three vec4 in a row, which may also stand for a parallelogram, see `meet_planes`. On the CPU eight
faces make a block of 36 vec4, as 18 rows of eight numbers: the components of three planes, of the first two barycentric
coordinates and of the face itself, then the lower and the upper corner of each face's own box.
"""

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.native import times_sign, zeros

# Boxes and faces are widened by this part of the coordinates and distances: a few units in the last place of float32.
WIDENING = wp.constant(4.0e-7)

# Faces of a block on the CPU.
LANES = wp.constant(8)

# Slots on the CPU, so that the index of a number stays below 2^31.
_MOST_SLOTS = (2**31 - 1) // 144 * 8


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // With an index of 64 bits all planes of neighbouring faces have one address and offsets.
    const float4 v = __ldg(reinterpret_cast<const float4*>(faces.data) + 3 * static_cast<int64_t>(slot) + plane);
    return wp::vec4(v.x, v.y, v.z, v.w);
#else
    const float* row = reinterpret_cast<const float*>(faces.data) + 144 * (slot / 8) + 32 * plane + slot % 8;
    return wp::vec4(row[0], row[8], row[16], row[24]);
#endif
""")
def load_plane(faces: wp.array[wp.vec4], slot: int, plane: int) -> wp.vec4:
    """Plane 0, 1 or 2 of the face in a slot; in one load on CUDA."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ldg(order.data + slot);
#else
    return order.data[slot];
#endif
""")
def number_in(order: wp.array[int], slot: int) -> int:
    """An entry of a contiguous array that no kernel changes, in one load on CUDA."""
    ...


@wp.func
def face_in(order: wp.array[int], slot: int) -> int:
    """Index of the face in a slot."""
    face = number_in(order, slot)
    return wp.where(face < 0, ~face, face)


@wp.func
def _coordinates(e1: wp.vec3, e2: wp.vec3, triangle: float):
    """Gradients of the two coordinates along the edges, the unit normal, one over the least height of the triangle, or
    with `triangle` = 0 of the parallelogram. Without area nothing is finite or the normal is 0: no ray hits it."""
    n = wp.cross(e1, e2)
    inverse = 1.0 / wp.dot(n, n)
    a = inverse * wp.cross(e2, n)
    b = inverse * wp.cross(n, e1)
    steepest = wp.max(wp.max(wp.length(a), wp.length(b)), triangle * wp.length(a + b))
    return a, b, wp.normalize(n), steepest


@wp.func
def _plane(normal: wp.vec3, offset: float) -> wp.vec4:
    return wp.vec4(normal[0], normal[1], normal[2], offset)


@wp.func
def middle_planes(p: wp.vec3, e1: wp.vec3, e2: wp.vec3, triangle: float):
    """Planes of a triangle with corner p and edges e1, e2 from it, or with `triangle` = 0 of the parallelogram: two
    coordinates as normals and offsets, -1 to 1 from edge to edge of the parallelogram; its unit normal and offset; half
    its least height [m]."""
    a, b, n, steepest = _coordinates(e1, e2, triangle)
    middle = p + 0.5 * (e1 + e2)
    a_plane = 2.0 * _plane(a, -wp.dot(a, middle))
    return a_plane, 2.0 * _plane(b, -wp.dot(b, middle)), _plane(n, wp.dot(n, middle)), 0.5 / steepest


@wp.kernel(enable_backward=False, module="unique")  # not compiled for a CPU
def _rows_kernel(mesh: wp.uint64, order: wp.array[int], corners: wp.array[int], faces: wp.array[wp.vec4]):
    """Faces as CUDA takes them, or the parallelograms that they are halves of. Launch: slots."""
    slot = wp.tid()
    face = face_in(order, slot)
    corner = int(-1)
    if corners.shape[0] > 0:
        corner = corners[slot]
    triangle = wp.where(corner < 0, 1.0, 0.0)
    corner = wp.max(corner, 0)
    m = wp.mesh_get(mesh)
    p = m.points[m.indices[3 * face + corner]]
    q = m.points[m.indices[3 * face + (corner + 1) % 3]]
    r = m.points[m.indices[3 * face + (corner + 2) % 3]]
    a, b, n, height = middle_planes(p, q - p, r - p, triangle)
    faces[3 * slot] = a
    faces[3 * slot + 1] = b
    turned = times_sign(height, n[3]) * wp.vec3(n[0], n[1], n[2])
    if triangle == 0.0:
        turned = -1.0 * turned
    offset = height * wp.abs(n[3])
    faces[3 * slot + 2] = _plane(turned, times_sign(offset, triangle - 0.5))


def set_rows(mesh: wp.Mesh, order: wp.array, faces: wp.array, corners: wp.array | None = None) -> None:
    """Writes the faces in their slots as CUDA takes them; `corners` is that of `join_faces`, None for triangles."""
    if corners is None:
        corners = wp.empty(0, dtype=int, device=mesh.device)
    wp.launch(_rows_kernel, order.size, [mesh.id, order, corners], [faces], device=mesh.device)


def numbers_of(rows: wp.array) -> wp.array:
    """The same memory as float32."""
    return wp.array(ptr=rows.ptr, dtype=float, shape=4 * rows.size, device=rows.device)


@wp.func
def face_number(slot: int, row: int) -> int:
    """Index of a number of the face in a slot, in the blocks of the CPU."""
    return 144 * (slot / LANES) + LANES * row + slot % LANES


@wp.kernel(enable_backward=False)
def _blocks_kernel(mesh: wp.uint64, padding: float, order: wp.array[int], faces: wp.array[float]):
    """Launch: slots; CPU. A slot without a face keeps planes of zeros and a box that no ray meets."""
    slot = wp.tid()
    face = order[slot]
    low = wp.vec3(1.0e30)
    high = wp.vec3(-1.0e30)
    if face >= 0:
        m = wp.mesh_get(mesh)
        first = m.points[m.indices[3 * face]]
        e1 = m.points[m.indices[3 * face + 1]] - first
        a, b, n, steepest = _coordinates(e1, m.points[m.indices[3 * face + 2]] - first, 1.0)
        n = n / steepest
        for i in range(3):
            faces[face_number(slot, i)] = a[i]
            faces[face_number(slot, 4 + i)] = b[i]
            faces[face_number(slot, 8 + i)] = n[i]
        faces[face_number(slot, 3)] = -wp.dot(a, first)
        faces[face_number(slot, 7)] = -wp.dot(b, first)
        faces[face_number(slot, 11)] = wp.dot(n, first)
        for corner in range(3):
            p = m.points[m.indices[3 * face + corner]]
            low = wp.min(low, p - wp.vec3(padding))
            high = wp.max(high, p + wp.vec3(padding))
    for axis in range(3):
        faces[face_number(slot, 12 + axis)] = low[axis]
        faces[face_number(slot, 15 + axis)] = high[axis]


def box_padding(extent: float) -> float:
    """By how much boxes are larger than what is in them [m], for coordinates up to the extent."""
    return 2.5 * WIDENING * extent + 1e-9


def face_vectors(slots: int, device: wp.Device) -> int:
    """Number of vec4 of the faces in so many slots."""
    return 3 * slots if device.is_cuda else 36 * (slots // 8)


def set_faces(mesh: wp.Mesh, extent: float, order: wp.array, faces: wp.array) -> None:
    """Writes the faces in their slots, for the mesh's points as they are."""
    if mesh.device.is_cuda:
        set_rows(mesh, order, faces)
    else:
        inputs = [mesh.id, box_padding(extent), order]
        wp.launch(_blocks_kernel, order.size, inputs, [numbers_of(faces)], device=mesh.device)


def pack_faces(mesh: wp.Mesh, extent: float, order: wp.array) -> wp.array:
    """The faces of a mesh in the slots of an order; raises `ArgumentError` for more than a CPU's indices reach."""
    if not mesh.device.is_cuda:
        check.integer("faces of the mesh, in slots,", order.size, 0, _MOST_SLOTS)
    faces = zeros(face_vectors(order.size, mesh.device), wp.vec4, mesh.device)
    set_faces(mesh, extent, order, faces)
    return faces


@wp.func
def meet_planes(a: wp.vec4, b: wp.vec4, n: wp.vec4, x: wp.vec3, u: wp.vec3) -> wp.vec2:
    """A ray from x along the unit vector u against a triangle or a parallelogram, two triangles side by side.

    Two coordinates in its plane are normals and offsets, -1 to 1 from edge to edge and 0 in the middle of the
    parallelogram; the sum of a triangle's is not above 0. The normal of the plane is half as long as the least height;
    the sign of its offset, also of a zero, is negative for a parallelogram.

    Returns the distance, >= 0, or -1 for a miss, and the sum of the coordinates there, which is above 0 in the second
    triangle. A ray may pass a hair outside, measured across the ray, so that none slips between two faces; more than
    that beyond the short edges of a sliver, where its box ends it.
    """
    rate = n[0] * u[0] + n[1] * u[1] + n[2] * u[2]
    height = n[3] - (n[0] * x[0] + n[1] * x[1] + n[2] * x[2])
    distance = height / rate  # infinite or not a number for a ray in the plane, which fails below
    y = x + distance * u
    first = a[0] * y[0] + a[1] * y[1] + a[2] * y[2] + a[3]
    second = b[0] * y[0] + b[1] * y[1] + b[2] * y[2] + b[3]
    both = first + second
    # Of a parallelogram the last does not count: negated it is the largest only beyond a corner.
    most = wp.max(wp.max(wp.abs(first), wp.abs(second)), times_sign(both + 1.0, n[3]))
    hair = WIDENING * (wp.abs(y[0]) + wp.abs(y[1]) + wp.abs(y[2]) + distance)
    if not ((1.0 - most) * wp.abs(rate) >= -hair and distance >= 0.0):
        distance = -1.0
    return wp.vec2(distance, both)


@wp.func
def face_normal(faces: wp.array[wp.vec4], slot: int, u: wp.vec3) -> wp.vec3:
    """The unit normal of a face, against u."""
    n = load_plane(faces, slot, 2)
    normal = wp.normalize(wp.vec3(n[0], n[1], n[2]))
    return wp.where(wp.dot(normal, u) > 0.0, -normal, normal)
