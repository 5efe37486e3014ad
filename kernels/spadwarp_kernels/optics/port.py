"""A port between camera or laser and the water: layers of air and glass that bend light; and the ways through it."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.native import fill

__all__ = ["DOME_PORT", "FLAT_PORT", "Port", "PortKind", "make_dome_port", "make_flat_port"]


@wp.struct
class Port:
    """What is between the air inside a housing and the water, in the frame of the camera; made by `make_flat_port` or
    `make_dome_port`.

    A flat window is all space between the planes x·normal = distance and distance + thickness, a dome all between the
    spheres of radius and radius + thickness about its centre. With a thickness of 0 there is none, as at a calm
    surface.
    """

    normal: wp.vec3  # unit vector into the water (flat)
    distance: float  # to the inner face from the origin along the normal [m] (flat)
    centre: wp.vec3  # of the spheres [m] (dome)
    radius: float  # of the inner sphere [m] (dome)
    thickness: float  # of the window [m]
    index: wp.vec3  # phase index of what is inside, of the window, of the water
    delay: wp.vec2  # group index over that of the water, of what is inside and of the window
    glass_slope: wp.vec2
    """Bounds of the tangent that a ray makes with the normal in the window over that inside, among the rays of a view:
    (least, largest) (flat)."""
    water_slope: wp.vec2  # the same in the water
    turn: float  # bound of the sine of the angle by which a ray of the view is bent (dome)
    aside: float  # bound of a ray's distance from the centre, in the water [m] (dome)
    margin: float  # bound of how far a rough surface moves a line of sight aside, over the depth below it (sea)
    amplitude: float  # bound of the height of resolved waves above the plane, and of their depth below it [m] (sea)
    straight: float  # and of how far aside light gets on its way between them, without being refracted [m] (sea)
    early: float
    """The way through the port takes at most this much less than the straight line in water [m of water]."""
    late: float  # and at most this much more [m of water]


@wp.struct
class Connection:
    """The one way of light from a point in the water to a point inside, or to one of the lens."""

    to_lens: wp.vec3  # unit direction at the point
    inside: wp.vec3  # unit direction in which it arrives
    exit: wp.vec3  # where it leaves the water, or crosses the surface of a sea; else the point of the lens [m]
    water: float  # length of its way in the water [m]
    path: float  # length in water that takes as long as the whole way [m]
    transmission: float  # fraction of unpolarised light that gets through
    # solid angle at the point in the water over the area that its light covers inside, across the ray [sr/m^2]; 0:
    # there is no such way. 1/r^2 where all indices are equal
    density: float
    # Of `Sight.link`:
    image: wp.vec3  # a point that the lens sees in the direction in which it arrives, in air alone [m]
    begin: wp.vec3  # by a sea, where its way in the water begins [m]
    along: wp.vec3  # and the unit vector along that
    gather: float  # by a port or a sea, what the lens gets of an intensity without extinction, per its area [sr/m^2]


@wp.struct
class PortRay:
    """A ray that has gone through a port."""

    x: wp.vec3  # where it leaves the port [m]; of a ray from the water, where it meets the plane z = 0 inside
    u: wp.vec3  # its unit direction there
    water: float  # length of its way in the water up to the port [m]; negative if the ray began behind that
    path: float  # length in water that takes as long as the way behind that [m]
    transmission: float  # fraction of unpolarised light that gets through; 0: none
    cosines: wp.vec4  # index times cosine to the normal before and behind both faces, from inside to the water
    seen: wp.vec3  # of `Sight.leave`, a point that the lens sees it come from, in air alone [m]


@wp.func
def transmission(n: wp.vec4, q: wp.vec4) -> float:
    """Fraction of unpolarised light that two interfaces let through, without what a window reflects inside: half the
    sum of the products of both polarisations. n: phase indices before and behind the first and before and behind the
    second; q: the same times the cosine to the normal there."""
    s1 = q[0] + q[1]
    s2 = q[2] + q[3]
    first = 4.0 * q[0] * q[1]
    second = 4.0 * q[2] * q[3]
    # cos/n in place of n cos gives the other polarisation.
    p1 = q[0] * n[1] / n[0] + q[1] * n[0] / n[1]
    p2 = q[2] * n[3] / n[2] + q[3] * n[2] / n[3]
    return 0.5 * first * second * (1.0 / (s1 * s1 * s2 * s2) + 1.0 / (p1 * p1 * p2 * p2))


@wp.func
def refracted(u: wp.vec3, normal: wp.vec3, ratio: float) -> wp.vec3:
    """The direction u behind an interface, for the ratio of the index before it to that behind it; the zero vector
    where all light is reflected. The normal is on either side."""
    cosine = wp.dot(u, normal)
    across = u - cosine * normal
    rest = 1.0 - ratio * ratio * wp.dot(across, across)
    if rest <= 0.0:
        return wp.vec3(0.0)
    return ratio * across + (wp.sign(cosine) * wp.sqrt(rest)) * normal


# ---- Faces: where a ray meets one, and its normal outwards, as x, y, z and length [m]; without a normal it does not.
# `outer`: that between window and water; `inward`: of a ray from the water.


@wp.func
def _plane_face(port: Port, x: wp.vec3, u: wp.vec3, outer: bool, inward: bool) -> wp.vec4:
    climb = wp.dot(u, port.normal)
    if (climb < 0.0) != inward or climb == 0.0:
        return wp.vec4()
    level = port.distance + wp.where(outer, port.thickness, 0.0)
    return wp.vec4(port.normal[0], port.normal[1], port.normal[2], (level - wp.dot(x, port.normal)) / climb)


@wp.func
def _sphere_face(port: Port, x: wp.vec3, u: wp.vec3, outer: bool, inward: bool) -> wp.vec4:
    radius = port.radius + wp.where(outer, port.thickness, 0.0)
    y = x - port.centre
    b = wp.length(wp.cross(y, u))
    near = -wp.dot(y, u) - _chord(radius, b)
    # From outside a ray enters at the nearer point, also of a ray that began behind it; from inside it leaves farther.
    if b >= radius or (not inward and near > 0.0):
        return wp.vec4()
    s = wp.where(inward, near, near + 2.0 * _chord(radius, b))
    normal = wp.normalize(y + s * u)
    return wp.vec4(normal[0], normal[1], normal[2], s)


@wp.func
def _chord(r: float, b: float) -> float:
    """Half the chord of a circle at the distance b from its centre [m]."""
    return wp.sqrt(wp.max((r - b) * (r + b), 0.0))


# ---- The way between two points, by Newton's method: the direction inside.


@wp.struct
class _Aim:
    u: wp.vec3  # unit direction at the point inside
    density: float  # see `Connection`; 0: there is no way


# It rises monotonically to the one root of a flat port: 3 steps at 15 degrees in air, 5 at 63; beyond the critical
# angle, where nearly all of the way is in a thin layer of air, up to about 12. After a step of this size, relative to
# the unknown, the error is its square.
_STEPS = wp.constant(16)
_LAST_STEP = wp.constant(1.0e-4)


@wp.func
def _aim_flat(port: Port, x: wp.vec3, o: wp.vec3) -> _Aim:
    """Unknown: t = k/sqrt(m^2 - k^2), k Snell's invariant and m the least index."""
    aim = _Aim()
    y = x - o
    along = wp.dot(y, port.normal)
    inside = port.distance - wp.dot(o, port.normal)
    h = wp.vec3(inside, port.thickness, along - inside - port.thickness)
    if h[0] <= 0.0 or h[2] <= 0.0:
        return aim
    across = y - along * port.normal
    aside = wp.length(across)
    n = port.index
    m = wp.min(n[0], wp.min(n[1], n[2]))
    t = aside / (m * (h[0] / n[0] + h[1] / n[1] + h[2] / n[2]))
    for _ in range(_STEPS):
        value = float(0.0)
        slope = float(0.0)
        for i in range(3):
            root = 1.0 / wp.sqrt(n[i] * n[i] + (n[i] - m) * (n[i] + m) * t * t)
            value += h[i] * root
            slope += h[i] * n[i] * n[i] * root * root * root
        step = (aside / m - t * value) / slope
        t += step
        if wp.abs(step) <= _LAST_STEP * t:
            break
    cos_m = 1.0 / wp.sqrt(1.0 + t * t)
    # d(Omega)/dA = k/(n_w^2 cos(theta_w) rho rho'(k)) on the port's plane; rho/k and rho' are sums of positive terms.
    ratio = float(0.0)
    slope = float(0.0)
    q = wp.vec3()  # n cos(theta)
    for i in range(3):
        q[i] = cos_m * wp.sqrt(n[i] * n[i] + (n[i] - m) * (n[i] + m) * t * t)
        ratio += h[i] / q[i]
        slope += h[i] * n[i] * n[i] / (q[i] * q[i] * q[i])
    aim.density = n[0] / (n[2] * q[0] * q[2] * ratio * slope)
    aim.u = (m * t * cos_m / (n[0] * wp.max(aside, 1.0e-30))) * across + (q[0] / n[0]) * port.normal
    return aim


