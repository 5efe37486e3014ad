"""Memory that is read and written all over."""

import numpy as np
import warp as wp

# From this size on [bytes], NumPy asks Linux for pages of 2 MiB.
_LARGE = 1 << 22


def zeros(size: int, dtype: type, device: wp.DeviceLike) -> wp.array:
    """`wp.zeros`, on the CPU in large pages, so that a core need not look up the page of each voxel that it adds to.

    `dtype`: int64 or vec4.
    """
    if wp.get_device(device).is_cuda or size * wp.types.type_size_in_bytes(dtype) < _LARGE:
        return wp.zeros(size, dtype=dtype, device=device)
    memory = np.zeros((size, 4), np.float32) if dtype is wp.vec4 else np.zeros(size, np.int64)
    return wp.array(memory, dtype=dtype, device="cpu", copy=False)


@wp.func_native("return values.data[index];")
def load_float(values: wp.array(dtype=float), index: int) -> float:
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
def load_vec2(values: wp.array(dtype=wp.vec2), index: int) -> wp.vec2:
    """As `load_float`, by one instruction instead of two; the array begins at a multiple of 8 bytes."""
    ...
