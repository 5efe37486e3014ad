"""Rays against a triangle mesh, step by step: the tree of a `wp.Mesh`, laid out for the warps of a GPU; `wide` is for
a CPU.

`wp.mesh_query_ray` walks a tree from its root to the end of the ray, so that a warp waits for its longest walk, some of
its lanes in the tree's nodes and others at its leaves. Here a walk is a state (node, stack, nearest face so far) that
a kernel moves on by a step, `step_node` or `step_leaf`: all lanes that are in nodes together, or all that are at
leaves, and new rays join while old ones still walk (Aila & Laine, High-Performance Graphics 2009, on what the order of
steps is worth). `intersect_surfaces` walks a tree with the same steps from its root to the end.

Nodes stand in pairs of four vec4: lower and upper corner of the first child, then of the second. The fourth component
of a lower corner holds the bits of the child: the index of its own pair, or -2 - slot of its first face. Faces are
three vec4 each, see `face_distance`, in the order of the leaves.
"""

import numpy as np
import warp as wp

from spadwarp_kernels.math.bits import bits_of, from_bits

from .box import box_span
from .triangle import box_padding, face_distance, face_in, pack_faces, set_faces

# What a walk holds in place of a node when it has come to its end: nodes are above, leaves below.
NO_NODE = wp.constant(-1)

# Nodes that a walk will return to: Warp's trees are at most 32 deep.
Stack = wp.types.vector(length=34, dtype=int)


_NOWHERE = wp.constant(1.0e30)


@wp.func_native("""
    const wp::Mesh m = wp::mesh_get(mesh);
    const wp::BVHPackedNodeHalf half = upper ? m.bvh.node_uppers[node] : m.bvh.node_lowers[node];
    union { float number; int bits; } both;
    both.bits = static_cast<int32_t>(half.i);
    return wp::vec4(half.x, half.y, half.z, both.number);
""")
def _tree_node(mesh: wp.uint64, node: int, upper: bool) -> wp.vec4:
    """A corner of a node's box and the bits of its child, or of the first and last face of a leaf."""
    ...


@wp.func_native("""
    const wp::Mesh m = wp::mesh_get(mesh);
    // The linear builder fills all nodes that there are room for, the others count theirs.
    const bool linear = m.bvh.constructor_type == BVH_CONSTRUCTOR_LBVH;
    if (node >= (linear ? m.bvh.max_nodes : m.bvh.num_nodes)) return -1;
    return m.bvh.node_lowers[node].b ? 1 : 0;
""")
def _tree_kind(mesh: wp.uint64, node: int) -> int:
    """0 for a node with children, 1 for a leaf, -1 beyond the tree."""
    ...


@wp.func_native("return *wp::mesh_get(mesh).bvh.root;")
def _tree_root(mesh: wp.uint64) -> int: ...


@wp.func_native("return wp::mesh_get(mesh).bvh.primitive_indices[slot];")
def _tree_face(mesh: wp.uint64, slot: int) -> int: ...


@wp.func
def _with_bits(corner: wp.vec3, bits: int) -> wp.vec4:
    return wp.vec4(corner[0], corner[1], corner[2], from_bits(bits))


@wp.kernel(enable_backward=False)
def _count_kernel(mesh: wp.uint64, has_children: wp.array(dtype=int)):
    """Launch: nodes that the tree may have."""
    node = wp.tid()
    has_children[node] = wp.where(_tree_kind(mesh, node) == 0, 1, 0)


@wp.func
def _order_leaf(mesh: wp.uint64, start: int, stop: int, order: wp.array(dtype=int)):
    for slot in range(start, stop):
        face = _tree_face(mesh, slot)
        order[slot] = wp.where(slot + 1 < stop, ~face, face)


