"""Geometry of the analytic model: how light gets from the laser to the water and on to the camera, each of which is in
the water or behind a port.

A range r is the length of the way in the water along a line of sight; without a port it begins at the lens. Rays
through ports are traced by the functions of the ports, in float32: lengths are right to 1e-7 of themselves.
"""

from typing import Any, NamedTuple

import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_struct
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import HALF, ONE, PI, TWO, ZERO
from spadwarp_kernels.optics.port import DOME_PORT, FLAT_PORT, PortKind, check_port

from .lidar import Lidar, Ports, beam_direction, beam_fluence, beam_path, check_lidar

__all__ = ["make_optics"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Of Newton's method, which has converged after a few; and of a search for the light on a line of sight.
_STEPS = wp.constant(16)
_EDGES = wp.constant(49)
_PART = wp.constant(wp.float64(1.0 / 48.0))
_HALVINGS = wp.constant(24)
_NONE = wp.constant(wp.float64(-1.0e30))


@wp.struct
class SightRay:
    """A line of sight in the water, of a pixel."""

    view: wp.vec3d  # unit vector in which the lens sees it
    start: wp.vec3d  # where it begins: the lens, or where it leaves the port [m]
    u: wp.vec3d  # its unit direction
    distance: wp.float64  # from the lens centre to there [m]
    delay: wp.float64  # length in water that takes as long as the way between them [m]
    radiance: wp.float64  # in front of the lens over that in the water, T (n_0/n_w)^2


@wp.struct
class BeamRay:
    """A ray of the laser's beam in the water."""

    x: wp.vec3d  # where it begins [m]
    u: wp.vec3d  # its unit direction
    transmission: wp.float64  # fraction of its light that got there


@wp.struct
class LaserConnection:
    """The way from the laser to a point in clear water."""

    path: wp.float64  # length in water that takes as long [m]
    water: wp.float64  # its length in the water [m]
    u: wp.vec3d  # its unit direction at the point
    fluence: wp.float64  # fraction of a pulse per area across it [1/m^2]


@wp.struct
class LensConnection:
    """The way to the lens of light that a surface scatters evenly."""

    ray: wp.vec3d  # in the direction in which the lens sees it, of any length
    share: wp.float64  # cosine at the surface times solid angle and transmission, over the lens's area [1/m^2]
    water: wp.float64  # its length in the water [m]


class Optics(NamedTuple):
    """Warp functions for a camera and a laser, each in the water or behind a port.

    Attributes:
        kinds: Of the ports of camera and laser; None: in the water.
        see: (ports, view) -> SightRay of a pixel, from the unit vector in which the lens sees it.
        beside: (lidar, sight, x, a, b) -> the point at the depth of x that the lens sees a and b pixels beside it.
        footprint: (lidar, distance) -> about the side of a pixel [m].
        receive: (lidar, normal, x) -> LensConnection of a point of a surface.
        spot: (lidar, path) -> about the radius of the beam [m].
        emit: (lidar, x, u) -> BeamRay in the water of a ray from the laser.
        light: (lidar, x) -> LaserConnection of a point.
        range_of_path: (laser, ports, sight, path) -> range at which light has gone a path from laser to target to
            lens [m]; 0 or less if there is none.
        illuminated: (lidar, sight, near, far) -> the part of an interval of ranges that the laser's uniform cone
            illuminates; far < near if there is none.
    """

    kinds: tuple[PortKind | None, PortKind | None]
    see: wp.Function
    beside: wp.Function
    footprint: wp.Function
    receive: wp.Function
    spot: wp.Function
    emit: wp.Function
    light: wp.Function
    range_of_path: wp.Function
    illuminated: wp.Function


@wp.func
def _single(x: wp.vec3d) -> wp.vec3:
    return wp.vec3(float(x[0]), float(x[1]), float(x[2]))


@wp.func
def _double(x: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func
def point_at(sight: SightRay, r: wp.float64) -> wp.vec3d:
    """Point of a line of sight at a range [m]."""
    return sight.start + r * sight.u


# ---- The camera.


@memoised
def _make_camera(kind: PortKind | None) -> dict[str, wp.Function]:
    """What `Optics` has of a camera behind a kind of port, or in the water."""
    has_port, is_flat = kind is not None, kind == FLAT_PORT
    enter, connect = (kind or FLAT_PORT).enter, (kind or FLAT_PORT).connect

    @wp.func
    def see(ports: Ports, view: wp.vec3d) -> SightRay:
        s = SightRay()
        s.view = view
        s.u = view
        s.radiance = ONE
        if wp.static(has_port):
            p = enter(ports.camera, wp.vec3(0.0), _single(view))
            s.radiance = ZERO
            if p.transmission > 0.0:
                s.start = _double(p.x)
                s.u = wp.normalize(_double(p.u))
                s.distance = wp.length(s.start)
                s.delay = wp.float64(p.path)
                ratio = wp.float64(ports.camera.index[0]) / wp.float64(ports.camera.index[2])
                s.radiance = wp.float64(p.transmission) * ratio * ratio
        return s

    @wp.func
    def beside(lidar: Lidar, sight: SightRay, x: wp.vec3d, a: wp.float64, b: wp.float64) -> wp.vec3d:
        aside = wp.vec3d(a * lidar.pixel_tangent, b * lidar.pixel_tangent, ZERO)
        if wp.static(has_port):
            other = see(lidar.ports, wp.normalize(sight.view / sight.view[2] + aside))
            return other.start + (x[2] - other.start[2]) / other.u[2] * other.u
        return x + x[2] * aside

    @wp.func
    def footprint(lidar: Lidar, distance: wp.float64) -> wp.float64:
        side = distance * lidar.pixel_tangent
        if wp.static(is_flat):
            side *= wp.float64(lidar.ports.camera.index[0] / lidar.ports.camera.index[2])
        return side

    @wp.func
    def receive(lidar: Lidar, normal: wp.vec3d, x: wp.vec3d) -> LensConnection:
        out = LensConnection()
        if wp.static(not has_port):
            r = wp.length(x)
            out.ray = x
            out.share = -wp.dot(normal, x) / r * (x[2] / r) / (r * r)
            out.water = r
            return out
        c = connect(lidar.ports.camera, _single(x), wp.vec3(0.0))
        if c.density > 0.0:
            out.ray = -_double(c.inside)
            cos_out = wp.dot(normal, _double(c.to_port))
            out.share = cos_out * out.ray[2] * wp.float64(c.density * c.transmission)
            out.water = wp.float64(c.water)
        return out

    return {"see": see, "beside": beside, "footprint": footprint, "receive": receive}


# ---- The laser.


@wp.func
def _intensity(lidar: Lidar, u: wp.vec3d) -> wp.float64:
    """Fraction of a pulse that a laser emits into a unit of solid angle about u [1/sr]."""
    along = wp.dot(u, lidar.axis)
    across = wp.length_sq(wp.cross(u, lidar.axis))
    if along <= ZERO:
        return ZERO
    if lidar.profile == 0:
        if across > lidar.spread * (ONE + along):
            return ZERO
        return ONE / (TWO * PI * lidar.spread)
    tan2 = across / (along * along)
    return TWO / (PI * lidar.tan2) * wp.exp(-TWO * tan2 / lidar.tan2) / (along * along * along)


@memoised
def _make_beam(kind: PortKind | None) -> dict[str, wp.Function]:
    """What `Optics` has of a laser behind a kind of port, or in the water."""
    has_port, is_flat = kind is not None, kind == FLAT_PORT
    enter, leave, connect = (kind or FLAT_PORT).enter, (kind or FLAT_PORT).leave, (kind or FLAT_PORT).connect

    @wp.func
    def spot(lidar: Lidar, path: wp.float64) -> wp.float64:
        if lidar.profile == 2:
            return lidar.radius
        radius = path * wp.sqrt(lidar.tan2)
        if wp.static(is_flat):
            radius *= wp.float64(lidar.ports.laser.index[0] / lidar.ports.laser.index[2])
        return radius

    @wp.func
    def emit(lidar: Lidar, x: wp.vec3d, u: wp.vec3d) -> BeamRay:
        ray = BeamRay()
        if wp.static(not has_port):
            ray.x = x
            ray.u = u
            ray.transmission = ONE
            return ray
        p = enter(lidar.ports.laser, _single(x), _single(u))
        ray.x = _double(p.x)
        ray.u = _double(p.u)
        ray.transmission = wp.float64(p.transmission)
        return ray

    @wp.func
    def parallel_light(lidar: Lidar, x: wp.vec3d) -> LaserConnection:
        """Of a collimated beam, which stays one behind a flat port: back along the ray through x."""
        light = LaserConnection()
        port = lidar.ports.laser
        u = enter(port, _single(lidar.laser), _single(lidar.axis)).u
        back = leave(port, _single(x), -u)
        if back.transmission <= 0.0:
            return light
        y = _double(back.x) - lidar.laser
        along = wp.dot(y, lidar.axis)
        light.u = _double(u)
        light.water = wp.float64(back.water)
        light.path = light.water + wp.float64(back.path) + wp.float64(port.delay[0]) * along
        if wp.length_sq(y - along * lidar.axis) <= lidar.radius * lidar.radius and light.water > ZERO:
            narrower = wp.dot(lidar.axis, _double(port.normal)) / wp.float64(wp.dot(u, port.normal))
            light.fluence = wp.float64(back.transmission) * narrower / (PI * lidar.radius * lidar.radius)
        return light

    @wp.func
    def light(lidar: Lidar, x: wp.vec3d) -> LaserConnection:
        out = LaserConnection()
        if wp.static(not has_port):
            out.path = beam_path(lidar, x)
            out.water = out.path
            out.u = beam_direction(lidar, x)
            out.fluence = beam_fluence(lidar, x)
            return out
        port = lidar.ports.laser
        if wp.static(is_flat) and lidar.profile == 2:
            return parallel_light(lidar, x)
        c = connect(port, _single(x), _single(lidar.laser))
        if c.density <= 0.0:
            return out
        out.path = wp.float64(c.path)
        out.water = wp.float64(c.water)
        out.u = -wp.normalize(_double(c.to_port))
        # The density is that of light from x to the laser; the other way the index goes with it.
        ratio = wp.float64(port.index[2]) / wp.float64(port.index[0])
        spread = ratio * ratio * wp.float64(c.density) * wp.float64(c.transmission)
        out.fluence = _intensity(lidar, -wp.normalize(_double(c.inside))) * spread
        return out

    return {"spot": spot, "emit": emit, "light": light}


# ---- Both.


@wp.func
def least_range(sight: SightRay) -> wp.float64:
    """So far behind a port that rounding does not put a point into the window [m]."""
    return wp.float64(1.0e-5) * (ONE + sight.distance)


@wp.func
def _straight_range(laser: wp.vec3d, sight: SightRay, path: wp.float64) -> wp.float64:
    """Range at which light has gone a path from a laser in the water to the point and on to where the line begins."""
    y = sight.start - laser
    if path <= wp.length(y):
        return _NONE
    return (path * path - wp.length_sq(y)) / (TWO * (path + wp.dot(sight.u, y)))


@memoised
def _make_range_of_path(kind: PortKind | None) -> wp.Function:
    """`Optics.range_of_path` for a laser behind a kind of port, or in the water."""
    has_port = kind is not None
    connect = (kind or FLAT_PORT).connect

    @wp.func
    def range_of_path(laser: wp.vec3d, ports: Ports, sight: SightRay, path: wp.float64) -> wp.float64:
        left = path - sight.delay
        if wp.static(not has_port):
            return _straight_range(laser, sight, left)
        o = _single(laser)
        least = least_range(sight)
        c = connect(ports.laser, _single(sight.start + least * sight.u), o)
        if c.density > 0.0 and wp.float64(c.path) + least >= left:
            return _NONE
        r = wp.max(_straight_range(laser, sight, left), least)
        for _ in range(_STEPS):
            c = connect(ports.laser, _single(sight.start + r * sight.u), o)
            if c.density <= 0.0:  # not yet where the laser's water is
                r = TWO * r + wp.float64(1.0e-3)
            else:
                # The path rises with the range by 1 + the cosine between both directions of light.
                slope = wp.max(ONE - wp.dot(_double(c.to_port), sight.u), wp.float64(1.0e-3))
                step = (left - wp.float64(c.path) - r) / slope
                r = wp.max(r + step, least)
                if wp.abs(step) <= wp.float64(1.0e-4) * r:
                    break
        return r

    return range_of_path


@wp.func
def cone_interval(lidar: Lidar, apex: wp.vec3d, u: wp.vec3d) -> wp.vec2d:
    """The part [near, far] of a line from the origin along u inside the uniform cone of a laser at `apex`; far < near
    if there is none."""
    far = wp.float64(1.0e30)
    if lidar.profile != 0 or lidar.spread >= ONE or lidar.lu2024 == 1:
        return wp.vec2d(ZERO, far)
    cos_half = ONE - lidar.spread
    k = cos_half * cos_half
    da = wp.dot(u, lidar.axis)
    pa = wp.dot(apex, lidar.axis)
    a = da * da - k
    b = da * pa - k * wp.dot(u, apex)
    c = pa * pa - k * wp.length_sq(apex)
    disc = b * b - a * c
    none = wp.vec2d(ONE, -ONE)
    if wp.abs(a) < wp.float64(1.0e-15):
        return wp.vec2d(ZERO, far)
    root = wp.sqrt(wp.max(disc, ZERO))
    low = wp.min((b - root) / a, (b + root) / a)
    high = wp.max((b - root) / a, (b + root) / a)
    if a > ZERO:
        if da > ZERO:
            return wp.vec2d(wp.max(high, ZERO), far)
        return wp.vec2d(ZERO, low)
    if disc <= ZERO or HALF * (low + high) * da - pa <= ZERO:
        return none
    return wp.vec2d(wp.max(low, ZERO), high)


@memoised
def _make_illuminated(kinds: tuple[PortKind | None, PortKind | None], light: wp.Function) -> wp.Function:
    """`Optics.illuminated` for kinds of ports of camera and laser."""
    in_water, has_port = kinds == (None, None), kinds[1] is not None

    @wp.func
    def edge(lidar: Lidar, sight: SightRay, dark: wp.float64, lit: wp.float64) -> wp.float64:
        """Where light begins between two ranges."""
        outer = wp.float64(dark)
        inner = wp.float64(lit)
        for _ in range(_HALVINGS):
            middle = HALF * (outer + inner)
            if light(lidar, point_at(sight, middle)).fluence > ZERO:
                inner = middle
            else:
                outer = middle
        return inner

    @wp.func
    def illuminated(lidar: Lidar, sight: SightRay, begin: wp.float64, far: wp.float64) -> wp.vec2d:
        near = wp.float64(begin)
        if wp.static(not in_water):
            near = wp.max(begin, least_range(sight))
        if wp.static(not has_port):
            cone = cone_interval(lidar, lidar.laser - sight.start, sight.u)
            return wp.vec2d(wp.max(near, cone[0]), wp.min(far, cone[1]))
        if lidar.profile != 0 or lidar.spread >= ONE or far <= near:
            return wp.vec2d(near, far)
        ratio = wp.pow((sight.distance + far) / (sight.distance + near), _PART)
        first = wp.float64(ONE)
        last = wp.float64(-ONE)
        before = wp.float64(near)
        r = wp.float64(near)
        was = bool(False)
        seen = bool(False)
        for k in range(_EDGES):
            lit = light(lidar, point_at(sight, r)).fluence > ZERO
            if lit and not seen:
                first = r
                if k > 0:
                    first = edge(lidar, sight, before, r)
                seen = True
            if lit:
                last = r
            if was and not lit:
                last = edge(lidar, sight, r, before)
            was = lit
            before = r
            r = wp.min((sight.distance + r) * ratio - sight.distance, far)
        return wp.vec2d(first, last)

    return illuminated


def make_optics(port: PortKind | None = None, laser_port: PortKind | None = None) -> Optics:
    """The optics of a camera and a laser behind kinds of ports; None: in the water.

    A collimated beam needs a flat port, behind which it stays one.
    """
    for name, kind in {"port": port, "laser_port": laser_port}.items():
        if not isinstance(kind, PortKind | None):
            raise ArgumentError(f"{name} = {kind!r} is not a PortKind or None")
    return _make_optics(port, laser_port)


@memoised
def _make_optics(port: PortKind | None, laser_port: PortKind | None) -> Optics:
    beam = _make_beam(laser_port)
    illuminated = _make_illuminated((port, laser_port), beam["light"])
    ranges = {"range_of_path": _make_range_of_path(laser_port), "illuminated": illuminated}
    return Optics((port, laser_port), **_make_camera(port), **beam, **ranges)


IN_WATER = make_optics()
"""A camera and a laser in the water."""


def check_ports(name: str, ports: Any, optics: Any) -> tuple[Optics, Any]:
    """Optics, None being those in the water, and parameters of the ports that they are of; raises `ArgumentError`."""
    optics = IN_WATER if optics is None else optics
    if not isinstance(optics, Optics):
        raise ArgumentError(f"optics = {optics!r} is not of make_optics")
    ports = Ports() if ports is None else ports
    check_struct(name, ports, Ports)
    for part, kind in zip(("camera", "laser"), optics.kinds, strict=True):
        if kind is not None:
            check_port(f"{name}.{part}", getattr(ports, part), kind)
    return optics, ports


def check_optics(lidar: Any, optics: Any) -> Optics:
    """A `Lidar` whose numbers are in range, and optics that its laser can have; raises `ArgumentError`."""
    check_lidar(lidar)
    optics, _ = check_ports("lidar.ports", lidar.ports, optics)
    if optics is not IN_WATER and lidar.lu2024:
        raise ArgumentError("lidar.lu2024 = 1 is for a camera and a laser in the water, not for optics of ports")
    if lidar.profile == 2 and optics.kinds[1] == DOME_PORT:
        raise ArgumentError("lidar.profile = 2: a collimated beam does not stay one behind a dome")
    return optics
