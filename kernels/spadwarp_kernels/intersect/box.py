"""Rays against boxes."""

import warp as wp


@wp.func
def segment_meets_box(x: wp.vec3, u: wp.vec3, length: float, lower: wp.vec3, upper: wp.vec3) -> bool:
    """False only if the segment x + s u, 0 <= s <= length, misses the box; the box must be padded against rounding."""
    near = float(0.0)
    far = float(length)
    for i in range(3):
        d = u[i]
        if wp.abs(d) < 1.0e-12:
            d = 1.0e-12
        inverse = 1.0 / d
        a = (lower[i] - x[i]) * inverse
        b = (upper[i] - x[i]) * inverse
        near = wp.max(near, wp.min(a, b))
        far = wp.min(far, wp.max(a, b))
    return near <= far


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    typedef float row __attribute__((vector_size(16)));
    const auto least = [](row p, row q) { return p < q ? p : q; };
    const auto most = [](row p, row q) { return p > q ? p : q; };
    // The fourth lane is the segment itself, from 0 to its length.
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
#else
    return true;
#endif
""")
def segment_meets_box_on_cpu(x: wp.vec3, u: wp.vec3, length: float, lower: wp.vec3, upper: wp.vec3) -> bool:
    """`segment_meets_box`, its three axes in one vector register; CPU alone."""
    ...


@wp.func
def _inverse(d: float) -> float:
    return 1.0 / wp.where(wp.abs(d) < 1.0e-18, 1.0e-18, d)


@wp.func
def inverse_direction(u: wp.vec3) -> wp.vec3:
    """1/u by components, finite."""
    return wp.vec3(_inverse(u[0]), _inverse(u[1]), _inverse(u[2]))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4* row = reinterpret_cast<const float4*>(nodes.data) + 4 * node;
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
    // negative counts only as that.
    const auto at = [](unsigned bytes, int pick, float scale, float start) {
        return __float_as_int(__uint_as_float(__byte_perm(bytes, 0x3f800000u, pick)) * scale + start);
    };
    const auto entry = [&](int pick) {
        const int in = __vimax3_s32_relu(at(x0, pick, mx, bx), at(y0, pick, my, by), at(z0, pick, mz, bz));
        const int out = __vimin3_s32(at(x1, pick, mx, bx), at(y1, pick, my, by), at(z1, pick, mz, bz));
        return in <= out && in <= __float_as_int(reach) ? __int_as_float(in) : 1.0e30f;
    };
    return wp::vec4(entry(0x7604), entry(0x7614), entry(0x7624), entry(0x7634));
#else
    return wp::vec4(1.0e30f);
#endif
""")
def box_entries(nodes: wp.array(dtype=wp.vec4), node: int, inverse: wp.vec3, shift: wp.vec3, reach: float) -> wp.vec4:
    """Where a ray enters the boxes of four children, within [0, reach]; 1e30 for those that it misses. CUDA alone."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 child = __ldg(reinterpret_cast<const float4*>(nodes.data) + 4 * node + 3);
    return wp::vec4(child.x, child.y, child.z, child.w);
#else
    return wp::vec4(-1.0f);
#endif
""")
def box_children(nodes: wp.array(dtype=wp.vec4), node: int) -> wp.vec4:
    """The bits of the four children of a node. CUDA alone."""
    ...