@wp.kernel(enable_backward=False)
def _pack_kernel(
    mesh: wp.uint64,
    padding: float,
    before: wp.array(dtype=int),
    nodes: wp.array(dtype=wp.vec4),
    order: wp.array(dtype=int),
):
    """Launch: nodes that the tree may have. The root's pair is the first; the others stand in the tree's order."""
    node = wp.tid()
    kind = _tree_kind(mesh, node)
    root = _tree_root(mesh)
    pad = wp.vec3(padding)
    if kind == 1 and node == root:  # a tree of one leaf
        lower = _tree_node(mesh, node, False)
        upper = _tree_node(mesh, node, True)
        _order_leaf(mesh, bits_of(lower[3]), bits_of(upper[3]), order)
        nodes[0] = _with_bits(wp.vec3(lower[0], lower[1], lower[2]) - pad, -2 - bits_of(lower[3]))
        nodes[1] = _with_bits(wp.vec3(upper[0], upper[1], upper[2]) + pad, 0)
        nodes[2] = _with_bits(wp.vec3(_NOWHERE), NO_NODE)
        nodes[3] = _with_bits(wp.vec3(_NOWHERE), NO_NODE)
    if kind == 0:
        # Leaves are written by their parents: a tree may hold more, within leaves that it has merged.
        pair = wp.where(node == root, 0, before[node] + 1)
        for k in range(2):
            child = bits_of(_tree_node(mesh, node, k == 1)[3])
            low = _tree_node(mesh, child, False)
            high = _tree_node(mesh, child, True)
            entry = before[child] + 1
            if _tree_kind(mesh, child) == 1:
                entry = -2 - bits_of(low[3])
                _order_leaf(mesh, bits_of(low[3]), bits_of(high[3]), order)
            nodes[4 * pair + 2 * k] = _with_bits(wp.vec3(low[0], low[1], low[2]) - pad, entry)
            nodes[4 * pair + 2 * k + 1] = _with_bits(wp.vec3(high[0], high[1], high[2]) + pad, 0)


def read_tree(mesh: wp.Mesh, extent: float) -> tuple[wp.array, wp.array]:
    """Nodes and order of a mesh's tree, see `pack_bvh`."""
    count, device = mesh.indices.size // 3, mesh.device
    has_children = wp.zeros(2 * count + 1, dtype=int, device=device)
    before = wp.zeros_like(has_children)
    nodes = wp.zeros(4 * (count + 1), dtype=wp.vec4, device=device)
    order = wp.zeros(count, dtype=int, device=device)
    wp.launch(_count_kernel, has_children.size, [mesh.id], outputs=[has_children], device=device)
    wp.utils.array_scan(has_children, before, inclusive=False)
    inputs = [mesh.id, box_padding(extent), before]
    wp.launch(_pack_kernel, has_children.size, inputs, outputs=[nodes, order], device=device)
    return nodes, order


def pack_bvh(mesh: wp.Mesh, extent: float) -> tuple[wp.array, wp.array, wp.array]:
    """Nodes, faces and order of a mesh's tree, for `step_node` and `face_distance`; see `refit_bvh` for moved points.

    Args:
        mesh: Any `wp.Mesh` on a GPU.
        extent: Its largest coordinate [m], for the padding of the boxes.

    Returns:
        nodes: vec4 [4 * pairs], see above; boxes are padded against rounding.
        faces: vec4 [3 * slots], see `face_distance`.
        order: int32 [slots]: the face in each slot, or ~face where the next slot belongs to the same leaf.
    """
    nodes, order = read_tree(mesh, extent)
    return nodes, pack_faces(mesh, extent, order), order


@wp.kernel(enable_backward=False)
def _depth_kernel(nodes: wp.array(dtype=wp.vec4), level: int, depth: wp.array(dtype=int)):
    """Launch: pairs."""
    pair = wp.tid()
    if depth[pair] == level:
        for k in range(2):
            entry = bits_of(nodes[4 * pair + 2 * k][3])
            if entry >= 0:
                depth[entry] = level + 1


