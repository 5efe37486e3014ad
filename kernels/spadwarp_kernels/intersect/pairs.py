"""The tree of a `wp.Mesh`, read from Warp's private structs: what the trees of GPUs and CPUs are made of.

Its nodes stand in pairs of four vec4: lower and upper corner of the first child, then of the second. The fourth
component of a lower corner holds the bits of the child: the index of its own pair, -2 - slot of the first face of a
leaf, or NO_NODE.
"""

import warp as wp

from spadwarp_kernels.math.bits import bits_of, from_bits

from .triangle import box_padding

# In place of a child that is not there, and of a walk's node at its end: nodes are above, leaves below.
NO_NODE = wp.constant(-1)

# Where no ray comes to [m].
NOWHERE = wp.constant(1.0e30)

# Warp's trees are at most so deep.
DEEPEST = 32


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
        nodes[2] = _with_bits(wp.vec3(NOWHERE), NO_NODE)
        nodes[3] = _with_bits(wp.vec3(NOWHERE), NO_NODE)
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
    """Pairs of nodes and order of a mesh's tree.

    Args:
        mesh: Any `wp.Mesh`.
        extent: Its largest coordinate [m], for the padding of the boxes.

    Returns:
        nodes: vec4 [4 * pairs], see above; boxes are padded against rounding.
        order: int32 [faces]: the face in each slot, or ~face where the next slot belongs to the same leaf.
    """
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
