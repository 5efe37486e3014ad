"""The bits of floats as integers, and back."""

from typing import Any

import numpy as np
import warp as wp


@wp.func
def bits_of(number: float) -> int:
    """The int32 with the bits of a float32."""
    return wp.cast(number, int)


@wp.func
def from_bits(bits: int) -> float:
    """The float32 with the bits of an int32; to be moved and not to be computed with."""
    return wp.cast(bits, float)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __uint_as_float(__float_as_uint(x) ^ (__float_as_uint(sign) & 0x80000000u));
#else
    return __builtin_signbit(sign) ? -x : x;
#endif
""")
def times_sign(x: float, sign: float) -> float:
    """x, negated where the sign bit is set, also of a zero."""
    ...


# ---- Memory that is read and written all over.


# From this size on [bytes], NumPy asks Linux for pages of 2 MiB.
_LARGE = 1 << 22


def zeros(size: int, dtype: type, device: wp.DeviceLike) -> wp.array:
    """`wp.zeros` of int64 or vec4, on the CPU in large pages: a core need not look up the page of each voxel."""
    if wp.get_device(device).is_cuda or size * wp.types.type_size_in_bytes(dtype) < _LARGE:
        return wp.zeros(size, dtype=dtype, device=device)
    memory = np.zeros((size, 4), np.float32) if dtype is wp.vec4 else np.zeros(size, np.int64)
    return wp.array(memory, dtype=dtype, device="cpu", copy=False)


def fill(struct: Any, device: wp.DeviceLike = None, **values: Any) -> Any:
    """The struct with values in its fields; for those of arrays anything that makes one, on the device."""
    for name, value in values.items():
        kind = struct._cls.vars[name].type
        if hasattr(kind, "ndim") and not isinstance(value, wp.array):
            value = wp.array(value, dtype=kind.dtype, device=device)
        setattr(struct, name, value)
    return struct


@wp.func_native("return values.data[index];")
def load_float(values: wp.array[float], index: int) -> float:
    """`values[index]` of an array without gaps, 0 <= index: a quarter of the instructions."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float2 pair = reinterpret_cast<const float2*>(values.data)[index];
    return wp::vec2(pair.x, pair.y);
#else
    return values.data[index];
#endif
""")
def load_vec2(values: wp.array[wp.vec2], index: int) -> wp.vec2:
    """As `load_float`, by one instruction instead of two; the array begins at a multiple of 8 bytes."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = __ldg(reinterpret_cast<const float4*>(rows.data) + static_cast<int64_t>(row));
    return wp::vec4(v.x, v.y, v.z, v.w);
#else
    return rows.data[row];
#endif
""")
def load_row(rows: wp.array[wp.vec4], row: int) -> wp.vec4:
    """An entry of a contiguous array that no kernel changes, in one load on CUDA."""
    ...


# ---- Double precision: constants, and functions that keep their digits where the plain formula cancels.


PI = wp.constant(wp.float64(3.141592653589793))
SQRT2 = wp.constant(wp.float64(1.4142135623730951))
SQRT_2PI = wp.constant(wp.float64(2.5066282746310002))
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))


@wp.func
def expm1(x: Any):
    """exp(x) − 1 without cancellation: relative error below 1e-13, of float32 1e-5."""
    one = type(x)(1.0)
    if wp.abs(x) > type(x)(0.01):
        return wp.exp(x) - one
    series = type(x)(1.0 / 6.0) + x * (type(x)(1.0 / 24.0) + x * type(x)(1.0 / 120.0))
    return x * (one + x * (type(x)(0.5) + x * series))


@wp.func
def log1p(x: Any):
    """ln(1 + x) without cancellation (Kahan's correction)."""
    one = type(x)(1.0)
    y = one + x
    if y == one:
        return x
    return x * wp.log(y) / (y - one)


@wp.func
def normal_cdf(z: wp.float64) -> wp.float64:
    """Probability below z of the normal distribution."""
    return HALF * wp.erfc(-z / SQRT2)


@wp.func
def one_minus_exp(x: wp.float64) -> wp.float64:
    """1 - exp(-x) for x >= 0 without cancellation."""
    if x < wp.float64(1.0e-4):
        return x * (ONE - x * (HALF - x / wp.float64(6.0)))
    return ONE - wp.exp(-x)
