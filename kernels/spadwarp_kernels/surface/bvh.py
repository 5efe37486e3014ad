"""Rays against a triangle mesh, step by step: the tree of a `wp.Mesh`, laid out for the warps of a GPU; `wide` is for
a CPU.

`wp.mesh_query_ray` walks a tree from its root to the end of the ray, so that a warp waits for its longest walk, some of
its lanes in the tree's nodes and others at its leaves. Here a walk is a state (node, stack, nearest face so far) that
a kernel moves on by `step_node` or `step_leaf`: all lanes that are in nodes together, or all that are at leaves, and
new rays join while old ones still walk (Aila & Laine, High-Performance Graphics 2009).

A node has four children: the binary tree's, of which the one with the largest surface is opened twice; their boxes are
in bytes (Ylitie, Karras & Laine, High Performance Graphics 2017). It is four vec4, half a line of a GPU's cache:

- origin x, y, z, scale x; scale y, z, lower x, y; lower z, upper x, y, z: of the boxes a byte k for each child, the
  first in the lowest, that stands for origin + scale (1 + k / 32768), rounded outwards;
- the bits of the children: the index of a node, NO_NODE, or below it a leaf, see `leaf_at`.

Faces are three vec4 each, see `meet_planes`, in the order of the leaves; two that make a parallelogram may be tried as
one, see `join_faces`.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from spadwarp_kernels.base.native import bits_of, from_bits

from .patches import SAME, join_faces, shared_corner
from .triangle import box_padding, face_in, load_plane, meet_planes, number_in, set_rows

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float in[3], out[3];
    for (int i = 0; i < 3; ++i) {
        // Infinite for a segment parallel to these two sides: in and out are then infinite as well, and their signs
        // decide. In the plane of a side 0 * infinity is no number; any answer is right there, within the padding.
        const float inverse = 1.0f / u[i], a = (lower[i] - x[i]) * inverse, b = (upper[i] - x[i]) * inverse;
        in[i] = wp::min(a, b);
        out[i] = wp::max(a, b);
    }
    // As integers, of which Hopper takes three at a time; the order of positive floats is the same, and what is
    // negative counts only as that.
    const auto bits = [](float number) { return __float_as_int(number); };
    const int enters = __vimax3_s32_relu(bits(in[0]), bits(in[1]), bits(in[2]));
    return enters <= min(__vimin3_s32(bits(out[0]), bits(out[1]), bits(out[2])), bits(length));
#else
    // The three axes in one vector register; the fourth lane is the segment itself, from 0 to its length.
    typedef float row __attribute__((vector_size(16)));
    const auto least = [](row p, row q) { return p < q ? p : q; };
    const auto most = [](row p, row q) { return p > q ? p : q; };
    const row start = {x[0], x[1], x[2], 0.0f}, low = {lower[0], lower[1], lower[2], 0.0f};
    const row high = {upper[0], upper[1], upper[2], length}, heading = {u[0], u[1], u[2], 1.0f};
    const row tiny = row{} + 1.0e-12f;
    const row inverse = 1.0f / (__builtin_elementwise_abs(heading) < tiny ? tiny : heading);
    const row a = (low - start) * inverse, b = (high - start) * inverse;
    row near = least(a, b), far = most(a, b);
    near = most(near, __builtin_shufflevector(near, near, 2, 3, 0, 1));
    far = least(far, __builtin_shufflevector(far, far, 2, 3, 0, 1));
    near = most(near, __builtin_shufflevector(near, near, 1, 0, 3, 2));
    far = least(far, __builtin_shufflevector(far, far, 1, 0, 3, 2));
    return near[0] <= far[0];
#endif
""")
def segment_meets_box(x: wp.vec3, u: wp.vec3, length: float, lower: wp.vec3, upper: wp.vec3) -> bool:
    """False only if the segment x + s u, 0 <= s <= length, misses the box; the box must be padded against rounding."""
    ...


