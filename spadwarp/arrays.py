"""Arrays of any kind: NumPy's, Warp's and torch's, which share memory where they can; labelled arrays and data frames.

Who hands in torch tensors is given torch tensors, on their device, in the order of the torch stream that is current.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

from spadwarp.values import ArgumentError, Interval, guarded, shown

__all__ = ["Variable", "as_warp", "caller_tallies", "histogram_rows", "in_torch_order", "is_torch", "labelled"]
__all__ += ["on_host", "output_tensor", "real_array", "tensor_of", "to_pandas"]

Floats = NDArray[np.float64]

if TYPE_CHECKING:
    import pandas
    import torch
    import warp as wp
    import xarray


def block_sums(cube: NDArray[Any], sizes: tuple[int, int, int]) -> NDArray[Any]:
    """Sums over blocks of so many entries along each axis; blocks at the ends may be smaller."""
    for axis in (2, 1, 0):
        if sizes[axis] > 1:
            cube = np.add.reduceat(cube, np.arange(0, cube.shape[axis], sizes[axis]), axis=axis)
    return cube


def as_warp(array: Any, *, name: str, device: Any = None) -> Any:
    """A contiguous Warp array of int32, int64, float32 or float64 from NumPy, torch or Warp; copies only if it must.

    Raises `ArgumentError`: the data is of another kind (complex, text).
    """
    import warp as wp

    from spadwarp.device import pick_device, start_warp

    start_warp()
    if isinstance(array, wp.array):
        result = array if device is None else array.to(pick_device(device))
    elif is_torch(array):
        tensor = array.detach().contiguous()
        if not tensor.is_floating_point() and tensor.element_size() < 4:
            tensor = tensor.int()
        elif tensor.element_size() < 4:
            tensor = tensor.float()
        result = wp.from_torch(tensor)
        result = result if device is None else result.to(pick_device(device))
    else:
        values = np.asarray(array)
        if values.dtype.kind in "bui":
            small = values.dtype.itemsize < 4 or values.dtype == np.int32
            values = values.astype(np.int32 if small else np.int64, copy=False)
        elif values.dtype.kind == "f":
            values = values.astype(np.float64 if values.dtype.itemsize >= 8 else np.float32, copy=False)
        else:
            raise ArgumentError(f"{name} has dtype {values.dtype}; integers or real numbers are needed")
        device = pick_device(device)
        result = wp.array(np.ascontiguousarray(values), device=device, copy=device.is_cuda)
    if result.dtype not in (wp.int32, wp.int64, wp.float32, wp.float64):
        raise ArgumentError(f"{name} has dtype {result.dtype.__name__}; int32, int64, float32 or float64 is needed")
    return result if result.is_contiguous else result.contiguous()


def histogram_rows(
    array: Any, *, name: str, device: Any = None, shape: str = "[..., bin]", dimensions: range = range(1, 16)
) -> tuple[Any, tuple[int, ...]]:
    """Warp rows `[pixel, bin]` of histograms and the shape that these had.

    Args:
        array: `[..., bin]`, finite and not negative.
        name: What to call it in an error.
        device: Warp device; default: where the array lies, for NumPy the first GPU or else the CPU.
        shape: The shape in words, for the error.
        dimensions: Allowed numbers of dimensions.

    Raises `ArgumentError`: no pixel or no bin, another number of dimensions, a negative or non-finite value;
    `TypeError`: see `as_warp`.
    """
    from spadwarp_kernels.detection import first_invalid_row

    cube = as_warp(array, name=name, device=device)
    sizes = tuple(int(n) for n in cube.shape)
    if cube.size == 0 or cube.ndim not in dimensions:
        raise ArgumentError(f"{name} has shape {sizes}; {shape} with at least one pixel and one bin is needed")
    rows = cube.reshape((cube.size // sizes[-1], sizes[-1]))
    if (row := first_invalid_row(rows)) is not None:
        pixel = tuple(int(i) for i in np.unravel_index(row, sizes[:-1])) if len(sizes) > 1 else ()
        raise ArgumentError(f"{name} holds a negative or non-finite value in pixel {pixel}")
    return rows, sizes


def on_host(array: Any) -> Any:
    """A tensor as a NumPy array, copied only from a GPU; anything else as it is."""
    return array.detach().cpu().numpy() if is_torch(array) else array


def real_array(
    name: str, values: Any, dtype: DTypeLike = np.float32, *, shapes: Sequence[tuple[int, ...]] = (), within: str = ""
) -> NDArray[Any]:
    """A copy of an argument as an array of real numbers, also of a tensor: of one of the shapes, and with all values in
    the range, such as "[0, inf)", where these are given. Raises `ArgumentError`."""
    try:
        given, kind = np.asarray(on_host(values)), np.dtype(dtype)
    except (TypeError, ValueError) as error:  # rows of several lengths, no type
        raise ArgumentError(f"{name} = {shown(values)}, dtype = {shown(dtype)}: {error}") from error
    if given.dtype.kind not in "biuf" or kind.kind not in "biuf":
        raise ArgumentError(f"{name} = {shown(values)} is not an array of real numbers ({kind})")
    if shapes and given.shape not in shapes:
        raise ArgumentError(f"{name} has shape {given.shape}; {' or '.join(map(str, shapes))} is needed")
    array = given.astype(kind)
    if within and not (inside := Interval.read(within).holds(array)).all():
        raise ArgumentError(f"{name} holds {array[~inside][0]}, which is outside {within}")
    return array


def is_torch(array: Any) -> bool:
    """Whether it is a tensor, found out without loading torch."""
    return type(array).__module__.partition(".")[0] == "torch"


@contextmanager
def in_torch_order(*arrays: Any) -> Iterator[None]:
    """Warp's work of the block goes to the torch stream that is current on the device of the first tensor on CUDA.

    Warp's own stream waits for it afterwards: on that one it frees what the block has allocated. What the block hands
    to the caller has to be torch's memory, which other streams may still read when it is freed (`tensor_of`).
    """
    place = next((array.device for array in arrays if is_torch(array) and array.is_cuda), None)
    if place is None:
        yield
        return
    import torch
    import warp as wp

    from spadwarp.device import start_warp

    start_warp()
    stream = wp.stream_from_torch(torch.cuda.current_stream(place))
    with wp.ScopedStream(stream, sync_enter=True, sync_exit=True):
        yield


def tensor_of(array: wp.array) -> torch.Tensor:
    """A copy in torch's memory on the array's device, inside `in_torch_order`.

    A copy, since an array of Warp's may be freed before other streams have read it.
    """
    import torch
    import warp as wp

    tensor = torch.empty(array.shape, dtype=wp.dtype_to_torch(array.dtype), device=wp.device_to_torch(array.device))
    wp.copy(cast(wp.array, wp.from_torch(tensor)), array)
    return tensor


def output_tensor(out: Any, *, name: str, shape: Sequence[int], device: wp.Device) -> torch.Tensor:
    """The caller's int32 tensor for an output, or a new one, inside `in_torch_order`.

    Raises `ArgumentError`: it is not a tensor, of another type or shape, not contiguous, or on another device.
    """
    import torch
    import warp as wp

    place, shape = torch.device(wp.device_to_torch(device)), tuple(shape)
    if out is None:
        return torch.empty(shape, dtype=torch.int32, device=place)
    if not is_torch(out):
        raise ArgumentError(f"{name} is a {type(out).__name__}; a torch tensor is needed")
    if out.dtype != torch.int32 or out.shape != shape or not out.is_contiguous() or out.device != place:
        needed = f"contiguous torch.int32 {shape} on {place} is needed"
        raise ArgumentError(f"{name} is {out.dtype} {tuple(out.shape)} on {out.device}; {needed}")
    return out


def caller_tallies(tallies: Any, *, shape: Sequence[int], device: wp.Device) -> wp.array:
    """The caller's own tensor or Warp array as zeroed tallies, flat.

    Raises `ArgumentError`: it is of another kind, type or size, not contiguous, or on another device.
    """
    import warp as wp

    if not (is_torch(tallies) or isinstance(tallies, wp.array)):
        raise ArgumentError(f"tallies are a {type(tallies).__name__}; a torch tensor or a Warp array is needed")
    array: Any = wp.from_torch(tallies, requires_grad=False) if is_torch(tallies) else tallies
    size = int(np.prod(shape))
    if array.dtype is not wp.int64 or array.size != size or not array.is_contiguous or array.device != device:
        needed = f"contiguous int64 {tuple(shape)} on {device} is needed"
        raise ArgumentError(f"tallies are {array.dtype.__name__} {tuple(array.shape)} on {array.device}; {needed}")
    with in_torch_order(tallies):
        array.zero_()
    return array.reshape((size,))


# ---- Labelled arrays (xarray) and data frames (pandas); both are optional.


Variable = tuple[tuple[str, ...], Any, str, str]
"""Dimensions, values, unit ("1" for a plain number) and meaning of an array."""


def labelled(
    variables: Mapping[str, Variable], coordinates: Mapping[str, Variable], attributes: Mapping[str, Any]
) -> xarray.Dataset:
    """An xarray data set whose arrays have `units` and `long_name`. Raises `FileError` without xarray."""
    import xarray

    def array(variable: Variable) -> tuple[tuple[str, ...], Any, dict[str, str]]:
        dimensions, values, unit, meaning = variable
        return dimensions, values, {"units": unit, "long_name": meaning}

    return xarray.Dataset(
        {name: array(variable) for name, variable in variables.items()},
        coords={name: array(variable) for name, variable in coordinates.items()},
        attrs=dict(attributes),
    )


def to_pandas(rows: Iterable[Any] | Any) -> pandas.DataFrame:
    """Rows as a pandas DataFrame: a list of data classes or dicts, or a `Sweep`, whose values are the index.

    For what `spadwarp.budget`, `sweep`, `check`, `scene.presets` and `analytic.plan` give: `to_pandas(budget(scene))`.

    Raises `FileError`: pandas is not installed; `ArgumentError`: rows that are neither data classes nor dicts.
    """
    import pandas

    index = None
    if hasattr(rows, "rows") and hasattr(rows, "values") and hasattr(rows, "fields"):
        rows, index = rows.rows, pandas.MultiIndex.from_tuples(rows.values, names=rows.fields)
        index = index if len(index.names) > 1 else index.get_level_values(0)
    elif isinstance(rows, Mapping):
        rows = rows.values()
    rows = rows if isinstance(rows, Iterable) else [rows]
    table: list[Any] = [dataclasses.asdict(row) if dataclasses.is_dataclass(row) else row for row in rows]  # type: ignore[arg-type]
    if not all(isinstance(row, Mapping) for row in table):
        raise ArgumentError(f"rows hold a {type(table[0]).__name__}; data classes or dicts are needed")
    return pandas.DataFrame(table, index=index)


guarded(__name__)
