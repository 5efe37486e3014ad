"""Rays against a triangle mesh on the CPU: a tree of eight children a node, for the vector registers of a core.

The tree is Warp's, as `read_tree` gives it: of each node the child with the largest surface is opened until there are
eight (Wald, Benthin & Boulos, Interactive Ray Tracing 2008), and what holds eight faces or fewer becomes a leaf. A ray
is tested against eight boxes, and against eight faces, at once. The nearer boxes come first, and those that wait are
left out where they begin behind the nearest face so far.

A node is 14 vec4, as seven rows of eight numbers: lower x, y and z of its children, upper x, y and z, and the children
as bits: a node's index, -2 - slot of the first face of a leaf, or NO_NODE. A leaf is a block of faces, see `triangle`.
A hit must lie in the box of the face itself too, as in a tree of one face a leaf, and of faces at the same distance the
first in the mesh counts: so hits do not depend on the tree.
"""

import numpy as np
import warp as wp

from spadwarp_kernels.base.native import bits_of

from .bvh import NO_NODE, Tree, open_tree, read_tree
from .triangle import LANES, face_number, numbers_of, pack_faces, set_faces

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


def _split_leaves(tree: Tree) -> Tree:
    """Leaves of more than LANES faces become nodes, parted in the middle."""
    while (large := np.flatnonzero((tree.children[:, 0] < 0) & (tree.stop - tree.start > LANES))).size:
        nodes = len(tree.start) + np.arange(2 * large.size)
        tree.children[large] = nodes.reshape(2, -1).T
        start, stop = tree.start[large], tree.stop[large]
        middle, box = (start + stop) // 2, [np.tile(corner[large], (2, 1)) for corner in (tree.lower, tree.upper)]
        new = (np.full((nodes.size, 2), -1), *box, np.append(start, middle), np.append(middle, stop))
        tree = Tree(tree.root, *map(np.concatenate, zip(tree[1:6], new, strict=True)), tree.faces)
    return tree


@wp.kernel(enable_backward=False)
def _boxes_kernel(faces: wp.array[float], nodes: wp.array[float]):
    """Boxes of all children, from the last node to the first, which stand after their parents. Launch: 1."""
    count = nodes.shape[0] / 56
    for i in range(count):
        node = count - 1 - i
        for k in range(LANES):
            child = bits_of(nodes[56 * node + 48 + k])
            for axis in range(3):
                low = float(1.0e30)
                high = float(-1.0e30)
                if child != NO_NODE:
                    for lane in range(LANES):
                        if child >= 0:
                            low = wp.min(low, nodes[56 * child + 8 * axis + lane])
                            high = wp.max(high, nodes[56 * child + 24 + 8 * axis + lane])
                        else:
                            slot = -2 - child + lane
                            low = wp.min(low, faces[face_number(slot, 12 + axis)])
                            high = wp.max(high, faces[face_number(slot, 15 + axis)])
                nodes[56 * node + 8 * axis + k] = low
                nodes[56 * node + 24 + 8 * axis + k] = high


def pack_wide(mesh: wp.Mesh, extent: float) -> tuple[wp.array, wp.array, wp.array]:
    """A mesh's tree for `walk_wide`, for coordinates up to the extent [m]: nodes, vec4 [14 * nodes], see above; faces,
    vec4 [36 * leaves], see `triangle`; and the face in each slot, int32 [8 * leaves], -1 for none."""
    tree = _split_leaves(read_tree(mesh, extent))
    leaf = tree.stop - tree.start <= LANES
    nodes, held, _ = open_tree(tree, leaf, LANES)
    leaves = held[(held >= 0) & leaf[held]]
    blocks = tree.start[leaves][:, None] + np.arange(LANES)
    slots = np.where(blocks < tree.stop[leaves][:, None], tree.faces[np.minimum(blocks, len(tree.faces) - 1)], -1)
    entry = np.full(len(leaf), NO_NODE)
    entry[leaves] = -2 - LANES * np.arange(len(leaves))
    entry[nodes[~leaf[nodes]]] = np.flatnonzero(~leaf[nodes])
    rows = np.zeros((len(nodes), 7, LANES), np.float32)
    rows[:, 6] = np.where(held >= 0, entry[held], NO_NODE).astype(np.int32).view(np.float32)
    boxes = wp.array(rows.reshape(-1, 4), dtype=wp.vec4, device="cpu", copy=False)  # in large pages, see `zeros`
    order = wp.array(slots.ravel(), dtype=int, device="cpu")
    faces = pack_faces(mesh, extent, order)
    wp.launch(_boxes_kernel, 1, [numbers_of(faces)], [numbers_of(boxes)], device="cpu")
    return boxes, faces, order


def refit_wide(mesh: wp.Mesh, extent: float, nodes: wp.array, faces: wp.array, order: wp.array) -> None:
    """Boxes and faces of a packed tree for points that have moved."""
    set_faces(mesh, extent, order, faces)
    wp.launch(_boxes_kernel, 1, [numbers_of(faces)], [numbers_of(nodes)], device="cpu")