# ---- The tree of a `wp.Mesh`, read from Warp's private structs: what the trees of GPUs and CPUs are made of.


# In place of a child that is not there, and of a walk's node at its end: nodes are above, leaves below.
NO_NODE = wp.constant(-1)

# Where no ray comes to [m].
NOWHERE = wp.constant(1.0e30)

# Warp's trees are at most so deep.
DEEPEST = 32


@wp.func_native("""
    const wp::Mesh m = wp::mesh_get(mesh);
    // The linear builder fills all nodes that there are room for, the others count theirs.
    const bool linear = m.bvh.constructor_type == BVH_CONSTRUCTOR_LBVH;
    const bool there = node < (linear ? m.bvh.max_nodes : m.bvh.num_nodes);
    links.data[3 * node] = there ? static_cast<int>(m.bvh.node_lowers[node].b) : -1;
    for (int k = 0; there && k < 2; ++k) {
        const wp::BVHPackedNodeHalf half = k ? m.bvh.node_uppers[node] : m.bvh.node_lowers[node];
        boxes.data[2 * node + k] = wp::vec3(half.x, half.y, half.z);
        links.data[3 * node + 1 + k] = static_cast<int32_t>(half.i);
    }
    const int count = faces.shape[0] - 1;
    if (node < count) faces.data[node] = m.bvh.primitive_indices[node];
    if (node == 0) faces.data[count] = *m.bvh.root;
""")
def _read_node(mesh: wp.uint64, node: int, links: wp.array2d[int], boxes: wp.array2d[wp.vec3], faces: wp.array[int]):
    """Whether a node is a leaf, -1 beyond the tree, and its children, or of a leaf the first face and the one after the
    last; the corners of its box; the faces, and behind them the root."""
    ...


@wp.kernel(enable_backward=False)
def _read_kernel(mesh: wp.uint64, links: wp.array2d[int], boxes: wp.array2d[wp.vec3], faces: wp.array[int]):
    """Launch: nodes that the tree may have."""
    _read_node(mesh, wp.tid(), links, boxes, faces)


class Tree(NamedTuple):
    """The binary tree of a mesh on the host, in which nothing leads to some of the nodes: these have no faces."""

    root: int
    children: np.ndarray  # [nodes, 2]; -1 for a leaf
    lower: np.ndarray  # corners of the boxes [m], float32 [nodes, 3], padded against rounding
    upper: np.ndarray
    start: np.ndarray  # where the faces below a node stand in `faces`, [nodes]
    stop: np.ndarray
    faces: np.ndarray  # from left to right, [faces]


def read_tree(mesh: wp.Mesh, extent: float) -> Tree:
    """The tree of any `wp.Mesh` with coordinates up to the extent [m]."""
    count, device = mesh.indices.size // 3, mesh.device
    most = 2 * count + 1
    shapes = (((most, 3), int), ((most, 2), wp.vec3), (count + 1, int))
    arrays = [wp.zeros(shape, dtype=kind, device=device) for shape, kind in shapes]
    wp.launch(_read_kernel, most, [mesh.id], arrays, device=device)
    links, boxes, slots = (array.numpy() for array in arrays)
    kind, children, root = links[:, 0], links[:, 1:], slots[-1:]
    levels, leaves, here = [], [], root
    while here.size:
        leaves.append(here[kind[here] == 1])
        levels.append(here[kind[here] == 0])
        here = children[levels[-1]].ravel()
    leaf = np.concatenate(leaves)
    size, start = (np.zeros(most, np.int64) for _ in range(2))
    size[leaf] = children[leaf, 1] - children[leaf, 0]
    for nodes in reversed(levels):
        size[nodes] = size[children[nodes]].sum(axis=1)
    for nodes in levels:
        left, right = children[nodes].T
        start[left], start[right] = start[nodes], start[nodes] + size[left]
    leaf = leaf[np.argsort(start[leaf], kind="stable")]
    faces = slots[np.repeat(children[leaf, 0] - start[leaf], size[leaf]) + np.arange(count)]
    inner = np.concatenate(levels)
    below = np.full((most, 2), -1)
    below[inner] = children[inner]
    boxes[np.setdiff1d(np.arange(most), np.append(leaf, inner))] = 0.0  # the tree does not use them: they hold anything
    pad = np.float32(box_padding(extent))
    return Tree(int(root[0]), below, boxes[:, 0] - pad, boxes[:, 1] + pad, start, start + size, faces)