def pair_depths(nodes: wp.array) -> tuple[wp.array, int]:
    """How deep in the tree each pair of nodes of `pack_bvh` stands, int32 [pairs], -1 for none, and the number of
    levels; waits for the device."""
    depth = wp.full(nodes.size // 4, -1, dtype=int, device=nodes.device)
    depth[:1].zero_()
    for level in range(Stack._length_):
        wp.launch(_depth_kernel, depth.size, [nodes, level], outputs=[depth], device=nodes.device)
    return depth, int(depth.numpy().max()) + 1


@wp.kernel(enable_backward=False)
def _refit_kernel(
    mesh: wp.uint64,
    padding: float,
    level: int,
    depth: wp.array(dtype=int),
    order: wp.array(dtype=int),
    nodes: wp.array(dtype=wp.vec4),
):
    """Boxes of the pairs of one level, those below being done. Launch: pairs."""
    pair = wp.tid()
    if depth[pair] != level:
        return
    m = wp.mesh_get(mesh)
    for k in range(2):
        entry = bits_of(nodes[4 * pair + 2 * k][3])
        low = wp.vec3(_NOWHERE)
        high = wp.vec3(-_NOWHERE)
        if entry >= 0:
            for child in range(2):
                lower = nodes[4 * entry + 2 * child]
                upper = nodes[4 * entry + 2 * child + 1]
                low = wp.min(low, wp.vec3(lower[0], lower[1], lower[2]))
                high = wp.max(high, wp.vec3(upper[0], upper[1], upper[2]))
        elif entry != NO_NODE:
            slot = -2 - entry
            more = bool(True)
            while more:
                face = face_in(order, slot)
                for corner in range(3):
                    p = m.points[m.indices[3 * face + corner]]
                    low = wp.min(low, p - wp.vec3(padding))
                    high = wp.max(high, p + wp.vec3(padding))
                more = order[slot] < 0
                slot += 1
        if entry != NO_NODE:
            nodes[4 * pair + 2 * k] = _with_bits(low, entry)
            nodes[4 * pair + 2 * k + 1] = _with_bits(high, 0)


def refit_bvh(
    mesh: wp.Mesh, extent: float, nodes: wp.array, faces: wp.array, order: wp.array, depth: wp.array, levels: int
) -> None:
    """Boxes and faces of a packed tree for points that have moved: a launch a level, without an allocation or a look
    at Warp's own tree. `depth` and `levels` are those of `pair_depths`."""
    for level in reversed(range(levels)):
        inputs = [mesh.id, box_padding(extent), level, depth, order]
        wp.launch(_refit_kernel, depth.size, inputs, outputs=[nodes], device=mesh.device)
    set_faces(mesh, extent, order, faces)


def empty_bvh(device: wp.DeviceLike) -> tuple[wp.array, wp.array, wp.array]:
    """What `pack_bvh` returns, for no faces at all: a root whose two children no ray meets."""
    x, bits = 1.0e30, float(np.array(-1, np.int32).view(np.float32))
    nodes = wp.array([[x, x, x, bits]] * 4, dtype=wp.vec4, device=device)
    return nodes, wp.zeros(0, dtype=wp.vec4, device=device), wp.zeros(0, dtype=int, device=device)


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


@wp.func
def step_node(nodes: wp.array(dtype=wp.vec4), walk: TreeWalk, inverse: wp.vec3, shift: wp.vec3):
    """The children of a node that a ray meets, the nearer first: two nodes, `NO_NODE` in place of one that it misses.

    Args:
        nodes: From `pack_bvh`.
        walk: Its node is >= 0; a walk begins with node 0. Below `NO_NODE` are leaves: -2 - slot of the first face.
        inverse: `inverse_direction` of the ray.
        shift: The ray's origin times `inverse`, by components.
    """
    one = box_span(nodes, walk.node, 0, inverse, shift, walk.nearest)
    two = box_span(nodes, walk.node, 1, inverse, shift, walk.nearest)
    first = wp.where(one[0] <= one[1], bits_of(one[2]), NO_NODE)
    second = wp.where(two[0] <= two[1], bits_of(two[2]), NO_NODE)
    swap = first == NO_NODE or (second != NO_NODE and two[0] < one[0])
    return wp.where(swap, second, first), wp.where(swap, first, second)


@wp.struct
class LeafStep:
    """A face of a leaf against a ray.

    Attributes:
        slot: Of the face.
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
    step.slot = -2 - walk.node
    step.distance = face_distance(faces, step.slot, x, u)
    step.hit = step.distance >= 0.0 and step.distance < walk.nearest
    step.node = wp.where(order[step.slot] < 0, walk.node - 1, NO_NODE)
    return step
