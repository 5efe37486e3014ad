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
        chord: The functions take, and q is over, the chord c = 2 sin(theta/2) in (0, 2) in place of theta, which spares
            trigonometry: Henyey-Greenstein is (a^2 + c^2)^(-3/2) without approximation, a^2 = (1 - g)^2/g.
    """

    complement: wp.Function
    angle: wp.Function
    density: wp.Function
    lobe_pdf: wp.Function
    lobe_sample: wp.Function
    chord: bool = False


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


@wp.func
def _hg_lobe_pdf(t: float, medium: Medium, guiding: Guiding) -> float:
    return henyey_greenstein_pdf(t, guiding.anisotropy)


@wp.func
def _hg_lobe_sample(xi: float, medium: Medium, guiding: Guiding) -> float:
    return sample_henyey_greenstein(xi, guiding.anisotropy)


HENYEY_GREENSTEIN_GUIDE = PhaseGuide(_hg_complement, _hg_chord, _hg_density, _hg_lobe_pdf, _hg_lobe_sample, chord=True)


@wp.func
def _turn(d: float, along: float, r: float) -> wp.vec2:
    """(1 - cos, 1 + cos) of the angle theta = atan2(d, -along), neither as a difference; r^2 = d^2 + along^2."""
    far = r + wp.abs(along)
    small = d * d / (r * far)
    large = far / r
    return wp.where(along < 0.0, wp.vec2(small, large), wp.vec2(large, small))


@wp.func
def _angle_of_turn(d: float, along: float, r: float) -> float:
    return wp.atan2(d, -along)


@wp.func
def _chord_of_turn(d: float, along: float, r: float) -> float:
    return wp.sqrt(2.0 * _turn(d, along, r)[0])


@wp.func
def _along_angle(d: float, angle: float) -> float:
    return -d * cotangent(angle)


@wp.func
def _along_chord(d: float, chord: float) -> float:
    h = 0.25 * chord * chord
    return -d * (1.0 - 2.0 * h) / (chord * wp.sqrt(wp.max(1.0 - h, 1.0e-12)))


@wp.func
def _angle_slope(d: float, along: float, r: float) -> float:
    return d / (r * r)


@wp.func
def _chord_slope(d: float, along: float, r: float) -> float:
    return wp.sqrt(0.5 * _turn(d, along, r)[1]) * d / (r * r)


@functools.cache
def make_sample_flight(guide: PhaseGuide = HENYEY_GREENSTEIN_GUIDE) -> wp.Function:
    """`sample_flight` for a guide: a Warp function ``(x, u, interval, extinction, medium, xi_choice, xi)``."""
    complement, inverse, guide_density = guide.complement, guide.angle, guide.density
    # What the guide takes: of a place on the flight, the place that has it, its derivative along the flight.
    turn_of, along_of, slope = (
        (_chord_of_turn, _along_chord, _chord_slope) if guide.chord else (_angle_of_turn, _along_angle, _angle_slope)
    )

    @wp.func
    def sample_flight(
        x: wp.vec3, u: wp.vec3, interval: wp.vec2, extinction: float, medium: Medium, xi_choice: float, xi: float
    ) -> FlightSample:
        """A point of the flight x + s u within the interval, x relative to the lens point.

        Half the points are drawn from exp(-c s), half in the angle theta(s) = atan2(D, t_c - s), D = |x cross u|, by
        which the light must turn to reach the lens: from the guide, which follows the phase function; on flights that
        lead away from the lens (s0 >= t_c) uniformly in tan(psi/2), psi = pi - theta, small for places far off.
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
        first = s0 - t_c
        last = s1 - t_c
        r_first = wp.sqrt(d * d + first * first)
        r_last = wp.sqrt(d * d + last * last)
        away = first >= 0.0
        begin = wp.where(away, d / (r_first + first), complement(turn_of(d, first, r_first), medium))
        end = wp.where(away, d / (r_last + last), complement(turn_of(d, last, r_last), medium))
        span = begin - end
        angular = wp.where(span > 1.0e-7 * begin, 0.5, 0.0)

        s = float(0.0)
        if xi_choice < angular:
            g = begin - xi * span
            s = t_c + 0.5 * d * (1.0 - g * g) / g if away else t_c + along_of(d, inverse(g, medium))
        else:
            s = s0 + wp.where(thick, -wp.log(1.0 - xi * kept) / extinction, xi * width)
        s = wp.clamp(s, s0, s1)

        along = s - t_c
        r = wp.sqrt(d * d + along * along)
        linear_density = wp.where(thick, extinction * wp.exp(-extinction * (s - s0)) / kept, 1.0 / width)
        towards = guide_density(turn_of(d, along, r), medium) * slope(d, along, r)
        angular_density = wp.where(away, d / (r * (r + along)), towards) / wp.max(span, 1.0e-30)
        if angular == 0.0:
            angular_density = 0.0
        sample.s = s
        sample.r = r
        sample.density = (1.0 - angular) * linear_density + angular * angular_density
        return sample

    return sample_flight
