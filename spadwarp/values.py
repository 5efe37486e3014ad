"""Values that enter: numbers with ranges and units, and words; the errors that refuse them; physical constants.

A range is written "(0, 1e6] 1/m": a bracket includes its end, a parenthesis does not. Those of a scene's fields stand
on the fields, from where `spadwarp.scene.sections.field_range` reads them.

The table of units is our own. pint 0.25 took 1.6 s to load where `spadwarp --help` takes 0.5 s, reads "5 a" as five
years and "50 PS" as petasiemens, and makes 3.7500000000000005e-08 J of "37.5 nJ"; a scene needs eleven kinds of units.
"""

from __future__ import annotations

import array
import difflib
import errno
import functools
import inspect
import math
import operator
import os
import re
import reprlib
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    SupportsFloat,
    SupportsIndex,
    Union,
    cast,
    get_args,
    get_origin,
    is_typeddict,
)

__version__ = "0.1.0"

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


class SpadwarpError(Exception):
    """Base of every error that spadwarp raises on purpose; its text is meant for the user as it is."""


class ArgumentError(SpadwarpError, ValueError):
    """An argument of a public function that is out of range, of the wrong shape, missing or one too many."""


class UnforeseenArgument(ArgumentError):
    """An argument that no check of ours refused and a library could not use, see `guarded`: its cause says where."""


class ConfigError(SpadwarpError):
    """A scene that cannot be used.

    The text has one line for each problem and names file, field, value and allowed range:
    `scene.toml: medium.g = 1.2 is outside (-1, 1)`.
    """

    def __init__(self, problems: str | Iterable[str], *, source: str | Path | None = None) -> None:
        """`problems`: one line each, without the file; `source`: the file they are in (None: made in Python)."""
        lines = [problems] if isinstance(problems, str) else list(problems)
        self.problems: tuple[str, ...] = tuple(lines)
        self.source = None if source is None else str(source)
        prefix = f"{source}: " if source else ""
        super().__init__("\n".join(prefix + line for line in lines))


class MeshError(SpadwarpError):
    """A mesh that cannot be used: missing, unreadable, empty, not finite or without area."""


class FileError(SpadwarpError):
    """A file that cannot be read or written, or that does not hold what it should."""


class DeviceError(SpadwarpError):
    """A device that does not exist, or has too little memory for what was asked."""


class SpadwarpWarning(UserWarning):
    """A success that may still mislead; its text is meant for the user as it is."""


# What the loader and threads say when memory is short, which Python then reports as another error.
_SHORT_OF_MEMORY = ("memory", "map segment", "start new thread", "bad_alloc")


def in_words(error: BaseException) -> str | None:
    """A sentence for an error that spadwarp did not raise but can foresee; None for any other, which is a bug.

    Foreseen are those of the system (files, memory, threads), text that is not Unicode, and input that is nested too
    deeply.
    """
    short = isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
    # Python's parser loses the MemoryError and says "error return without exception set".
    limit, text = address_space(), " ".join(str(error).split())[:300] or type(error).__name__
    short = short or (isinstance(error, SystemError) and limit is not None)
    if isinstance(error, OSError | ImportError | RuntimeError):
        short = short or any(words in str(error).lower() for words in _SHORT_OF_MEMORY)
    if short:
        most = "" if limit is None else f" (this process may use {limit / 2**30:.3g} GiB, see ulimit -v)"
        return f"not enough memory{most}" + (f": {text}" if str(error) else "")
    if isinstance(error, FileNotFoundError) and error.filename is None:
        return "the working directory is not there any more"
    if isinstance(error, OSError) and error.strerror:
        names = " and ".join(str(name)[:1000] for name in (error.filename, error.filename2) if name is not None)
        return f"{names}: {error.strerror}" if names else error.strerror
    if isinstance(error, UnicodeError):
        return f"text that cannot be read or written: {text}"
    if isinstance(error, RecursionError):
        return "the input is nested too deeply"
    if isinstance(error, ImportError):
        return f"a package cannot be loaded, see `spadwarp doctor`: {text}"
    return None if error.__cause__ is None else in_words(error.__cause__)


def address_space() -> int | None:
    """Bytes that this process may map, such as `ulimit -v` sets; None without a limit."""
    if resource is None:
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if limit == resource.RLIM_INFINITY else limit


