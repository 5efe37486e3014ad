"""Kernels of the tests from NumPy to NumPy."""

import numpy as np
import warp as wp

Vectors, Floats, Integers = (wp.array(dtype=kind) for kind in (wp.vec3, float, int))  # of a kernel's arguments


def on_device(values, device="cpu", dtype=None):
    """An array of float32 or int32; rows of three numbers are `wp.vec3`."""
    values = np.asarray(values)
    if dtype is None:
        dtype = int if values.dtype.kind in "iu" else wp.vec3 if values.ndim == 2 and values.shape[1] == 3 else float
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)


def launched(kernel, inputs, out=(float,), device="cpu", count=None):
    """What a kernel writes into arrays of the types `out`, its last arguments: NumPy arrays, floats as float64.

    Arrays among the inputs move to the device; `count` threads, else one for each entry of the first array.
    """
    count = len(next(value for value in inputs if isinstance(value, np.ndarray))) if count is None else count
    inputs = [on_device(value, device) if isinstance(value, np.ndarray) else value for value in inputs]
    arrays = [wp.zeros(count, dtype=kind, device=device) for kind in out]
    wp.launch(kernel, count, [*inputs, *arrays], device=device)
    values = [array.numpy() for array in arrays]
    return [value.astype(np.float64) if value.dtype == np.float32 else value for value in values]
