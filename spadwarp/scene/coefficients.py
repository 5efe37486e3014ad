"""The four coefficients of a water, of which two are given."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spadwarp.limits import Interval

EXTINCTION = "[1e-12, 1e6]"
COEFFICIENTS = ("absorption", "scattering", "extinction", "albedo")


def complete_coefficients(pair: Mapping[str, Any]) -> dict[str, Any]:
    """All four coefficients from exactly two of them, the given ones as they are.

    With `albedo = "lu2024"` absorption and scattering are the means (ω is uniform in (0, 0.97): mean 0.485).
    Raises `ValueError` whose text names field, value and range, without the section.
    """
    if len(pair) != 2:
        given = ", ".join(pair) or "none"
        raise ValueError(f"needs exactly two of {', '.join(COEFFICIENTS)}, or chlorophyll; given: {given}")
    a, b, c, albedo = (pair.get(name) for name in COEFFICIENTS)  # type: Any, Any, Any, Any
    if albedo == "lu2024":
        if c is None:
            raise ValueError("albedo = 'lu2024' goes with extinction only")
        return {"absorption": c * (1.0 - 0.485), "scattering": c * 0.485, "extinction": c, "albedo": albedo}
    if albedo is not None:
        if c is None:
            rest = albedo if a is None else 1.0 - albedo
            if rest <= 0.0:
                raise ValueError(f"albedo = {albedo} leaves the extinction undetermined; give extinction and albedo")
            c = (b if a is None else a) / rest
        a = c * (1.0 - albedo) if a is None else a
        b = c * albedo if b is None else b
    elif c is None:
        c = a + b
    else:
        part, value = ("scattering", b) if a is None else ("absorption", a)
        if value > c:
            raise ValueError(f"{part} = {value} is outside [0, {c}], {c} being the extinction")
        a = c - b if a is None else a
        b = c - a if b is None else b
    if c not in Interval.read(EXTINCTION):
        raise ValueError(f"extinction = {c} is outside {EXTINCTION}")
    return {"absorption": a, "scattering": b, "extinction": c, "albedo": b / c if albedo is None else albedo}
