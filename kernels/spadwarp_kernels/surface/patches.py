"""Rays against a handful of faces, all of which are tried: two that make a parallelogram are one patch.

A patch is a triangle or a parallelogram, in five vec4 (rows) of `patches`:

0. its unit normal, and the offset of its plane;
1. and 2. two coordinates in its plane as normals and offsets, -1 to 1 from edge to edge and 0 in the middle of the
   parallelogram that its first face is one half of: the half in which their sum is not above 0;
3. half its least height over `WIDENING` [m], 1 for a triangle and 0 for a parallelogram, the largest sum of a corner's
   absolute coordinates [m], and bits of the corner of the first face that lies opposite the diagonal;
4. bits of slot and index of the first face, and of the second, which for a triangle is the first again.
"""

import numpy as np
import warp as wp

from spadwarp_kernels.base.native import bits_of

from .triangle import WIDENING, middle_planes

__all__ = ["BRUTE_FORCE_FACES"]

PATCH_ROWS = wp.constant(5)

# Meshes of at most this many faces need no BVH.
BRUTE_FORCE_FACES = 12

# Corners of two faces are taken for one, and four for a parallelogram, within this part of the largest coordinate.
SAME = 5.0e-7
# Triangles less high than so many of these distances stay by themselves.
LEAST_HEIGHT = 100.0


@wp.func
def _point(mesh: wp.uint64, face: int, corner: int) -> wp.vec3:
    m = wp.mesh_get(mesh)
    return m.points[m.indices[3 * face + corner % 3]]


@wp.func
def _apart(p: wp.vec3, q: wp.vec3) -> float:
    return wp.max(wp.abs(p - q))


@wp.func
def shared_corner(mesh: wp.uint64, first: int, second: int, same: float) -> int:
    """The corner (0 to 2) of a face that is not on the diagonal of the parallelogram that another one completes; -1 if
    it does not, or is less high than LEAST_HEIGHT; points so far from each other [m] are taken for one."""
    found = int(-1)
    p = _point(mesh, first, 0)
    q = _point(mesh, first, 1)
    r = _point(mesh, first, 2)
    longest = wp.max(wp.max(wp.length(q - p), wp.length(r - q)), wp.length(p - r))
    if wp.length(wp.cross(q - p, r - p)) > wp.static(LEAST_HEIGHT) * same * longest:
        for corner in range(3):
            a = _point(mesh, first, corner + 1)
            b = _point(mesh, first, corner + 2)
            across = a + (b - _point(mesh, first, corner))
            for turn in range(3):
                apart = _apart(_point(mesh, second, turn), across)
                apart = wp.max(apart, _apart(_point(mesh, second, turn + 1), b))
                apart = wp.max(apart, _apart(_point(mesh, second, turn + 2), a))
                if apart <= same and found < 0:
                    found = corner
    return found


@wp.kernel(enable_backward=False)
def _corners_kernel(mesh: wp.uint64, same: float, corners: wp.array2d[int]):
    """Launch: (faces, faces)."""
    first, second = wp.tid()
    corners[first, second] = wp.where(first < second, shared_corner(mesh, first, second, same), -1)


def pair_faces(mesh: wp.Mesh) -> list[tuple[int, int, int]]:
    """A mesh's faces as (face, second face, corner) of patches: where two make a parallelogram, the lower index first
    and the corner (0 to 2) of the first that is not on the diagonal; else (face, face, 0). Faces that turn opposite
    ways are not paired."""
    count = mesh.indices.size // 3
    found = wp.empty((count, count), dtype=int, device=mesh.device)
    same = SAME * float(np.abs(mesh.points.numpy()[mesh.indices.numpy()]).max(initial=0.0))
    wp.launch(_corners_kernel, found.shape, [mesh.id, same], [found], device=mesh.device)
    corners, patches = found.numpy(), []
    taken: set[int] = set()
    for first in range(count):
        if first not in taken:
            seconds = (k for k in range(first + 1, count) if k not in taken and corners[first, k] >= 0)
            second = next(seconds, first)
            taken.add(second)
            patches.append((first, second, max(int(corners[first, second]), 0)))
    return patches


@wp.kernel(enable_backward=False)
def _patches_kernel(mesh: wp.uint64, patches: wp.array[wp.vec4], normals: wp.array[wp.vec4]):
    """Rows 0 to 3 from row 4 and what row 3 says of the patch. Launch: patches."""
    row = PATCH_ROWS * wp.tid()
    m = wp.mesh_get(mesh)
    face = bits_of(patches[row + 4][1])
    triangle = patches[row + 3][1]
    corner = patches[row + 3][3]
    k = bits_of(corner)
    p = m.points[m.indices[3 * face + k]]
    q = m.points[m.indices[3 * face + (k + 1) % 3]]
    r = m.points[m.indices[3 * face + (k + 2) % 3]]
    a, b, n, height = middle_planes(p, q - p, r - p, triangle)
    largest = wp.max(wp.max(_size(p), _size(q)), wp.max(_size(r), (1.0 - triangle) * _size(q + r - p)))
    patches[row] = n
    patches[row + 1] = a
    patches[row + 2] = b
    patches[row + 3] = wp.vec4(height / WIDENING, triangle, largest, corner)
    named = patches[row + 4]
    normals[bits_of(named[0])] = wp.vec4(n[0], n[1], n[2], named[1])
    normals[bits_of(named[2])] = wp.vec4(n[0], n[1], n[2], named[3])


@wp.func
def _size(p: wp.vec3) -> float:
    return wp.abs(p[0]) + wp.abs(p[1]) + wp.abs(p[2])