@wp.func
def _turn(p: float, x: float) -> wp.vec2:
    """asin(p/x) and its derivative by p."""
    s = p / x
    return wp.vec2(wp.asin(s), 1.0 / (x * wp.sqrt(wp.max(1.0 - s * s, 1.0e-12))))


@wp.func
def _aim_dome(port: Port, x: wp.vec3, o: wp.vec3) -> _Aim:
    """Unknown: the angle i inside to the axis through o and the centre."""
    aim = _Aim()
    n = port.index
    inner = port.radius
    outer = port.radius + port.thickness
    y = x - port.centre
    r = wp.length(y)
    z = o - port.centre
    d = wp.length(z)
    if r <= outer or d >= inner:
        return aim
    to_x = y / r
    e = to_x
    if d > 1.0e-9:
        e = z / d
    cosine = wp.dot(e, to_x)
    if cosine < 0.0:  # the axis on the side of x, where no angle is near pi
        e = -e
        d = -d
        cosine = -cosine
    sine = wp.length(wp.cross(e, to_x))
    beta = wp.atan2(sine, cosine)
    i = wp.atan2(r * sine, r * cosine - d)
    slope = float(1.0)
    for _ in range(_STEPS):
        p = n[0] * d * wp.sin(i)
        t0 = _turn(p, n[0] * inner)
        t1 = _turn(p, n[1] * inner)
        t2 = _turn(p, n[1] * outer)
        t3 = _turn(p, n[2] * outer)
        t4 = _turn(p, n[2] * r)
        bend = (t1 - t0) + (t3 - t2) - t4
        slope = 1.0 + n[0] * d * wp.cos(i) * bend[1]
        step = (beta - i - bend[0]) / slope
        i += step
        if wp.abs(step) <= _LAST_STEP * i:
            break
    sin_i = wp.sin(i)
    aim.u = wp.cos(i) * e + sin_i / wp.max(sine, 1.0e-20) * (to_x - cosine * e)
    # sin(alpha) |d alpha/d beta|/(d^2 sin(beta) |cos i|) with alpha = asin(p/(n_w r)) put in.
    spread = 1.0 / slope
    if sine > 1.0e-12:
        spread = sin_i / sine
    water_out = _chord(r, n[0] * d * sin_i / n[2])
    aim.density = n[0] * n[0] * spread / (n[2] * n[2] * r * water_out * wp.abs(slope))
    return aim


