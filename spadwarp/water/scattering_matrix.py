"""Scattering matrices: how one scattering changes the polarisation of light, apart from its phase function.

Each function takes cosines of the scattering angle `[n]`, in [-1, 1], and gives m12, m22, m33, m34 and m44, each over
m11, the phase function, `[n, 5]`, in the form that matter without a preferred direction or handedness has (Bohren &
Huffman 1983, eq 4.77): m21 = m12, m43 = −m34, and the others are zero. The reference direction of both Stokes vectors
lies in the scattering plane.

>>> spadwarp.water.voss_fry_matrix(np.cos(np.radians([0.0, 90.0, 180.0])))
"""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np

from spadwarp.arrays import Floats, real_array
from spadwarp.io.text import read_columns
from spadwarp.values import ConfigError, check_real
from spadwarp.water.seawater import RANGES, WATER_DEPOLARISATION

__all__ = ["MATRIX_COLUMNS", "rayleigh_matrix", "read_matrix_table", "scaled_rayleigh_matrix", "voss_fry_matrix"]

MATRIX_COLUMNS = {"angle_deg": "[0, 180]"} | dict.fromkeys(("m12", "m22", "m33", "m34", "m44"), "[-1, 1]")
"""Columns of a table of a scattering matrix: scattering angle [°] and five elements, each over m11."""

# Voss & Fry's water: −m12 at 90°; the shift of the angle in m22 [rad]; height, and decay over the angle [1/rad], of the
# light that large particles scatter forward and whose polarisation they keep.
_AT_90_DEGREES, _SHIFT, _FORWARD, _DECAY = 0.66, 0.25, 25.6, 4.0

# By which a table may exceed what is physical: measured and rounded values.
_SLACK = 0.01


def _cosines(values: Floats) -> Floats:
    return np.clip(real_array("cosine", values, np.float64, within="[-1.000001, 1.000001]"), -1.0, 1.0)


def rayleigh_matrix(cosine: Floats, depolarisation_ratio: float = WATER_DEPOLARISATION) -> Floats:
    """Matrix of molecules, or of particles much smaller than the wavelength (Hansen & Travis 1974).

    With d = (1 − ρ)/(1 + ρ): −m12 = d·sin²θ, m22 = d·(1 + cos²θ), m33 = 2d·cosθ and m44 = (3d − 1)·cosθ, each over
    1 + d·cos²θ; ρ, of unpolarised light scattered by 90°, in [0, 0.5], else `ArgumentError`. `[n]` → `[n, 5]`.
    """
    ratio = check_real("depolarisation_ratio", depolarisation_ratio, RANGES["depolarisation_ratio"])
    cosine, d = _cosines(cosine), (1.0 - ratio) / (1.0 + ratio)
    squared = d * cosine**2
    elements = (squared - d, d + squared, 2.0 * d * cosine, 0.0 * cosine, (3.0 * d - 1.0) * cosine)
    return np.stack(elements, axis=-1) / (1.0 + squared)[..., None]


def scaled_rayleigh_matrix(cosine: Floats, largest: float = _AT_90_DEGREES) -> Floats:
    """Matrix whose m12 has Rayleigh's shape and a given largest value, and which depolarises no polarised light.

    −m12 = P·sin²θ, m33 = m44 = 2·cosθ, each over 1 + cos²θ, and m22 = 1: as of a mixture of spheres that all turn the
    plane of polarisation alike and of which a part P polarises. With it light that is scattered once straight back has
    nothing across the laser's plane; `voss_fry_matrix` has. `largest`: P, −m12 at 90°, in [0, 1], else `ArgumentError`;
    0.66 is Voss & Fry's ocean. `[n]` → `[n, 5]`.
    """
    part, cosine = check_real("largest", largest, RANGES["largest"]), _cosines(cosine)
    zero, turned = 0.0 * cosine, 2.0 * cosine / (1.0 + cosine**2)
    return np.stack([part * (cosine**2 - 1.0) / (1.0 + cosine**2), zero + 1.0, turned, zero, turned], axis=-1)


