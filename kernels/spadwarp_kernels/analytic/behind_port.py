"""Ways of light of a camera or a laser behind a port, or of both.

Rays are traced by the functions of the ports, in float32: lengths are right to 1e-7 of themselves.
"""

from typing import NamedTuple

import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError
from spadwarp_kernels.base.kernels import made_once
from spadwarp_kernels.base.native import HALF, ONE, PI, TWO, ZERO
from spadwarp_kernels.optics.port import FLAT_PORT, Passage, Port, PortKind

from .lidar import Lidar, Ports
from .optics import IN_WATER, Light, Optics, Ray, Received, cone_interval

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
class Sight:
    """A line of sight in the water, of a pixel.

    Attributes:
        view: Unit vector in which the lens sees it.
        start: Where it begins: the lens, or where it leaves the port [m].
        u: Its unit direction.
        distance: From the lens centre to there [m].
        delay: Length in water that takes as long as the way between them [m].
        radiance: Radiance in front of the lens over that in the water, T (n_0/n_w)^2.
    """

    view: wp.vec3d
    start: wp.vec3d
    u: wp.vec3d
    distance: wp.float64
    delay: wp.float64
    radiance: wp.float64


@wp.func
def _single(x: wp.vec3d) -> wp.vec3:
    return wp.vec3(float(x[0]), float(x[1]), float(x[2]))


