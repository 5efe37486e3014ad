"""Rays against boxes."""

import warp as wp

__all__ = ["segment_meets_box"]


@wp.func_native("""
    float in[3], out[3];
    for (int i = 0; i < 3; ++i) {
        // Infinite for a segment parallel to these two sides: in and out are then infinite as well, and their signs
        // decide. In the plane of a side 0 * infinity is no number; any answer is right there, within the padding.
        const float inverse = 1.0f / u[i], a = (lower[i] - x[i]) * inverse, b = (upper[i] - x[i]) * inverse;
        in[i] = wp::min(a, b);
        out[i] = wp::max(a, b);
    }
#if defined(__CUDA_ARCH__)
    // As integers, of which Hopper takes three at a time; the order of positive floats is the same, and what is
    // negative counts only as that.
    const auto bits = [](float number) { return __float_as_int(number); };
    const int enters = __vimax3_s32_relu(bits(in[0]), bits(in[1]), bits(in[2]));
    return enters <= min(__vimin3_s32(bits(out[0]), bits(out[1]), bits(out[2])), bits(length));
#else
    const float enters = wp::max(wp::max(in[0], in[1]), wp::max(in[2], 0.0f));
    return enters <= wp::min(wp::min(out[0], out[1]), wp::min(out[2], length));
#endif
""")
def segment_meets_box(x: wp.vec3, u: wp.vec3, length: float, lower: wp.vec3, upper: wp.vec3) -> bool:
    """False only if the segment x + s u, 0 <= s <= length, misses the box; the box must be padded against rounding."""
    ...


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
