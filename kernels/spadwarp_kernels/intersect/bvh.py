"""Rays against a triangle mesh, step by step: the tree of a `wp.Mesh`, laid out for the warps of a GPU.

`wp.mesh_query_ray` walks a tree from its root to the end of the ray, so that a warp waits for its longest walk, some of
its lanes in the tree's nodes and others at its leaves. Here a walk is a state (node, stack, nearest face so far) that
a kernel moves on by a step: all lanes that are in nodes together, or all that are at leaves, and new rays join while
old ones still walk (Aila & Laine, High-Performance Graphics 2009, on what the order of steps is worth).

Nodes stand in pairs of four vec4: lower and upper corner of the first child, then of the second. The fourth component
of a lower corner holds the bits of the child: the index of its own pair, or -2 - slot of its first face. Faces are
three vec4 each, see `face_distance`, in the order of the leaves.
"""

import warp as wp

from spadwarp_kernels.math.bits import bits_of, from_bits

# What a walk that has come to its end holds in place of a node: nodes are above, leaves below.
FINISHED = wp.constant(-1)

# Nodes that a walk will go back to: Warp's trees are at most 32 deep.
Stack = wp.types.vector(length=34, dtype=int)

# Boxes and faces are widened by this part of the coordinates and distances: a few units in the last place of float32.
_WIDENING = wp.constant(4.0e-7)

_NOWHERE = wp.constant(1.0e30)


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
        nodes[2] = _with_bits(wp.vec3(_NOWHERE), FINISHED)
        nodes[3] = _with_bits(wp.vec3(_NOWHERE), FINISHED)
    if kind == 0:
        # Leaves are written by their parents: a tree may hold more, within leaves that it has merged.
        place = wp.where(node == root, 0, before[node] + 1)
        for k in range(2):
            child = bits_of(_tree_node(mesh, node, k == 1)[3])
            low = _tree_node(mesh, child, False)
            high = _tree_node(mesh, child, True)
            entry = before[child] + 1
            if _tree_kind(mesh, child) == 1:
                entry = -2 - bits_of(low[3])
                _order_leaf(mesh, bits_of(low[3]), bits_of(high[3]), order)
            nodes[4 * place + 2 * k] = _with_bits(wp.vec3(low[0], low[1], low[2]) - pad, entry)
            nodes[4 * place + 2 * k + 1] = _with_bits(wp.vec3(high[0], high[1], high[2]) + pad, 0)


@wp.func
def face_in(order: wp.array(dtype=int), slot: int) -> int:
    """Index of the face in a slot."""
    face = order[slot]
    return wp.where(face < 0, ~face, face)


@wp.kernel(enable_backward=False)
def _faces_kernel(mesh: wp.uint64, order: wp.array(dtype=int), faces: wp.array(dtype=wp.vec4)):
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


def pack_bvh(mesh: wp.Mesh, extent: float) -> tuple[wp.array, wp.array, wp.array]:
    """Nodes, faces and order of a mesh's tree, for `walk_node` and `face_distance`; to be made anew after a refit.

    Args:
        mesh: Any `wp.Mesh`.
        extent: Its largest coordinate [m], for the padding of the boxes.

    Returns:
        nodes: vec4 [4 * pairs], see above; boxes are padded against rounding.
        faces: vec4 [3 * slots], see `face_distance`.
        order: int32 [slots]: the face in each slot, or ~face where the next slot belongs to the same leaf.
    """
    count, device = mesh.indices.size // 3, mesh.device
    has_children = wp.zeros(2 * count + 1, dtype=int, device=device)
    before = wp.zeros_like(has_children)
    nodes = wp.zeros(4 * (count + 1), dtype=wp.vec4, device=device)
    faces = wp.zeros(3 * count, dtype=wp.vec4, device=device)
    order = wp.zeros(count, dtype=int, device=device)
    wp.launch(_count_kernel, has_children.size, [mesh.id], outputs=[has_children], device=device)
    wp.utils.array_scan(has_children, before, inclusive=False)
    padding = 2.5 * _WIDENING * extent + 1e-9
    wp.launch(_pack_kernel, has_children.size, [mesh.id, padding, before], outputs=[nodes, order], device=device)
    wp.launch(_faces_kernel, count, [mesh.id, order], outputs=[faces], device=device)
    return nodes, faces, order


