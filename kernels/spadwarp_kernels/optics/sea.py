"""The surface of the sea: facets with Gaussian slopes between air and water, about a mean plane or about waves, a
periodic height field above it; and the ways of light by them.

Slopes after Cox & Munk 1954, masking after Smith 1967, reflection and refraction by rough interfaces after Walter et
al. 2007. Directions of light are those in which it goes; densities are of power. What is on which side of waves is
decided by the one who asks: rounding leaves points that were put on them a little above or below.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.native import fill
from spadwarp_kernels.base.philox import begin_sequence, sequence_word, step_sequence, u01, u01_fine, u01_open
from spadwarp_kernels.base.rotations import cos_sin_turn
from spadwarp_kernels.water.limits import fresnel_reflectance

from .port import FLAT_PORT, Connection, Port, refracted

__all__ = ["FACETS", "WAVES", "Sea", "SeaKind", "Waves", "make_sea", "see_through_waves_kernel", "slope_variances"]

_INV_PI = wp.constant(0.3183098861837907)
_INV_SQRT_PI = wp.constant(0.5641895835477563)

# A way to the lens is drawn from slopes of the surface's own width, and in this part of the draws from wider ones, by
# this factor, which keeps the weights of oblique ways small.
_WIDE_PART = wp.constant(0.1)
_WIDE = wp.constant(3.0)


# Cells that a ray is followed through; a flight within the slab of the waves that is longer meets none.
_MOST_CELLS = wp.constant(65536)
_NOWHERE = wp.constant(1.0e30)

connect_flat = FLAT_PORT.connect


@wp.struct
class Waves:
    """A height field over the mean plane of a sea, in the frame of the camera; made by `make_sea`."""

    heights: wp.array2d[float]  # of the nodes above the mean plane [m], along the rows' and the columns' direction
    cell: wp.vec2  # distance of the nodes of a row, and of the rows [m]
    low: float  # bounds of the heights, with a margin for rounding [m]
    high: float
    steepest: float  # bound of the slopes
    normal: wp.vec3  # of the mean plane, upwards
    origin: wp.vec3  # the point of the mean plane at the first node [m]
    columns: wp.vec3  # unit vector in the plane along a row
    rows: wp.vec3  # and from row to row


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
    spread_along: wp.vec3  # of all slopes, with those of resolved waves: as `along`
    spread: wp.vec2  # and as `slope`
    waves: Waves  # of a surface with resolved waves, see `WAVES`; its facets are then about those, else about the plane


@wp.func
def _height_above(sea: Sea, x: wp.vec3) -> float:
    return wp.dot(x, sea.normal) - sea.height


@wp.func
def _is_above_plane(sea: Sea, x: wp.vec3) -> bool:
    return _height_above(sea, x) > 0.0


@wp.func
def _plane_distance(sea: Sea, x: wp.vec3, u: wp.vec3, above: bool, limit: float) -> float:
    climb = wp.dot(u, sea.normal)
    toward = wp.where(above, climb < 0.0, climb > 0.0)
    return wp.where(toward, wp.max(-_height_above(sea, x) / climb, 0.0), 1.0e30)


# ---- Resolved waves. Between its nodes the field is bilinear.


@wp.struct
class Facet:
    """The field about a point: its height above the mean plane there [m], and its slopes along `columns` and `rows`."""

    height: float
    slope: wp.vec2


@wp.func
def _wrapped(k: int, count: int) -> int:
    """A number of a node within the period."""
    r = k % count
    return wp.where(r < 0, r + count, r)


@wp.func
def _next(k: int, count: int) -> int:
    return wp.where(k + 1 == count, 0, k + 1)


@wp.func
def _after(k: int, toward: float, count: int) -> int:
    return wp.where(toward > 0.0, _next(k, count), wp.where(k == 0, count, k) - 1)


@wp.func
def _corners(waves: Waves, row: int, column: int) -> wp.vec4:
    """Of a cell within the period, as the polynomial of a and b in [0, 1] along columns and rows: of 1, a, b and
    a b."""
    row_after = _next(row, waves.heights.shape[0])
    column_after = _next(column, waves.heights.shape[1])
    h = waves.heights[row, column]
    right = waves.heights[row, column_after] - h
    below = waves.heights[row_after, column] - h
    return wp.vec4(h, right, below, waves.heights[row_after, column_after] - h - right - below)


@wp.func
def _in_cells(waves: Waves, v: wp.vec3) -> wp.vec2:
    return wp.vec2(wp.dot(v, waves.columns) / waves.cell[0], wp.dot(v, waves.rows) / waves.cell[1])


@wp.func
def facet_at(waves: Waves, x: wp.vec3) -> Facet:
    """The field above or below a point."""
    p = _in_cells(waves, x - waves.origin)
    column = wp.floor(p[0])
    row = wp.floor(p[1])
    a = p[0] - column
    b = p[1] - row
    k = _corners(waves, _wrapped(int(row), waves.heights.shape[0]), _wrapped(int(column), waves.heights.shape[1]))
    facet = Facet()
    facet.height = k[0] + k[1] * a + k[2] * b + k[3] * a * b
    facet.slope = wp.vec2((k[1] + k[3] * b) / waves.cell[0], (k[2] + k[3] * a) / waves.cell[1])
    return facet


@wp.func
def is_above_waves(sea: Sea, x: wp.vec3) -> bool:
    """Whether a point is above the field."""
    waves = sea.waves
    z = wp.dot(x - waves.origin, waves.normal)
    above = z > waves.high
    if z >= waves.low and not above:
        above = z > facet_at(waves, x).height
    return above


@wp.func
def _first_rise(g0: float, g1: float, g2: float) -> float:
    """The first s >= 0 at which g0 + g1 s + g2 s^2 rises through 0; 0 if it is positive and rises; else -1."""
    if g0 > 0.0 and g1 > 0.0:
        return 0.0
    root = g1 * g1 - 4.0 * g2 * g0
    if root < 0.0:
        return -1.0
    root = wp.sqrt(root)
    if g1 > 0.0:
        return -2.0 * g0 / (g1 + root)
    if g2 > 0.0:
        return 0.5 * (root - g1) / g2
    return -1.0


@wp.func
def waves_distance(sea: Sea, x: wp.vec3, u: wp.vec3, above: bool, limit: float) -> float:
    """Length of the flight from x along u to where it leaves its side of the field, `above` or below it [m]; 1e30 if
    that is farther than the limit. 0 at a point beyond the field, by rounding, that leads farther away."""
    waves = sea.waves
    z = wp.dot(x - waves.origin, waves.normal)
    climb = wp.dot(u, waves.normal)
    side = wp.where(above, -1.0, 1.0)  # times the height: positive on the wrong side
    if side * climb < 0.0 and climb * climb > 1.001 * waves.steepest * waves.steepest * (1.0 - climb * climb):
        return _NOWHERE  # no wave is as steep
    # The part of the flight between the planes that hold the waves.
    begin = float(0.0)
    end = float(limit)
    flat = wp.abs(climb) < 1.0e-12
    to_low = (waves.low - z) / wp.where(flat, 1.0, climb)
    to_high = (waves.high - z) / wp.where(flat, 1.0, climb)
    if flat:
        if z < waves.low or z > waves.high:
            return _NOWHERE
    else:
        begin = wp.max(wp.min(to_low, to_high), 0.0)
        end = wp.min(wp.max(to_low, to_high), limit)
    if begin > end:
        return _NOWHERE
    p = _in_cells(waves, x - waves.origin)
    d = _in_cells(waves, u)
    column = wp.floor(p[0] + begin * d[0])
    row = wp.floor(p[1] + begin * d[1])
    i = _wrapped(int(row), waves.heights.shape[0])
    j = _wrapped(int(column), waves.heights.shape[1])
    t = begin
    for _ in range(_MOST_CELLS):
        to_column = float(_NOWHERE)
        if wp.abs(d[0]) > 1.0e-12:
            to_column = (column + wp.where(d[0] > 0.0, 1.0, 0.0) - p[0]) / d[0]
        to_row = float(_NOWHERE)
        if wp.abs(d[1]) > 1.0e-12:
            to_row = (row + wp.where(d[1] > 0.0, 1.0, 0.0) - p[1]) / d[1]
        leave = wp.max(wp.min(wp.min(to_column, to_row), end), t)
        k = _corners(waves, i, j)
        a = p[0] + t * d[0] - column
        b = p[1] + t * d[1] - row
        value = z + t * climb - (k[0] + k[1] * a + k[2] * b + k[3] * a * b)
        rise = climb - (k[1] + k[3] * b) * d[0] - (k[2] + k[3] * a) * d[1]
        s = _first_rise(side * value, side * rise, -side * k[3] * d[0] * d[1])
        if s >= 0.0 and s <= leave - t:
            return t + s
        if leave >= end:
            return _NOWHERE
        if to_column <= to_row:
            column += wp.sign(d[0])
            j = _after(j, d[0], waves.heights.shape[1])
        else:
            row += wp.sign(d[1])
            i = _after(i, d[1], waves.heights.shape[0])
        t = leave
    return _NOWHERE


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


@wp.func
def _draw_point(
    port: Port, flat: Connection, behind: float, up: wp.vec3, along: wp.vec3, width: wp.vec2, seed: wp.uint64
) -> wp.vec4:
    """A point S of the mean plane by which light may go, and its density [1/m^2], drawn around that of the flat
    surface, `behind` m before the end of the way, from a distribution of slopes: a slope moves it, to first order, by
    the slope over J in the plane of incidence and across it."""
    n = port.index
    cos_x = -wp.dot(flat.to_lens, port.normal)
    cos_o = -wp.dot(flat.inside, port.normal)
    gap = wp.abs(n[2] * cos_x - n[0] * cos_o)
    across_j = (n[2] / flat.water + n[0] / behind) / gap
    in_j = (n[2] * cos_x * cos_x / flat.water + n[0] * cos_o * cos_o / behind) / gap
    state = step_sequence(begin_sequence(seed))
    wide = wp.where(u01(sequence_word(state)) < _WIDE_PART, _WIDE, 1.0)
    state = step_sequence(state)
    r = wide * wp.sqrt(-wp.log(u01_open(sequence_word(state))))
    state = step_sequence(state)
    turn = cos_sin_turn(u01(sequence_word(state)))
    slope = (r * width[0] * turn[0]) * along + (r * width[1] * turn[1]) * wp.cross(up, along)
    plane = flat.to_lens + cos_x * port.normal  # along the plane of incidence
    length = wp.length(plane)
    plane = wp.where(length > 1.0e-6, plane / wp.max(length, 1.0e-6), along)
    across = wp.cross(port.normal, plane)
    s = flat.exit + (wp.dot(slope, plane) / in_j) * plane + (wp.dot(slope, across) / across_j) * across
    r2 = r * r
    drawn = (1.0 - _WIDE_PART) * wp.exp(-r2) + _WIDE_PART / (_WIDE * _WIDE) * wp.exp(-r2 / (_WIDE * _WIDE))
    drawn *= in_j * across_j * _INV_PI / (width[0] * width[1])
    return wp.vec4(s[0], s[1], s[2], drawn)


@wp.func
def facet_normal(waves: Waves, slope: wp.vec2) -> wp.vec3:
    """Unit normal of a facet, upwards."""
    return wp.normalize(waves.normal - slope[0] * waves.columns - slope[1] * waves.rows)


@wp.func
def _tilted(sea: Sea, facet: Facet) -> Sea:
    """The surface at a point of the waves, as that of their facet there."""
    normal = facet_normal(sea.waves, facet.slope)
    local = sea
    local.normal = normal
    local.along = wp.normalize(sea.along - wp.dot(sea.along, normal) * normal)
    return local


def _make_connect(waves: bool) -> wp.Function:
    """`SeaKind.connect`. By waves S is drawn about the flat surface at their height near it, and put on them."""

    @wp.func
    def connect(sea: Sea, port: Port, x: wp.vec3, o: wp.vec3, seed: wp.uint64) -> Connection:
        below = wp.dot(port.normal, sea.normal) < 0.0  # x is
        side = wp.where(below, -1.0, 1.0)
        plane = port
        near = bool(False)
        if wp.static(waves):
            # The flat surface above or below x, by which there is a way; of an x that is far from waves the mean plane.
            depth = wp.dot(x, port.normal) - port.distance
            near = depth < wp.max(sea.waves.high, -sea.waves.low)
            if near:
                plane.distance += side * facet_at(sea.waves, x).height
        c = connect_flat(plane, x, o)
        if c.density <= 0.0 or sea.spread[0] <= 0.0:
            return c
        if wp.static(waves):
            far = not near
            if far:
                # And from there on to the height of the waves: about, for a lens that is much farther than x.
                across = c.to_lens + wp.dot(-c.to_lens, port.normal) * port.normal
                lower = side * facet_at(sea.waves, c.exit).height / wp.max(-wp.dot(c.to_lens, port.normal), 0.1)
                c.exit -= lower * across
                c.water -= wp.min(lower, 0.5 * c.water)
        drawn = _draw_point(port, c, wp.length(o - c.exit), sea.normal, sea.spread_along, sea.spread, seed)
        s = wp.vec3(drawn[0], drawn[1], drawn[2])
        local = sea
        if wp.static(waves):
            facet = facet_at(sea.waves, s)
            local = _tilted(sea, facet)
            s += (facet.height - wp.dot(s - sea.waves.origin, sea.normal)) * sea.normal
        to_s = s - x
        to_o = o - s
        behind = wp.length(to_o)
        c.exit = s
        c.water = wp.length(to_s)
        c.to_lens = to_s / c.water
        c.inside = to_o / behind
        c.transmission = 1.0
        c.density = 0.0
        cosine = wp.dot(c.to_lens, local.normal)
        # Facets that turn their backs on x or on o let nothing through.
        if (cosine > 0.0) == below and (wp.dot(c.inside, local.normal) > 0.0) == below:
            area = c.water * c.water * behind * behind * wp.dot(local.normal, sea.normal)
            density = passage_density(local, c.to_lens, c.inside)
            c.density = density * wp.abs(cosine) / (area * wp.max(drawn[3], 1.0e-30))
        return c

    return connect


class SeaKind(NamedTuple):
    """A kind of surface; its name identifies it in the kernel cache. Warp functions, in any one frame."""

    name: str  # "facets" or "waves"
    is_above: wp.Function  # ``(sea, x) -> bool``, whether a point is in the air
    # ``(sea, x, u, above, limit) -> float``: length of the flight from x along u, on the side `above` the surface or
    # below it, to the surface [m]; 1e30 if it does not meet it, as a flight over waves may not beyond the limit [m]
    distance: wp.Function
    at: wp.Function  # ``(sea, x) -> Sea``, whose facets are those about a point x of the surface
    # ``(sea, port, x, o, seed) -> Connection``: a way from x to o on the other side, by a point of the surface that is
    # drawn, or that of a flat one; its density is over that of the draw. The port describes the other side: the mean
    # plane as o sees it; `seed`: 64 random bits
    connect: wp.Function


@wp.func
def _plane_at(sea: Sea, x: wp.vec3) -> Sea:
    return sea


@wp.func
def _waves_at(sea: Sea, x: wp.vec3) -> Sea:
    return _tilted(sea, facet_at(sea.waves, x))


FACETS = SeaKind("facets", _is_above_plane, _plane_distance, _plane_at, _make_connect(False))
"""Facets about the mean plane: waves by the statistics of their slopes alone."""

WAVES = SeaKind("waves", is_above_waves, waves_distance, _waves_at, _make_connect(True))
"""A height field of waves, and about it facets for what it does not resolve."""


@wp.kernel(enable_backward=False)
def see_through_waves_kernel(
    sea: Sea,
    origins: wp.array2d[wp.vec3],
    directions: wp.array2d[wp.vec3],
    start: wp.array2d[wp.vec3],
    behind: wp.array2d[wp.vec3],
    length: wp.array2d[float],
):
    """Rays [m] up to the waves, refracted there by the height field alone: where, in which unit direction they go on,
    and how long they are; NaN for those that do not get through."""
    i, j = wp.tid()
    x = origins[i, j]
    u = directions[i, j]
    above = is_above_waves(sea, x)
    distance = waves_distance(sea, x, u, above, 1.0e9)
    v = wp.vec3(0.0)
    if distance < 1.0e30:
        x += distance * u
        normal = facet_normal(sea.waves, facet_at(sea.waves, x).slope)
        v = refracted(u, normal, wp.where(above, 1.0 / sea.index, sea.index))
    if wp.length_sq(v) == 0.0:
        v = wp.vec3(wp.nan)
        distance = wp.nan
    start[i, j] = x
    behind[i, j] = v
    length[i, j] = distance


# ---- Parameters.


def slope_variances(wind: float, *, by_direction: bool = False) -> tuple[float, float]:
    """Variances of the slopes along and across the wind (Cox & Munk 1954, clean surface), at a wind speed of 0 ... 30
    m/s at 12.5 m above the sea; evenly distributed unless `by_direction`. Raises `ArgumentError`."""
    check.number("wind", wind, "[0, 30]")
    if by_direction:
        return 3.16e-3 * wind, 0.003 + 1.92e-3 * wind
    even = 0.5 * (0.003 + 5.12e-3 * wind)
    return even, even


def facet_covariance(heights: ArrayLike, size: Sequence[float]) -> NDArray[np.float64]:
    """Mean squares and product of the slopes of a periodic height field along its rows and from row to row, `[2, 2]`;
    arguments: see `make_sea`."""
    (a, a_next), (b, b_next) = _edges(_checked(heights, size), size)
    squares = [(p * p + p * q + q * q).mean() / 3.0 for p, q in ((a, a_next), (b, b_next))]
    product = (0.25 * (a + a_next) * (b + b_next)).mean()
    return np.array([[squares[0], product], [product, squares[1]]])


def _edges(h: NDArray[np.float64], size: Sequence[float]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Slopes of both edges of each cell along the rows, and of both from row to row."""
    slopes = [(np.roll(h, -1, axis=k) - h) * (h.shape[k] / length) for k, length in ((1, size[0]), (0, size[1]))]
    return [(slope, np.roll(slope, -1, axis=k)) for k, slope in enumerate(slopes)]


