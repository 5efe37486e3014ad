"""Fournier–Forand from its closed distribution function, apart from the engine's density.

The density is published in Fournier & Jonasz, Proc. SPIE 3761, 62 (1999), its integral in Forand & Fournier, Proc. SPIE
3761, 34 (1999). Here the density is the derivative of the integral, by a complex step.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def cumulative(t: ArrayLike, particle_index: float, junge_slope: float) -> NDArray[Any]:
    """Probability that 1 − cosθ is below t in (0, 2]; loses digits within a hundredth of δ = 1, t = 3(n − 1)²/2."""
    t = np.asarray(t)
    nu, whole = (3 - junge_slope) / 2, 4 / (3 * (particle_index - 1) ** 2)
    delta = whole * t / 2
    first = ((1 - delta ** (nu + 1)) - (1 - delta**nu) * t / 2) / ((1 - delta) * delta**nu)
    return first + (1 - whole**nu) / (8 * (whole - 1) * whole**nu) * (1 - t) * t * (2 - t)


def density(t: ArrayLike, particle_index: float, junge_slope: float) -> NDArray[np.float64]:
    """p [1/sr] at 1 − cosθ = t."""
    step = 1e-30
    return cumulative(np.asarray(t) + 1j * step, particle_index, junge_slope).imag / step / (2 * np.pi)
