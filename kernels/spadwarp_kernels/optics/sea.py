"""The surface of the sea: facets with Gaussian slopes about a mean plane between air and water, and the ways of light
by them.

Slopes after Cox & Munk 1954, masking after Smith 1967, reflection and refraction by rough interfaces after Walter et
al. 2007. Directions of light are those in which it goes; densities are of power.
"""

import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from spadwarp_kernels.base.arguments import check_number, check_range, check_vector
from spadwarp_kernels.base.philox import begin_sequence, sequence_word, step_sequence, u01, u01_fine, u01_open
from spadwarp_kernels.base.rotations import cos_sin_turn
from spadwarp_kernels.water.limits import fresnel_reflectance

from .port import Port, connect_flat, refracted

__all__ = ["Sea", "make_sea", "slope_variances"]

_INV_PI = wp.constant(0.3183098861837907)
_INV_SQRT_PI = wp.constant(0.5641895835477563)

# A way to the lens is drawn from slopes of the surface's own width, and in this part of the draws from wider ones, by
# this factor, which keeps the weights of oblique ways small.
_WIDE_PART = wp.constant(0.1)
_WIDE = wp.constant(3.0)


@wp.struct
class Sea:
    """The surface in the frame of the camera, made by `make_sea`; above it is air."""

    normal: wp.vec3  # unit vector of the mean plane, upwards
    height: float  # of the mean plane, x·normal of its points [m]
    along: wp.vec3  # unit vector in the plane in which the wind blows
    slope: wp.vec2
    """Along and across the wind the width of the distribution exp(-s^2/width^2) of slopes s, sqrt(2) standard
    deviations; 0 is flat."""
    index: float  # phase index of the water over that of the air
    delay: float  # group index of the air over that of the water
    extinction: float  # of the air [1/m]; what it takes is absorbed


@wp.func
def height_above(sea: Sea, x: wp.vec3) -> float:
    """Height of a point above the mean plane [m]."""
    return wp.dot(x, sea.normal) - sea.height


@wp.func
def surface_distance(sea: Sea, x: wp.vec3, u: wp.vec3, above: bool) -> float:
    """Length of the flight from x along u to the mean plane [m], 1e30 if it leads away from it."""
    climb = wp.dot(u, sea.normal)
    toward = wp.where(above, climb < 0.0, climb > 0.0)
    return wp.where(toward, wp.max(-height_above(sea, x) / climb, 0.0), 1.0e30)


# ---- Facets. Vectors in the frame of the plane: along and across the wind, and its normal on the side of the light.


@wp.func
def _to_plane(sea: Sea, side: float, v: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.dot(v, sea.along), wp.dot(v, wp.cross(sea.normal, sea.along)), side * wp.dot(v, sea.normal))


@wp.func
def _from_plane(sea: Sea, side: float, v: wp.vec3) -> wp.vec3:
    return v[0] * sea.along + v[1] * wp.cross(sea.normal, sea.along) + (side * v[2]) * sea.normal


@wp.func
def _cotangent(sea: Sea, v: wp.vec3) -> float:
    """Of the angle of v to the normal, over the width of the slopes in its azimuth."""
    x = sea.slope[0] * v[0]
    y = sea.slope[1] * v[1]
    return wp.abs(v[2]) / wp.max(wp.sqrt(x * x + y * y), 1.0e-12)


@wp.func
def _unmasked(sea: Sea, v: wp.vec3) -> float:
    """Smith's G1: the part of the facets that face the direction v which others do not hide from it."""
    a = wp.max(_cotangent(sea, v), 1.0e-6)
    if a > 4.0:
        return 1.0
    return 1.0 / (0.5 + 0.5 * (wp.exp(-a * a) * _INV_SQRT_PI / a + wp.erf(a)))


