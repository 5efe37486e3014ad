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
    const float4* box = reinterpret_cast<const float4*>(nodes.data) + 8 * node;
    // Of the rows of lower and upper corners, those that a ray in this direction meets first.
    const int x = inverse[0] < 0.0f ? 3 : 0, y = inverse[1] < 0.0f ? 4 : 1, z = inverse[2] < 0.0f ? 5 : 2;
    const float4 x0 = __ldg(box + x), y0 = __ldg(box + y), z0 = __ldg(box + z);
    const float4 x1 = __ldg(box + 3 - x), y1 = __ldg(box + 5 - y), z1 = __ldg(box + 7 - z);
    // As integers, of which Hopper takes three at a time; the order of positive floats is the same, and what is
    // negative counts only as that.
    const auto entry = [&](float a, float b, float c, float d, float e, float f) {
        const int in = __vimax3_s32_relu(__float_as_int(a * inverse[0] - shift[0]),
            __float_as_int(b * inverse[1] - shift[1]), __float_as_int(c * inverse[2] - shift[2]));
        const int out = __vimin3_s32(__float_as_int(d * inverse[0] - shift[0]),
            __float_as_int(e * inverse[1] - shift[1]), __float_as_int(f * inverse[2] - shift[2]));
        return in <= out && in <= __float_as_int(reach) ? __int_as_float(in) : 1.0e30f;
    };
    return wp::vec4(
        entry(x0.x, y0.x, z0.x, x1.x, y1.x, z1.x), entry(x0.y, y0.y, z0.y, x1.y, y1.y, z1.y),
        entry(x0.z, y0.z, z0.z, x1.z, y1.z, z1.z), entry(x0.w, y0.w, z0.w, x1.w, y1.w, z1.w));
#else
    return wp::vec4(1.0e30f);
#endif
""")
def box_entries(nodes: wp.array(dtype=wp.vec4), node: int, inverse: wp.vec3, shift: wp.vec3, reach: float) -> wp.vec4:
    """Where a ray enters the boxes of four children, within [0, reach]; 1e30 for those that it misses. CUDA alone."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 child = __ldg(reinterpret_cast<const float4*>(nodes.data) + 8 * node + 6);
    return wp::vec4(child.x, child.y, child.z, child.w);
#else
    return wp::vec4(-1.0f);
#endif
""")
def box_children(nodes: wp.array(dtype=wp.vec4), node: int) -> wp.vec4:
    """The bits of the four children of a node. CUDA alone."""
    ...
