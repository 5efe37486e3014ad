"""The guided estimator: one next event per flight, drawn by distance and angle at once.

After Kulla & Fajardo 2012 (equi-angular sampling) and Georgiev et al. 2013 (joint distance-angle sampling).
"""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.rotations import cos_sin_turn, cotangent
from spadwarp_kernels.optics.camera import Camera, lens_point
from spadwarp_kernels.optics.port import FLAT_PORT, PortKind
from spadwarp_kernels.water.medium import Layers, Medium, Profile
from spadwarp_kernels.water.phase_functions import HENYEY_GREENSTEIN_GUIDE, PhaseGuide


@wp.struct
class FlightSample:
    """A point of a flight: distance s along it, distance r to the lens point [m], its density over s [1/m]; 0 for
    none. With a `Profile`: its optical depth up to there."""

    s: float
    r: float
    density: float
    depth: float


@wp.struct
class LensSample:
    """A point of the lens [m]; its density if it were uniform, over that of the draw."""

    point: wp.vec3
    weight: float


@memoised
def make_sample_lens(port: PortKind | None) -> wp.Function:
    """The Warp function ``(camera, x, u, xi1, xi2) -> LensSample``: a point of the lens by which the flight x + s u is
    scored.

    The score goes with 1/D, D its distance from the flight's line. Where this, refracted by a port, passes the lens,
    the point is drawn with that density, uniform in angle and distance about the place: even draws would have no finite
    variance. Else it is even.
    """
    has_port, leave = port is not None, (port or FLAT_PORT).leave

    @wp.func
    def sample_lens(camera: Camera, x: wp.vec3, u: wp.vec3, xi1: float, xi2: float) -> LensSample:
        p = wp.vec2(1.0e30, 0.0)
        if wp.static(has_port):
            ray = leave(camera.port, x, wp.where(u[2] < 0.0, u, -u))
            if ray.transmission > 0.0:
                p = wp.vec2(ray.x[0], ray.x[1])
        else:
            s = -x[2] / u[2]
            p = wp.vec2(x[0] + s * u[0], x[1] + s * u[1])
        sample = LensSample()
        sample.point = lens_point(camera, xi1, xi2)
        sample.weight = 1.0
        radius2 = camera.aperture_radius * camera.aperture_radius
        if wp.dot(p, p) < radius2:
            turn = cos_sin_turn(xi2)
            aside = p[0] * turn[1] - p[1] * turn[0]
            to_rim = wp.sqrt(wp.max(radius2 - aside * aside, 0.0)) - wp.dot(p, turn)
            distance = xi1 * to_rim
            sample.point = wp.vec3(p[0] + distance * turn[0], p[1] + distance * turn[1], 0.0)
            sample.weight = 2.0 * to_rim * distance / radius2
        return sample

    return sample_lens


@wp.func
def _turn(d: float, along: float, r: float) -> wp.vec2:
    """(1 - cos, 1 + cos) of the angle theta = atan2(d, -along), neither as a difference; r^2 = d^2 + along^2."""
    far = r + wp.abs(along)
    small = d * d / (r * far)
    large = far / r
    return wp.where(along < 0.0, wp.vec2(small, large), wp.vec2(large, small))


@memoised
def _make_variable(chord: bool) -> tuple[wp.Function, wp.Function, wp.Function]:
    """The variable of a guide, angle or chord: at a point of the flight ``(d, along, r)``, the point that has it
    ``(d, value)``, and its derivative along the flight ``(d, along, r)``."""

    @wp.func
    def turn_of(d: float, along: float, r: float) -> float:
        if wp.static(chord):
            return wp.sqrt(2.0 * _turn(d, along, r)[0])
        return wp.atan2(d, -along)

    @wp.func
    def along_of(d: float, value: float) -> float:
        if wp.static(chord):
            h = 0.25 * value * value
            return -d * (1.0 - 2.0 * h) / (value * wp.sqrt(wp.max(1.0 - h, 1.0e-12)))
        return -d * cotangent(value)

    @wp.func
    def slope(d: float, along: float, r: float) -> float:
        if wp.static(chord):
            return wp.sqrt(0.5 * _turn(d, along, r)[1]) * d / (r * r)
        return d / (r * r)

    return turn_of, along_of, slope


@memoised
def make_sample_flight(guide: PhaseGuide = HENYEY_GREENSTEIN_GUIDE, profile: Profile | None = None) -> wp.Function:
    """`sample_flight` for a guide: a Warp function ``(x, u, interval, extinction, medium, xi_choice, xi)``; with a
    profile ``(..., layers, begin_point)``, the latter where the interval begins. With a profile that draws nothing xi
    is the distance to the collision unless the point is to be drawn from the angle, and the density is that of the
    angle alone."""
    has_profile, draws = profile is not None, profile is not None and profile.draw is not None
    draw = profile.draw if profile is not None and profile.draw is not None else _turn  # any: it is not called
    complement, inverse, guide_density = guide.complement, guide.angle, guide.density
    turn_of, along_of, slope = _make_variable(guide.chord)

    @wp.func
    def sample_flight(
        x: wp.vec3,
        u: wp.vec3,
        interval: wp.vec2,
        extinction: float,
        medium: Medium,
        xi_choice: float,
        xi: float,
        layers: Layers,
        begin_point: wp.vec3,
    ) -> FlightSample:
        """A point of the flight x + s u within the interval, x relative to the lens point.

        Half the points are drawn from exp(-c s), with a profile from c(s) exp(-depth(s)), half in the angle theta(s) =
        atan2(D, t_c - s), D = |x cross u|, by which the light must turn to reach the lens: from the guide, which
        follows the phase function; on flights that lead away from the lens (s0 >= t_c) uniformly in tan(psi/2), psi =
        pi - theta, small far from the lens.
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
        given = float(-1.0)
        if xi_choice < angular:
            g = begin - xi * span
            s = t_c + 0.5 * d * (1.0 - g * g) / g if away else t_c + along_of(d, inverse(g, medium))
            if wp.static(draws):
                given = wp.clamp(s, s0, s1) - s0
        else:
            if wp.static(not has_profile):
                s = s0 + wp.where(thick, -wp.log(1.0 - xi * kept) / extinction, xi * width)
            if wp.static(has_profile and not draws):
                s = xi
        if wp.static(draws):
            drawn = draw(medium, layers, begin_point, u, width, given, xi)
            s = s0 + drawn.s
            sample.depth = drawn.depth
        s = wp.clamp(s, s0, s1)

        along = s - t_c
        r = wp.sqrt(d * d + along * along)
        if wp.static(draws):
            linear_density = drawn.density
        elif wp.static(has_profile):
            linear_density = 0.0
        else:
            linear_density = wp.where(thick, extinction * wp.exp(-extinction * (s - s0)) / kept, 1.0 / width)
        towards = guide_density(turn_of(d, along, r), medium) * slope(d, along, r)
        angular_density = wp.where(away, d / (r * (r + along)), towards) / wp.max(span, 1.0e-30)
        if angular == 0.0:
            angular_density = 0.0
        sample.s = s
        sample.r = r
        sample.density = (1.0 - angular) * linear_density + angular * angular_density
        return sample

    if profile is not None:
        return sample_flight

    @wp.func
    def sample_flight_without_profile(
        x: wp.vec3, u: wp.vec3, interval: wp.vec2, extinction: float, medium: Medium, xi_choice: float, xi: float
    ) -> FlightSample:
        """As `sample_flight`, in water of one extinction."""
        return sample_flight(x, u, interval, extinction, medium, xi_choice, xi, Layers(), wp.vec3())

    return sample_flight_without_profile
