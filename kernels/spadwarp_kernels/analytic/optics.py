"""Laser, water and camera of the analytic model, and how light gets from the laser to the water and on to the camera,
each of which is in the water or behind a port.

A range r is the length of the way in the water along a line of sight; without a port it begins at the lens. In float64,
but rays through ports are traced by the functions of the ports, in float32: lengths are right to 1e-7 of themselves.
"""

from typing import Any, NamedTuple

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import HALF, ONE, PI, TWO, ZERO
from spadwarp_kernels.optics.port import DOME_PORT, FLAT_PORT, Connection, Port, PortKind, check_port

__all__ = ["BACKSCATTER_SOURCES", "Lidar", "Ports", "make_optics"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Of Newton's method, which has converged after a few; and of a search for the light on a line of sight.
_STEPS = wp.constant(16)
_EDGES = wp.constant(49)
_PART = wp.constant(wp.float64(1.0 / 48.0))
_HALVINGS = wp.constant(24)
_NONE = wp.constant(wp.float64(-1.0e30))

BACKSCATTER_SOURCES = ("constant", "single_scatter", "monte_carlo")


@wp.struct
class Ports:
    """The ports that an `Optics` of them reads; those of a camera and a laser in the water are as they are made."""

    camera: Port  # what the camera looks through
    laser: Port  # what the laser shines through
    slope: wp.float64  # of a rough surface that both are, standard deviation of its slopes along an axis


@wp.struct
class Lidar:
    """Laser, water, camera and gate as the analytic model needs them."""

    lu2024: int
    """1 if the photon budget of Lu et al. 2024 (K = 8, small angles, no cosines) replaces radiometry, else 0."""
    photons: wp.float64  # photons per pulse, E0 λ/hc
    pde: wp.float64  # photon detection efficiency, PDP times fill factor
    extinction: wp.float64  # of the water [1/m]
    scattering: wp.float64  # of the water [1/m]
    speed: wp.float64  # group velocity c0/n_g [m/s]
    laser: wp.vec3d  # position of the laser [m]
    axis: wp.vec3d  # its unit direction
    profile: int  # index into LASER_PROFILES
    spread: wp.float64  # 1 - cos(half angle) (uniform cone); unused otherwise
    tan2: wp.float64  # tan^2 of the half angle
    radius: wp.float64  # beam radius [m] (collimated)
    pixel_tangent: wp.float64  # pixel pitch over focal length
    aperture_area: wp.float64  # [m^2]
    start: wp.float64  # of the gate [s]
    stop: wp.float64  # of the gate [s]
    sigma: wp.float64  # standard deviation of the instrument response [s]
    dark: wp.float64  # rate of dark counts and ambient light [1/s]
    source: int  # index into BACKSCATTER_SOURCES
    constant: wp.float64  # backscatter rate [1/s] (source 0)
    nearest: wp.float64  # range below which single scattering is left out [m] (source 1)
    bin_width: wp.float64  # of the Monte Carlo profile [s] (source 2)
    ports: Ports  # what camera and laser are behind, for the optics that say so


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
class LaserConnection:
    """The way from the laser to a point in clear water."""

    path: wp.float64  # length in water that takes as long [m]
    water: wp.float64  # its length in the water [m]
    u: wp.vec3d  # its unit direction at the point
    fluence: wp.float64  # fraction of a pulse per area across it [1/m^2]


class Optics(NamedTuple):
    """Warp functions for a camera and a laser, each in the water or behind a port."""

    kinds: tuple[PortKind | None, PortKind | None]  # of the ports of camera and laser; None: in the water
    rough: bool  # whether these are the surface of a sea with slopes; `light` is then the mean over a pixel
    see: wp.Function  # (ports, view) -> SightRay of a pixel, from the unit vector in which the lens sees it
    beside: wp.Function  # (lidar, sight, x, a, b) -> point at the depth of x that is seen a and b pixels beside it
    footprint: wp.Function  # (lidar, distance) -> about the side of a pixel [m]
    # (lidar, normal, x) -> way to the lens of light that a point of a surface scatters evenly: direction in which it is
    # seen, of any length; cosine at the surface times solid angle and transmission, over the lens's area [1/m^2]; its
    # length in the water [m]
    receive: wp.Function
    spot: wp.Function  # (lidar, path) -> about the radius of the beam [m]
    # (lidar, x, u) -> where a ray from the laser begins in the water [m], its unit direction, the fraction of its light
    emit: wp.Function
    light: wp.Function  # (lidar, x) -> LaserConnection of a point
    # (laser, ports, sight, path) -> range at which light has gone a path from laser to target to lens [m]; 0 or less if
    # there is none
    range_of_path: wp.Function
    # (lidar, sight, near, far) -> the part of an interval of ranges that the laser's uniform cone illuminates; far <
    # near if there is none
    illuminated: wp.Function


@wp.func
def point_at(sight: SightRay, r: wp.float64) -> wp.vec3d:
    """Point of a line of sight at a range [m]."""
    return sight.start + r * sight.u


# ---- The camera.


def _make_camera(kind: PortKind | None) -> tuple[wp.Function, ...]:
    """`Optics.see` to `receive` of a camera behind a kind of port, or in the water."""
    has_port, is_flat = kind is not None, kind == FLAT_PORT
    enter, connect = (kind or FLAT_PORT).enter, (kind or FLAT_PORT).connect

    @wp.func
    def see(ports: Ports, view: wp.vec3d) -> SightRay:
        s = SightRay()
        s.view = view
        s.u = view
        s.radiance = ONE
        if wp.static(has_port):
            p = enter(ports.camera, wp.vec3(0.0), wp.vec3(view))
            s.radiance = ZERO
            if p.transmission > 0.0:
                s.start = wp.vec3d(p.x)
                s.u = wp.normalize(wp.vec3d(p.u))
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
    def receive(lidar: Lidar, normal: wp.vec3d, x: wp.vec3d):
        if wp.static(not has_port):
            r = wp.length(x)
            return x, -wp.dot(normal, x) / r * (x[2] / r) / (r * r), r
        c = connect(lidar.ports.camera, wp.vec3(x), wp.vec3(0.0))
        ray = -wp.vec3d(c.inside)
        cos_out = wp.dot(normal, wp.vec3d(c.to_lens))
        return ray, cos_out * ray[2] * wp.float64(c.density * c.transmission), wp.float64(c.water)

    return see, beside, footprint, receive


# ---- The laser.


@wp.func
def beam_path(lidar: Lidar, x: wp.vec3d) -> wp.float64:
    """Distance that light goes in water from the laser to x [m]; along the axis for a collimated beam."""
    y = x - lidar.laser
    if lidar.profile == 2:
        return wp.dot(y, lidar.axis)
    return wp.length(y)


@wp.func
def beam_fluence(lidar: Lidar, y: wp.vec3d, r2: wp.float64) -> wp.float64:
    """Fraction of a pulse per area across a diverging beam at y from its laser, y² being r2 [1/m^2], in clear water."""
    along = wp.dot(y, lidar.axis)
    if along <= ZERO:
        return ZERO
    # 1 - cos and tan from the cross product: keeps narrow cones exact.
    across = wp.length_sq(wp.cross(y, lidar.axis))
    r = wp.sqrt(r2)
    if lidar.profile == 0:
        if across > lidar.spread * r * (r + along):
            return ZERO
        return ONE / (TWO * PI * lidar.spread * r2)
    tan2 = across / (along * along)
    cos = along / r
    return TWO / (PI * lidar.tan2) * wp.exp(-TWO * tan2 / lidar.tan2) / (cos * cos * cos * r2)


@wp.func
def _light_in_water(lidar: Lidar, x: wp.vec3d) -> LaserConnection:
    light = LaserConnection()
    y = x - lidar.laser
    light.path = beam_path(lidar, x)
    light.water = light.path
    if lidar.profile == 2:
        light.u = lidar.axis
        aside2 = wp.length_sq(wp.cross(y, lidar.axis))
        if light.path > ZERO and aside2 <= lidar.radius * lidar.radius:
            light.fluence = ONE / (PI * lidar.radius * lidar.radius)
    else:
        light.u = wp.normalize(y)
        light.fluence = beam_fluence(lidar, y, wp.dot(y, y))
    return light


@wp.func
def facet_spread(port: Port, slope: wp.float64, c: Connection) -> wp.float64:
    """Variance across a way through the surface of a sea, along an axis, of where its facets send it [m^2]."""
    bend = port.index[0] / port.index[2] * wp.dot(c.inside, port.normal) - wp.dot(c.to_lens, port.normal)
    aside = slope * wp.float64(c.water * bend)
    return aside * aside


def _make_beam(kind: PortKind | None, rough: bool) -> tuple[wp.Function, ...]:
    """`Optics.spot` to `light` of a laser behind a kind of port, or in the water."""
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
    def emit(lidar: Lidar, x: wp.vec3d, u: wp.vec3d):
        if wp.static(has_port):
            p = enter(lidar.ports.laser, wp.vec3(x), wp.vec3(u))
            return wp.vec3d(p.x), wp.vec3d(p.u), wp.float64(p.transmission)
        return x, u, ONE

    @wp.func
    def parallel_light(lidar: Lidar, x: wp.vec3d) -> LaserConnection:
        """Of a collimated beam, which stays one behind a flat port: back along the ray through x."""
        light = LaserConnection()
        port = lidar.ports.laser
        u = enter(port, wp.vec3(lidar.laser), wp.vec3(lidar.axis)).u
        back = leave(port, wp.vec3(x), -u)
        if back.transmission <= 0.0:
            return light
        y = wp.vec3d(back.x) - lidar.laser
        along = wp.dot(y, lidar.axis)
        light.u = wp.vec3d(u)
        light.water = wp.float64(back.water)
        light.path = light.water + wp.float64(back.path) + wp.float64(port.delay[0]) * along
        if wp.length_sq(y - along * lidar.axis) <= lidar.radius * lidar.radius and light.water > ZERO:
            narrower = wp.dot(lidar.axis, wp.vec3d(port.normal)) / wp.float64(wp.dot(u, port.normal))
            light.fluence = wp.float64(back.transmission) * narrower / (PI * lidar.radius * lidar.radius)
        return light

    @wp.func
    def light_behind_port(lidar: Lidar, x: wp.vec3d) -> LaserConnection:
        out = LaserConnection()
        port = lidar.ports.laser
        if wp.static(is_flat) and lidar.profile == 2:
            return parallel_light(lidar, x)
        c = connect(port, wp.vec3(x), wp.vec3(lidar.laser))
        if c.density <= 0.0:
            return out
        out.path = wp.float64(c.path)
        out.water = wp.float64(c.water)
        out.u = -wp.normalize(wp.vec3d(c.to_lens))
        # The density is that of light from x to the laser; the other way the index goes with it.
        ratio = wp.float64(port.index[2]) / wp.float64(port.index[0])
        spread = ratio * ratio * wp.float64(c.density) * wp.float64(c.transmission)
        out.fluence = beam_fluence(lidar, -wp.normalize(wp.vec3d(c.inside)), ONE) * spread
        return out

    @wp.func
    def light_by_facets(lidar: Lidar, x: wp.vec3d) -> LaserConnection:
        """The mean over what the pixel that sees x gets its light from: the beam and the ways down and up are normal
        distributions, the pixel a square."""
        out = light_behind_port(lidar, x)
        down = connect(lidar.ports.laser, wp.vec3(x), wp.vec3(lidar.laser))
        up = connect(lidar.ports.camera, wp.vec3(x), wp.vec3(0.0))
        if down.density > 0.0 and up.density > 0.0:
            ratio = wp.float64(lidar.ports.laser.index[2] / lidar.ports.laser.index[0])
            solid = ratio * ratio * wp.float64(down.density)  # angle at the laser over area at x
            aside2 = facet_spread(lidar.ports.laser, lidar.ports.slope, down)
            aside2 += facet_spread(lidar.ports.camera, lidar.ports.slope, up)
            width = wp.sqrt(TWO * (wp.float64(0.25) * lidar.tan2 + solid * aside2))
            side = lidar.pixel_tangent * wp.sqrt(wp.float64(down.density / up.density))
            seen = -wp.vec3d(down.inside)
            off = seen / wp.dot(seen, lidar.axis) - lidar.axis
            out.fluence = solid * wp.float64(down.transmission)
            for k in range(2):
                share = wp.erf((off[k] + HALF * side) / width) - wp.erf((off[k] - HALF * side) / width)
                out.fluence *= HALF * share / side
        return out

    return spot, emit, light_by_facets if rough else light_behind_port if has_port else _light_in_water


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


def _make_range_of_path(kind: PortKind | None) -> wp.Function:
    """`Optics.range_of_path` for a laser behind a kind of port, or in the water."""
    has_port, connect = kind is not None, (kind or FLAT_PORT).connect

    @wp.func
    def range_of_path(laser: wp.vec3d, ports: Ports, sight: SightRay, path: wp.float64) -> wp.float64:
        left = path - sight.delay
        if wp.static(not has_port):
            return _straight_range(laser, sight, left)
        o = wp.vec3(laser)
        least = least_range(sight)
        c = connect(ports.laser, wp.vec3(sight.start + least * sight.u), o)
        if c.density > 0.0 and wp.float64(c.path) + least >= left:
            return _NONE
        r = wp.max(_straight_range(laser, sight, left), least)
        for _ in range(_STEPS):
            c = connect(ports.laser, wp.vec3(sight.start + r * sight.u), o)
            if c.density <= 0.0:  # not yet where the laser's water is
                r = TWO * r + wp.float64(1.0e-3)
            else:
                # The path rises with the range by 1 + the cosine between both directions of light.
                slope = wp.max(ONE - wp.dot(wp.vec3d(c.to_lens), sight.u), wp.float64(1.0e-3))
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
    disc = b * b - a * (pa * pa - k * wp.length_sq(apex))
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
        return wp.vec2d(ONE, -ONE)
    return wp.vec2d(wp.max(low, ZERO), high)


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


def make_optics(port: PortKind | None = None, laser_port: PortKind | None = None, rough: bool = False) -> Optics:
    """The optics of a camera and a laser behind kinds of ports; None: in the water.

    A collimated beam needs a flat port, behind which it stays one. `rough`: both ports are FLAT_PORT and the surface of
    a sea, whose facets have `Ports.slope`; of a diverging laser along about the camera's axis.
    """
    for name, kind in {"port": port, "laser_port": laser_port}.items():
        if not isinstance(kind, PortKind | None):
            raise ArgumentError(f"{name} = {kind!r} is not a PortKind or None")
    if rough and (port, laser_port) != (FLAT_PORT, FLAT_PORT):
        raise ArgumentError("rough = True needs FLAT_PORT as port and laser_port")
    return _make_optics((port, laser_port), rough)


@memoised
def _make_optics(kinds: tuple[PortKind | None, PortKind | None], rough: bool) -> Optics:
    beam = _make_beam(kinds[1], rough)
    ranges = _make_range_of_path(kinds[1]), _make_illuminated(kinds, beam[-1])
    return Optics(kinds, rough, *_make_camera(kinds[0]), *beam, *ranges)


IN_WATER = make_optics()
"""A camera and a laser in the water."""


# ---- Checks of arguments.


_RANGES = {
    "[0, inf)": ("photons", "extinction", "scattering", "start", "dark", "constant", "nearest"),
    "(0, inf)": ("speed", "pixel_tangent", "aperture_area", "sigma"),
    "[0, 1]": ("pde",),
}
# What each laser profile reads.
_BEAM = ({"spread": "[0, 2]"}, {"tan2": "[0, inf)"}, {"radius": "[0, inf)"})


def check_ports(name: str, ports: Any, optics: Any) -> tuple[Optics, Any]:
    """Optics, None being those in the water, and parameters of the ports that they are of; raises `ArgumentError`."""
    optics = IN_WATER if optics is None else optics
    if not isinstance(optics, Optics):
        raise ArgumentError(f"optics = {optics!r} is not of make_optics")
    ports = Ports() if ports is None else ports
    check.kind(name, ports, Ports)
    for part, kind in zip(("camera", "laser"), optics.kinds, strict=True):
        if kind is not None:
            check_port(f"{name}.{part}", getattr(ports, part), kind)
    return optics, ports


def check_lidar(lidar: Any, optics: Any, view: Any, **columns: Any) -> tuple[Optics, int, Any]:
    """A `Lidar` whose numbers are in range, optics that its laser can have, lines of sight, and float64 columns of a
    number for each: the optics, number and device of the lines. Raises `ArgumentError`."""
    check.kind("lidar", lidar, Lidar)
    check.integer("lidar.lu2024", lidar.lu2024, 0, 1)
    check.fields("lidar", lidar, {name: interval for interval, names in _RANGES.items() for name in names})
    check.number("lidar.stop", lidar.stop, f"({float(lidar.start)}, inf)")
    check.vector("lidar.laser", lidar.laser)
    check.vector("lidar.axis", lidar.axis, unit=True)
    check.fields("lidar", lidar, _BEAM[check.integer("lidar.profile", lidar.profile, 0, len(_BEAM) - 1)])
    source = check.integer("lidar.source", lidar.source, 0, len(BACKSCATTER_SOURCES) - 1)
    if lidar.lu2024:
        check.number("lidar.tan2", lidar.tan2, "(0, inf)")
    if BACKSCATTER_SOURCES[source] == "monte_carlo":
        check.number("lidar.bin_width", lidar.bin_width, "(0, inf)")
    optics, _ = check_ports("lidar.ports", lidar.ports, optics)
    if optics is not IN_WATER and lidar.lu2024:
        raise ArgumentError("lidar.lu2024 = 1 is for a camera and a laser in the water, not for optics of ports")
    if lidar.profile == 2 and (optics.kinds[1] == DOME_PORT or optics.rough):
        raise ArgumentError("lidar.profile = 2: a collimated beam does not stay one behind a dome or a rough surface")
    if optics.rough:
        check.number("lidar.ports.slope", lidar.ports.slope, "(0, 1]")
    check.array("view", view, wp.vec3d, (None,))
    check.arrays(wp.float64, (view.shape[0],), view.device, **columns)
    return optics, view.shape[0], view.device
