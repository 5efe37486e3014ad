"""The guided estimator: one next event per flight, drawn by distance and angle at once.

After Kulla & Fajardo 2012 (equi-angular sampling) and Georgiev et al. 2013 (joint distance-angle sampling).
"""

import functools
from typing import NamedTuple

import warp as wp

from .direction import cotangent
from .gate import Gate
from .medium import Medium
from .phase import henyey_greenstein_pdf, sample_henyey_greenstein


@wp.struct
class Guiding:
    """How strongly directions are drawn towards the lens.

    Attributes:
        probability: Chance that a water collision draws its direction from the lobe about the lens, in [0, 1).
        surface_probability: The same at a surface.
        anisotropy: g of that Henyey-Greenstein lobe; phase functions with a guide have one of their own.
        return_probability: Chance that an event outside the view draws its direction from a lobe towards the optical
            axis, so that light that strayed comes back into the view more often, in [0, 1).
        return_anisotropy: g of that lobe.
    """

    probability: float
    surface_probability: float
    anisotropy: float
    return_probability: float
    return_anisotropy: float


@wp.struct
class FlightSample:
    """A point of a flight: distance s along it, distance r to the lens point [m], its density over s [1/m]; 0 for
    none."""

    s: float
    r: float
    density: float


@wp.func
def clip_to_gate(gate: Gate, x: wp.vec3, u: wp.vec3, path: float, lens: wp.vec3, interval: wp.vec2) -> wp.vec2:
    """The part of the interval [s0, s1] of the flight x + s u whose light arrives within the gate by way of a lens
    point; empty where s0 >= s1.

    The arrival path s + r(s) rises with s, so the gate cuts out an interval: s + r = L at
    s = (L^2 - |x|^2)/(2 (L - t_c)), x from the lens point, t_c = -x.u.
    """
    if interval[0] >= interval[1]:
        return interval

    y = x - lens
    distance = wp.length(y)
    t_c = -wp.dot(y, u)
    to_stop = gate.stop - path
    if to_stop <= distance:
        return wp.vec2(0.0, -1.0)
    lower = interval[0]
    # (L^2 - |x|^2) as a product: the difference of squares would cancel near the gate's end.
    upper = wp.min(interval[1], 0.5 * (to_stop - distance) * (to_stop + distance) / wp.max(to_stop - t_c, 1.0e-12))
    to_start = gate.start - path
    if to_start > distance:
        lower = wp.max(lower, 0.5 * (to_start - distance) * (to_start + distance) / wp.max(to_start - t_c, 1.0e-12))
    return wp.vec2(lower, upper)


class PhaseGuide(NamedTuple):
    """What `guided` draws from in place of a phase function p that it cannot invert; all are Warp functions.

    The angle theta in (0, pi) by which light on a flight turns to reach the lens has the density q(theta), per radian
    and of any scale: best is p(theta). Directions towards the lens have the density of a lobe [1/sr]: best is the
    integral of p from theta to pi, which the flight in such a direction brings, over the sine of theta, its distance
    from the lens. The lobe is about the very point of the lens at which that flight is scored.

    Attributes:
        complement: ``(theta: float, medium: Medium) -> float``, integral of q from theta to pi; falls with theta.
        angle: ``(value: float, medium: Medium) -> float``, the inverse of it.
        density: ``(theta: float, medium: Medium) -> float``, q itself.
        lobe_pdf: ``(t: float, medium: Medium, guiding: Guiding) -> float``, t = 1 - cos of the angle to the lens.
        lobe_sample: ``(xi: float, medium: Medium, guiding: Guiding) -> float``, returns t.
    """

    complement: wp.Function
    angle: wp.Function
    density: wp.Function
    lobe_pdf: wp.Function
    lobe_sample: wp.Function


@wp.func
def _a2(medium: Medium) -> float:
    """a^2 = (1 - g)^2/g of q ~ (a^2 + theta^2)^(-3/2); nearly uniform for g < 0.05."""
    return (1.0 - medium.anisotropy) * (1.0 - medium.anisotropy) / wp.max(medium.anisotropy, 0.05)


