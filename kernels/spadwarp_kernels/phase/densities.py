"""Phase functions in NumPy float64: densities [1/sr] over t = 1 - cos(theta), for tables and for figures."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from spadwarp_kernels.arguments import ArgumentError, check_number, check_numbers
from spadwarp_kernels.random.density_tables import Floats, folded_quadrature


def henyey_greenstein_density(t: ArrayLike, g: float) -> Floats:
    """Henyey & Greenstein (1941); mean cosine g in (-1, 1)."""
    check_number("g", g, "(-1, 1)")
    t = check_numbers("t", t)
    return (1.0 - g * g) / (4.0 * np.pi * ((1.0 - g) ** 2 + 2.0 * g * t) ** 1.5)


def two_term_henyey_greenstein_density(t: ArrayLike, g1: float, g2: float, alpha: float) -> Floats:
    """alpha HG(g1) + (1 - alpha) HG(g2), alpha in [0, 1] (Haltrin, Appl. Opt. 41, 1022 (2002), with -g2 for his g2)."""
    check_number("alpha", alpha, "[0, 1]")
    return alpha * henyey_greenstein_density(t, g1) + (1.0 - alpha) * henyey_greenstein_density(t, g2)


def rayleigh_density(t: ArrayLike, depolarisation_ratio: float = 0.0) -> Floats:
    """Molecules: 1 + cos^2(theta)(1 - r)/(1 + r), r in [0, 1] the depolarisation ratio of unpolarised light that is
    scattered by 90 degrees (Hansen & Travis, Space Sci. Rev. 16, 527 (1974), eq 2.15)."""
    check_number("depolarisation_ratio", depolarisation_ratio, "[0, 1]")
    part = (1.0 - depolarisation_ratio) / (1.0 + depolarisation_ratio)
    return (1.0 + part * (1.0 - check_numbers("t", t)) ** 2) / (4.0 * np.pi * (1.0 + part / 3.0))


def fournier_forand_density(t: ArrayLike, particle_index: float, junge_slope: float) -> Floats:
    """Fournier & Forand (1994) as in Fournier & Jonasz, Proc. SPIE 3761, 62 (1999); infinite at t = 0.

    Args:
        t: In (0, 2].
        particle_index: Real index n of the particles over that of the water, in (1, 1.35].
        junge_slope: Slope mu of their size distribution, in (3, 5).
    """
    check_number("particle_index", particle_index, "(1, 1.35]")
    check_number("junge_slope", junge_slope, "(3, 5)")
    s2 = 0.5 * check_numbers("t", t)  # sin^2(theta/2)
    nu = 0.5 * (3.0 - junge_slope)
    delta_180 = 4.0 / (3.0 * (particle_index - 1.0) ** 2)
    delta = delta_180 * s2
    # Both brackets cancel where delta is 1: there as series in ln(delta), whose square the quotient is freed of.
    x = np.log(delta)
    small = np.clip(x, -0.5, 0.5)
    powers = [small ** (k - 2) / math.factorial(k) for k in range(2, 20)]
    first = sum((nu**k - nu) * power for k, power in enumerate(powers, 2))
    second = sum((1.0 + nu - (1.0 + nu) ** k) * power for k, power in enumerate(powers, 2))
    near = np.abs(x) < 0.5
    far = np.where(near, 1.0, x)
    first = np.where(near, first, (nu * (1.0 - delta) - (1.0 - delta**nu)) / far**2)
    second = np.where(near, second, (delta * (1.0 - delta**nu) - nu * (1.0 - delta)) / far**2)
    quotient = np.where(near, sum(small**k / math.factorial(k + 1) for k in range(18)), np.expm1(x) / far)
    bracket = (first + second / s2) / quotient**2
    rayleigh = (1.0 - delta_180**nu) / (16.0 * np.pi * (delta_180 - 1.0) * delta_180**nu)
    return bracket / (4.0 * np.pi * delta**nu) + rayleigh * (3.0 * (1.0 - 2.0 * s2) ** 2 - 1.0)


def interpolated_density(angles: ArrayLike, values: ArrayLike) -> Callable[[ArrayLike], Floats]:
    """A measured phase function, normalised: power laws in theta between the points, linear next to a zero.

    Below the first angle the first power law goes on if it falls with theta (no steeper than theta^-1.9, whose integral
    is finite), else the first value; beyond the last angle the last value.

    Args:
        angles: Scattering angles [rad], ascending in [0, pi], two or more.
        values: >= 0, of any scale.

    Raises:
        ArgumentError: Angles or values are not of that kind.
    """
    theta, value = check_numbers("angles", angles), check_numbers("values", values)
    if theta.ndim != 1 or theta.size < 2 or value.shape != theta.shape:
        raise ArgumentError(f"angles {theta.shape} and values {value.shape} are not two equal lists of two or more")
    if not (np.isfinite(theta).all() and (np.diff(theta) > 0.0).all()):
        raise ArgumentError("angles of a phase function must be finite and ascending")
    if theta[0] < 0.0 or theta[-1] > np.pi * (1.0 + 1e-12):
        raise ArgumentError(f"angles [{theta[0]:g}, {theta[-1]:g}] rad are outside [0, pi]")
    if not (np.isfinite(value).all() and value.min() >= 0.0 and value.any()):
        raise ArgumentError(f"values ({value.min():g} ... {value.max():g}) must be finite, not negative and not all 0")
    logs = np.log(np.maximum(theta, 1e-300)), np.log(np.maximum(value, 1e-300))
    straight = (value[:-1] > 0.0) & (value[1:] > 0.0) & (theta[:-1] > 0.0)
    slope = np.diff(logs[1]) / np.diff(logs[0])
    forward = max(float(slope[0]), -1.9) if straight[0] and slope[0] < 0.0 else 0.0

    def unscaled(t: ArrayLike) -> Floats:
        angle = 2.0 * np.arcsin(np.sqrt(0.5 * np.asarray(t, np.float64)))
        k = np.clip(np.searchsorted(theta, angle, side="right") - 1, 0, theta.size - 2)
        power = np.exp(logs[1][k] + slope[k] * (np.log(np.maximum(angle, 1e-300)) - logs[0][k]))
        linear = value[k] + (value[k + 1] - value[k]) * (angle - theta[k]) / (theta[k + 1] - theta[k])
        between = np.where(straight[k], power, linear)
        before = value[0] * (np.maximum(angle, 1e-300) / max(theta[0], 1e-300)) ** forward
        return np.where(angle < theta[0], before, np.where(angle > theta[-1], value[-1], between))

    total = sphere_integral(unscaled)
    return lambda t: unscaled(t) / total


def sphere_integral(function: Callable[[Floats], Floats]) -> float:
    """Integral over the unit sphere of a function of t = 1 - cos(theta)."""
    z, weight = folded_quadrature()
    if not callable(function):
        raise ArgumentError(f"function = {function!r} is not a function of t")
    found = check_numbers("what function returns", function(np.where(z < 0.0, 2.0 + 2.0 * z, 2.0 * z)))
    if found.shape != z.shape and not (found.shape == () and np.isfinite(found)):
        raise ArgumentError(f"what function returns has shape {found.shape}; {z.shape} is needed, that of t")
    return float(4.0 * np.pi * (found * weight).sum())