def need_memory(gibibytes: float, name: str) -> None:
    """Raises `MemoryError` where a limit leaves less than what `name` needs to be loaded.

    Libraries that meet the limit while they are loaded end the process, or wait for ever.
    """
    limit = address_space()
    if limit is not None and limit < gibibytes * 2**30:
        raise MemoryError(f"{name} needs {gibibytes:g} GiB")


# ---- Arguments of public functions, and packages that they need


EXTRAS = {"torch": "torch", "ray": "ray", "xarray": "xarray", "pandas": "xarray", "ptufile": "formats", "laspy": "las"}
"""Optional packages, as they are imported, and the extra that brings each."""
EXTRAS |= {"lazrs": "las", "pyarrow": "datasets", "zarr": "datasets", "pxr": "usd", "miepython": "mie", "bmnd": "bm3d"}
EXTRAS |= {"plotly": "view", "imageio_ffmpeg": "video"}


def guarded(module: str) -> None:
    """Makes `ArgumentError` of what libraries raise when a public function of a module gets an argument that is not of
    its annotated type, that holds nothing or no finite number, or arrays that do not fit; and of what the kernel
    library refuses: numbers that pass one by one, but together leave the range of what is computed with. Makes
    `FileError` of files that cannot be opened and optional packages that are missing.

    The public names of a package are those of its modules that it has imported; they become its `__all__`.
    Nothing is checked before something was raised: calls cost no time for it.
    """
    space = vars(sys.modules[module])
    if "__all__" not in space:
        loaded = list(sys.modules.items())  # to which other threads may add
        modules = [vars(found) for name, found in loaded if name.startswith(f"{module}.")]
        names = {name for one in modules for name in one.get("__all__", ()) if space.get(name) is one[name]}
        space["__all__"] = sorted(names)
    for name in space["__all__"]:
        found = space[name]
        if isinstance(found, types.FunctionType):
            space[name] = _guarded(found, module)
        elif isinstance(found, type) and not issubclass(found, Exception):
            for kind in found.__mro__:
                if kind.__module__.startswith("spadwarp."):
                    _guard_methods(kind)


def _guard_methods(kind: type) -> None:
    for name, member in list(vars(kind).items()):
        wrap = type(member) if isinstance(member, classmethod | staticmethod) else None
        function = member.__func__ if wrap is not None else member
        if isinstance(function, types.FunctionType) and (name == "__init__" or not name.startswith("_")):
            guard = _guarded(function, function.__module__)
            setattr(kind, name, guard if wrap is None else wrap(guard))


