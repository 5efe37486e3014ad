"""Kernels of the tests from NumPy to NumPy."""

import functools
import linecache

import numpy as np
import warp as wp

Floats = wp.array(dtype=float)  # of a kernel's arguments


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


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


@functools.cache
def kernel_of(function, arrays, out):
    """A kernel that calls a Warp function in each thread, with entries of those arguments that are `arrays`."""
    names, results = list(function.input_types), [f"out{k}" for k in range(len(out))]
    values = ", ".join(f"{name}[i]" if name in arrays else name for name in names)
    stored = [f"    {result}[i] = value{k}\n" for k, result in enumerate(results)]
    call = f"    {', '.join(f'value{k}' for k in range(len(out)))} = function({values})\n"
    lines = [f"def {function.key}({', '.join(names + results)}):\n", "    i = wp.tid()\n", call, *stored]
    place = f"<{function.key}, {id(function)}, {sorted(arrays)}>"
    linecache.cache[place] = 1, None, lines, place  # where Warp reads what it compiles
    exec(compile("".join(lines), place, "exec"), scope := {"wp": wp, "function": function})
    kinds = {name: wp.array(dtype=kind) if name in arrays else kind for name, kind in function.input_types.items()}
    kinds |= {result: wp.array(dtype=kind) for result, kind in zip(results, out, strict=True)}
    scope[function.key].__annotations__ = kinds
    return wp.kernel(scope[function.key], enable_backward=False, module="unique")


def each(function, inputs, out=(float,), device="cpu"):
    """What a Warp function returns for each entry of the arrays among its arguments: NumPy arrays, one by itself."""
    given = [(*item, value) for item, value in zip(function.input_types.items(), inputs, strict=True)]
    whole = {name for name, kind, _ in given if hasattr(kind, "dtype")}
    arrays = {name: value for name, _, value in given if isinstance(value, np.ndarray | wp.array) and name not in whole}
    count = min(map(len, arrays.values()))
    found = launched(kernel_of(function, frozenset(arrays), tuple(out)), inputs, out, device, count)
    return found if len(found) > 1 else found[0]