@wp.func
def _inverse(d: float) -> float:
    return 1.0 / wp.where(wp.abs(d) < 1.0e-18, 1.0e-18, d)


@wp.func
def inverse_direction(u: wp.vec3) -> wp.vec3:
    """1/u by components, finite."""
    return wp.vec3(_inverse(u[0]), _inverse(u[1]), _inverse(u[2]))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4* box = reinterpret_cast<const float4*>(nodes.data) + 4 * node + 2 * child;
    const float4 lower = __ldg(box), upper = __ldg(box + 1);
    const float a = lower.x * inverse[0] - shift[0], b = upper.x * inverse[0] - shift[0];
    const float c = lower.y * inverse[1] - shift[1], d = upper.y * inverse[1] - shift[1];
    const float e = lower.z * inverse[2] - shift[2], f = upper.z * inverse[2] - shift[2];
    return wp::vec3(
        fmaxf(fmaxf(fminf(a, b), fminf(c, d)), fmaxf(fminf(e, f), 0.0f)),
        fminf(fminf(fmaxf(a, b), fmaxf(c, d)), fminf(fmaxf(e, f), reach)),
        lower.w);
#else
    // The three axes in a vector register; its fourth number is none to compute with.
    typedef float vec __attribute__((ext_vector_type(4), aligned(4)));
    typedef int32_t ivec __attribute__((ext_vector_type(4), aligned(4)));
    const ivec* box = reinterpret_cast<const ivec*>(nodes.data) + 4 * node + 2 * child;
    const ivec axes = {-1, -1, -1, 0};
    const ivec lower = box[0], upper = box[1];
    const vec factor = {inverse[0], inverse[1], inverse[2], 0.0f};
    const vec offset = {shift[0], shift[1], shift[2], 0.0f};
    const vec a = __builtin_bit_cast(vec, lower & axes) * factor - offset;
    const vec b = __builtin_bit_cast(vec, upper & axes) * factor - offset;
    const vec first = a < b ? a : b;
    const vec last = a < b ? b : a;
    const auto more = [](float p, float q) { return p > q ? p : q; };
    const auto less = [](float p, float q) { return p < q ? p : q; };
    return wp::vec3(
        more(more(first[0], first[1]), more(first[2], 0.0f)),
        less(less(last[0], last[1]), less(last[2], reach)),
        reinterpret_cast<const float*>(box)[3]);
#endif
""")
def _span(
    nodes: wp.array(dtype=wp.vec4), node: int, child: int, inverse: wp.vec3, shift: wp.vec3, reach: float
) -> wp.vec3:
    """Where a ray enters and leaves the box of a child, within [0, reach], and the child's bits; it misses where the
    first exceeds the second."""
    ...


@wp.func
def walk_node(nodes: wp.array(dtype=wp.vec4), node: int, inverse: wp.vec3, shift: wp.vec3, reach: float):
    """The children of a node that a ray meets, the nearer first: two nodes, `FINISHED` in place of one that it misses.

    Args:
        nodes: From `pack_bvh`.
        node: >= 0; a walk begins with node 0. Below `FINISHED` are leaves: -2 - slot of the first face.
        inverse: `inverse_direction` of the ray.
        shift: The ray's origin times `inverse`, by components.
        reach: Distance of the nearest face so far, or the length of the ray [m].
    """
    one = _span(nodes, node, 0, inverse, shift, reach)
    two = _span(nodes, node, 1, inverse, shift, reach)
    first = wp.where(one[0] <= one[1], bits_of(one[2]), FINISHED)
    second = wp.where(two[0] <= two[1], bits_of(two[2]), FINISHED)
    swap = first == FINISHED or (second != FINISHED and two[0] < one[0])
    return wp.where(swap, second, first), wp.where(swap, first, second)


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
    hair = _WIDENING * (wp.abs(y[0]) + wp.abs(y[1]) + wp.abs(y[2]) + distance)
    if not (least * wp.abs(rate) >= -hair and distance >= 0.0):
        distance = -1.0
    return distance


@wp.func
def face_normal(faces: wp.array(dtype=wp.vec4), slot: int, u: wp.vec3) -> wp.vec3:
    """The unit normal of a face, against u."""
    n = load_vec4(faces, 3 * slot + 2)
    normal = wp.normalize(wp.vec3(n[0], n[1], n[2]))
    return wp.where(wp.dot(normal, u) > 0.0, -normal, normal)