def _make_ways(face: wp.Function, aim_at: wp.Function) -> tuple[wp.Function, ...]:
    """`connect`, `leave`, `enter` and `cosines` of a `PortKind`, by its faces."""

    @wp.func
    def cross(port: Port, x: wp.vec3, u: wp.vec3, inward: bool) -> PortRay:
        """A ray through both faces: x and u behind the second, length up to the first as `water`, to the second as
        `path`."""
        p = PortRay()
        p.u = u
        n = port.index
        q = wp.vec4()
        before = wp.where(inward, n[2], n[0])
        behind = wp.where(inward, n[0], n[2])
        first = face(port, x, u, inward, inward)
        m = wp.vec3(first[0], first[1], first[2])
        glass = refracted(u, m, before / n[1])
        if wp.length_sq(m) == 0.0 or wp.length_sq(glass) == 0.0:
            return p
        start = x + first[3] * u
        second = face(port, start, glass, not inward, inward)
        k = wp.vec3(second[0], second[1], second[2])
        v = refracted(glass, k, n[1] / behind)
        if wp.length_sq(k) == 0.0 or wp.length_sq(v) == 0.0:
            return p
        q[0] = before * wp.abs(wp.dot(u, m))
        q[1] = n[1] * wp.abs(wp.dot(glass, m))
        q[2] = n[1] * wp.abs(wp.dot(glass, k))
        q[3] = behind * wp.abs(wp.dot(v, k))
        p.cosines = wp.where(inward, wp.vec4(q[3], q[2], q[1], q[0]), q)
        p.x = start + second[3] * glass
        p.u = v
        p.water = first[3]
        p.path = second[3]
        p.transmission = transmission(wp.vec4(n[0], n[1], n[1], n[2]), p.cosines)
        return p

    @wp.func
    def leave(port: Port, x: wp.vec3, u: wp.vec3) -> PortRay:
        p = cross(port, x, u, True)
        length = -p.x[2] / p.u[2]
        wall = face(port, p.x, p.u, False, False)
        walled = wp.length_sq(wall) > 0.0 and length >= wall[3]
        if p.u[2] >= 0.0 or length <= 0.0 or walled:
            p.transmission = 0.0
        p.path = port.delay[0] * length + port.delay[1] * p.path
        p.x += length * p.u
        return p

    @wp.func
    def enter(port: Port, x: wp.vec3, u: wp.vec3) -> PortRay:
        p = cross(port, x, u, False)
        if p.water <= 0.0:
            p.transmission = 0.0
        p.path = port.delay[0] * p.water + port.delay[1] * p.path
        p.water = 0.0
        return p

    @wp.func
    def connect(port: Port, x: wp.vec3, o: wp.vec3) -> Connection:
        c = Connection()
        aim = aim_at(port, x, o)
        if aim.density <= 0.0:
            return c
        p = enter(port, o, aim.u)
        c.inside = -aim.u
        c.to_lens = -p.u
        c.water = face(port, x, c.to_lens, True, True)[3]
        c.exit = x + c.water * c.to_lens
        c.path = c.water + p.path
        c.transmission = p.transmission
        c.density = aim.density
        return c

    @wp.func
    def cosines(port: Port, x: wp.vec3, u: wp.vec3) -> wp.vec4:
        return cross(port, x, wp.where(wp.dot(u, port.normal) > 0.0, -u, u), True).cosines

    return connect, leave, enter, cosines