@wp.func
def _facet_density(sea: Sea, m: wp.vec3) -> float:
    """Beckmann's D(m), density of facet normals [1/sr]: the integral of D cos(theta_m) over the hemisphere is 1."""
    if m[2] <= 0.0:
        return 0.0
    p = m[0] / (m[2] * sea.slope[0])
    q = m[1] / (m[2] * sea.slope[1])
    cos2 = m[2] * m[2]
    return _INV_PI * wp.exp(-p * p - q * q) / (sea.slope[0] * sea.slope[1] * cos2 * cos2)


@wp.func
def _visible_slope(a: float, xi: float) -> float:
    """A slope s from the density max(0, a - s) exp(-s^2), a > 0, for uniform xi in (0, 1): by Newton's method within a
    bracket, in its distribution function."""
    low = float(-5.5)
    high = float(wp.min(a, 5.5))
    scale = 1.0 / wp.max(a, 1.0)
    first = a * scale
    second = scale * _INV_SQRT_PI
    target = xi * (first * wp.erfc(-high) + second * wp.exp(-high * high))
    s = float(wp.min(0.0, 0.5 * (low + high)))
    for _ in range(40):
        bell = wp.exp(-s * s)
        excess = first * wp.erfc(-s) + second * bell - target
        if excess > 0.0:
            high = s
        else:
            low = s
        step = excess / wp.max(2.0 * (first - s * scale) * _INV_SQRT_PI * bell, 1.0e-30)
        after = s - step
        if after <= low or after >= high:
            after = 0.5 * (low + high)
        change = wp.abs(after - s)
        s = after
        if change < 2.0e-6:
            break
    return s


@wp.func
def sample_facet(sea: Sea, i: wp.vec3, xi1: float, xi2: float) -> wp.vec3:
    """The normal m of a facet that the direction i sees, in the frame of the plane, with the density D_i(m) =
    G1(i) max(0, i·m) D(m)/|i·n| [1/sr], for uniform xi1, xi2 in (0, 1)."""
    x = sea.slope[0] * i[0]
    y = sea.slope[1] * i[1]
    length = wp.sqrt(x * x + y * y)
    toward = wp.vec2(1.0, 0.0)
    if length > 1.0e-12:
        toward = wp.vec2(x / length, y / length)
    s = _visible_slope(wp.max(wp.abs(i[2]) / wp.max(length, 1.0e-12), 1.0e-6), xi1)
    t = wp.erfinv(wp.clamp(2.0 * xi2 - 1.0, -0.9999999, 0.9999999))
    p = sea.slope[0] * (s * toward[0] - t * toward[1])
    q = sea.slope[1] * (s * toward[1] + t * toward[0])
    return wp.normalize(wp.vec3(-p, -q, 1.0))


@wp.struct
class SeaPassage:
    """What becomes of light at a facet."""

    u: wp.vec3  # its new direction
    part: float  # of the light that leaves the surface; other facets mask the rest
    reflected: bool


@wp.func
def sample_passage(sea: Sea, u: wp.vec3, above: bool, random: wp.vec4ui) -> SeaPassage:
    """Light that comes along u from the air (`above`) or the water is reflected or refracted by a facet that it sees,
    by the chance of Fresnel's equations."""
    passage = SeaPassage()
    side = wp.where(above, 1.0, -1.0)
    ratio = wp.where(above, sea.index, 1.0 / sea.index)  # behind over before
    i = _to_plane(sea, side, -u)
    i = wp.vec3(i[0], i[1], wp.max(i[2], 1.0e-9))
    m = wp.vec3(0.0, 0.0, 1.0)
    if sea.slope[0] > 0.0:
        m = sample_facet(sea, i, u01_open(random[0]), u01_open(random[1]))
    cosine = wp.clamp(wp.dot(i, m), 0.0, 1.0)
    passage.reflected = u01_fine(random[2]) <= fresnel_reflectance(cosine, ratio)
    o = 2.0 * cosine * m - i
    if not passage.reflected:
        o = refracted(-i, m, 1.0 / ratio)
    leaves = wp.where(passage.reflected, o[2] > 0.0, o[2] < 0.0)
    if leaves:
        passage.part = 1.0
        if sea.slope[0] > 0.0:
            passage.part = _unmasked(sea, o)
    passage.u = wp.normalize(_from_plane(sea, side, o))
    return passage


