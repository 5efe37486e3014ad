"""Rays against a triangle mesh, step by step: the tree of a `wp.Mesh`, laid out for the warps of a GPU; `wide` is for
a CPU.

`wp.mesh_query_ray` walks a tree from its root to the end of the ray, so that a warp waits for its longest walk, some of
its lanes in the tree's nodes and others at its leaves. Here a walk is a state (node, stack, nearest face so far) that
a kernel moves on by a step, `step_node` or `step_leaf`: all lanes that are in nodes together, or all that are at
leaves, and new rays join while old ones still walk (Aila & Laine, High-Performance Graphics 2009, on what the order of
steps is worth). `intersect_surfaces` walks a tree with the same steps from its root to the end.

A node has four children, made of Warp's pairs, of which the one with the largest surface is opened twice; `nodes` says
how it is kept. Faces are three vec4 each, see `meet_planes`, in the order of the leaves; two that make a parallelogram
may be tried as one, see `leaves`.
"""

import warp as wp

from spadwarp_kernels.base.native import bits_of, from_bits

from .nodes import (
    Corners,
    box_entries,
    box_of,
    child_of,
    children_of,
    empty_nodes,
    leaf_at,
    set_node,
    slot_of,
)
from .patches import DEEPEST, NO_NODE, NOWHERE, join_leaves, read_tree
from .triangle import box_padding, face_in, meet_face, pack_faces, set_faces

# Nodes that a walk will return to: three a level, and NO_NODE.
Stack = wp.types.vector(length=3 * DEEPEST + 2, dtype=int)


@wp.func
def _surface(nodes: wp.array(dtype=wp.vec4), node: int) -> float:
    """Of the box of a node [m²]; -1 for a leaf, which cannot be opened."""
    size = nodes[2 * node + 1] - nodes[2 * node]
    area = size[0] * size[1] + size[1] * size[2] + size[2] * size[0]
    return wp.where(bits_of(nodes[2 * node][3]) >= 0, area, -1.0)


@wp.kernel(enable_backward=False)
def _open_kernel(pairs: wp.array(dtype=wp.vec4), nodes: wp.array(dtype=wp.vec4)):
    """A node of four children for each pair; the largest are opened first. Launch: pairs."""
    pair = wp.tid()
    held = wp.vec4i(2 * pair, 2 * pair + 1, -1, -1)
    for count in range(2, 4):
        best = int(-1)
        most = float(0.0)
        for k in range(count):
            if held[k] >= 0:
                area = _surface(pairs, held[k])
                if area > most:
                    most = area
                    best = k
        if best >= 0:
            opened = bits_of(pairs[2 * held[best]][3])
            held[best] = 2 * opened
            held[count] = 2 * opened + 1
    children = wp.vec4i(NO_NODE)
    low = Corners()
    high = Corners()
    for k in range(4):
        if held[k] >= 0:
            corner = pairs[2 * held[k]]
            other = pairs[2 * held[k] + 1]
            children[k] = bits_of(corner[3])
            for axis in range(3):
                low[k, axis] = corner[axis]
                high[k, axis] = other[axis]
    set_node(nodes, pair, children, low, high)


@wp.kernel(enable_backward=False)
def _depth_kernel(nodes: wp.array(dtype=wp.vec4), level: int, depth: wp.array(dtype=int)):
    """Launch: nodes."""
    node = wp.tid()
    if depth[node] == level:
        for k in range(4):
            child = child_of(nodes, node, k)
            if child >= 0:
                depth[child] = level + 1