def set_patches(mesh: wp.Mesh, patches: wp.array, normals: wp.array) -> None:
    """Writes both anew, for the mesh's points as they are; parallelograms must still be such."""
    wp.launch(_patches_kernel, patches.size // PATCH_ROWS, [mesh.id], [patches, normals], device=mesh.device)


def pack_patches(mesh: wp.Mesh, order: np.ndarray, pairs: bool = True) -> tuple[wp.array, wp.array]:
    """The patches of a mesh, vec4 [5 * patches]; vec4 [slots]: normals, see `normal_and_face`.

    Args:
        mesh: Of a few faces: each is compared with all others.
        order: The face in each slot, or its complement, see `pack_bvh`.
        pairs: Whether to look for parallelograms: not where the points will move.
    """
    faces = mesh.indices.numpy().reshape(-1, 3)
    found = pair_faces(mesh) if pairs else [(face, face, 0) for face in range(len(faces))]
    slots = np.zeros(len(faces), int)
    slots[np.where(order < 0, ~order, order)] = np.arange(len(order))
    rows = np.zeros((len(found), PATCH_ROWS, 4), np.float32)
    bits = rows.view(np.int32)
    for k, (first, second, corner) in enumerate(found):
        rows[k, 3, 1] = float(first == second)
        bits[k, 3, 3] = corner
        bits[k, 4] = slots[first], first, slots[second], second
    patches = wp.array(rows.reshape(-1, 4), dtype=wp.vec4, device=mesh.device)
    normals = wp.zeros(len(order), dtype=wp.vec4, device=mesh.device)
    set_patches(mesh, patches, normals)
    return patches, normals


def empty_patches(device: wp.DeviceLike) -> tuple[wp.array, wp.array]:
    """What `pack_patches` returns, for no faces at all."""
    return wp.zeros(0, dtype=wp.vec4, device=device), wp.zeros(0, dtype=wp.vec4, device=device)


@wp.func_native("""
    const auto load = [&](int row) {
#if defined(__CUDA_ARCH__)
        return __ldg(reinterpret_cast<const float4*>(patches.data) + row);
#else
        struct { float x, y, z, w; } v = {patches.data[row][0], patches.data[row][1], patches.data[row][2],
                                          patches.data[row][3]};
        return v;
#endif
    };
    // As meet_planes; the hair is that of the patch's farthest corner. One patch at a time, not two in a turn.
    float nearest = reach, rate_there = 0.0f, side = 0.0f;
    int found = -1, row = 0;
    const int rows = patches.shape[0];
#pragma unroll 1
    do {
        const auto n = load(row), a = load(row + 1), b = load(row + 2), c = load(row + 3);
        const float rate = n.x * u[0] + n.y * u[1] + n.z * u[2];
        const float height = n.w - n.x * x[0] - n.y * x[1] - n.z * x[2];
        const float distance = height / rate;
        const float y0 = x[0] + distance * u[0], y1 = x[1] + distance * u[1], y2 = x[2] + distance * u[2];
        const float p = a.w + a.x * y0 + a.y * y1 + a.z * y2;
        const float q = b.w + b.x * y0 + b.y * y1 + b.z * y2;
        const float most = wp::max(wp::max(fabsf(p), fabsf(q)), c.y * (p + q) + 1.0f);
        const float room = (1.0f - most) * (c.x * fabsf(rate)) + distance;
        const bool met = (distance >= 0.0f) & (distance < nearest) & (room >= -c.z);
        nearest = met ? distance : nearest;
        rate_there = met ? rate : rate_there;
        side = met ? p + q : side;
        found = met ? row : found;
        row += 5;
    } while (row < rows);
    union { int bits; float number; } both;
    both.bits = found;
    return wp::vec4(nearest, rate_there, side, both.number);
""")
def nearest_patch(patches: wp.array[wp.vec4], x: wp.vec3, u: wp.vec3, reach: float) -> wp.vec4:
    """The nearest patch along a ray from x in the unit direction u.

    Returns:
        Its distance [m], below `reach`, or that; the rate at which the ray gains height over it along its normal; the
        sum of its coordinates there; bits of its first row, -1 for none.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int4 v = __ldg(reinterpret_cast<const int4*>(patches.data + static_cast<int64_t>(row)) + 4);
    return second ? wp::vec2i(v.z, v.w) : wp::vec2i(v.x, v.y);
#else
    const int* v = reinterpret_cast<const int*>(patches.data + row + 4);
    return second ? wp::vec2i(v[2], v[3]) : wp::vec2i(v[0], v[1]);
#endif
""")
def patch_faces(patches: wp.array[wp.vec4], row: int, second: bool) -> wp.vec2i:
    """Slot and index of the first or the second face of the patch that begins at a row."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(patches.data + static_cast<int64_t>(row)));
    const float against = -copysignf(1.0f, rate);
    return wp::vec3(against * v.x, against * v.y, against * v.z);
#else
    const wp::vec4& v = patches.data[row];
    const float against = rate > 0.0f ? -1.0f : 1.0f;
    return wp::vec3(against * v[0], against * v[1], against * v[2]);
#endif
""")
def patch_normal(patches: wp.array[wp.vec4], row: int, rate: float) -> wp.vec3:
    """The unit normal of the patch that begins at a row, against a ray with that rate, see `nearest_patch`."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(normals.data) + slot);
    const int face = __float_as_int(v.w);
    __builtin_assume(face >= 0);
    union { int bits; float number; } both;
    both.bits = face;
    return wp::vec4(v.x, v.y, v.z, both.number);
#else
    return normals.data[slot];
#endif
""")
def normal_and_face(normals: wp.array[wp.vec4], slot: int) -> wp.vec4:
    """The unit normal of the face in a slot, and bits of its index."""
    ...