def unresolved_covariance(
    variances: Sequence[float], along: Sequence[float], heights: ArrayLike, size: Sequence[float]
) -> NDArray[np.float64]:
    """Covariance of the slopes that a height field leaves to facets, along its rows and from row to row, `[2, 2]`.

    `along`: the wind's direction along both, of any length; else as in `make_sea`. Raises `ArgumentError` where less
    than a tenth of the variance on an axis is left.
    """
    resolved = facet_covariance(heights, size)
    wind = np.array(along, np.float64) / math.hypot(*along)
    turn = np.array([wind, [-wind[1], wind[0]]])
    total = turn.T @ np.diag(np.maximum(np.array(variances, np.float64), 1e-30)) @ turn
    part = turn @ resolved @ turn.T / np.sqrt(np.outer(variances, variances)) if min(variances) > 0.0 else np.eye(2)
    if (most := float(np.linalg.eigvalsh(part)[-1])) > 0.9:
        raise ArgumentError(
            f"heights: the waves hold {most:.3g} of the variance of the sea's slopes on an axis, which is outside "
            "[0, 0.9]: the rest is that of the waves between the nodes"
        )
    covariance: NDArray[np.float64] = total - resolved
    return covariance


def make_sea(
    variances: Sequence[float],
    *,
    index: float,
    normal: Sequence[float],
    height: float,
    along: Sequence[float] | None = None,
    delay: float = 1.0,
    extinction: float = 0.0,
    heights: ArrayLike | None = None,
    size: Sequence[float] = (1.0, 1.0),
    columns: Sequence[float] | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    device: wp.DeviceLike = None,
) -> Sea:
    """The surface of the sea.

    Args:
        variances: Of all slopes along and across the wind, see `slope_variances`; both 0 for a flat surface.
        index: Phase index of the water over that of the air, > 1.
        normal: Unit vector of the mean plane, upwards.
        height: Of the mean plane, x·normal of its points [m].
        along: Direction in which the wind blows, of any length, not along the normal.
        delay: Group index of the air over that of the water.
        extinction: Of the air [1/m].
        heights: Of resolved waves above the plane [m], `[rows, columns]`, at least 2 of each, for `TransportSpec.sea` =
            WAVES. The field is periodic; facets about it hold the rest of the variances, see `unresolved_covariance`.
        size: Length of a row of the heights and of a column, the periods [m].
        columns: Direction along a row, of any length, not along the normal; default: that of the wind.
        origin: A point above or below the first node [m].
        device: Where the heights are stored.

    Raises:
        ArgumentError: A number out of its range.
    """
    check.vector("variances", variances, size=2)
    for k, variance in enumerate(variances):
        check.number(f"variances[{k}]", variance, "[0, 0.5]" if not any(variances) else "[1e-9, 0.5]")
    check.vector("normal", normal, unit=True)
    check.number("index", index, "(1, 4]")
    check.within("[0, 1e9]", extinction=extinction)
    check.number("height", height, "(-inf, inf)")
    check.number("delay", delay, "(0, 4]")
    up = np.array(normal, np.float64)
    wind = _level("along", np.eye(3)[np.argmin(np.abs(up))] if along is None else along, up)
    width = [math.sqrt(2.0 * variance) for variance in variances]
    sea = fill(Sea(), normal=normal, height=height, along=wind, slope=width, spread_along=wind, spread=width)
    fill(sea, index=index, delay=delay, extinction=extinction)
    if heights is not None:
        check.vector("origin", origin)
        first = wind if columns is None else _level("columns", columns, up)
        second = np.cross(up, first)
        rest = unresolved_covariance(variances, (wind @ first, wind @ second), heights, size)
        values, vectors = np.linalg.eigh(rest)
        place = np.array(origin, np.float64)
        place += (height - place @ up) * up
        waves = fill(_make_waves(heights, size, device), normal=normal, origin=place, columns=first, rows=second)
        steep = (math.sqrt(2.0 * values[1]), math.sqrt(2.0 * values[0]))
        fill(sea, waves=waves, along=vectors[0, 1] * first + vectors[1, 1] * second, slope=steep)
    return sea


