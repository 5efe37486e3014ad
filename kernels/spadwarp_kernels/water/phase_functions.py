"""Phase functions in NumPy float64: densities [1/sr] over t = 1 - cos(theta), for tables and for figures."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from spadwarp_kernels.base import check, tables
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.tables import DensityTables, Floats, fold

from .medium import MOST_CONSTITUENTS, Medium

__all__ = ["HENYEY_GREENSTEIN", "TABULATED", "Guiding", "PhaseFunction", "PhaseGuide", "fournier_forand_density"]
__all__ += ["henyey_greenstein_density", "henyey_greenstein_pdf", "interpolated_density", "make_mixture"]
__all__ += ["make_phase_tables", "rayleigh_density", "sample_henyey_greenstein", "sphere_integral"]
__all__ += ["two_term_henyey_greenstein_density"]


def henyey_greenstein_density(t: ArrayLike, g: float) -> Floats:
    """Henyey & Greenstein (1941); mean cosine g in (-1, 1)."""
    check.number("g", g, "(-1, 1)")
    t = check.numbers("t", t)
    return (1.0 - g * g) / (4.0 * np.pi * ((1.0 - g) ** 2 + 2.0 * g * t) ** 1.5)


def two_term_henyey_greenstein_density(t: ArrayLike, g1: float, g2: float, alpha: float) -> Floats:
    """alpha HG(g1) + (1 - alpha) HG(g2), alpha in [0, 1] (Haltrin, Appl. Opt. 41, 1022 (2002), with -g2 for his g2)."""
    check.number("alpha", alpha, "[0, 1]")
    return alpha * henyey_greenstein_density(t, g1) + (1.0 - alpha) * henyey_greenstein_density(t, g2)


def rayleigh_density(t: ArrayLike, depolarisation_ratio: float = 0.0) -> Floats:
    """Molecules: 1 + cos^2(theta)(1 - r)/(1 + r), r in [0, 1] the depolarisation ratio of unpolarised light that is
    scattered by 90 degrees (Hansen & Travis, Space Sci. Rev. 16, 527 (1974), eq 2.15)."""
    check.number("depolarisation_ratio", depolarisation_ratio, "[0, 1]")
    part = (1.0 - depolarisation_ratio) / (1.0 + depolarisation_ratio)
    return (1.0 + part * (1.0 - check.numbers("t", t)) ** 2) / (4.0 * np.pi * (1.0 + part / 3.0))


def fournier_forand_density(t: ArrayLike, particle_index: float, junge_slope: float) -> Floats:
    """Fournier & Forand (1994) as in Fournier & Jonasz, Proc. SPIE 3761, 62 (1999); infinite at t = 0.

    Args:
        t: In (0, 2].
        particle_index: Real index n of the particles over that of the water, in (1, 1.35].
        junge_slope: Slope mu of their size distribution, in (3, 5).
    """
    check.number("particle_index", particle_index, "(1, 1.35]")
    check.number("junge_slope", junge_slope, "(3, 5)")
    s2 = 0.5 * check.numbers("t", t)  # sin^2(theta/2)
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
    theta = check.numbers("angles", angles, (None,), f"[0, {np.pi}]")
    value = check.numbers("values", values, theta.shape, "[0, inf)")
    if theta.size < 2 or not (np.diff(theta) > 0.0).all():
        raise ArgumentError("angles of a phase function must be two or more, ascending")
    if not value.any():
        raise ArgumentError("values are all 0")
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
    z, weight = tables.folded_quadrature()
    if not callable(function):
        raise ArgumentError(f"function = {function!r} is not a function of t")
    found = check.numbers("what function returns", function(np.where(z < 0.0, 2.0 + 2.0 * z, 2.0 * z)))
    if found.shape != z.shape and not (found.shape == () and np.isfinite(found)):
        raise ArgumentError(f"what function returns has shape {found.shape}; {z.shape} is needed, that of t")
    return float(4.0 * np.pi * (found * weight).sum())


# ---- What a phase function is to the transport kernels, and what the estimator `guided` draws from instead.


@wp.struct
class Guiding:
    """How strongly directions are drawn towards the lens; where weights have grown or a vessel is likely, `guided_part`
    lowers the probabilities.
    """

    probability: float
    """Chance p that a water collision draws its direction from the lobe about the lens, in [0, 1); with delta tracking
    1 - (1 - p)^2 for light that comes back, along u_z < 0."""
    surface_probability: float  # the same at a surface
    anisotropy: float
    """g, in (0, 1), of the Henyey-Greenstein water for which that lobe is best; phase functions with a guide have one
    of their own"""
    return_probability: float
    """Chance that an event outside the view draws its direction from a lobe towards the optical axis, so that light
    that strayed comes back into the view more often, in [0, 1)."""
    return_anisotropy: float  # g of that lobe


class PhaseGuide(NamedTuple):
    """What `guided` draws from instead of a phase function p that it cannot invert; all are Warp functions.

    The angle theta in (0, pi) by which light on a flight turns to reach the lens has the density q(theta), per radian
    and of any scale: best is p(theta). Directions towards the lens have the density of a lobe [1/sr]: best is the
    integral of p from theta to pi, which the flight in such a direction brings, over the sine of theta, its distance
    from the lens. The lobe is about the very point of the lens at which that flight is scored.
    """

    complement: wp.Function
    """``(theta: float, medium: Medium) -> float``, integral of q from theta to pi; falls with theta."""
    angle: wp.Function  # ``(value: float, medium: Medium) -> float``, the inverse of it
    density: wp.Function  # ``(theta: float, medium: Medium) -> float``, q itself
    lobe_pdf: wp.Function
    """``(t: float, medium: Medium, guiding: Guiding) -> float``, t = 1 - cos of the angle to the lens."""
    lobe_sample: wp.Function  # ``(xi: float, medium: Medium, guiding: Guiding) -> float``, returns t
    chord: bool = False
    """The functions take, and q is over, the chord c = 2 sin(theta/2) in (0, 2) instead of theta, which needs no
    trigonometry: Henyey-Greenstein is (a^2 + c^2)^(-3/2) without approximation, a^2 = (1 - g)^2/g."""


class PhaseFunction(NamedTuple):
    """A phase function as the transport kernels take it."""

    name: str  # identifies it in the kernel cache and in files
    pdf: wp.Function  # Warp function ``(t: float, medium: Medium) -> float``, density [1/sr]
    sample: wp.Function  # Warp function ``(xi: float, medium: Medium) -> float``, returns t = 1 - cos(theta)
    guide: PhaseGuide | None = None
    """How the estimator `guided` follows it; None: as it follows Henyey-Greenstein with the medium's anisotropy. No
    guide makes it wrong, a poor one makes it noisy."""
    constituents: int = 0
    """Of a mixture, from `make_mixture`: how many phase functions it has, weighted by the shares at the point."""
    part: wp.Function | None = None
    """Of a mixture ``(t: float, medium: Medium, constituent: int) -> float``: the density of one of them over `pdf`."""


# ---- The phase function of Henyey and Greenstein.


_INV_4PI = wp.constant(0.07957747154594767)


@wp.func
def henyey_greenstein_pdf(t: float, g: float) -> float:
    """Henyey-Greenstein density [1/sr] at t = 1 - cos(theta) in [0, 2], for g in (-1, 1); mean cosine g (Henyey &
    Greenstein 1941)."""
    root = 1.0 / wp.sqrt((1.0 - g) * (1.0 - g) + 2.0 * g * t)
    return _INV_4PI * (1.0 - g * g) * (root * root * root)


@wp.func
def henyey_greenstein_log_derivative(t: float, g: float) -> float:
    """d ln p/dg of the Henyey-Greenstein density at t = 1 - cos(theta) in [0, 2], for g in (-1, 1); nothing cancels at
    the forward peak."""
    d = 1.0 - g
    return -2.0 * g / (d * (1.0 + g)) - 3.0 * (t - d) / (d * d + 2.0 * g * t)


@wp.func
def sample_henyey_greenstein(xi: float, g: float) -> float:
    """t = 1 - cos(theta) drawn from Henyey-Greenstein for uniform xi in [0, 1); small xi is forward
    (eq 14, rearranged).

    Equal in distribution to cos(theta) = [1 + g^2 - ((1 - g^2)/(1 - g + 2 g xi))^2]/(2 g), without its cancellation
    at the peak and without its singularity at g = 0.
    """
    inverse = 1.0 / (1.0 + g - 2.0 * g * xi)
    return wp.min((1.0 - g) * xi * inverse * ((1.0 - g * g) * inverse + (1.0 - g)), 2.0)


@wp.func
def _hg_pdf(t: float, medium: Medium) -> float:
    return henyey_greenstein_pdf(t, medium.anisotropy)


@wp.func
def _hg_sample(xi: float, medium: Medium) -> float:
    return sample_henyey_greenstein(xi, medium.anisotropy)


HENYEY_GREENSTEIN = PhaseFunction("henyey_greenstein", _hg_pdf, _hg_sample)


@wp.func
def _a2(medium: Medium) -> float:
    """a^2 = (1 - g)^2/g of q ~ (a^2 + c^2)^(-3/2); nearly uniform for g < 0.05."""
    return (1.0 - medium.anisotropy) * (1.0 - medium.anisotropy) / wp.max(medium.anisotropy, 0.05)


@wp.func
def _hg_complement(chord: float, medium: Medium) -> float:
    """1 - c/sqrt(a^2 + c^2) without cancellation."""
    a2 = _a2(medium)
    s = wp.sqrt(a2 + chord * chord)
    return a2 / (s * (s + chord))


@wp.func
def _hg_chord(value: float, medium: Medium) -> float:
    """c = a F/sqrt(1 - F^2) with F = 1 - value."""
    return wp.sqrt(_a2(medium)) * (1.0 - value) / wp.sqrt(value * (2.0 - value))


@wp.func
def _hg_density(chord: float, medium: Medium) -> float:
    a2 = _a2(medium)
    q = a2 + chord * chord
    return a2 / (q * wp.sqrt(q))


# The lobe of `PhaseGuide`, over the chord c = 2 sin(theta/2) instead of the sine of theta: (1 - c/sqrt(a^2 + c^2))/c.
# Its integral up to c is that of 2 pi a y, y = (c + a - sqrt(a^2 + c^2))/a.


@wp.func
def _lobe_width(guiding: Guiding) -> float:
    return (1.0 - guiding.anisotropy) / wp.sqrt(guiding.anisotropy)


@wp.func
def _lobe_part(a: float) -> float:
    """y at the largest chord, 2."""
    return 1.0 - a / (wp.sqrt(a * a + 4.0) + 2.0)


@wp.func
def _hg_lobe_pdf(t: float, medium: Medium, guiding: Guiding) -> float:
    a = _lobe_width(guiding)
    chord = wp.max(wp.sqrt(2.0 * t), 1.0e-6)
    s = wp.sqrt(a * a + chord * chord)
    return 2.0 * _INV_4PI * a / (_lobe_part(a) * chord * s * (s + chord))


@wp.func
def _hg_lobe_sample(xi: float, medium: Medium, guiding: Guiding) -> float:
    a = _lobe_width(guiding)
    y = 1.0 - xi * _lobe_part(a)
    chord = 0.5 * a * (1.0 - y) * (1.0 + y) / y
    return wp.min(0.5 * chord * chord, 2.0)


HENYEY_GREENSTEIN_GUIDE = PhaseGuide(_hg_complement, _hg_chord, _hg_density, _hg_lobe_pdf, _hg_lobe_sample, chord=True)


# ---- Phase functions that run on tables: Fournier-Forand, two-term Henyey-Greenstein, measured ones, any other.


_PI = wp.constant(3.141592653589793)
_INV_PI = wp.constant(0.3183098861837907)

# Rows of the tables: 4 pi p over t/2; p over 1 - theta/pi, from which the angle by which a flight turns to the lens is
# drawn; over t/2 the directions towards the lens.
_SCATTERING, _TURNING, _LOBE = (wp.constant(i) for i in range(3))
_OWN_ROWS = wp.constant(3)  # of a mixture the first of the rows of its constituents, each 4 pi p over t/2

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
    return _INV_4PI * tables.table_density(medium.phase, _SCATTERING, fold(0.5 * t))


@wp.func
def _sample(xi: float, medium: Medium) -> float:
    return _one_minus_cosine(tables.table_sample(medium.phase, _SCATTERING, xi))


@wp.func
def _complement(theta: float, medium: Medium) -> float:
    return tables.table_cumulative(medium.phase, _TURNING, _turn(theta))


@wp.func
def _angle(value: float, medium: Medium) -> float:
    z = tables.table_sample(medium.phase, _TURNING, value)
    return wp.where(z < 0.0, -_PI * z, _PI * (1.0 - z))


@wp.func
def _angle_density(theta: float, medium: Medium) -> float:
    return _INV_PI * tables.table_density(medium.phase, _TURNING, _turn(theta))


@wp.func
def _lobe_pdf(t: float, medium: Medium, guiding: Guiding) -> float:
    return _INV_4PI * tables.table_density(medium.phase, _LOBE, fold(0.5 * t))


@wp.func
def _lobe_sample(xi: float, medium: Medium, guiding: Guiding) -> float:
    return _one_minus_cosine(tables.table_sample(medium.phase, _LOBE, xi))


TABULATED = PhaseFunction(
    "tabulated", _pdf, _sample, PhaseGuide(_complement, _angle, _angle_density, _lobe_pdf, _lobe_sample)
)


def make_mixture(count: int) -> PhaseFunction:
    """The phase function of so many constituents, 1 to MOST_CONSTITUENTS: the sum of theirs by `Medium.shares`, on the
    tables that `make_phase_tables` makes with `constituents`.

    A direction is drawn from one of them, chosen by its share with the number that the direction is drawn with: within
    the share it is uniform again. Densities are of the sum, which varies less than that of the chosen one would.
    `guided` follows the tables' own density, whatever the shares are.
    """
    return _mixture(check.integer("count", count, 1, MOST_CONSTITUENTS))


@memoised
def _mixture(count: int) -> PhaseFunction:
    @wp.func
    def pdf(t: float, medium: Medium) -> float:
        z = fold(0.5 * t)
        density = float(0.0)
        for i in range(wp.static(count)):
            density += medium.shares[i] * tables.table_density(medium.phase, _OWN_ROWS + i, z)
        return _INV_4PI * density

    @wp.func
    def sample(xi: float, medium: Medium) -> float:
        below = float(0.0)
        end = float(medium.shares[0])
        chosen = int(0)
        share = float(end)
        for i in range(1, wp.static(count)):
            if xi >= end and medium.shares[i] > 0.0:
                chosen = i
                below = end
                share = medium.shares[i]
            end += medium.shares[i]
        part = wp.clamp((xi - below) / wp.max(share, 1.0e-30), 0.0, 0.99999994)
        return _one_minus_cosine(tables.table_sample(medium.phase, _OWN_ROWS + chosen, part))

    @wp.func
    def part(t: float, medium: Medium, constituent: int) -> float:
        own = _INV_4PI * tables.table_density(medium.phase, _OWN_ROWS + constituent, fold(0.5 * t))
        return own / wp.max(pdf(t, medium), 1.0e-30)

    return PhaseFunction(f"mixture_{count}", pdf, sample, TABULATED.guide, count, part)


def make_phase_tables(
    density: Callable[[Floats], Floats],
    *,
    constituents: Sequence[Callable[[Floats], Floats]] = (),
    device: wp.DeviceLike = None,
) -> DensityTables:
    """The tables of a phase function, for `Medium.phase` with the phase function TABULATED, or a mixture.

    Args:
        density: Over t = 1 - cos(theta) in (0, 2), >= 0, of any scale. Towards t = 0 it may rise as t^-0.95.
        constituents: Of a mixture the phase functions of each, of which `density` is the sum that `guided` follows. The
            one with the sharpest forward peak comes first: its smallest angles are drawn with the most digits.

    Raises:
        ArgumentError: A density is negative, not finite or zero everywhere.
    """
    device = check.device("device", device)
    check.kind("density", density, Callable)

    def over_t(one: Callable[[Floats], Floats]) -> Floats:
        return tables.tabulate(lambda z: one(np.where(z < 0.0, 2.0 + 2.0 * z, 2.0 * z)))

    scattering = over_t(density)

    def over_angle(z: Floats) -> Floats:
        t = 2.0 * np.sin(0.5 * np.pi * np.where(z < 0.0, -z, 1.0 - z)) ** 2
        return density(np.maximum(t, _FLAT))  # where the density over t stays finite, its integral over theta does

    turning = tables.tabulate(over_angle)
    below = np.append(turning[:, 0], 1.0), np.append(tables.lower_ends(), 1.0)

    def lobe(z: Floats) -> Floats:
        """What a flight at an angle theta to the lens brings, up to factors that vary little: integral of p from theta
        on over its distance from the lens, ~ sin(theta)."""
        angle = 2.0 * np.arcsin(np.sqrt(np.abs(z)))  # from the nearer end
        position = np.where(z < 0.0, angle, np.pi - angle) / np.pi
        return np.interp(position, below[1], below[0]) / np.sin(angle)

    return tables.make_density_tables(
        scattering, turning, tables.tabulate(lobe), *map(over_t, constituents), device=device
    )


# ---- The phase functions by name.


PHASE_FUNCTIONS: dict[str, PhaseFunction] = {one.name: one for one in (HENYEY_GREENSTEIN, TABULATED)}
"""What `TransportSpec.phase` may be; add one of your own here, and the tests compare its samples with its density."""