# ---- From where light seems to come, of a ray that goes straight on.


@wp.func
def _apparent_flat(port: Port, x: wp.vec3, o: wp.vec3, c: Connection) -> wp.vec3:
    """Where the ray of a connection from x to o meets the port's axis through o."""
    n = port.index
    q_water = -n[2] * wp.dot(c.to_lens, port.normal)
    q_inside = -n[0] * wp.dot(c.inside, port.normal)
    q_glass = wp.sqrt(n[1] * n[1] - n[0] * n[0] + q_inside * q_inside)
    inside = port.distance - wp.dot(o, port.normal)
    behind = inside * q_water / q_inside + port.thickness * q_water / q_glass
    return o + (inside + port.thickness - behind) * port.normal


@wp.func
def apparent_centre(port: Port) -> wp.vec3:
    """That of the lens's centre, of rays along the normal; of a dome, whose normal is 0, the centre itself: there rays
    hardly bend."""
    n = port.index
    behind = port.distance * n[2] / n[0] + port.thickness * n[2] / n[1]
    return (port.distance + port.thickness - behind) * port.normal


@wp.func
def _apparent_dome(port: Port, x: wp.vec3, o: wp.vec3, c: Connection) -> wp.vec3:
    """The point of the ray of a connection from x to o that is nearest to o."""
    return x + wp.dot(o - x, c.to_lens) * c.to_lens