def empty_tree(device: wp.Device) -> tuple[wp.array, wp.array, wp.array]:
    """Nodes, faces and order of no faces at all: a root whose children no ray meets; of `bvh` on CUDA."""
    rows = np.full((4, 4) if device.is_cuda else (7, LANES), np.array(-1, np.int32).view(np.float32))
    if device.is_cuda:
        rows[0], rows[1, :2] = (1.0e30, 1.0e30, 1.0e30, 0.0), 0.0
    else:
        rows[:3], rows[3:6] = 1.0e30, -1.0e30
    nodes = wp.array(rows.reshape(-1, 4), dtype=wp.vec4, device=device)
    return nodes, wp.zeros(0, dtype=wp.vec4, device=device), wp.zeros(0, dtype=int, device=device)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return wp::vec2(reach, 0.0f);
#else
    typedef float row __attribute__((ext_vector_type(8), aligned(4)));
    typedef int32_t irow __attribute__((ext_vector_type(8), aligned(4)));
    typedef bool flags __attribute__((ext_vector_type(8)));
    const auto more = [](row p, row q) { return p > q ? p : q; };
    const auto less = [](row p, row q) { return p < q ? p : q; };
    const auto size = [](row p) { return __builtin_elementwise_abs(p); };
    const auto bits = [](irow p) { return (unsigned)__builtin_bit_cast(uint8_t, __builtin_convertvector(p, flags)); };

    // Of the rows of lower and upper corners, those that a ray in this direction meets first.
    const int x0 = inverse[0] < 0.0f ? 3 : 0, y0 = inverse[1] < 0.0f ? 4 : 1, z0 = inverse[2] < 0.0f ? 5 : 2;
    const int x1 = 3 - x0, y1 = 5 - y0, z1 = 7 - z0;
    float nearest = reach;
    const auto enter = [&](const row* box) {
        return more(more(box[x0] * inverse[0] - shift[0], box[y0] * inverse[1] - shift[1]),
                    more(box[z0] * inverse[2] - shift[2], row(0.0f)));
    };
    const auto leave = [&](const row* box) {
        return less(less(box[x1] * inverse[0] - shift[0], box[y1] * inverse[1] - shift[1]),
                    less(box[z1] * inverse[2] - shift[2], row(nearest)));
    };

    // Seven children wait at each of Warp's 32 levels at most, and where many faces lie on each other at 10 more.
    int waiting[300], depth = 1, node = 0, found = -1;
    float entries[300];
    waiting[0] = -1;
    entries[0] = 0.0f;
    while (node != -1) {
        if (node >= 0) {
            const row* box = reinterpret_cast<const row*>(nodes.data) + 7 * node;
            const row entry = enter(box);
            const irow children = __builtin_bit_cast(irow, box[6]);
            node = -1;
            float first = 0.0f;
            for (unsigned met = bits(entry <= leave(box)); met; met &= met - 1) {
                const int k = __builtin_ctz(met);
                const bool nearer = node == -1 || entry[k] < first;
                if (node != -1) {
                    waiting[depth] = nearer ? node : children[k];
                    entries[depth++] = nearer ? first : entry[k];
                }
                if (nearer) {
                    node = children[k];
                    first = entry[k];
                }
            }
            if (node != -1) continue;
        } else {
            // As meet_planes.
            const int slot = -2 - node;
            const row* f = reinterpret_cast<const row*>(faces.data) + 18 * (slot / 8);
            const row rate = f[8] * u[0] + f[9] * u[1] + f[10] * u[2];
            const row height = f[11] - (f[8] * x[0] + f[9] * x[1] + f[10] * x[2]);
            const row distance = height / rate;
            const row a = x[0] + distance * u[0], b = x[1] + distance * u[1], c = x[2] + distance * u[2];
            const row p = f[0] * a + f[1] * b + f[2] * c + f[3];
            const row q = f[4] * a + f[5] * b + f[6] * c + f[7];
            const row least = less(less(p, q), 1.0f - p - q);
            const row hair = 4.0e-7f * (size(a) + size(b) + size(c) + distance);
            unsigned hit = bits((least * size(rate) >= -hair) & (distance >= 0.0f) & (distance <= nearest));
            if (hit) hit &= bits(enter(f + 12) <= leave(f + 12));
            for (; hit; hit &= hit - 1) {
                const int k = __builtin_ctz(hit);
                const bool level = distance[k] == nearest && found >= 0;
                if (distance[k] < nearest || (level && order.data[slot + k] < order.data[found])) {
                    nearest = distance[k];
                    found = slot + k;
                }
            }
            if (any_hit && found >= 0) break;
        }
        do node = waiting[--depth]; while (entries[depth] > nearest);
    }
    union { float number; int bits; } both;
    both.bits = found;
    return wp::vec2(nearest, both.number);
#endif
""")
def walk_wide(
    nodes: wp.array[wp.vec4],
    faces: wp.array[wp.vec4],
    order: wp.array[int],
    x: wp.vec3,
    u: wp.vec3,
    inverse: wp.vec3,
    shift: wp.vec3,
    reach: float,
    any_hit: bool,
) -> wp.vec2:
    """Distance of the nearest face along a ray of length `reach`, or that, and the bits of its slot, -1 for none; CPU
    alone. `inverse` is `inverse_direction`, `shift` the origin times that, by components; with `any_hit` the first leaf
    with a face that it meets is enough."""
    ...