@wp.func
def passage_density(sea: Sea, u: wp.vec3, v: wp.vec3) -> float:
    """Density [1/sr] of the light that the surface sends along v, of light that comes along u: reflected if both lie on
    one side of the mean plane, else transmitted; 0 for a flat surface. Its integral over the sphere is the part that
    is not masked."""
    if sea.slope[0] <= 0.0:
        return 0.0
    above = wp.dot(u, sea.normal) < 0.0
    side = wp.where(above, 1.0, -1.0)
    i = _to_plane(sea, side, -u)
    o = _to_plane(sea, side, v)
    ratio = wp.where(above, sea.index, 1.0 / sea.index)
    if i[2] <= 0.0:
        return 0.0
    shared = _unmasked(sea, i) * _unmasked(sea, o) / i[2]
    if o[2] > 0.0:
        m = wp.normalize(i + o)
        return 0.25 * fresnel_reflectance(wp.min(wp.dot(i, m), 1.0), ratio) * _facet_density(sea, m) * shared
    between = i + ratio * o
    m = wp.normalize(wp.where(above, -between, between))
    before = wp.dot(i, m)
    behind = wp.dot(o, m)
    if before <= 0.0 or behind >= 0.0:
        return 0.0
    # n_o^2 |o·m|/(n_i i·m + n_o o·m)^2, over n_i^2: the denominator is the squared length of `between`.
    spread = ratio * ratio * wp.abs(behind) / wp.dot(between, between)
    return (1.0 - fresnel_reflectance(wp.min(before, 1.0), ratio)) * before * _facet_density(sea, m) * spread * shared


# ---- The way of light through the surface from a point to the lens.


@wp.struct
class SeaConnection:
    """A way from a point on one side of the surface to one on the other, by a point S of the mean plane that was drawn;
    or by that of the flat surface, the only one there is."""

    to_surface: wp.vec3  # unit direction at the point
    inside: wp.vec3  # unit direction from S to the other point
    surface: wp.vec3  # S [m]
    before: float  # length of the way up to S [m]
    behind: float  # and from there on [m]
    density: float
    """What arrives of an intensity of 1 in that direction, per area across the ray and without extinction, over the
    density of the draw [sr/m^2]; 0: nothing."""


@wp.func
def connect_sea(sea: Sea, port: Port, x: wp.vec3, o: wp.vec3, seed: wp.uint64) -> SeaConnection:
    """A way from x to o on the other side, which the port describes: the mean plane as o sees it. `seed`: 64 random
    bits.

    S is drawn around the flat surface's from the distribution of slopes: a slope moves it, to first order, by the slope
    over J in the plane of incidence and across it.
    """
    c = SeaConnection()
    flat = connect_flat(port, x, o)
    if flat.density <= 0.0:
        return c
    c.to_surface = flat.to_port
    c.inside = flat.inside
    c.surface = flat.exit
    c.before = flat.water
    c.behind = wp.length(o - flat.exit)
    c.density = flat.transmission * flat.density
    if sea.slope[0] <= 0.0:
        return c
    n = port.index
    cos_x = -wp.dot(flat.to_port, port.normal)
    cos_o = -wp.dot(flat.inside, port.normal)
    gap = wp.abs(n[2] * cos_x - n[0] * cos_o)
    across_j = (n[2] / c.before + n[0] / c.behind) / gap
    in_j = (n[2] * cos_x * cos_x / c.before + n[0] * cos_o * cos_o / c.behind) / gap
    state = step_sequence(begin_sequence(seed))
    wide = wp.where(u01(sequence_word(state)) < _WIDE_PART, _WIDE, 1.0)
    state = step_sequence(state)
    r = wide * wp.sqrt(-wp.log(u01_open(sequence_word(state))))
    state = step_sequence(state)
    turn = cos_sin_turn(u01(sequence_word(state)))
    slope = (r * sea.slope[0] * turn[0]) * sea.along + (r * sea.slope[1] * turn[1]) * wp.cross(sea.normal, sea.along)
    plane = flat.to_port + cos_x * port.normal  # along the plane of incidence
    length = wp.length(plane)
    plane = wp.where(length > 1.0e-6, plane / wp.max(length, 1.0e-6), sea.along)
    across = wp.cross(port.normal, plane)
    s = flat.exit + (wp.dot(slope, plane) / in_j) * plane + (wp.dot(slope, across) / across_j) * across
    c.surface = s
    to_s = s - x
    to_o = o - s
    c.before = wp.length(to_s)
    c.behind = wp.length(to_o)
    c.to_surface = to_s / c.before
    c.inside = to_o / c.behind
    r2 = r * r
    drawn = (1.0 - _WIDE_PART) * wp.exp(-r2) + _WIDE_PART / (_WIDE * _WIDE) * wp.exp(-r2 / (_WIDE * _WIDE))
    drawn *= in_j * across_j * _INV_PI / (sea.slope[0] * sea.slope[1])  # density of S [1/m^2]
    cosine = wp.abs(wp.dot(c.to_surface, port.normal))
    area = c.before * c.before * c.behind * c.behind
    c.density = passage_density(sea, c.to_surface, c.inside) * cosine / (area * wp.max(drawn, 1.0e-30))
    return c