def _guarded(function: Callable[..., Any], module: str) -> Callable[..., Any]:
    if hasattr(function, "__guarded__"):
        return function

    def explain(error: Exception, arguments: Sequence[Any], named: Mapping[str, Any]) -> None:
        if isinstance(error, SpadwarpError):
            return
        if isinstance(error, OSError) and error.filename is not None and error.errno != errno.ENOMEM:
            raise FileError(in_words(error)) from error
        package = str(error.name).partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
        if extra := EXTRAS.get(package):
            needed = f"{function.__name__} needs the package {package}: pip install 'spadwarp[{extra}]'"
            raise FileError(needed) from error
        if type(error).__name__ == "ArgumentError":  # of the kernel library, which is not loaded here
            raise ArgumentError(str(error)) from error
        if problem := _wrong_argument(error, function, arguments, named):
            raise UnforeseenArgument(problem) from error

    def value_of(*arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except Exception as error:
            explain(error, arguments, named)
            raise

    def items_of(*arguments: Any, **named: Any) -> Any:
        try:
            return (yield from function(*arguments, **named))
        except Exception as error:
            explain(error, arguments, named)
            raise

    call: Any = functools.wraps(function)(items_of if inspect.isgeneratorfunction(function) else value_of)
    call.__module__ = module  # where pickle finds it
    call.__guarded__ = True
    return call


# What libraries raise for values that are of the right type and yet cannot be used.
_OF_VALUES = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
_FUNCTIONS = (types.FunctionType, types.MethodType, functools.partial)


def _wrong_argument(
    error: Exception, function: Callable[..., Any], arguments: Sequence[Any], named: Mapping[str, Any]
) -> str:
    """The first argument that is not of the type that it is annotated with, or else the first that holds nothing, no
    numbers, or none that are finite and below 2^31, or else the arrays, where these do not fit; empty if none is."""
    signature = inspect.signature(function)
    modules = [module for key, module in sys.modules.items() if key.startswith("spadwarp.")]
    names = {name: value for module in modules for name, value in vars(module).items()}
    names |= getattr(function, "__globals__", {})  # which lack what is there for type checkers alone
    try:
        given = signature.bind(*arguments, **named).arguments
    except TypeError:  # one is missing or too many, as Python says
        return ""
    arrays = []
    for name, value in given.items():
        parameter = signature.parameters[name]
        kind, text = parameter.annotation, str(parameter.annotation)
        if isinstance(kind, str):
            try:
                kind = eval(kind, names)
            except Exception:  # of a package that is not loaded
                kind = Any
        single = parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        of_numbers = "ArrayLike" in text.split(" | ")  # which are many types: what it holds says more
        if name not in ("self", "cls") and single and not of_numbers and not _fits(value, kind):
            return f"{name} = {shown(value)} is not of the type {text}"
        if of_numbers and value is not None and not _holds_numbers(value):
            return f"{name} = {shown(value)} holds no numbers"
        if "Array" in text or hasattr(value, "shape"):
            arrays.append(f"{name} [{', '.join(map(str, getattr(value, 'shape', [])))}]")
    words = " ".join(str(error).split())[:200] or type(error).__name__
    short = (in_words(error) or "").startswith("not enough memory")
    if short or not isinstance(error, _OF_VALUES) or any(isinstance(value, _FUNCTIONS) for value in given.values()):
        return ""  # or from a function of the caller's
    for name, value in given.items():
        needed = isinstance(error, AttributeError) and error.obj is value
        needed |= value is None and signature.parameters[name].default is not None
        if name not in ("self", "cls") and (needed or _is_odd(value)):
            return f"{name} = {shown(value)} cannot be used: {words}"
        tables = [item for item in (value if isinstance(value, list | tuple) else [value]) if isinstance(item, Mapping)]
        if isinstance(error, KeyError) and any(error.args[0] not in table for table in tables):
            return f"{name} = {shown(value)} has no {error}"
    unfit = isinstance(error, IndexError | ValueError) or "array" in words
    return f"{', '.join(arrays)}: arrays that do not fit: {words}" if arrays and unfit else ""


def _is_odd(value: Any) -> bool:
    """Whether a value holds nothing, no numbers, or none that are finite and below 2^31."""
    if isinstance(value, str | bytes | os.PathLike):
        text = os.fsdecode(value)
        return not text or "\0" in text or not text.isprintable()
    if isinstance(value, dict | list | tuple) and not all(isinstance(item, int | float) for item in value):
        return any(map(_is_odd, value.values() if isinstance(value, dict) else value))
    if value is None or not (type(value).__module__ in ("builtins", "numpy") or hasattr(value, "numpy")):
        return False
    return not _holds_numbers(value, 2.0**31)


def _holds_numbers(value: Any, limit: float | None = None) -> bool:
    """Whether an array can be made of a value that holds numbers; with a limit, whether it does, and all are below."""
    import numpy as np

    try:
        array = np.asarray(value.numpy() if hasattr(value, "numpy") else value)
        with np.errstate(all="ignore"):
            below = limit is None or (array.size > 0 and bool((np.abs(array) < limit).all()))
            return array.dtype.kind in "biuf" and below
    except Exception:
        return False


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is of an annotated type, as far as it can be seen without using it up."""
    origin, inner = get_origin(kind), get_args(kind)
    if hasattr(origin or kind, "__value__"):  # an alias, as those of NumPy are from Python 3.12 on
        return _fits(value, (origin or kind).__value__)
    if origin in (Union, types.UnionType):
        return any(_fits(value, item) for item in inner)
    if origin is Annotated:
        return _fits(value, inner[0])
    if origin is Literal:
        return any(value is item or (isinstance(value, str | int) and value == item) for item in inner)
    if kind is None or kind is Any:
        return kind is Any or value is None
    if kind in (complex, float, int):  # of which each takes those behind it
        needed = "__index__" if kind is int else "__float__"
        single = not isinstance(value, type | bool) and getattr(value, "ndim", 0) == 0
        if kind is int and getattr(getattr(value, "dtype", None), "kind", "i") not in ("i", "u", "b"):
            return False
        return single and (isinstance(value, kind) or hasattr(value, needed) or hasattr(value, "__index__"))
    plain = dict if is_typeddict(kind) else origin or kind
    if not isinstance(plain, type):
        return True
    if getattr(plain, "_is_protocol", False):
        members = [name for name, member in vars(plain).items() if isinstance(member, types.FunctionType | property)]
        return all(hasattr(value, name) for name in members if name not in ("__init__", "__subclasshook__"))
    if not isinstance(value, plain) or (inner and isinstance(value, str | bytes)):  # a text is no list of texts
        return False
    if isinstance(value, tuple) and plain is tuple and inner and inner[-1] is not Ellipsis:
        return len(value) == len(inner) and all(_fits(*pair) for pair in zip(value, inner, strict=True))
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple | range) else ()
    return not inner or all(_fits(item, inner[len(inner) > 1 and isinstance(value, dict)]) for item in items)


# ---- Numbers and words, as text or from Python: of their kind and within their range, or refused by name.


SEED = "[0, 18446744073709551615]"
"""Range of seeds: 64 bits."""
BIN_WIDTH, TIME = "[1e-24, 1e6] s", "[-1e6, 1e6] s"
"""Ranges of the width of a bin and of a time, beyond which squares leave those of single precision."""

_NUMBER = re.compile(
    r"[+-]?(?:\d+(?:_\d+)*(?:\.(?:\d+(?:_\d+)*)?)?|\.\d+(?:_\d+)*)(?:e[+-]?\d+)?", re.ASCII | re.IGNORECASE
)
_INTERVAL = re.compile(r"([\[(])(.+), (.+)([])])(?: (\S+))?")
_LONGEST = 60  # characters of a value in a message


class Interval(NamedTuple):
    """A range of numbers."""

    low: float
    high: float
    includes_low: bool
    includes_high: bool
    unit: str = ""

    @classmethod
    @functools.cache
    def read(cls, text: str) -> Interval:
        """From "(0, 1]", or with a unit "(0, 1] m"; only "inf]" includes infinity."""
        match = _INTERVAL.fullmatch(text)
        assert match is not None, text
        low, high = (int(end) if end.lstrip("-").isdecimal() else float(end) for end in match.group(2, 3))
        return cls(low, high, match[1] == "[", match[4] == "]", match[5] or "")

    def holds(self, values: Any) -> Any:
        """Whether a number, or each of an array, lies in it; NaN does not."""
        above = values >= self.low if self.includes_low else values > self.low
        return above & (values <= self.high if self.includes_high else values < self.high)

    def __contains__(self, value: object) -> bool:
        return isinstance(value, int | float) and self.holds(value)

    def __str__(self) -> str:
        left, right = "[" if self.includes_low else "(", "]" if self.includes_high else ")"
        return f"{left}{_end(self.low)}, {_end(self.high)}{right} {self.unit}".rstrip()


def bounds(text: str) -> dict[str, Any]:
    """A range as the arguments of pydantic's `Field`."""
    interval = Interval.read(text)
    low, high = "ge" if interval.includes_low else "gt", "le" if interval.includes_high else "lt"
    return {low: interval.low, high: interval.high}


def _end(value: float) -> str:
    """An end of an interval: integers in full, 1e9 rather than 1000000000.0."""
    return str(value) if isinstance(value, int) else re.sub(r"e\+?(-?)0*", r"e\1", f"{value:g}")


def check_real(name: str, value: Any, within: str | Interval = "(-inf, inf)") -> float:
    """An argument as a float; infinite only where the range includes it, as "(0, inf]" does.

    Raises `ArgumentError`, which names the argument, its value and the range, where it is no number or outside.
    """
    if not (_is_single(value) and isinstance(value, SupportsFloat | SupportsIndex)):
        raise ArgumentError(f"{name} = {shown(value)} is not a number")
    try:
        number = float(value)
    except OverflowError:  # an integer beyond 1.8e308
        number = math.nan
    return _inside(name, value, number, within)


def check_integer(name: str, value: Any, within: str | Interval) -> int:
    """An argument as an int; a float without a fraction, such as 1e5, counts as one.

    Raises `ArgumentError`, which names the argument, its value and the range, where it is no integer or outside.
    """
    if _is_single(value) and isinstance(value, SupportsIndex):
        number = operator.index(value)
    elif _is_single(value) and isinstance(value, SupportsFloat) and float(value).is_integer():
        number = int(float(value))
    else:
        raise ArgumentError(f"{name} = {shown(value)} is not an integer in {within}")
    return _inside(name, value, number, within)


def _inside(name: str, value: Any, number: Any, within: str | Interval) -> Any:
    if number not in (Interval.read(within) if isinstance(within, str) else within):
        units = {"s": ("ps", "ns"), "m": ("mm", "cm")}.get(str(within).rpartition(" ")[2], ())
        meant = " or ".join(f'"{number:g} {unit}"' for unit in units)
        hint = f"; or was {meant} meant?" if units and 1 < number < 1e6 else ""
        raise ArgumentError(f"{name} = {shown(value)} is outside {within}{hint}")
    return number


def read_real(name: str, cell: Any, within: str | Interval) -> float:
    """A number, or a text that stands for one, with a unit if the range has one; as `check_real`, whose errors it
    raises."""
    unit = (Interval.read(within) if isinstance(within, str) else within).unit
    if isinstance(cell, str):
        try:
            cell = quantity(cell, unit) if unit else parse_number(cell)
        except ValueError as error:
            raise ArgumentError(f"{name} = {shown(cell)} {error}") from None
    return check_real(name, cell, within)


def check_part(name: str, value: Any) -> tuple[int, int]:
    """An argument as (k, n), the k-th of n parts, counted from 1. Raises `ArgumentError`."""
    if not (isinstance(value, tuple | list) and len(value) == 2):
        raise ArgumentError(f"{name} = {shown(value)} is not a pair such as (3, 64)")
    number, parts = (check_integer(f"{name}: an item", one, "[0, 1000000000]") for one in value)
    if not 1 <= number <= parts:
        raise ArgumentError(f"{name} = {number}/{parts} is outside [1/{parts}, {parts}/{parts}]")
    return number, parts


def check_choice(name: str, value: Any, choices: Sequence[str]) -> str:
    """An argument that is one of some words. Raises `ArgumentError`, with the word that was probably meant."""
    if isinstance(value, str) and value in choices:
        return value
    listed = ", ".join(map(repr, choices))
    raise ArgumentError(f"{name} = {shown(value)} is not one of {listed}{suggestion(value, choices)}")


def suggestion(word: Any, known: Sequence[str]) -> str:
    """A hint for an error, `; did you mean 'gaussian'?`, where a known word is close to the one that was given."""
    # The time to compare words grows as the product of their lengths.
    if not (isinstance(word, str) and 0 < len(word) <= 100):
        return ""
    close = [one for one in known if one.lower().startswith(word.lower())]
    close = close or difflib.get_close_matches(word, known, n=1, cutoff=0.61)
    return f"; did you mean {' or '.join(map(repr, close[:2]))}?" if close else ""


def _is_single(value: Any) -> bool:
    """Whether it may be a number: no class, truth value, text, time or complex number of NumPy's, and no array."""
    kind = getattr(getattr(value, "dtype", None), "kind", "f")  # dtypes of torch have none
    return not isinstance(value, bool | type) and kind in ("i", "u", "f") and getattr(value, "ndim", 0) == 0


def parse_number(text: str) -> float:
    """The number that a text stands for: "2e9", ".5", "2_000_000"; "inf" and "-inf" too, but not "nan".

    Raises `ValueError` whose text continues the text: "is not a number", or "is beyond the largest number, 1.8e308".
    """
    word = text.strip()
    if word.lower().lstrip("+-") in ("inf", "infinity"):
        return -math.inf if word.startswith("-") else math.inf
    if not _NUMBER.fullmatch(word):
        raise ValueError("is not a number")
    number = float(word)
    if math.isinf(number):
        raise ValueError("is beyond the largest number, 1.8e308")
    return number


class _Short(reprlib.Repr):
    """`repr` of what may be endless, deep or huge."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = self.maxlong = 4 * _LONGEST
        self.maxlist = self.maxtuple = self.maxdict = self.maxset = self.maxarray = _LONGEST
        self.maxlevel = 10

    def repr_array(self, x: Any, level: int) -> str:
        # Chosen by the name of the type, which Warp's arrays share with those of the standard library.
        return super().repr_array(x, level) if isinstance(x, array.array) else self.repr_instance(x, level)

    def repr_int(self, x: int, level: int) -> str:
        return repr(x) if x.bit_length() < 1000 else f"an integer of {x.bit_length()} bits"


def shown(value: Any) -> str:
    """A value as messages quote it, at most 60 characters."""
    text = _Short().repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."


# ---- What notebooks show.


class Shown:
    """Scenes and results, which `spadwarp.viz` draws."""

    def plot(self, kind: Any = None, **options: Any) -> Any:
        """A figure; of a result "depth", "intensity", "histogram" or "truth"; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(cast(Any, self), kind, **options)

    def _repr_html_(self) -> str:
        import spadwarp

        return spadwarp.viz.html(cast(Any, self))


# ---- Constants, and the one place where the time of flight of a pulse becomes a length.


SPEED_OF_LIGHT = 299_792_458.0
"""c0, in vacuum [m/s]."""

PLANCK = 6.626_070_15e-34
"""h [J s]."""


def pulse_speed(group_index: float) -> float:
    """Speed of a pulse in water, c0 over the group index [m/s]."""
    return SPEED_OF_LIGHT / group_index


def path_from_time(time: Any, group_index: float) -> Any:
    """Geometric path [m] of a time of flight [s], a number or an array; `time_from_path` is its inverse."""
    return time * pulse_speed(group_index)


def time_from_path(path: Any, group_index: float) -> Any:
    """Time of flight [s] along a geometric path [m], a number or an array."""
    return path * (group_index / SPEED_OF_LIGHT)


def range_from_time(time: Any, group_index: float) -> Any:
    """Range [m] of a round trip of a time [s], laser at the lens; `spadwarp.scene.sight` has it for any laser."""
    return 0.5 * pulse_speed(group_index) * time


def time_from_range(distance: Any, group_index: float) -> Any:
    """Time [s] of a round trip to a range [m], laser at the lens."""
    return distance * (2.0 * group_index / SPEED_OF_LIGHT)


# ---- Numbers with a unit.

_PREFIXES = {"f": -15, "p": -12, "n": -9, "u": -6, "µ": -6, "μ": -6, "m": -3, "": 0, "k": 3, "M": 6, "G": 9}

_RADIAN = Fraction(180 / math.pi)  # [°]

# A kind of quantity with its article, an example, the unit that takes prefixes, and units without them.
_KINDS: tuple[tuple[str, str, str, dict[str, Fraction]], ...] = (
    ("a length", "1 cm", "m", {"cm": Fraction(1, 100)}),
    ("a time", "50 ps", "s", {"min": Fraction(60), "h": Fraction(3600)}),
    (
        "a frequency",
        "20 MHz",
        "Hz",
        {"1/s": Fraction(1), "/s": Fraction(1), "cps": Fraction(1), "kcps": Fraction(10**3), "Mcps": Fraction(10**6)},
    ),
    ("an energy", "150 nJ", "J", {}),
    ("a power", "20 mW", "W", {}),
    ("an angle", "12 deg", "", {"deg": Fraction(1), "°": Fraction(1), "rad": _RADIAN, "mrad": _RADIAN / 1000}),
    (
        "a coefficient",
        "0.3 1/m",
        "",
        dict.fromkeys(("1/m", "/m", "m^-1", "m-1", "m⁻¹"), Fraction(1))
        | {"1/cm": Fraction(100), "1/km": Fraction(1, 1000)},
    ),
    ("a concentration", "0.5 mg/m³", "", dict.fromkeys(("mg/m³", "mg/m3", "mg/m^3", "µg/L", "ug/L"), Fraction(1))),
    ("a speed", "5 m/s", "", {"m/s": Fraction(1), "km/h": Fraction(5, 18), "kn": Fraction(1852, 3600)}),
    ("a salinity", "35 g/kg", "", {"g/kg": Fraction(1)}),
    ("a temperature", "20 °C", "", {"°C": Fraction(1), "degC": Fraction(1)}),
    ("a ratio", "20 %", "", {"1": Fraction(1), "%": Fraction(1, 100)}),
)


def _unit_table() -> dict[str, tuple[str, str, Fraction]]:
    """Kind, example and factor of every unit."""
    table: dict[str, tuple[str, str, Fraction]] = {}
    for kind, example, base, others in _KINDS:
        scaled = {prefix + base: Fraction(10) ** power for prefix, power in _PREFIXES.items()} if base else {}
        table |= {unit: (kind, example, factor) for unit, factor in {**scaled, **others}.items()}
    del table["mHz"]  # for MHz, more often than not
    return table


UNITS = _unit_table()
"""Units that `quantity` reads: their kind, an example, and the factor to the unit of the kind."""
_NUMBER_WITH_UNIT = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*(.*?)\s*", re.DOTALL | re.ASCII)


def quantity(text: str, unit: str) -> float:
    """The number of a text such as "150 nJ" in another unit of its kind, such as "J"; correctly rounded.

    Units: m, s, Hz, J and W with the prefixes f p n u µ m k M G; cm, min, h, deg, °, rad, mrad, 1/s, cps, kcps, Mcps,
    1/m, 1/cm, 1/km, m/s, km/h, kn, mg/m³, g/kg, °C, %. Raises `ValueError`, whose text begins with a verb, to be put
    behind the value, for text without a number or a known unit ("mJ" and "MJ" differ), and a unit of another kind.
    """
    kind, example, factor = UNITS[unit]
    if factor not in (1, UNITS[example.partition(" ")[2]][2]):
        example = f"50 {unit}"
    found = _NUMBER_WITH_UNIT.fullmatch(text) if len(text) <= _LONGEST else None
    if found is None:
        raise ValueError(f"is not {kind}, such as {example!r}")
    number, given = found.groups()
    if math.isinf(float(number)):
        raise ValueError("is beyond the largest number, 1.8e308")
    if not given:
        raise ValueError(f"has no unit; write {number} without quotes for {unit}, or {example!r}")
    if given not in UNITS:
        meant = " or ".join(repr(f"{number} {one}") for one in UNITS if one.casefold() == given.casefold())
        meant = meant or repr(text.replace(",", ".")) * (given[0] == ",")
        hint = f"did you mean {meant}?" if meant else f"e.g. {example!r}"
        raise ValueError(f"has the unit {given!r}, which is not known; {hint}")
    other, _, given_factor = UNITS[given]
    if other != kind:
        raise ValueError(f"is {other}; {kind} is needed, such as {example!r}")
    try:
        return float(Fraction(number) * given_factor / factor)
    except OverflowError:
        raise ValueError("is beyond the largest number, 1.8e308") from None


def count(number: float) -> str:
    """A whole number with a space between thousands: 2 000 000."""
    return f"{number:,.0f}".replace(",", " ")


def percent(share: float) -> str:
    """A share in per cent, to two digits and without an exponent: `percent(1.234)` is "120"."""
    return f"{float(f'{100.0 * share:.2g}'):g}"


def rounded(value: float, error: float) -> str:
    """A value to the second digit of its standard error, and to five digits at least: 1.49938 for an error of 0.00037.

    Five digits where the error is 0 or not finite.
    """
    digits = 5
    if value and error > 0.0 and math.isfinite(value) and math.isfinite(error):
        digits = max(digits, math.floor(math.log10(abs(value))) - math.floor(math.log10(error)) + 2)
    return f"{value:.{min(digits, 15)}g}"


def with_prefix(value: float, unit: str, *, digits: int = 3) -> str:
    """A number of m, s, Hz, J or W for people: `with_prefix(1.5e-7, "J")` is "150 nJ"."""
    if not abs(value) > 0 or math.isinf(value):
        return f"{value:.{digits}g} {unit}"
    symbols = {power: prefix for prefix, power in _PREFIXES.items() if prefix not in ("u", "μ")}
    rounded = float(f"{value:.{digits}g}")
    power = max((one for one in symbols if abs(rounded) >= 10.0**one * (1 - 1e-12)), default=min(symbols))
    scaled = value / 10.0**power
    text = f"{scaled:.{digits}g}"
    return f"{float(text):.0f} {symbols[power]}{unit}" if "e" in text else f"{text} {symbols[power]}{unit}"