def node_depths(nodes: wp.array) -> wp.array:
    """How deep in the tree each node of four stands, int32 [nodes], -1 where no other leads to it."""
    depth = wp.full(nodes.size // 4, -1, dtype=int, device=nodes.device)
    depth[:1].zero_()
    for level in range(DEEPEST + 2):
        wp.launch(_depth_kernel, depth.size, [nodes, level], outputs=[depth], device=nodes.device)
    return depth


@wp.kernel(enable_backward=False)
def _flag_kernel(depth: wp.array(dtype=int), used: wp.array(dtype=int)):
    """Launch: nodes."""
    used[wp.tid()] = wp.where(depth[wp.tid()] >= 0, 1, 0)


@wp.kernel(enable_backward=False)
def _gather_kernel(
    wide: wp.array(dtype=wp.vec4),
    order: wp.array(dtype=int),
    used: wp.array(dtype=int),
    place: wp.array(dtype=int),
    nodes: wp.array(dtype=wp.vec4),
):
    """The nodes that are used, in their order. Launch: nodes."""
    node = wp.tid()
    if used[node] > 0:
        for row in range(3):
            nodes[4 * place[node] + row] = wide[4 * node + row]
        for k in range(4):
            child = child_of(wide, node, k)
            if child >= 0:
                child = place[child]
            elif child != NO_NODE:
                child = leaf_at(order, -2 - child)
            nodes[4 * place[node] + 3][k] = from_bits(child)


def open_pairs(pairs: wp.array, order: wp.array) -> wp.array:
    """Nodes of four children, as they are described above, from pairs."""
    count, device = pairs.size // 4, pairs.device
    wide = wp.zeros(pairs.size, dtype=wp.vec4, device=device)
    wp.launch(_open_kernel, count, [pairs], [wide], device=device)
    used, place = (wp.zeros(count, dtype=int, device=device) for _ in range(2))
    wp.launch(_flag_kernel, count, [node_depths(wide)], [used], device=device)
    wp.utils.array_scan(used, place, inclusive=False)
    kept = int(place[-1:].numpy()[0] + used[-1:].numpy()[0])
    nodes = wp.zeros(4 * kept, dtype=wp.vec4, device=device)
    wp.launch(_gather_kernel, count, [wide, order, used, place], [nodes], device=device)
    return nodes


def pack_bvh(mesh: wp.Mesh, extent: float, join: bool = True) -> tuple[wp.array, wp.array, wp.array]:
    """Nodes, faces and order of a mesh's tree, for `step_node` and `step_leaf`; see `refit_bvh` for moved points.

    Args:
        mesh: Any `wp.Mesh` on a GPU.
        extent: Its largest coordinate [m], for the padding of the boxes.
        join: Whether two faces may be tried as one, see `leaves`: not where the points will move.

    Returns:
        nodes: vec4 [4 * nodes], see above; boxes are padded against rounding.
        faces: vec4 [3 * slots], see `meet_planes`.
        order: int32 [slots]: the face in each slot, or ~face where others of its leaf are tried after it.
    """
    pairs, order = read_tree(mesh, extent)
    faces = pack_faces(mesh, extent, order)
    if join:
        join_leaves(mesh, extent, pairs, order, faces)
    return open_pairs(pairs, order), faces, order


@wp.kernel(enable_backward=False)
def _refit_kernel(
    mesh: wp.uint64,
    padding: float,
    level: int,
    depth: wp.array(dtype=int),
    order: wp.array(dtype=int),
    nodes: wp.array(dtype=wp.vec4),
):
    """Boxes of the children of one level's nodes, those below being done. Launch: nodes."""
    node = wp.tid()
    if depth[node] != level:
        return
    m = wp.mesh_get(mesh)
    children = wp.vec4i()
    lows = Corners()
    highs = Corners()
    for k in range(4):
        child = child_of(nodes, node, k)
        low = wp.vec3(NOWHERE)
        high = wp.vec3(-NOWHERE)
        if child >= 0:
            low, high = box_of(nodes, child)
        elif child != NO_NODE:
            slot = slot_of(child)
            more = bool(True)
            while more:
                face = face_in(order, slot)
                for corner in range(3):
                    p = m.points[m.indices[3 * face + corner]]
                    low = wp.min(low, p - wp.vec3(padding))
                    high = wp.max(high, p + wp.vec3(padding))
                more = order[slot] < 0
                slot += 1
        children[k] = child
        for axis in range(3):
            lows[k, axis] = low[axis]
            highs[k, axis] = high[axis]
    set_node(nodes, node, children, lows, highs)


def refit_bvh(
    mesh: wp.Mesh, extent: float, nodes: wp.array, faces: wp.array, order: wp.array, depth: wp.array, levels: int
) -> None:
    """Boxes and faces of a packed tree for points that have moved: a launch a level, without an allocation or a look
    at Warp's own tree. `depth` is that of `node_depths`, `levels` their number."""
    for level in reversed(range(levels)):
        inputs = [mesh.id, box_padding(extent), level, depth, order]
        wp.launch(_refit_kernel, depth.size, inputs, outputs=[nodes], device=mesh.device)
    set_faces(mesh, extent, order, faces)


def empty_bvh(device: wp.DeviceLike) -> tuple[wp.array, wp.array, wp.array]:
    """What `pack_bvh` returns, for no faces at all."""
    return empty_nodes(device), wp.zeros(0, dtype=wp.vec4, device=device), wp.zeros(0, dtype=int, device=device)


@wp.struct
class TreeWalk:
    """A ray on its way down the tree; its stack is a `Stack` beside it.

    Attributes:
        node: Where it is; NO_NODE when it has come to its end.
        depth: Size of the stack.
        nearest: Distance of the nearest face so far, or the length of the ray [m].
        found: Slot of that face; -1 for none.
    """

    node: int
    depth: int
    nearest: float
    found: int


@wp.func_native("__builtin_assume(depth >= 0); return depth;")
def place(depth: int) -> int:
    """Index into a `Stack`: the compiler knows then that it does not count from the end."""
    ...


@wp.func
def _first(near: wp.vec2ui, far: wp.vec2ui):
    """(entry, child) of two, the nearer first."""
    swap = far[0] < near[0]
    return wp.where(swap, far, near), wp.where(swap, near, far)


@wp.struct
class NodeStep:
    """The children of a node against a ray, the nearest first.

    Attributes:
        child: Nodes; of no meaning for those that the ray misses.
        entry: Bits of the distances at which it enters their boxes [m]; 2^31 more for those that it misses.
        reach: Bits of the largest distance that counts.
    """

    child: wp.vec4i
    entry: wp.vec4ui
    reach: wp.uint32


@wp.func
def step_node(nodes: wp.array(dtype=wp.vec4), walk: TreeWalk, inverse: wp.vec3, shift: wp.vec3) -> NodeStep:
    """The children of a node that a ray meets.

    Args:
        nodes: From `pack_bvh`.
        walk: Its node is >= 0; a walk begins with node 0. Below `NO_NODE` are leaves, see `leaf_at`.
        inverse: `inverse_direction` of the ray.
        shift: The ray's origin times `inverse`, by components.
    """
    entry = box_entries(nodes, walk.node, inverse, shift)
    child = children_of(nodes, walk.node)
    a, b = _first(wp.vec2ui(entry[0], child[0]), wp.vec2ui(entry[1], child[1]))
    c, d = _first(wp.vec2ui(entry[2], child[2]), wp.vec2ui(entry[3], child[3]))
    a, c = _first(a, c)
    step = NodeStep()
    step.child = wp.vec4i(int(a[1]), int(b[1]), int(c[1]), int(d[1]))
    step.entry = wp.vec4ui(a[0], b[0], c[0], d[0])
    step.reach = wp.uint32(bits_of(walk.nearest))
    return step


@wp.struct
class LeafStep:
    """A face of a leaf, or two that are one leaf, against a ray.

    Attributes:
        slot: Of the face, of two that which the ray would hit.
        distance: At which the ray meets it [m]; of no meaning for a miss.
        hit: Whether it does, nearer than the nearest face so far.
        node: The next face of the leaf, or NO_NODE after the last: then the walk returns to its stack.
    """

    slot: int
    distance: float
    hit: bool
    node: int


@wp.func
def step_leaf(
    faces: wp.array(dtype=wp.vec4), order: wp.array(dtype=int), walk: TreeWalk, x: wp.vec3, u: wp.vec3
) -> LeafStep:
    """Tries the face that a walk has come to.

    Args:
        faces, order: From `pack_bvh`.
        walk: Its node is below NO_NODE, see `step_node`.
        x, u: Origin and unit direction of the ray.
    """
    step = LeafStep()
    slot = slot_of(walk.node)
    distance, met, last = meet_face(faces, slot, x, u)
    step.slot = met
    step.distance = distance
    step.hit = step.distance >= 0.0 and step.distance < walk.nearest
    step.node = NO_NODE
    if (walk.node & 1) != 0:
        step.node = leaf_at(order, last + 1)
    return step
