"""Memory that is read and written all over."""

import numpy as np
import warp as wp


def zeros(size: int, dtype: type, device: wp.DeviceLike) -> wp.array:
    """`wp.zeros`, on the CPU in large pages: for 4 MiB and more, NumPy asks Linux for pages of 2 MiB, so that a core
    need not look up the page of each voxel that it adds to. `dtype`: int64 or vec4."""
    if wp.get_device(device).is_cuda:
        return wp.zeros(size, dtype=dtype, device=device)
    memory = np.zeros((size, 4), np.float32) if dtype is wp.vec4 else np.zeros(size, np.int64)
    return wp.array(memory, dtype=dtype, device="cpu", copy=False)
