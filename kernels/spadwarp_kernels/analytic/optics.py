"""Ways of light between laser, water and camera, the geometry of the analytic model: here for both in the water."""

from typing import Any, NamedTuple

import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_struct
from spadwarp_kernels.base.native import HALF, ONE, TWO, ZERO
from spadwarp_kernels.optics.port import DOME_PORT, PortKind, check_port

from .lidar import Lidar, Ports, beam_direction, beam_fluence, beam_path, check_lidar

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class Light:
    """The laser's light that passes a point in clear water.

    Attributes:
        path: Length in water that takes as long as its way [m].
        water: Length of its way in the water [m].
        u: Its unit direction.
        fluence: Fraction of a pulse per area across it [1/m^2].
    """

    path: wp.float64
    water: wp.float64
    u: wp.vec3d
    fluence: wp.float64


@wp.struct
class Ray:
    """A ray of the beam in the water.

    Attributes:
        x: Where it begins [m].
        u: Its unit direction.
        transmission: Fraction of its light that got there.
    """

    x: wp.vec3d
    u: wp.vec3d
    transmission: wp.float64


@wp.struct
class Received:
    """What the lens collects of light that a surface scatters evenly.

    Attributes:
        ray: In the direction in which the lens sees it, of any length.
        share: Cosine at the surface times solid angle and transmission, over the lens's area [1/m^2].
        water: Length of its way in the water [m].
    """

    ray: wp.vec3d
    share: wp.float64
    water: wp.float64


class Optics(NamedTuple):
    """Warp functions for a camera and a laser, each in the water or behind a port.

    A range r is the length of the way in the water, along the line of sight; without a port it begins at the lens.

    Attributes:
        kinds: Of the ports of camera and laser; None: in the water.
        sight: Type of a line of sight: of a camera and a laser in the water its unit vector, else `Sight`.
        see: (ports, view) -> the line of sight of a pixel, from the unit vector in which the lens sees it.
        view: (sight) -> that unit vector.
        direction: (sight) -> unit vector of the line in the water.
        point: (sight, r) -> point at a range [m].
        beside: (lidar, sight, x, a, b) -> the point at the depth of x that the lens sees a and b pixels beside it.
        from_lens, along: (sight, r) -> about the distance from the lens, and back [m].
        whole_path: (sight, path) -> with the way from the water to the lens, as length in water that takes as long [m].
        collected: (sight, value) -> of the radiance in the water, the part that is there in front of the lens.
        spot, footprint: (lidar, length) -> about the radius of the beam, and the side of a pixel [m].
        emit: (lidar, x, u) -> Ray of the beam in the water.
        receive: (lidar, normal, x) -> Received, of light that a surface scatters to the lens.
        light: (lidar, x) -> Light of the laser that passes x.
        range_of_path: (laser, ports, sight, path) -> range at which light has gone a path from laser to target to
            lens [m]; 0 or less if there is none.
        illuminated: (lidar, sight, near, far) -> the part of an interval of ranges that the laser's uniform cone
            illuminates; far < near if there is none.
    """

    kinds: tuple[PortKind | None, PortKind | None]
    sight: type
    see: wp.Function
    view: wp.Function
    direction: wp.Function
    point: wp.Function
    beside: wp.Function
    from_lens: wp.Function
    along: wp.Function
    whole_path: wp.Function
    collected: wp.Function
    spot: wp.Function
    footprint: wp.Function
    emit: wp.Function
    receive: wp.Function
    light: wp.Function
    range_of_path: wp.Function
    illuminated: wp.Function


@wp.func
def _see(ports: Ports, view: wp.vec3d) -> wp.vec3d:
    return view


@wp.func
def _itself(view: wp.vec3d) -> wp.vec3d:
    return view


@wp.func
def _point(view: wp.vec3d, r: wp.float64) -> wp.vec3d:
    return r * view


@wp.func
def _beside(lidar: Lidar, view: wp.vec3d, x: wp.vec3d, a: wp.float64, b: wp.float64) -> wp.vec3d:
    return x + wp.vec3d(a * lidar.pixel_tangent * x[2], b * lidar.pixel_tangent * x[2], ZERO)


@wp.func
def _same(view: wp.vec3d, value: wp.float64) -> wp.float64:
    return value


@wp.func
def _spot(lidar: Lidar, path: wp.float64) -> wp.float64:
    if lidar.profile == 2:
        return lidar.radius
    return path * wp.sqrt(lidar.tan2)


@wp.func
def _footprint(lidar: Lidar, distance: wp.float64) -> wp.float64:
    return distance * lidar.pixel_tangent


@wp.func
def _emit(lidar: Lidar, x: wp.vec3d, u: wp.vec3d) -> Ray:
    ray = Ray()
    ray.x = x
    ray.u = u
    ray.transmission = ONE
    return ray


@wp.func
def _receive(lidar: Lidar, normal: wp.vec3d, x: wp.vec3d) -> Received:
    out = Received()
    r = wp.length(x)
    cos_out = -wp.dot(normal, x) / r
    out.ray = x
    out.share = cos_out * (x[2] / r) / (r * r)
    out.water = r
    return out


@wp.func
def _light(lidar: Lidar, x: wp.vec3d) -> Light:
    light = Light()
    light.path = beam_path(lidar, x)
    light.water = light.path
    light.u = beam_direction(lidar, x)
    light.fluence = beam_fluence(lidar, x)
    return light


@wp.func
def range_of_path(laser: wp.vec3d, ports: Ports, view: wp.vec3d, path: wp.float64) -> wp.float64:
    """Distance along `view` at which light has gone `path` from laser to target to lens [m]; 0 if there is none."""
    baseline2 = wp.length_sq(laser)
    if path * path <= baseline2:
        return ZERO
    return (path * path - baseline2) / (TWO * (path - wp.dot(view, laser)))


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


@wp.func
def _illuminated(lidar: Lidar, view: wp.vec3d, near: wp.float64, far: wp.float64) -> wp.vec2d:
    cone = cone_interval(lidar, lidar.laser, view)
    return wp.vec2d(wp.max(near, cone[0]), wp.min(far, cone[1]))


IN_WATER = Optics(
    kinds=(None, None),
    sight=wp.vec3d,
    see=_see,
    view=_itself,
    direction=_itself,
    point=_point,
    beside=_beside,
    from_lens=_same,
    along=_same,
    whole_path=_same,
    collected=_same,
    spot=_spot,
    footprint=_footprint,
    emit=_emit,
    receive=_receive,
    light=_light,
    range_of_path=range_of_path,
    illuminated=_illuminated,
)
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
