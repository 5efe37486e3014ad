"""Refractive indices of what windows are made of, and of air, by wavelength."""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ["MATERIALS", "air_indices", "window_indices"]


class Material(NamedTuple):
    """Sellmeier's n² = 1 + Σ B λ²/(λ² − C), λ in µm, within a range [µm]."""

    terms: tuple[tuple[float, float], ...]
    low: float
    high: float
    source: str


_PMMA = Material(((1.1819, 0.011313),), 0.4368, 1.052, "Sultanova et al., Acta Phys. Pol. A 116, 585 (2009), 20 °C")

MATERIALS: dict[str, Material] = {
    "BK7": Material(
        ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)),
        0.3,
        2.5,
        "SCHOTT, data sheet of N-BK7",
    ),
    "fused silica": Material(
        ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)),
        0.21,
        6.7,
        "Malitson, J. Opt. Soc. Am. 55, 1205 (1965)",
    ),
    "sapphire": Material(
        ((1.4313493, 0.0726631**2), (0.65054713, 0.1193242**2), (5.3414021, 18.028251**2)),
        0.2,
        5.0,
        "ordinary ray; Malitson (1962), as in Weber, Handbook of optical materials (2003)",
    ),
    "acrylic": _PMMA,
    "PMMA": _PMMA,
    "polycarbonate": Material(
        ((1.4182, 0.021304),), 0.4368, 1.052, "Sultanova et al., Acta Phys. Pol. A 116, 585 (2009), 20 °C"
    ),
}
"""Materials of windows; the coefficients as refractiveindex.info lists them."""


def window_indices(material: str, wavelength_nm: float) -> tuple[float, float]:
    """Phase and group index of a material of `MATERIALS` at a vacuum wavelength; n_g = n − λ dn/dλ.

    Raises `ValueError` outside the range of its source.
    """
    glass, micrometres = MATERIALS[material], wavelength_nm * 1e-3
    if not glass.low <= micrometres <= glass.high:
        low, high = 1e3 * glass.low, 1e3 * glass.high
        raise ValueError(f"material = {material!r} is known for [{low:g}, {high:g}] nm, not for {wavelength_nm:g} nm")
    square = micrometres**2
    index = math.sqrt(1.0 + sum(b * square / (square - c) for b, c in glass.terms))
    slope = -sum(b * c * micrometres / (square - c) ** 2 for b, c in glass.terms) / index
    return index, index - micrometres * slope


def air_indices(wavelength_nm: float) -> tuple[float, float]:
    """Phase and group index of dry air at 15 °C and 101 325 Pa (Ciddor, Appl. Opt. 35, 1566 (1996))."""
    s2 = 1.0 / max(wavelength_nm * 1e-3, 0.23) ** 2
    excess, slope = 0.0, 0.0
    for strength, pole in ((0.05792105, 238.0185), (0.00167917, 57.362)):
        excess += strength / (pole - s2)
        slope += strength * 2.0 * s2 / (pole - s2) ** 2  # −λ d/dλ
    return 1.0 + excess, 1.0 + excess + slope
