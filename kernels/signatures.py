"""Writes `signatures.txt`, the promise of what stays as it is: `python kernels/signatures.py`.

A line that changes or goes is a change that breaks callers, and asks for the version number that says so.
"""

import dataclasses
import inspect
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import warp as wp

import spadwarp_kernels as sk

PLACE = Path(__file__).with_name("signatures.txt")


def signatures() -> str:
    """A line for each public name, and one for each field of a struct."""
    return "".join(line + "\n" for name in sorted(sk.__all__) for line in _lines(name, getattr(sk, name)))


def _lines(name, thing):
    if isinstance(thing, type) and issubclass(thing, Exception):
        return [f"class {name}({thing.__base__.__name__})"]
    if isinstance(thing, wp.Kernel):
        return [f"kernel {name}{_arguments(inspect.signature(thing.func))}"]
    if isinstance(thing, wp.Function):
        return [f"func {name}{_arguments(inspect.signature(thing.func))}" if thing.func else f"func {name}(native)"]
    if type(thing).__name__ == "Struct":  # of Warp
        fields = [f"{name}.{field}: {_type(var.type)}" for field, var in thing.vars.items()]
        return [f"struct {name}", *fields]
    if isinstance(thing, type) and dataclasses.is_dataclass(thing):
        return [f"class {name}", *(f"{name}.{one.name}" for one in dataclasses.fields(thing))]
    if isinstance(thing, type) and hasattr(thing, "_fields"):
        return [f"class {name}", *(f"{name}.{field}{_default(thing, field)}" for field in thing._fields)]
    if isinstance(thing, type):
        members = [f"{name}.{one}" for one in sorted(vars(thing)) if not one.startswith("_")]
        return [f"class {name}{_arguments(inspect.signature(thing))}", *members]
    if callable(thing) and not isinstance(thing, tuple):
        return [f"def {name}{_arguments(inspect.signature(thing))}"]
    return [f"{name} = {_value(thing)}"]


def _arguments(signature):
    parts, keyword_only = [], False
    for one in signature.parameters.values():
        if one.kind is one.KEYWORD_ONLY and not keyword_only:
            keyword_only = True
            parts.append("*")
        parts.append(one.name + (f"={_value(one.default)}" if one.default is not one.empty else ""))
    return f"({', '.join(parts)})"


def _default(thing, field):
    return f" = {_value(thing._field_defaults[field])}" if field in thing._field_defaults else ""


def _value(value):
    if isinstance(value, (int, float, str, bool, tuple)) and type(value).__name__ in ("int", "float", "str", "bool"):
        return repr(value)
    if value is None:
        return "None"
    if type(value) in (tuple, dict):
        return f"({', '.join(map(_value, value))})"
    return getattr(value, "name", type(value).__name__)


def _type(kind):
    if isinstance(kind, wp.array):
        return f"array{kind.ndim}d of {_type(kind.dtype)}"
    return getattr(kind, "key", None) or getattr(kind, "__name__", str(kind))


if __name__ == "__main__":
    PLACE.write_text(signatures())
