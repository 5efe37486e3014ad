"""The scattering matrix of ocean water as Voss and Fry measured it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["voss_fry_matrix"]

Floats = NDArray[np.float64]

_AT_90_DEGREES = 0.66  # −m12 there
_SHIFT = 0.25  # of the angle in m22 [rad]
_FORWARD, _DECAY = 25.6, 4.0  # height, and decay over the angle [1/rad], of the light that keeps its polarisation


def voss_fry_matrix(cosine: Floats) -> Floats:
    """Average scattering matrix of Atlantic, Pacific and Gulf of Mexico water, by Kokhanovsky's fit to the measurement.

    −m12 = 0.66·sin²θ/(1 + 0.66·cos²θ), m22 and m33 with the part 25.6·exp(−4θ) of large particles, m34 = 0 as measured.
    m44 is taken equal to m33. The measurement goes from 10° to 160° with a standard deviation of mostly less than 10 %
    over places and depths; beyond, the fit is an extrapolation (where particles without mirror image of their own would
    have m44 = 1 − 2·m22 at 180°, −0.58 in place of −0.80).

    Voss & Fry, Appl. Opt. 23, 4427 (1984); Kokhanovsky, J. Geophys. Res. 108, 3175 (2003), doi:10.1029/2001JC001222.

    Args:
        cosine: Of the scattering angle `[n]`, in [-1, 1].

    Returns:
        m12, m22, m33, m34 and m44, each over m11, `[n, 5]`.
    """
    cosine = np.asarray(cosine, np.float64)
    angle = np.arccos(cosine)
    forward = _FORWARD * np.exp(-_DECAY * angle)
    squared, shifted = _AT_90_DEGREES * cosine**2, _AT_90_DEGREES * np.cos(angle - _SHIFT) ** 2
    m12 = (squared - _AT_90_DEGREES) / (1.0 + squared)
    m22 = (_AT_90_DEGREES + shifted + forward) / (1.0 + shifted + forward)
    m33 = (2.0 * _AT_90_DEGREES * cosine + forward) / (1.0 + squared + forward)
    return np.stack([m12, m22, m33, np.zeros_like(m33), m33], axis=-1)
