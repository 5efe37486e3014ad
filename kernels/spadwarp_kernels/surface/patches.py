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

from spadwarp_kernels.base.native import bits_of, load_row

from .triangle import WIDENING, middle_planes

__all__ = ["BRUTE_FORCE_FACES"]

PATCH_ROWS = wp.constant(5)

# Meshes of at most this many faces need no BVH.
BRUTE_FORCE_FACES = 12

# Corners of two faces are taken for one, and four for a parallelogram, within this part of the largest coordinate.
SAME = 5.0e-7
# Triangles less high than so many of these distances stay by themselves.
LEAST_HEIGHT = 100.0


def shared_corner(first: np.ndarray, second: np.ndarray, same: float) -> np.ndarray:
    """The corner (0 to 2) of each face that is not on the diagonal of the parallelogram that another one completes; -1
    for none, and for faces less high than LEAST_HEIGHT. Corners are float32 [faces, 3, 3]; points so far from each
    other [m] are taken for one."""
    found = np.full(len(first), -1)
    edges = np.roll(first, -1, axis=1) - first
    height = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    high = height > LEAST_HEIGHT * same * np.linalg.norm(edges, axis=2).max(axis=1, initial=0.0)
    for corner in (2, 1, 0):
        a, b = first[:, (corner + 1) % 3], first[:, (corner + 2) % 3]
        rest = np.stack([a + (b - first[:, corner]), b, a], axis=1)
        for turn in range(3):
            apart = np.abs(np.roll(second, -turn, axis=1) - rest).max(axis=(1, 2), initial=0.0)
            found[high & (apart <= same)] = corner
    return found


def join_faces(
    points: np.ndarray, faces: np.ndarray, start: np.ndarray, stop: np.ndarray, same: float
) -> tuple[np.ndarray, np.ndarray]:
    """The faces in the slots of each leaf anew: behind a face the one with which it makes a parallelogram, where they
    turn the same way. Also the `shared_corner` of each with the next one; -1 for a triangle and for a second face."""
    order, corners = faces.copy(), np.full(len(faces), -1)
    free, place = np.ones(len(faces), bool), start.copy()
    most = int((stop - start).max(initial=0))
    for i in range(most):
        leaf = np.flatnonzero(start + i < stop)
        leaf = leaf[free[start[leaf] + i]]
        here, second = start[leaf] + i, np.full(leaf.size, -1)
        for j in range(i + 1, most):
            there = start[leaf] + j
            rows = np.flatnonzero((second < 0) & (there < stop[leaf]))
            rows = rows[free[there[rows]]]
            found = shared_corner(points[faces[here[rows]]], points[faces[there[rows]]], same)
            rows, found = rows[found >= 0], found[found >= 0]
            second[rows], corners[place[leaf[rows]]] = there[rows], found
        order[place[leaf]] = faces[here]
        paired = np.flatnonzero(second >= 0)
        order[place[leaf[paired]] + 1] = faces[second[paired]]
        free[second[paired]] = False
        place[leaf] += 1 + (second >= 0)
    return order, corners


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
    """The patches of a mesh of a few faces, vec4 [5 * patches], and the unit normal of the face in each slot with the
    bits of its index, vec4 [slots]; `order` is that of `pack_bvh`, `pairs` false where the points will move."""
    faces = np.arange(len(order))
    corners = np.full(len(order), -1)
    if pairs:
        points = mesh.points.numpy()[mesh.indices.numpy().reshape(-1, 3)]
        faces, corners = join_faces(points, faces, np.array([0]), np.array([len(order)]), SAME * np.abs(points).max())
    first = np.flatnonzero(np.append(True, corners[:-1] < 0))  # no second faces
    second = faces[first + (corners[first] >= 0)]
    slots = np.argsort(np.where(order < 0, ~order, order))
    rows = np.zeros((len(first), PATCH_ROWS, 4), np.float32)
    bits = rows.view(np.int32)
    rows[:, 3, 1] = corners[first] < 0
    bits[:, 3, 3] = np.maximum(corners[first], 0)
    bits[:, 4] = np.stack([slots[faces[first]], faces[first], slots[second], second], axis=1)
    patches = wp.array(rows.reshape(-1, 4), dtype=wp.vec4, device=mesh.device)
    normals = wp.zeros(len(order), dtype=wp.vec4, device=mesh.device)
    set_patches(mesh, patches, normals)
    return patches, normals


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
    """The nearest patch along a ray from x in the unit direction u: its distance [m], below `reach`, or that; the rate
    at which the ray gains height over it; the sum of its coordinates there; bits of its first row, -1 for none."""
    ...


@wp.func
def patch_faces(patches: wp.array[wp.vec4], row: int, second: bool) -> wp.vec2i:
    """Slot and index of the first or the second face of the patch that begins at a row."""
    v = load_row(patches, row + 4)
    return wp.vec2i(bits_of(wp.where(second, v[2], v[0])), bits_of(wp.where(second, v[3], v[1])))