# ---- Parameters.


def slope_variances(wind: float, *, by_direction: bool = False) -> tuple[float, float]:
    """Variances of the slopes along and across the wind (Cox & Munk 1954, clean surface), at a wind speed of 0 ... 30
    m/s at 12.5 m above the sea; evenly distributed unless `by_direction`. Raises `ArgumentError`."""
    check_number("wind", wind, "[0, 30]")
    if by_direction:
        return 3.16e-3 * wind, 0.003 + 1.92e-3 * wind
    even = 0.5 * (0.003 + 5.12e-3 * wind)
    return even, even


def make_sea(
    variances: Sequence[float],
    *,
    index: float,
    normal: Sequence[float],
    height: float,
    along: Sequence[float] | None = None,
    delay: float = 1.0,
    extinction: float = 0.0,
) -> Sea:
    """The surface of the sea.

    Args:
        variances: Of the slopes along and across the wind, see `slope_variances`; both 0 for a flat surface.
        index: Phase index of the water over that of the air, > 1.
        normal: Unit vector of the mean plane, upwards.
        height: Of the mean plane, x·normal of its points [m].
        along: Direction in which the wind blows, of any length, not along the normal.
        delay: Group index of the air over that of the water.
        extinction: Of the air [1/m].

    Raises:
        ArgumentError: A number out of its range.
    """
    check_vector("variances", variances, size=2)
    for k, variance in enumerate(variances):
        check_number(f"variances[{k}]", variance, "[0, 0.5]" if not any(variances) else "[1e-9, 0.5]")
    check_vector("normal", normal, unit=True)
    check_number("index", index, "(1, 4]")
    check_range("[0, 1e9]", extinction=extinction)
    check_number("height", height, "(-inf, inf)")
    check_number("delay", delay, "(0, 4]")
    up = np.array(normal, np.float64)
    wind = np.eye(3)[np.argmin(np.abs(up))] if along is None else np.array(along, np.float64)
    check_vector("along", wind.tolist())
    level = wind - (wind @ up) * up
    check_number("length of along in the plane", float(np.linalg.norm(level)), "(0, inf)")
    sea = Sea()
    sea.normal, sea.height, sea.along = wp.vec3(*normal), height, wp.vec3(*(level / np.linalg.norm(level)))
    sea.slope = wp.vec2(*(math.sqrt(2.0 * variance) for variance in variances))
    sea.index, sea.delay, sea.extinction = index, delay, extinction
    return sea
