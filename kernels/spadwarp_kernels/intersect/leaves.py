"""Leaves of the tree on CUDA: two children of a node that make a parallelogram are one leaf, tried as one face.

Both faces keep their slots, which follow each other. The leaf leads to the first, where the parallelogram is kept in
place of the triangle, see `meet_planes`; the second keeps its own planes, of which only the normal is read. A mesh
whose points move has leaves of triangles alone.
"""

import warp as wp

from spadwarp_kernels.math.bits import bits_of

from .pairs import NO_NODE
from .patches import LEAST_HEIGHT, SAME
from .triangle import set_row


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
def _find_kernel(
    mesh: wp.uint64,
    same: float,
    nodes: wp.array(dtype=wp.vec4),
    order: wp.array(dtype=int),
    corners: wp.array(dtype=int),
):
    """The first face's corner of leaves that make a parallelogram, -1 for other pairs. Launch: pairs."""
    pair = wp.tid()
    first = _leaf(nodes, 2 * pair)
    corners[pair] = -1
    if pair == 0 or first < 0 or _leaf(nodes, 2 * pair + 1) != first + 1:
        return
    if order[first] >= 0 and order[first + 1] >= 0:
        corners[pair] = shared_corner(mesh, order[first], order[first + 1], same)


@wp.kernel(enable_backward=False)
def _join_kernel(corners: wp.array(dtype=int), nodes: wp.array(dtype=wp.vec4)):
    """In place of a pair that is a parallelogram, its leaf. Launch: nodes."""
    node = wp.tid()
    child = bits_of(nodes[2 * node][3])
    if child > NO_NODE and corners[wp.max(child, 0)] >= 0:
        nodes[2 * node][3] = nodes[4 * child][3]


@wp.kernel(enable_backward=False)
def _set_kernel(
    mesh: wp.uint64,
    nodes: wp.array(dtype=wp.vec4),
    order: wp.array(dtype=int),
    corners: wp.array(dtype=int),
    faces: wp.array(dtype=wp.vec4),
):
    """Launch: pairs."""
    pair = wp.tid()
    if corners[pair] >= 0:
        slot = _leaf(nodes, 2 * pair)
        set_row(mesh, order[slot], corners[pair], 0.0, slot, faces)


def join_leaves(mesh: wp.Mesh, extent: float, nodes: wp.array, order: wp.array, faces: wp.array) -> None:
    """Makes pairs of leaves that are a parallelogram leaves of their own.

    Args:
        mesh: Whose points will not move.
        extent: Its largest coordinate [m].
        nodes, order: From `read_tree`; the nodes change.
        faces: The faces in their slots as CUDA takes them; parallelograms replace the first of theirs.
    """
    count, device = nodes.size // 4, mesh.device
    corners = wp.empty(count, dtype=int, device=device)
    wp.launch(_find_kernel, count, [mesh.id, SAME * extent, nodes, order], [corners], device=device)
    wp.launch(_join_kernel, 2 * count, [corners], [nodes], device=device)
    wp.launch(_set_kernel, count, [mesh.id, nodes, order, corners], [faces], device=device)