def _level(name: str, vector: ArrayLike, up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit vector of the mean plane that a vector lies above."""
    direction = check.numbers(name, vector, (3,), "(-inf, inf)")
    level = direction - (direction @ up) * up
    check.number(f"length of {name} in the plane", float(np.linalg.norm(level)), "(0, inf)")
    unit: NDArray[np.float64] = level / np.linalg.norm(level)
    return unit


def _make_waves(heights: ArrayLike, size: Sequence[float], device: wp.DeviceLike) -> Waves:
    """A height field that is still to be placed."""
    h = _checked(heights, size)
    cell, margin = (size[0] / h.shape[1], size[1] / h.shape[0]), 0.01 * float(np.ptp(h)) + 1e-4
    bounds = {"low": float(h.min()) - margin, "high": float(h.max()) + margin}
    # Slopes are bilinear in a cell's corners: the largest are at its corners.
    along, across = (np.maximum(np.abs(p), np.abs(q)) for p, q in _edges(h, size))
    return fill(Waves(), device, heights=h, cell=cell, **bounds, steepest=float(np.hypot(along, across).max()))


def _checked(heights: ArrayLike, size: Sequence[float]) -> NDArray[np.float64]:
    h = np.asarray(heights, np.float64)
    if h.ndim != 2 or min(h.shape) < 2:
        raise ArgumentError(f"heights of shape {h.shape}: [rows, columns] are needed, at least 2 of each")
    if not (np.abs(h) <= 1e4).all():
        raise ArgumentError("heights are not all numbers in [-1e4, 1e4] m")
    check.vector("size", size, size=2)
    for k, length in enumerate(size):
        check.number(f"size[{k}]", length, "[1e-3, 1e6]")
    return h
