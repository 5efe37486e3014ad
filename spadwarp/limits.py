"""Numbers and words that enter, as text or from Python: of their kind and within their range, or refused by name.

A range is written "(0, 1e6] 1/m": a bracket includes its end, a parenthesis does not. Those of a scene's fields stand
on the fields, from where `spadwarp.scene.sections.field_range` reads them.
"""

from __future__ import annotations

import array
import difflib
import functools
import math
import operator
import os
import re
import reprlib
from collections.abc import Sequence
from typing import Any, NamedTuple, SupportsFloat, SupportsIndex

from spadwarp.errors import ArgumentError

__all__ = ["BIN_WIDTH", "SEED", "TIME", "Interval", "bounds", "check_choice", "check_integer", "check_part"]
__all__ += ["check_real", "environment_integer", "parse_number", "read_real", "shown", "suggestion"]

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
        raise ArgumentError(f"{name} = {shown(value)} is outside {within}")
    return number


def read_real(name: str, cell: Any, within: str | Interval) -> float:
    """A number of a file, or a text that stands for one; as `check_real`, whose errors it raises."""
    try:
        return check_real(name, parse_number(cell) if isinstance(cell, str) else cell, within)
    except ArgumentError:
        raise
    except ValueError as error:
        raise ArgumentError(f"{name} = {shown(cell)} {error}") from None


def check_part(name: str, value: Any) -> tuple[int, int]:
    """An argument as (k, n), the k-th of n parts, counted from 1. Raises `ArgumentError`."""
    if not (isinstance(value, tuple | list) and len(value) == 2):
        raise ArgumentError(f"{name} = {shown(value)} is not a pair such as (3, 64)")
    number, parts = (check_integer(f"{name}: an item", one, "[0, 1000000000]") for one in value)
    if not 1 <= number <= parts:
        raise ArgumentError(f"{name} = {number}/{parts} is outside [1/{parts}, {parts}/{parts}]")
    return number, parts


def environment_integer(name: str, default: int) -> int:
    """A variable of the environment that is an integer ≥ 0. Raises `ArgumentError` where it is none."""
    text = os.environ.get(name)
    if text is None:
        return default
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise ArgumentError(f"environment variable {name} = {shown(text)} is not an integer >= 0")
    return int(text)


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
    close = close or difflib.get_close_matches(word, known, n=1)
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
