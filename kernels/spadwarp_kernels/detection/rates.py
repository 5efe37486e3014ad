"""Rows of counts, tallies or rates: what they may be."""

from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import check_array
from spadwarp_kernels.base.kernels import launch_pixels, made_once

__all__ = ["first_invalid_row"]

wp.set_module_options({"enable_backward": False})

RATES = (wp.int32, wp.int64, wp.float32, wp.float64)


@made_once
def _invalid_kernel(dtype: Any) -> wp.Kernel:
    @wp.kernel(enable_backward=False, module="unique")
    def invalid(first_pixel: int, values: wp.array2d(dtype=dtype), worst: wp.array(dtype=int)):
        pixel = first_pixel + wp.tid()
        for k in range(values.shape[1]):
            value = float(values[pixel, k])
            if value < 0.0 or not wp.isfinite(value):
                wp.atomic_min(worst, 0, pixel)
                return

    return invalid


def first_invalid_row(values: wp.array) -> int | None:
    """The first row of `values` `[pixel, bin]` that holds a negative or non-finite number, or None."""
    check_array("values", values, RATES, (None, None))
    if values.shape[0] == 0:
        return None
    worst = wp.full(1, 2**31 - 1, dtype=int, device=values.device)
    launch_pixels(_invalid_kernel(values.dtype), values.shape[0], [values, worst], device=values.device)
    row = int(worst.numpy()[0])
    return None if row == 2**31 - 1 else row