@wp.func
def _double(x: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func
def _no_passage(port: Port, x: wp.vec3, u: wp.vec3) -> Passage:
    return Passage()


# Lines of sight


@wp.func
def _view(sight: Sight) -> wp.vec3d:
    return sight.view


@wp.func
def _direction(sight: Sight) -> wp.vec3d:
    return sight.u


@wp.func
def _point(sight: Sight, r: wp.float64) -> wp.vec3d:
    return sight.start + r * sight.u


@wp.func
def _from_lens(sight: Sight, r: wp.float64) -> wp.float64:
    return sight.distance + r


@wp.func
def _along(sight: Sight, distance: wp.float64) -> wp.float64:
    return distance - sight.distance


@wp.func
def _whole_path(sight: Sight, path: wp.float64) -> wp.float64:
    return path + sight.delay


@wp.func
def _collected(sight: Sight, value: wp.float64) -> wp.float64:
    return value * sight.radiance


class _Camera(NamedTuple):
    """What `Optics` has of a camera."""

    see: wp.Function
    beside: wp.Function
    footprint: wp.Function
    receive: wp.Function


@made_once
def _make_camera(kind: PortKind | None) -> _Camera:
    """The functions of a camera behind a kind of port, or in the water."""
    has_port, is_flat = kind is not None, kind == FLAT_PORT
    enter = kind.enter if kind is not None else _no_passage
    connect = kind.connect if kind is not None else FLAT_PORT.connect
    receive_in_water = IN_WATER.receive

    @wp.func
    def see(ports: Ports, view: wp.vec3d) -> Sight:
        s = Sight()
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
    def beside(lidar: Lidar, sight: Sight, x: wp.vec3d, a: wp.float64, b: wp.float64) -> wp.vec3d:
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
    def receive(lidar: Lidar, normal: wp.vec3d, x: wp.vec3d) -> Received:
        if wp.static(not has_port):
            return receive_in_water(lidar, normal, x)
        out = Received()
        c = connect(lidar.ports.camera, _single(x), wp.vec3(0.0))
        if c.density > 0.0:
            out.ray = -_double(c.inside)
            cos_out = wp.dot(normal, _double(c.to_port))
            out.share = cos_out * out.ray[2] * wp.float64(c.density * c.transmission)
            out.water = wp.float64(c.water)
        return out

    return _Camera(see, beside, footprint, receive)


# The laser


class _Beam(NamedTuple):
    """What `Optics` has of a laser."""

    spot: wp.Function
    emit: wp.Function
    light: wp.Function


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


@made_once
def _make_beam(kind: PortKind | None) -> _Beam:
    """The functions of a laser behind a kind of port, or in the water."""
    if kind is None:
        return _Beam(IN_WATER.spot, IN_WATER.emit, IN_WATER.light)
    is_flat, enter, leave, connect = kind == FLAT_PORT, kind.enter, kind.leave, kind.connect

    @wp.func
    def spot(lidar: Lidar, path: wp.float64) -> wp.float64:
        if lidar.profile == 2:
            return lidar.radius
        radius = path * wp.sqrt(lidar.tan2)
        if wp.static(is_flat):
            radius *= wp.float64(lidar.ports.laser.index[0] / lidar.ports.laser.index[2])
        return radius

    @wp.func
    def emit(lidar: Lidar, x: wp.vec3d, u: wp.vec3d) -> Ray:
        ray = Ray()
        p = enter(lidar.ports.laser, _single(x), _single(u))
        ray.x = _double(p.x)
        ray.u = _double(p.u)
        ray.transmission = wp.float64(p.transmission)
        return ray

    @wp.func
    def parallel_light(lidar: Lidar, x: wp.vec3d) -> Light:
        """Of a collimated beam, which stays one behind a flat port: back along the ray through x."""
        light = Light()
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
    def light(lidar: Lidar, x: wp.vec3d) -> Light:
        out = Light()
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

    return _Beam(spot, emit, light)


# Both


@wp.func
def least_range(sight: Sight) -> wp.float64:
    """So far behind a port that rounding does not put a point into the window [m]."""
    return wp.float64(1.0e-5) * (ONE + sight.distance)


@wp.func
def _straight_range(laser: wp.vec3d, sight: Sight, path: wp.float64) -> wp.float64:
    """Range at which light has gone a path from a laser in the water to the point and on to where the line begins."""
    y = sight.start - laser
    if path <= wp.length(y):
        return _NONE
    return (path * path - wp.length_sq(y)) / (TWO * (path + wp.dot(sight.u, y)))


@made_once
def _make_range_of_path(kind: PortKind | None) -> wp.Function:
    """`Optics.range_of_path` for a laser behind a kind of port, or in the water."""
    has_port = kind is not None
    connect = kind.connect if kind is not None else FLAT_PORT.connect

    @wp.func
    def range_of_path(laser: wp.vec3d, ports: Ports, sight: Sight, path: wp.float64) -> wp.float64:
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


@made_once
def _make_illuminated(kind: PortKind | None, light: wp.Function) -> wp.Function:
    """`Optics.illuminated` for a laser behind a kind of port, or in the water."""
    has_port = kind is not None

    @wp.func
    def edge(lidar: Lidar, sight: Sight, dark: wp.float64, lit: wp.float64) -> wp.float64:
        """Where light begins between two ranges."""
        outer = wp.float64(dark)
        inner = wp.float64(lit)
        for _ in range(_HALVINGS):
            middle = HALF * (outer + inner)
            if light(lidar, _point(sight, middle)).fluence > ZERO:
                inner = middle
            else:
                outer = middle
        return inner

    @wp.func
    def illuminated(lidar: Lidar, sight: Sight, begin: wp.float64, far: wp.float64) -> wp.vec2d:
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
            lit = light(lidar, _point(sight, r)).fluence > ZERO
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
    return IN_WATER if port is None and laser_port is None else _make_optics(port, laser_port)


@made_once
def _make_optics(port: PortKind | None, laser_port: PortKind | None) -> Optics:
    camera, beam = _make_camera(port), _make_beam(laser_port)
    return Optics(
        kinds=(port, laser_port),
        sight=Sight,
        see=camera.see,
        view=_view,
        direction=_direction,
        point=_point,
        beside=camera.beside,
        from_lens=_from_lens,
        along=_along,
        whole_path=_whole_path,
        collected=_collected,
        spot=beam.spot,
        footprint=camera.footprint,
        emit=beam.emit,
        receive=camera.receive,
        light=beam.light,
        range_of_path=_make_range_of_path(laser_port),
        illuminated=_make_illuminated(laser_port, beam.light),
    )