@wp.func
def _hg_complement(theta: float, medium: Medium) -> float:
    """1 - theta/sqrt(a^2 + theta^2) without cancellation."""
    a2 = _a2(medium)
    s = wp.sqrt(a2 + theta * theta)
    return a2 / (s * (s + theta))


@wp.func
def _hg_angle(value: float, medium: Medium) -> float:
    """theta = a F/sqrt(1 - F^2) with F = 1 - value."""
    return wp.sqrt(_a2(medium)) * (1.0 - value) / wp.sqrt(value * (2.0 - value))


@wp.func
def _hg_density(theta: float, medium: Medium) -> float:
    a2 = _a2(medium)
    q = a2 + theta * theta
    return a2 / (q * wp.sqrt(q))


@wp.func
def _hg_lobe_pdf(t: float, medium: Medium, guiding: Guiding) -> float:
    return henyey_greenstein_pdf(t, guiding.anisotropy)


@wp.func
def _hg_lobe_sample(xi: float, medium: Medium, guiding: Guiding) -> float:
    return sample_henyey_greenstein(xi, guiding.anisotropy)


HENYEY_GREENSTEIN_GUIDE = PhaseGuide(_hg_complement, _hg_angle, _hg_density, _hg_lobe_pdf, _hg_lobe_sample)


@functools.cache
def make_sample_flight(guide: PhaseGuide = HENYEY_GREENSTEIN_GUIDE) -> wp.Function:
    """`sample_flight` for a guide: a Warp function ``(x, u, interval, extinction, medium, xi_choice, xi)``."""
    complement, angle_of, turn_density = guide.complement, guide.angle, guide.density

    @wp.func
    def sample_flight(
        x: wp.vec3, u: wp.vec3, interval: wp.vec2, extinction: float, medium: Medium, xi_choice: float, xi: float
    ) -> FlightSample:
        """A point of the flight x + s u within the interval, x relative to the lens point.

        Half the points are drawn from exp(-c s), half in the angle at which the light must turn to reach the lens:
        towards the lens theta(s) = atan2(D, t_c - s) from the guide's q(theta), which follows the phase function; away
        from it (s0 >= t_c) uniformly in psi = atan2(D, s - t_c), D = |x cross u|.
        """
        sample = FlightSample()
        s0 = interval[0]
        s1 = interval[1]
        width = s1 - s0
        t_c = -wp.dot(x, u)
        # The cross product, not |x|^2 - t_c^2, which cancels. The floor keeps float32 angles of a coaxial laser apart.
        d = wp.max(wp.length(wp.cross(x, u)), 1.0e-7)
        kept = 1.0 - wp.exp(-extinction * width)
        thick = extinction * width > 1.0e-4
        # Angles between the flight and the direction to the lens, or its opposite: small ones for places far off.
        away = s0 >= t_c
        sign = wp.where(away, -1.0, 1.0)
        first = wp.atan2(d, sign * (t_c - s0))
        last = wp.atan2(d, sign * (t_c - s1))
        begin = wp.where(away, first, complement(first, medium))
        end = wp.where(away, last, complement(last, medium))
        span = begin - end
        angular = wp.where(span > 1.0e-7 * begin, 0.5, 0.0)

        s = float(0.0)
        if xi_choice < angular:
            g = begin - xi * span
            angle = wp.where(away, g, angle_of(g, medium))
            s = t_c - sign * d * cotangent(angle)
        else:
            s = s0 + wp.where(thick, -wp.log(1.0 - xi * kept) / extinction, xi * width)
        s = wp.clamp(s, s0, s1)

        along = s - t_c
        r2 = d * d + along * along
        linear_density = wp.where(thick, extinction * wp.exp(-extinction * (s - s0)) / kept, 1.0 / width)
        theta = wp.atan2(d, -along)
        angular_density = wp.where(away, 1.0, turn_density(theta, medium)) * d / (r2 * wp.max(span, 1.0e-30))
        if angular == 0.0:
            angular_density = 0.0
        sample.s = s
        sample.r = wp.sqrt(r2)
        sample.density = (1.0 - angular) * linear_density + angular * angular_density
        return sample

    return sample_flight
