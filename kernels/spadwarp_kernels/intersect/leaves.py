"""Leaves of the tree on CUDA: two faces that make a parallelogram are tried as one, in a leaf of their own or among
others.

They are two faces of one leaf of Warp's tree, or of two that are the children of one node: these become one leaf. Both
keep slots, which follow each other. In the first the parallelogram is kept in place of the triangle, see `meet_planes`;
the second keeps its own planes, of which only the normal is read. A mesh whose points move has leaves of triangles
alone.
"""

import warp as wp

from spadwarp_kernels.math.bits import bits_of

from .pairs import NO_NODE
from .patches import LEAST_HEIGHT, SAME
from .triangle import face_in, set_row

# Leaves of more faces are left as they are: all pairs of a leaf's faces are compared.
LARGEST_LEAF = wp.constant(8)


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
    it does not. As `pair_faces`; points so far from each other [m] are taken for one."""
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


@wp.func
def _leaf(nodes: wp.array(dtype=wp.vec4), node: int) -> int:
    """The slot of a leaf's first face, below 0 for other nodes."""
    return -2 - bits_of(nodes[2 * node][3])


@wp.kernel(enable_backward=False)
def _siblings_kernel(
    mesh: wp.uint64,
    same: float,
    nodes: wp.array(dtype=wp.vec4),
    order: wp.array(dtype=int),
    joined: wp.array(dtype=int),
):
    """Two leaves of a face each that make a parallelogram become a leaf of two, which is marked. Launch: pairs."""
    pair = wp.tid()
    first = _leaf(nodes, 2 * pair)
    if pair == 0 or first < 0 or _leaf(nodes, 2 * pair + 1) != first + 1:
        return
    if order[first] < 0 or order[first + 1] < 0:
        return
    if shared_corner(mesh, order[first], order[first + 1], same) >= 0:
        order[first] = ~order[first]
        joined[pair] = 1


@wp.kernel(enable_backward=False)
def _parents_kernel(joined: wp.array(dtype=int), nodes: wp.array(dtype=wp.vec4)):
    """In place of a pair that has become one leaf, that. Launch: nodes."""
    node = wp.tid()
    child = bits_of(nodes[2 * node][3])
    if child > NO_NODE and joined[wp.max(child, 0)] > 0:
        nodes[2 * node][3] = nodes[4 * child][3]


@wp.kernel(enable_backward=False)
def _leaves_kernel(
    mesh: wp.uint64,
    same: float,
    found: wp.array(dtype=int),
    order: wp.array(dtype=int),
    faces: wp.array(dtype=wp.vec4),
):
    """Writes the faces of each leaf anew: behind a face the one with which it makes a parallelogram, if there is one.
    Launch: slots."""
    start = wp.tid()
    if start > 0 and found[wp.max(start - 1, 0)] < 0:
        return
    stop = start + 1
    while found[stop - 1] < 0 and stop - start <= LARGEST_LEAF:
        stop += 1
    if stop - start > LARGEST_LEAF:
        return
    taken = int(0)
    slot = int(start)
    for i in range(start, stop):
        if ((taken >> (i - start)) & 1) == 0:
            first = face_in(found, i)
            second = int(-1)
            corner = int(-1)
            for j in range(i + 1, stop):
                if corner < 0 and ((taken >> (j - start)) & 1) == 0:
                    second = face_in(found, j)
                    corner = shared_corner(mesh, first, second, same)
                    taken = wp.where(corner >= 0, taken | (1 << (j - start)), taken)
            width = wp.where(corner >= 0, 2, 1)
            more = slot + width < stop
            order[slot] = wp.where(more, ~first, first)
            set_row(mesh, first, wp.max(corner, 0), wp.where(corner >= 0, 0.0, 1.0), slot, faces)
            if corner >= 0:
                order[slot + 1] = wp.where(more, ~second, second)
                set_row(mesh, second, 0, 1.0, slot + 1, faces)
            slot += width


def join_leaves(mesh: wp.Mesh, extent: float, nodes: wp.array, order: wp.array, faces: wp.array) -> None:
    """Faces that are tried as one where two of a leaf, or of two leaves of a face each, make a parallelogram.

    Args:
        mesh: Whose points will not move.
        extent: Its largest coordinate [m].
        nodes, order: From `read_tree`; both change.
        faces: The faces in their slots as CUDA takes them, see `pack_faces`; they change, too.
    """
    count, device, same = nodes.size // 4, mesh.device, SAME * extent
    joined = wp.zeros(count, dtype=int, device=device)
    wp.launch(_siblings_kernel, count, [mesh.id, same, nodes], [order, joined], device=device)
    wp.launch(_parents_kernel, 2 * count, [joined], [nodes], device=device)
    wp.launch(_leaves_kernel, order.size, [mesh.id, same, wp.clone(order)], [order, faces], device=device)