def open_tree(tree: Tree, closed: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes of `width` children, level by level: the child with the largest surface is opened until there are so many,
    but none that is closed, a leaf.

    Returns:
        The tree's node that each stands for; its children among those, [nodes, width], -1 for none; its level.
    """
    size = tree.upper - tree.lower
    area = size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0]
    area = np.append(np.where(closed, -1.0, area), -1.0)  # the last is that of the child -1
    nodes, children, here = [], [], np.array([tree.root])
    while here.size:
        held = np.full((here.size, width), -1)
        held[:, 0] = here
        for count in range(1, width):
            best = area[held].argmax(axis=1)
            rows = np.flatnonzero(area[held[np.arange(len(held)), best]] >= 0.0)
            opened = tree.children[held[rows, best[rows]]]
            held[rows, best[rows]], held[rows, count] = opened.T
        nodes.append(here)
        children.append(held)
        here = held[area[held] >= 0.0]
    levels = np.repeat(np.arange(len(nodes)), [len(level) for level in nodes])
    return np.concatenate(nodes), np.concatenate(children), levels


# ---- Nodes.


# Corners of four boxes, a row each.
Corners = wp.types.matrix(shape=(4, 3), dtype=float)

# Bytes of a box are this part of a node's scale apart.
_BYTE = wp.constant(1.0 / 32768.0)

# A box is wider by this part of a byte, for what a step rounds, which is a 256th.
_SLACK = wp.constant(1.0 / 64.0)


@wp.func
def child_of(nodes: wp.array[wp.vec4], node: int, k: int) -> int:
    """One of the four children of a node."""
    return bits_of(nodes[4 * node + 3][k])


@wp.func
def leaf_at(order: wp.array[int], slot: int) -> int:
    """A slot's face and those after it in its leaf, as a child of a node: -2 - 2 slot, one less if there are more."""
    return -2 - 2 * slot - wp.where(number_in(order, slot) < 0, 1, 0)


@wp.func
def slot_of(leaf: int) -> int:
    """The slot of a leaf's first face."""
    return (-2 - leaf) >> 1


@wp.func
def _byte(bits: int, k: int) -> int:
    return (bits >> (8 * k)) & 255


@wp.func
def set_node(nodes: wp.array[wp.vec4], node: int, children: wp.vec4i, low: Corners, high: Corners):
    """Writes a node of boxes with these corners; those of children that are not there do not matter."""
    origin, scale = wp.vec3(), wp.vec3()
    lower, upper = wp.vec3i(), wp.vec3i()
    for axis in range(3):
        least = float(NOWHERE)
        most = float(-NOWHERE)
        for k in range(4):
            if children[k] != NO_NODE:
                least = wp.min(least, low[k, axis])
                most = wp.max(most, high[k, axis])
        step = wp.max((most - least) / 254.9, 2.0e-7 * wp.max(wp.abs(least), wp.abs(most)))
        scale[axis] = step / _BYTE
        origin[axis] = (least - 2.0 * _SLACK * step) - scale[axis]
        zero = origin[axis] + scale[axis]
        for k in range(4):
            first = int(255)  # of a child that is not there the sides stand the wrong way round
            last = int(0)
            if children[k] != NO_NODE:
                first = wp.clamp(int(wp.floor((low[k, axis] - zero) / step - _SLACK)), 0, 255)
                last = wp.clamp(int(wp.ceil((high[k, axis] - zero) / step + _SLACK)), 0, 255)
            lower[axis] = lower[axis] | (first << (8 * k))
            upper[axis] = upper[axis] | (last << (8 * k))
    nodes[4 * node] = wp.vec4(origin[0], origin[1], origin[2], scale[0])
    nodes[4 * node + 1] = wp.vec4(scale[1], scale[2], from_bits(lower[0]), from_bits(lower[1]))
    nodes[4 * node + 2] = wp.vec4(from_bits(lower[2]), from_bits(upper[0]), from_bits(upper[1]), from_bits(upper[2]))
    for k in range(4):
        nodes[4 * node + 3][k] = from_bits(children[k])


@wp.func
def box_of(nodes: wp.array[wp.vec4], node: int):
    """Lower and upper corner of a box around all children of a node."""
    p = nodes[4 * node]
    q = nodes[4 * node + 1]
    r = nodes[4 * node + 2]
    origin = wp.vec3(p[0], p[1], p[2])
    scale = wp.vec3(p[3], q[0], q[1])
    lower = wp.vec3i(bits_of(q[2]), bits_of(q[3]), bits_of(r[0]))
    upper = wp.vec3i(bits_of(r[1]), bits_of(r[2]), bits_of(r[3]))
    low = wp.vec3()
    high = wp.vec3()
    for axis in range(3):
        first = int(255)
        last = int(0)
        for k in range(4):
            if child_of(nodes, node, k) != NO_NODE:
                first = wp.min(first, _byte(lower[axis], k))
                last = wp.max(last, _byte(upper[axis], k))
        zero = origin[axis] + scale[axis]
        a = zero + float(first) * (_BYTE * scale[axis])
        b = zero + float(last) * (_BYTE * scale[axis])
        low[axis] = a - 2.0e-7 * wp.abs(a)
        high[axis] = b + 2.0e-7 * wp.abs(b)
    return low, high


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4* row = reinterpret_cast<const float4*>(nodes.data) + 4 * static_cast<int64_t>(node);
    const float4 p = __ldg(row), q = __ldg(row + 1), r = __ldg(row + 2);
    // A byte k of the boxes becomes the float 1 + k / 32768, so that a slab costs one multiplication and addition.
    const float mx = p.w * inverse[0], my = q.x * inverse[1], mz = q.y * inverse[2];
    const float bx = p.x * inverse[0] - shift[0], by = p.y * inverse[1] - shift[1], bz = p.z * inverse[2] - shift[2];
    const unsigned lx = __float_as_uint(q.z), ly = __float_as_uint(q.w), lz = __float_as_uint(r.x);
    const unsigned hx = __float_as_uint(r.y), hy = __float_as_uint(r.z), hz = __float_as_uint(r.w);
    // Of the lower and upper sides, those that a ray in this direction meets first.
    const bool x = inverse[0] < 0.0f, y = inverse[1] < 0.0f, z = inverse[2] < 0.0f;
    const unsigned x0 = x ? hx : lx, y0 = y ? hy : ly, z0 = z ? hz : lz;
    const unsigned x1 = x ? lx : hx, y1 = y ? ly : hy, z1 = z ? lz : hz;
    // As integers, of which Hopper takes three at a time; the order of positive floats is the same, and what is
    // negative counts only as that. A ray that leaves a box before it enters misses it: its sign is put in front.
    const auto at = [](unsigned bytes, int pick, float scale, float start) {
        return __float_as_int(__uint_as_float(__byte_perm(bytes, 0x3f800000u, pick)) * scale + start);
    };
    const auto entry = [&](int pick) {
        const int in = __vimax3_s32_relu(at(x0, pick, mx, bx), at(y0, pick, my, by), at(z0, pick, mz, bz));
        const int out = __vimin3_s32(at(x1, pick, mx, bx), at(y1, pick, my, by), at(z1, pick, mz, bz));
        return in | (__float_as_uint(__int_as_float(out) - __int_as_float(in)) & 0x80000000u);
    };
    return wp::vec4ui(entry(0x7604), entry(0x7614), entry(0x7624), entry(0x7634));
#else
    return wp::vec4ui(0xffffffffu);
#endif
""")
def box_entries(nodes: wp.array[wp.vec4], node: int, inverse: wp.vec3, shift: wp.vec3) -> wp.vec4ui:
    """Bits of the distances at which a ray enters four children; 2^31 more for those that it misses. CUDA alone."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const uint4 child = __ldg(reinterpret_cast<const uint4*>(nodes.data) + 4 * static_cast<int64_t>(node) + 3);
    return wp::vec4ui(child.x, child.y, child.z, child.w);
#else
    return wp::vec4ui(0xffffffffu);
#endif
""")
def children_of(nodes: wp.array[wp.vec4], node: int) -> wp.vec4ui:
    """The bits of the four children of a node. CUDA alone."""
    ...


# ---- The tree.


# Where a walk will return to: three a level, and NO_NODE.
Stack = wp.types.vector(length=3 * DEEPEST + 2, dtype=int)

# Leaves of more faces are left as they are: all pairs of a leaf's faces are compared.
LARGEST_LEAF = 8


@wp.kernel(enable_backward=False)
def _nodes_kernel(
    children: wp.array[wp.vec4i], low: wp.array[Corners], high: wp.array[Corners], nodes: wp.array[wp.vec4]
):
    """Launch: nodes."""
    node = wp.tid()
    set_node(nodes, node, children[node], low[node], high[node])


def pack_bvh(mesh: wp.Mesh, extent: float, join: bool = True) -> tuple[wp.array, wp.array, wp.array, wp.array]:
    """A mesh's tree for `step_node` and `step_leaf`: nodes, vec4 [4 * nodes]; faces, vec4 [3 * slots]; the face in each
    slot, int32 [slots], or ~face where others of its leaf are tried after it; the level of each node.

    Boxes are padded for coordinates up to the extent [m]. `join`: two faces that make a parallelogram are tried as one,
    not where the points will move, see `refit_bvh`.
    """
    tree, device = read_tree(mesh, extent), mesh.device
    faces, size, closed = tree.faces, tree.stop - tree.start, tree.children[:, 0] < 0
    last = np.zeros(len(faces), bool)  # whether a slot is the last of its leaf
    last[tree.stop[closed & (size > 0)] - 1] = True
    corners = np.full(len(faces), -1)
    if join:
        same = SAME * extent
        points = mesh.points.numpy()[mesh.indices.numpy().reshape(-1, 3)]
        # Two leaves of a face each become one.
        both = np.flatnonzero(size == 2)
        slots = tree.start[both]
        paired = last[slots] & (shared_corner(points[faces[slots]], points[faces[slots + 1]], same) >= 0)
        closed[both[paired]] = True
        last[slots[paired]] = False
        stop = np.flatnonzero(last) + 1
        start = np.append(0, stop[:-1])
        few = stop - start <= LARGEST_LEAF
        faces, corners = join_faces(points, faces, start[few], stop[few], same)
    slots = np.arange(len(faces))
    stop = np.flatnonzero(last)[np.cumsum(last) - last] + 1
    order = np.where(slots + np.where(corners >= 0, 2, 1) < stop, ~faces, faces)

    nodes, held, levels = open_tree(tree, closed, 4)
    sort = np.argsort(np.where(nodes == tree.root, -1, nodes))  # the root, then as in Warp's tree
    nodes, held, levels = nodes[sort], held[sort], levels[sort]
    entry = -2 - 2 * tree.start - (order[tree.start] < 0)
    entry[nodes[~closed[nodes]]] = np.flatnonzero(~closed[nodes])
    children = np.where(held >= 0, entry[held], NO_NODE)
    packed, rows = (wp.zeros(size, dtype=wp.vec4, device=device) for size in (4 * len(nodes), 3 * len(order)))
    inputs = [(children.astype(np.int32), wp.vec4i), (tree.lower[held], Corners), (tree.upper[held], Corners)]
    arrays = [wp.array(values, dtype=kind, device=device) for values, kind in inputs]
    wp.launch(_nodes_kernel, len(nodes), arrays, [packed], device=device)
    order, corners, levels = (wp.array(each, dtype=int, device=device) for each in (order, corners, levels))
    set_rows(mesh, order, rows, corners)
    return packed, rows, order, levels


# Not compiled where nothing moves.
@wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 1})
def _refit_kernel(
    mesh: wp.uint64, padding: float, level: int, depth: wp.array[int], order: wp.array[int], nodes: wp.array[wp.vec4]
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
    """Boxes and faces for points that have moved, as many launches as levels; `depth`: that of each node."""
    for level in reversed(range(levels)):
        inputs = [mesh.id, box_padding(extent), level, depth, order]
        wp.launch(_refit_kernel, depth.size, inputs, outputs=[nodes], device=mesh.device)
    set_rows(mesh, order, faces)


@wp.struct
class TreeWalk:
    """A ray on its way down the tree; its stack is a `Stack` beside it."""

    node: int  # where it is; NO_NODE when it has come to its end
    depth: int  # size of the stack
    nearest: float  # distance of the nearest face so far, or the length of the ray [m]
    found: int  # slot of that face; -1 for none


@wp.func_native("__builtin_assume(depth >= 0); return depth;")
def place(depth: int) -> int:
    """An index of which the compiler then knows that it does not count from the end of an array."""
    ...


@wp.func
def _first(near: wp.vec2ui, far: wp.vec2ui):
    """(entry, child) of two, the nearer first."""
    swap = far[0] < near[0]
    return wp.where(swap, far, near), wp.where(swap, near, far)


@wp.struct
class NodeStep:
    """The children of a node against a ray, the nearest first."""

    child: wp.vec4i  # nodes; of no meaning for those that the ray misses
    entry: wp.vec4ui  # bits of the distances at which it enters their boxes [m]; 2^31 more for those that it misses
    reach: wp.uint32  # bits of the largest distance that counts


@wp.func
def step_node(nodes: wp.array[wp.vec4], walk: TreeWalk, inverse: wp.vec3, shift: wp.vec3) -> NodeStep:
    """The children of the walk's node, >= 0, that a ray meets; `inverse_direction` of the ray and its origin times that
    by components. A walk begins with node 0."""
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
    """A face of a leaf, or two that are one leaf, against a ray."""

    slot: int  # of the face, of two that which the ray would hit
    distance: float  # at which the ray meets it [m]; of no meaning for a miss
    hit: bool  # whether it does, nearer than the nearest face so far
    node: int  # the next face of the leaf, or NO_NODE after the last: then the walk returns to its stack


@wp.func
def step_leaf(faces: wp.array[wp.vec4], order: wp.array[int], walk: TreeWalk, x: wp.vec3, u: wp.vec3) -> LeafStep:
    """Tries the face that a walk has come to: its node is below NO_NODE; origin and unit direction of the ray."""
    step = LeafStep()
    slot = slot_of(walk.node)
    a = load_plane(faces, slot, 0)
    b = load_plane(faces, slot, 1)
    n = load_plane(faces, slot, 2)
    met = meet_planes(a, b, n, x, u)
    last = slot + wp.where(bits_of(n[3]) < 0, 1, 0)
    step.slot = wp.where(met[1] > 0.0, last, slot)
    step.distance = met[0]
    step.hit = step.distance >= 0.0 and step.distance < walk.nearest
    step.node = NO_NODE
    if (walk.node & 1) != 0:
        step.node = leaf_at(order, last + 1)
    return step
