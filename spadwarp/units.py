"""Physical constants, the one place where the time of flight of a pulse becomes a length, and numbers with a unit.

The table of units is our own. pint 0.25 took 1.6 s to load where `spadwarp --help` takes 0.5 s, reads "5 a" as five
years and "50 PS" as petasiemens, and makes 3.7500000000000005e-08 J of "37.5 nJ"; a scene needs eleven kinds of units.
"""

from __future__ import annotations

import math
import re
from fractions import Fraction
from typing import Any

__all__ = ["PLANCK", "SPEED_OF_LIGHT", "UNITS", "path_from_time", "percent", "pulse_speed", "quantity"]
__all__ += ["range_from_time", "rounded", "time_from_path", "time_from_range", "with_prefix"]

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


# Numbers with a unit

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
_LONGEST = 60  # characters
_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*(.*?)\s*", re.DOTALL | re.ASCII)


def quantity(text: str, unit: str) -> float:
    """The number of a text such as "150 nJ" in another unit of its kind, such as "J"; correctly rounded.

    Units: m, s, Hz, J and W with the prefixes f p n u µ m k M G; cm, min, h, deg, °, rad, mrad, 1/s, cps, kcps, Mcps,
    1/m, 1/cm, 1/km, mg/m³, g/kg, °C, %. Raises `ValueError` for text without a number or unit, an unknown unit
    (capitals count: "mJ" and "MJ" differ), and a unit of another kind; its text begins with a verb, to be put behind
    the value.
    """
    kind, example, factor = UNITS[unit]
    if factor not in (1, UNITS[example.partition(" ")[2]][2]):
        example = f"50 {unit}"
    found = _NUMBER.fullmatch(text) if len(text) <= _LONGEST else None
    if found is None:
        raise ValueError(f"is not {kind}, such as {example!r}")
    number, given = found.groups()
    if math.isinf(float(number)):
        raise ValueError("is beyond the largest number, 1.8e308")
    if not given:
        raise ValueError(f"has no unit; write {number} without quotes for {unit}, or {example!r}")
    if given not in UNITS:
        close = [one for one in UNITS if one.casefold() == given.casefold()]
        hint = (
            f"did you mean {' or '.join(repr(f'{number} {one}') for one in close)}?" if close else f"e.g. {example!r}"
        )
        raise ValueError(f"has the unit {given!r}, which is not known; {hint}")
    other, _, given_factor = UNITS[given]
    if other != kind:
        raise ValueError(f"is {other}; {kind} is needed, such as {example!r}")
    try:
        return float(Fraction(number) * given_factor / factor)
    except OverflowError:
        raise ValueError("is beyond the largest number, 1.8e308") from None


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