# ---- Kinds of ports, as the transport kernels take them, and their parameters from lengths and indices.


# Stands for no bound.
_FAR = 1.0e6


class PortKind(NamedTuple):
    """A kind of port; its name identifies it in the kernel cache."""

    name: str  # "flat" or "dome"
    connect: wp.Function  # Warp function (port, x, o) -> Connection from x in the water to o inside
    leave: wp.Function
    """Warp function (port, x, u) -> PortRay of a ray from x in the water along u, up to the plane z = 0 inside; x may
    lie behind the port, on the ray as it goes straight on."""
    enter: wp.Function  # Warp function (port, x, u) -> PortRay of a ray from inside up to where it enters the water
    cosines: wp.Function
    """Warp function (port, x, u) -> vec4, `PortRay.cosines` of the ray through x in the water along u, on its way in or
    out."""
    apparent: wp.Function
    """Warp function (port, x, o, connection) -> the point from where the light of o seems to come at x [m]."""


FLAT_PORT = PortKind("flat", *_make_ways(_plane_face, _aim_flat), _apparent_flat)
"""A plane window, or a calm surface without one."""

DOME_PORT = PortKind("dome", *_make_ways(_sphere_face, _aim_dome), _apparent_dome)
"""A spherical window."""


def make_flat_port(
    *,
    distance: float,
    thickness: float = 0.0,
    normal: Sequence[float] = (0.0, 0.0, 1.0),
    index: Sequence[float],
    group_index: Sequence[float],
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    aperture_radius: float = 0.0,
    largest_angle: float = 1.5,
    sea: Any = None,
) -> Port:
    """The parameters of a plane window.

    Args:
        distance: From the camera's lens centre along the normal to the inner face [m].
        thickness: Of the window [m], >= 0.
        normal: Unit vector into the water.
        index, group_index: Of what is inside, of the window, of the water; >= 1.
        origin: The lens centre, or the position of a laser, which must be inside [m].
        aperture_radius: Of the camera [m]: all of the lens must be inside.
        largest_angle: Between the normal and any ray of the view, inside, in [0, pi/2) [rad].
        sea: The surface of a sea, see `make_sea`, if the port is its mean plane; all of the lens must be farther away
            than its waves are high.

    Raises:
        ArgumentError: A number out of its range.
    """
    check.number("distance", distance, "(-inf, inf)")
    check.vector("normal", normal, unit=True)
    if sea is not None and not hasattr(sea, "waves"):
        raise ArgumentError(f"sea = {sea!r} is not the surface of a sea")
    port = _port(thickness, index, group_index, origin, aperture_radius, largest_angle)
    tilt = aperture_radius * math.hypot(normal[0], normal[1])
    inside = distance - sum(x * n for x, n in zip(origin, normal, strict=True))
    amplitude = 0.0 if sea is None else max(sea.waves.high, -sea.waves.low)
    if tilt >= inside - amplitude:
        waves = f", whose waves are up to {amplitude:.3g} m high" if amplitude > 0.0 else ""
        raise ArgumentError(
            f"distance = {distance} m: a lens or laser at {tuple(origin)} m of radius {aperture_radius} m reaches "
            f"through the port{waves}"
        )
    n = tuple(port.index)
    slopes = [_slopes(n[0], n[k], largest_angle) for k in (1, 2)]
    fill(port, normal=normal, distance=distance, glass_slope=slopes[0], water_slope=slopes[1])
    tangent = max(1.0, slopes[0][1]) * math.tan(largest_angle)  # the largest inside and in the window
    longest = min(math.hypot(1.0, tangent), _FAR)
    _set_times(port, ((inside - tilt, (inside + tilt) * longest), (thickness, thickness * longest)))
    if sea is not None:
        # Facets about waves hold no more than all slopes do; together with the steepest wave that is a bound.
        deviation = math.sqrt(0.5) * max(*sea.spread)
        _widen(port, _STEEPEST * deviation + sea.waves.steepest, largest_angle)
    if sea is not None and index[2] <= index[0]:
        port.early = port.late = 0.0  # water behind it is seen straight on
    elif amplitude > 0.0:
        between = 2.0 * amplitude / max(math.cos(largest_angle), 0.02)
        port.amplitude, port.straight = amplitude, between * math.sin(largest_angle)
        port.early, port.late = port.early + 2.0 * between, port.late + 2.0 * between
    return port