def voss_fry_matrix(cosine: Floats) -> Floats:
    """Average matrix of Atlantic, Pacific and Gulf of Mexico water, by Kokhanovsky's fit to Voss & Fry's measurement.

    −m12 = 0.66·sin²θ/(1 + 0.66·cos²θ), m22 and m33 with the part 25.6·exp(−4θ) of large particles, m34 = 0 as measured;
    m44 is taken equal to m33. The measurement goes from 10° to 160°, with a standard deviation of mostly less than 10 %
    over places and depths. Beyond, the fit is an extrapolation: for circular polarisation straight back, symmetry asks
    for m44 = 1 − 2·m22, −0.58 in place of the fit's −0.80.

    Voss & Fry, Appl. Opt. 23, 4427 (1984); Kokhanovsky, J. Geophys. Res. 108, 3175 (2003), doi:10.1029/2001JC001222.
    `[n]` → `[n, 5]`.
    """
    cosine = _cosines(cosine)
    angle = np.arccos(cosine)
    forward = _FORWARD * np.exp(-_DECAY * angle)
    squared, shifted = _AT_90_DEGREES * cosine**2, _AT_90_DEGREES * np.cos(angle - _SHIFT) ** 2
    m12 = (squared - _AT_90_DEGREES) / (1.0 + squared)
    m22 = (_AT_90_DEGREES + shifted + forward) / (1.0 + shifted + forward)
    m33 = (2.0 * _AT_90_DEGREES * cosine + forward) / (1.0 + squared + forward)
    return np.stack([m12, m22, m33, np.zeros_like(m33), m33], axis=-1)


def read_matrix_table(path: str | os.PathLike[str]) -> Callable[[Floats], Floats]:
    """A matrix from a .csv file of `MATRIX_COLUMNS`, 0° to 180°, as a function of the cosine; straight between rows.

    Raises:
        FileError: The file cannot be read.
        ConfigError: A line that is not six numbers in their ranges; angles that do not ascend from 0 to 180; or a row
            that no matter has, since it would make light polarised by more than 1.
    """
    angles, *columns = read_columns(path, MATRIX_COLUMNS).T
    elements, source = np.stack(columns, axis=-1), str(path)
    if len(angles) < 2:
        raise ConfigError(f"has {len(angles)} rows; at least 2 are needed", source=source)
    if (at := np.flatnonzero(np.diff(angles) <= 0.0)).size:
        raise ConfigError(f"angle_deg = {angles[at[0] + 1]:g} follows {angles[at[0]]:g}: not ascending", source=source)
    if angles[0] != 0.0 or angles[-1] != 180.0:
        text = f"angle_deg goes from {angles[0]:g} to {angles[-1]:g}, not from 0 to 180; add the rows that are missing"
        raise ConfigError(text, source=source)
    m12, m22, m33, m34, m44 = elements.T
    # No negative eigenvalue of the coherency matrix (Hovenier & van der Mee 1996).
    for left, right, words in (
        (1.0 - m22, np.abs(m33 - m44), "1 - m22 = {:.4g} is below |m33 - m44| = {:.4g}"),
        (
            1.0 + m22,
            np.hypot(m33 + m44, 2.0 * np.hypot(m12, m34)),
            "1 + m22 = {:.4g} is below sqrt((m33 + m44)² + 4·m12² + 4·m34²) = {:.4g}",
        ),
    ):
        if (at := np.flatnonzero(right > left + _SLACK)).size:
            text = words.format(left[at[0]], right[at[0]])
            raise ConfigError(f"at angle_deg = {angles[at[0]]:g} no matter scatters so: {text}", source=source)

    def matrix(cosine: Floats) -> Floats:
        degrees = np.degrees(np.arccos(np.asarray(cosine, np.float64)))
        return np.stack([np.interp(degrees, angles, column) for column in columns], axis=-1)

    return matrix
