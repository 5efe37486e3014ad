"""The guided estimator: one next event per flight, drawn by distance and angle at once.

After Kulla & Fajardo 2012 (equi-angular sampling) and Georgiev et al. 2013 (joint distance-angle sampling).
"""

import warp as wp

from .camera import Camera
from .direction import cotangent
from .gate import Gate


@wp.struct
class Guiding:
    """How strongly directions are drawn towards the lens.

    Attributes:
        probability: Chance that a water collision draws its direction from the lobe about the lens, in [0, 1).
        surface_probability: The same at a surface.
        anisotropy: g of that Henyey-Greenstein lobe.
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
def _clip(value: float, slope: float, interval: wp.vec2) -> wp.vec2:
    """The part of the interval of s in which value + slope s > 0."""
    lower = interval[0]
    upper = interval[1]
    if slope > 0.0:
        lower = wp.max(lower, -value / slope)
    elif slope < 0.0:
        upper = wp.min(upper, -value / slope)
    elif value <= 0.0:
        upper = -1.0
    return wp.vec2(lower, upper)


@wp.func
def clip_flight(
    camera: Camera, gate: Gate, x: wp.vec3, u: wp.vec3, path: float, lens: wp.vec3, limit: float
) -> wp.vec2:
    """The part [s0, s1] of the flight x + s u, 0 <= s <= limit, that the camera sees within the gate; empty where s0
    >= s1.

    The view is five half-spaces (front, four side planes through the lens centre). The arrival path s + r(s) rises
    with s,
    so the gate cuts out an interval: s + r = L at s = (L^2 - |x|^2)/(2 (L - t_c)), x from the lens point, t_c = -x.u.
    """
    half_width = 0.5 * float(camera.width) * camera.pixel_tangent
    half_height = 0.5 * float(camera.height) * camera.pixel_tangent
    interval = wp.vec2(0.0, limit)
    interval = _clip(x[2], u[2], interval)
    interval = _clip(half_width * x[2] - x[0], half_width * u[2] - u[0], interval)
    interval = _clip(half_width * x[2] + x[0], half_width * u[2] + u[0], interval)
    interval = _clip(half_height * x[2] - x[1], half_height * u[2] - u[1], interval)
    interval = _clip(half_height * x[2] + x[1], half_height * u[2] + u[1], interval)
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


@wp.func
def _complement(theta: float, a2: float) -> float:
    """1 - theta/sqrt(a^2 + theta^2) without cancellation."""
    s = wp.sqrt(a2 + theta * theta)
    return a2 / (s * (s + theta))


@wp.func
def sample_flight(
    x: wp.vec3, u: wp.vec3, interval: wp.vec2, extinction: float, a2: float, xi_choice: float, xi: float
) -> FlightSample:
    """A point of the flight x + s u within the interval, x relative to the lens point.

    Half the points are drawn from exp(-c s), half in the angle at which the light must turn to reach the lens:
    towards the lens theta(s) = atan2(D, t_c - s) from q(theta) ~ (a^2 + theta^2)^(-3/2), which follows
    Henyey-Greenstein
    for a2 = (1 - g)^2/g; away from it (s0 >= t_c) uniformly in psi = atan2(D, s - t_c), D = |x cross u|.
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
    # Angles between the flight and the direction to the lens, or its opposite: measured so that they are small far off.
    away = s0 >= t_c
    sign = wp.where(away, -1.0, 1.0)
    first = wp.atan2(d, sign * (t_c - s0))
    last = wp.atan2(d, sign * (t_c - s1))
    begin = wp.where(away, first, _complement(first, a2))
    end = wp.where(away, last, _complement(last, a2))
    span = begin - end
    angular = wp.where(span > 1.0e-7 * begin, 0.5, 0.0)

    s = float(0.0)
    if xi_choice < angular:
        g = begin - xi * span
        # theta = a F/sqrt(1 - F^2) with F = 1 - g
        angle = wp.where(away, g, wp.sqrt(a2) * (1.0 - g) / wp.sqrt(g * (2.0 - g)))
        s = t_c - sign * d * cotangent(angle)
    else:
        s = s0 + wp.where(thick, -wp.log(1.0 - xi * kept) / extinction, xi * width)
    s = wp.clamp(s, s0, s1)

    along = s - t_c
    r2 = d * d + along * along
    linear_density = wp.where(thick, extinction * wp.exp(-extinction * (s - s0)) / kept, 1.0 / width)
    theta = wp.atan2(d, -along)
    q = a2 + theta * theta
    angular_density = wp.where(away, 1.0, a2 / (q * wp.sqrt(q))) * d / (r2 * wp.max(span, 1.0e-30))
    if angular == 0.0:
        angular_density = 0.0
    sample.s = s
    sample.r = wp.sqrt(r2)
    sample.density = (1.0 - angular) * linear_density + angular * angular_density
    return sample