def make_dome_port(
    *,
    radius: float,
    thickness: float,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    index: Sequence[float],
    group_index: Sequence[float],
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    aperture_radius: float = 0.0,
    largest_angle: float = 1.5,
) -> Port:
    """The parameters of a spherical window.

    Args:
        radius: Of the inner sphere [m], > 0.
        centre: Of the spheres, from the camera's lens centre [m].
        thickness, index, group_index, origin, aperture_radius: As for `make_flat_port`.
        largest_angle: Between the optical axis and any ray of the view, inside, in [0, pi/2) [rad].

    Raises:
        ArgumentError: A number out of its range, or a lens so far from the centre that some of its light could not get
            through.
    """
    check.number("radius", radius, "(0, 1e9]")
    check.vector("centre", centre)
    port = _port(thickness, index, group_index, origin, aperture_radius, largest_angle)
    n = tuple(fill(port, radius=radius, centre=centre).index)
    furthest = math.dist(centre, origin) + aperture_radius
    if not furthest < min(1.0, n[1] / n[0], n[2] / n[0] * (1.0 + thickness / radius)) * radius:
        raise ArgumentError(
            f"centre = {tuple(centre)} m: a lens or laser reaches {furthest:g} m from it, too far for a dome of radius "
            f"{radius} m"
        )
    p, outer = np.linspace(0.0, n[0] * furthest, 257), radius + thickness
    angle = [np.arcsin(p / x) for x in (n[0] * radius, n[1] * radius, n[1] * outer, n[2] * outer)]
    turn = float(np.abs(angle[1] - angle[0] + angle[3] - angle[2]).max())
    widest = largest_angle + turn
    port.turn = math.sin(turn) / math.cos(widest) if widest < 1.57 else _FAR
    port.aside = max(1.0, n[0] / n[2]) * furthest
    b = n[0] * furthest / n[1]
    oblique = math.sqrt(outer**2 - b**2) - math.sqrt(radius**2 - b**2)
    _set_times(port, ((radius - furthest, radius + furthest), (thickness, oblique)))
    return port


def check_port(name: str, port: Port, kind: PortKind) -> None:
    """Parameters of a port of that kind; raises `ArgumentError`."""
    flat, dome = {"distance": "(-inf, inf)", "normal": "unit"}, {"radius": "(0, inf)", "centre": "(-inf, inf)"}
    check.fields(name, port, {"index": "[1, inf)"} | (flat if kind.name == FLAT_PORT.name else dome))


