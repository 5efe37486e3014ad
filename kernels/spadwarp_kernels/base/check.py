"""What public functions check of their arguments before anything is launched, and the error that they raise.

Used as a module, `check.number("g", g, "(-1, 1)")`. Kinds, shapes, dtypes, devices and numbers are read on the host and
cost microseconds. Values of arrays are read only where something is built from them once: a GPU has to be waited for.
"""

import math
import operator
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

__all__ = ["ArgumentError"]


# What a field of a struct must be, see `fields`.
Need: TypeAlias = str | tuple[int | None, ...]


class ArgumentError(ValueError):
    """An argument that is missing, of the wrong kind or shape, on another device, or out of range.

    The text names the argument, its value and what is allowed: `medium.albedo = 1.5 is outside [0, 1]`.
    """


@lru_cache(256)
def _limits(interval: str) -> tuple[float, float, bool, bool]:
    low, high = interval[1:-1].split(",")
    return float(low), float(high), interval[0] == "(", interval[-1] == ")"


def number(name: str, value: Any, interval: str = "(-inf, inf)") -> float:
    """A finite number in an interval, as in an error: `"[0, 1)"`; closed ends hold what float32 makes of them."""
    try:
        found = math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError, OverflowError):
        raise ArgumentError(f"{name} = {value!r} is not a number") from None
    low, high, low_open, high_open = _limits(interval)
    inside = (low < found if low_open else low <= found) and (found < high if high_open else found <= high)
    ends = [end for end, is_open in ((low, low_open), (high, high_open)) if not is_open]
    if not (math.isfinite(found) and (inside or any(math.isclose(found, end, rel_tol=6e-8) for end in ends))):
        raise ArgumentError(f"{name} = {value} is outside {interval}")
    return found


def within(interval: str, **values: Any) -> None:
    """`number` for several numbers of one interval, by name."""
    for name, value in values.items():
        number(name, value, interval)


def integer(name: str, value: Any, low: int, high: int = 2**31 - 1) -> int:
    """An integer from low to high, also one that is written as a float."""
    try:
        found = int(value) if isinstance(value, float) and value.is_integer() else operator.index(value)
    except TypeError:
        raise ArgumentError(f"{name} = {value!r} is not an integer") from None
    if not low <= found <= high:
        raise ArgumentError(f"{name} = {value} is outside [{low}, {high}]")
    return found


def choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """One of a few values."""
    if value not in tuple(choices):
        raise ArgumentError(f"{name} = {value!r} is not one of {', '.join(map(repr, choices))}")


def device(name: str, value: Any) -> wp.Device:
    """A device by name, or the current one for None."""
    try:
        return wp.get_device(value)
    except (ValueError, TypeError, RuntimeError) as error:
        raise ArgumentError(f"{name} = {value!r} is not a device of this machine: {error}") from None


def kind(name: str, value: Any, of: Any) -> Any:
    """An instance of a class or of a Warp struct."""
    if not isinstance(value, getattr(of, "cls", of)):
        needed = of.key.rsplit(".")[-1] if hasattr(of, "cls") else of.__name__
        raise ArgumentError(f"{name} is {_kind(value)}; a {needed} is needed")
    return value


def fields(name: str, struct: Any, needs: Mapping[str, Need], device: Any = None) -> None:
    """Fields of a struct, each by what it must be: numbers, also those of a vector, in an interval such as `"[0, 1)"`;
    `"unit"`, a unit vector or a matrix of them; a shape: an array of the field's dtype, see `array`."""
    for field, need in needs.items():
        path, value = f"{name}.{field}", getattr(struct, field)
        if isinstance(need, tuple):
            array(path, value, struct._cls.vars[field].type.dtype, need, device)
        elif need == "unit":
            for row in np.reshape(value, (-1, 3)):
                vector(path, row, unit=True)
        elif hasattr(value, "__len__") and np.ndim(value):
            for k, one in enumerate(value):
                number(f"{path}[{k}]", one, need)
        else:
            number(path, value, need)


