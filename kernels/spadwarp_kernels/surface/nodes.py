"""A node of the tree on CUDA: boxes of four children in bytes (Ylitie, Karras & Laine, High Performance Graphics 2017).

It is four vec4, half a line of a GPU's cache:

- origin x, y, z, scale x; scale y, z, lower x, y; lower z, upper x, y, z: of the boxes a byte k for each child, the
  first in the lowest, that stands for origin + scale (1 + k / 32768), rounded outwards;
- the bits of the children: the index of a node, NO_NODE, or below it a leaf, see `leaf_at`.
"""

import numpy as np
import warp as wp

from spadwarp_kernels.base.native import bits_of, from_bits

from .patches import NO_NODE, NOWHERE
from .triangle import number_in

# Corners of four boxes, a row each.
Corners = wp.types.matrix(shape=(4, 3), dtype=float)

# Bytes of a box are this part of a node's scale apart.
_BYTE = wp.constant(1.0 / 32768.0)

# A box is wider by this part of a byte, for what a step rounds, which is a 256th.
_SLACK = wp.constant(1.0 / 64.0)


@wp.func
def child_of(nodes: wp.array(dtype=wp.vec4), node: int, k: int) -> int:
    """One of the four children of a node."""
    return bits_of(nodes[4 * node + 3][k])


@wp.func
def leaf_at(order: wp.array(dtype=int), slot: int) -> int:
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
def set_node(nodes: wp.array(dtype=wp.vec4), node: int, children: wp.vec4i, low: Corners, high: Corners):
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
    nodes[4 * node + 3] = wp.vec4(
        from_bits(children[0]), from_bits(children[1]), from_bits(children[2]), from_bits(children[3])
    )


@wp.func
def box_of(nodes: wp.array(dtype=wp.vec4), node: int):
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


def empty_nodes(device: wp.DeviceLike) -> wp.array:
    """A root whose four children no ray meets."""
    x, bits = 1.0e30, float(np.array(-1, np.int32).view(np.float32))
    return wp.array([[x, x, x, 0.0], [0.0, 0.0, bits, bits], [bits] * 4, [bits] * 4], dtype=wp.vec4, device=device)


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
def box_entries(nodes: wp.array(dtype=wp.vec4), node: int, inverse: wp.vec3, shift: wp.vec3) -> wp.vec4ui:
    """Bits of the distances at which a ray enters the boxes of four children; 2^31 more for those that it misses. CUDA
    alone."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const uint4 child = __ldg(reinterpret_cast<const uint4*>(nodes.data) + 4 * static_cast<int64_t>(node) + 3);
    return wp::vec4ui(child.x, child.y, child.z, child.w);
#else
    return wp::vec4ui(0xffffffffu);
#endif
""")
def children_of(nodes: wp.array(dtype=wp.vec4), node: int) -> wp.vec4ui:
    """The bits of the four children of a node. CUDA alone."""
    ...