def _port(
    thickness: float,
    index: Sequence[float],
    group_index: Sequence[float],
    origin: Sequence[float],
    aperture_radius: float,
    largest_angle: float,
) -> Port:
    """What both kinds have, whose numbers are in range."""
    check.vector("origin", origin)
    check.within("[0, 1e9]", thickness=thickness, aperture_radius=aperture_radius)
    for name, values in (("index", index), ("group_index", group_index)):
        check.vector(name, values)
        for k, value in enumerate(values):
            check.number(f"{name}[{k}]", value, "[1, inf)")
    check.number("largest_angle", largest_angle, "[0, 1.5707963]")
    # A window without thickness has no faces, and must not be the layer of the least index.
    index = (index[0], index[1] if thickness > 0.0 else index[0], index[2])
    delay = (group_index[0] / group_index[2], group_index[1] / group_index[2])
    return fill(Port(), thickness=thickness, index=index, delay=delay)


def _slopes(inside: float, layer: float, angle: float) -> tuple[float, float]:
    """Least and largest tan(theta_layer)/tan(theta_inside) of rays within an angle of the normal; rising or falling."""
    rest = layer**2 - (inside * math.sin(angle)) ** 2
    oblique = inside * math.cos(angle) / math.sqrt(rest) if rest > 0.0 else _FAR
    return min(inside / layer, oblique), max(inside / layer, oblique)


def _set_times(port: Port, lengths: Sequence[tuple[float, float]]) -> None:
    """Bounds of a way's time, from the least and largest lengths in the layers: the ray is no shorter than the straight
    line, and by Fermat's principle its optical length is not longer."""
    early, late = 0.0, 0.0
    for k, (least, largest) in enumerate(lengths):
        delay, ratio = port.delay[k], port.index[k] / port.index[2]
        early += max(1.0 - delay, 0.0) * largest
        late += (ratio - 1.0) * (least if ratio < 1.0 else largest)
        late += (delay - ratio) * (least if delay < ratio else largest)
    port.early, port.late = early, late


# Slopes that the view is made wide enough for, in standard deviations: the others hold 3e-7 of the light.
_STEEPEST = 5.5


def _widen(port: Port, steepest: float, largest_angle: float) -> None:
    """Fills what of a port, the mean plane of a sea as seen from the air, allows for slopes up to the steepest:
    `margin`, and times. `largest_angle`: as for `make_flat_port`."""
    ratio = port.index[2] / port.index[0]
    if ratio <= 1.0 or steepest == 0.0:
        return
    angles = np.linspace(-largest_angle, largest_angle, 61)[:, None, None]
    turn = np.linspace(0.0, math.pi, 25)[:, None]
    slopes = steepest * np.linspace(0.0, 1.0, 25)
    u = np.stack(np.broadcast_arrays(np.sin(angles), 0.0, -np.cos(angles)), axis=-1)
    m = np.stack(np.broadcast_arrays(-slopes * np.cos(turn), -slopes * np.sin(turn), 1.0), axis=-1)
    m = m / np.linalg.norm(m, axis=-1, keepdims=True)
    cosine = -(u * m).sum(axis=-1, keepdims=True)
    across = (u + cosine * m) / ratio
    behind = across - np.sqrt(1.0 - (across * across).sum(axis=-1, keepdims=True)) * m
    flat = u[..., :2] / np.sqrt(ratio**2 - (u[..., :2] ** 2).sum(axis=-1, keepdims=True))
    seen = (cosine[..., 0] > 0.0) & (behind[..., 2] < -0.05)
    aside = np.linalg.norm(behind[..., :2] / np.maximum(-behind[..., 2:], 0.05) - flat, axis=-1)
    port.margin = float(np.where(seen, aside, 0.0).max())
    bend = np.where(seen, (behind * u).sum(axis=-1), 1.0).min()
    longest = port.distance / max(math.cos(largest_angle), 0.02)
    port.late += float(1.0 - bend) * longest