def numbers(
    name: str, values: Any, shape: Sequence[int | None] | None = None, interval: str = "", *, whole: bool = False
) -> NDArray[np.float64]:
    """Numbers of lists or of an array of NumPy or Warp: of a shape, with the sizes given (None: any); finite and in an
    interval, see `number`, if there is one; integers, if `whole`. Those on a GPU are waited for."""
    try:
        found = np.asarray(values.numpy() if isinstance(values, wp.array) else values, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ArgumentError(f"{name} is {_kind(values)} and not an array of numbers") from None
    if shape is not None and not _fits(found.shape, shape):
        raise ArgumentError(f"{name} has shape {found.shape}; {_sizes(shape)} is needed")
    if interval:
        low, high, low_open, high_open = _limits(interval)
        # What float32 makes of the ends counts as these.
        low_slack, high_slack = (6e-8 * abs(end) if math.isfinite(end) else 0.0 for end in (low, high))
        above = found > low + low_slack if low_open else found >= low - low_slack
        below = found < high - high_slack if high_open else found <= high + high_slack
        inside = above & below & np.isfinite(found) & (not whole or found == np.rint(found))
        if not inside.all():
            at = np.unravel_index(int(inside.argmin()), found.shape)
            place = f"[{', '.join(map(str, at))}]" if at else ""
            raise ArgumentError(f"{name}{place} = {found[at]:.9g} is {'not whole or ' * whole}outside {interval}")
    return found


def vector(name: str, value: Sequence[float], *, unit: bool = False, size: int = 3) -> None:
    """Finite components, of a unit vector if asked."""
    try:
        length = math.hypot(*value) if len(value) == size else math.nan
    except TypeError:
        length = math.nan
    if not math.isfinite(length):
        numbers(name, value, (size,), "(-inf, inf)")  # says what is wrong, slowly
    if unit and not abs(length - 1.0) <= 1e-3:
        raise ArgumentError(f"{name} = {tuple(value)} has the length {length:g}; a unit vector is needed")


def items(name: str, value: Any) -> list[Any]:
    """A list of what has items, such as a list, a tuple or an array."""
    if isinstance(value, str | bytes) or not (isinstance(value, Iterable) and getattr(value, "ndim", 1)):
        raise ArgumentError(f"{name} is {_kind(value)}; a list is needed")
    return list(value)


def array(
    name: str, value: Any, dtypes: Any, shape: Sequence[int | None], device: Any = None, *, contiguous: bool = False
) -> Any:
    """A `wp.array` of one of the dtypes, with the sizes given (None: any), on a device (None: any)."""
    allowed = dtypes if isinstance(dtypes, tuple) else (dtypes,)
    if not isinstance(value, wp.array):
        problem = f"is {_kind(value)}"
    elif not (_fits(value.shape, shape) and any(wp.types.types_equal(value.dtype, dtype) for dtype in allowed)):
        problem = f"is a wp.array of {_dtype_name(value.dtype)}, shape {tuple(value.shape)}"
    elif device is not None and value.device != device:
        problem = f"is on {value.device} and not on {device}"
    elif contiguous and not value.is_contiguous:
        problem = "is not contiguous"
    else:
        return value
    kinds = " or ".join(map(_dtype_name, allowed))
    raise ArgumentError(f"{name} {problem}; a wp.array of {kinds}, shape {_sizes(shape)}, is needed")


def arrays(dtypes: Any, shape: Sequence[int | None], device: Any = None, **values: Any) -> None:
    """`array` for several arrays of one kind, by name."""
    for name, value in values.items():
        array(name, value, dtypes, shape, device)


def _fits(shape: Sequence[int], needed: Sequence[int | None]) -> bool:
    return len(shape) == len(needed) and all(each in (None, size) for size, each in zip(shape, needed, strict=True))


def _sizes(shape: Sequence[int | None]) -> str:
    return f"({', '.join('any' if size is None else str(size) for size in shape)}{',' * (len(shape) == 1)})"


def _kind(value: Any) -> str:
    if value is None:
        return "None"
    if wp.types.is_struct(value):
        return f"a {type(value).__mro__[1].__name__}"
    shape = getattr(value, "shape", None)
    return f"{type(value).__name__}{'' if shape is None else f' of shape {tuple(shape)}'}"


def _dtype_name(dtype: Any) -> str:
    return {float: "float32", int: "int32"}.get(dtype) or getattr(dtype, "__name__", str(dtype))
