"""Phase functions that run on tables: Fournier-Forand, two-term Henyey-Greenstein, measured ones, any other.

`make_phase_tables` takes a density [1/sr] over t = 1 - cos(theta) in NumPy, such as those of `phase_densities.py`; the
phase function TABULATED samples and evaluates it. A cell of the tables is up to 6 % wide in t and 3 % in theta; below
2e-5 rad the density is constant, whatever p does.
"""

from collections.abc import Callable

import numpy as np
import warp as wp

from spadwarp_kernels.arguments import check_device, check_kind
from spadwarp_kernels.medium.water import Medium
from spadwarp_kernels.random.density_tables import (
    DensityTables,
    Floats,
    fold,
    lower_ends,
    make_density_tables,
    table_cumulative,
    table_density,
    table_sample,
    tabulate,
)

from .phase_function import Guiding, PhaseFunction, PhaseGuide

_INV_4PI = wp.constant(0.07957747154594767)
_PI = wp.constant(3.141592653589793)
_INV_PI = wp.constant(0.3183098861837907)

# Rows of the tables: 4 pi p over t/2; p over 1 - theta/pi, from which the angle by which a flight turns to the lens is
# drawn; over t/2 the directions towards the lens.
_SCATTERING, _TURNING, _LOBE = (wp.constant(i) for i in range(3))

_FLAT = 2.0**-32  # t up to which a table takes the density for constant


@wp.func
def _one_minus_cosine(z: float) -> float:
    """t at the folded coordinate z of t/2."""
    return wp.where(z < 0.0, 2.0 + 2.0 * z, 2.0 * z)


@wp.func
def _turn(theta: float) -> float:
    """The folded coordinate of 1 - theta/pi; a forward theta keeps its precision."""
    return wp.where(theta < 0.5 * _PI, wp.min(-theta * _INV_PI, -1.0e-12), wp.max(1.0 - theta * _INV_PI, 0.0))


@wp.func
def _pdf(t: float, medium: Medium) -> float:
    return _INV_4PI * table_density(medium.phase, _SCATTERING, fold(0.5 * t))


@wp.func
def _sample(xi: float, medium: Medium) -> float:
    return _one_minus_cosine(table_sample(medium.phase, _SCATTERING, xi))


@wp.func
def _complement(theta: float, medium: Medium) -> float:
    return table_cumulative(medium.phase, _TURNING, _turn(theta))


@wp.func
def _angle(value: float, medium: Medium) -> float:
    z = table_sample(medium.phase, _TURNING, value)
    return wp.where(z < 0.0, -_PI * z, _PI * (1.0 - z))


@wp.func
def _angle_density(theta: float, medium: Medium) -> float:
    return _INV_PI * table_density(medium.phase, _TURNING, _turn(theta))


@wp.func
def _lobe_pdf(t: float, medium: Medium, guiding: Guiding) -> float:
    return _INV_4PI * table_density(medium.phase, _LOBE, fold(0.5 * t))


@wp.func
def _lobe_sample(xi: float, medium: Medium, guiding: Guiding) -> float:
    return _one_minus_cosine(table_sample(medium.phase, _LOBE, xi))


TABULATED = PhaseFunction(
    "tabulated", _pdf, _sample, PhaseGuide(_complement, _angle, _angle_density, _lobe_pdf, _lobe_sample)
)


def make_phase_tables(density: Callable[[Floats], Floats], *, device: wp.DeviceLike = None) -> DensityTables:
    """The tables of a phase function, for `Medium.phase` with the phase function TABULATED.

    Args:
        density: Over t = 1 - cos(theta) in (0, 2), >= 0, of any scale. Towards t = 0 it may rise as t^-0.95.

    Raises:
        ArgumentError: The density is negative, not finite or zero everywhere.
    """
    device = check_device("device", device)
    check_kind("density", density, Callable)
    scattering = tabulate(lambda z: density(np.where(z < 0.0, 2.0 + 2.0 * z, 2.0 * z)))

    def over_angle(z: Floats) -> Floats:
        t = 2.0 * np.sin(0.5 * np.pi * np.where(z < 0.0, -z, 1.0 - z)) ** 2
        return density(np.maximum(t, _FLAT))  # where the density over t stays finite, its integral over theta does

    turning = tabulate(over_angle)
    below = np.append(turning[:, 0], 1.0), np.append(lower_ends(), 1.0)

    def lobe(z: Floats) -> Floats:
        """What a flight at an angle theta to the lens brings, up to factors that vary little: integral of p from theta
        on over its distance from the lens, ~ sin(theta)."""
        angle = 2.0 * np.arcsin(np.sqrt(np.abs(z)))  # from the nearer end
        position = np.where(z < 0.0, angle, np.pi - angle) / np.pi
        return np.interp(position, below[1], below[0]) / np.sin(angle)

    return make_density_tables(scattering, turning, tabulate(lobe), device=device)
