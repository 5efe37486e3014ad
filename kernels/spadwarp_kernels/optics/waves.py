"""Resolved waves: a periodic height field above a mean plane, and the ways of rays to it.

Between its nodes the field is bilinear. What is on which side of it is decided by the one who asks: rounding leaves
points that were put on the surface a little above or below.
"""

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError

__all__ = ["Waves", "facet_covariance", "make_waves", "steepest_facet"]

# Cells that a ray is followed through; a flight within the slab of the waves that is longer meets none.
_MOST_CELLS = wp.constant(65536)
_NOWHERE = wp.constant(1.0e30)


@wp.struct
class Waves:
    """A height field over the mean plane of a sea, in the frame of the camera; made by `make_waves`, placed by
    `make_sea`."""

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
def height_above_waves(waves: Waves, x: wp.vec3) -> float:
    """Height of a point above the field [m]."""
    return wp.dot(x - waves.origin, waves.normal) - facet_at(waves, x).height


@wp.func
def is_above_waves(waves: Waves, x: wp.vec3) -> bool:
    """Whether a point is above the field."""
    z = wp.dot(x - waves.origin, waves.normal)
    above = z > waves.high
    if z >= waves.low and not above:
        above = z > facet_at(waves, x).height
    return above


@wp.func
def facet_normal(waves: Waves, slope: wp.vec2) -> wp.vec3:
    """Unit normal of a facet, upwards."""
    return wp.normalize(waves.normal - slope[0] * waves.columns - slope[1] * waves.rows)


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
def waves_distance(waves: Waves, x: wp.vec3, u: wp.vec3, above: bool, limit: float) -> float:
    """Length of the flight from x along u to where it leaves its side of the field, `above` or below it [m]; 1e30 if
    that is farther than the limit. 0 at a point beyond the field, by rounding, that leads farther away."""
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


# ---- Parameters.


def facet_covariance(heights: ArrayLike, size: Sequence[float]) -> NDArray[np.float64]:
    """Mean squares and product of the slopes of a periodic height field along its rows and from row to row, `[2, 2]`.

    Args:
        heights: Of the nodes [m], `[rows, columns]`, at least 2 of each.
        size: Length of a row and of a column, the periods [m].

    Raises:
        ArgumentError: Heights that are no such array, or no numbers.
    """
    (a, a_next), (b, b_next) = _edges(_checked(heights, size), size)
    squares = [(p * p + p * q + q * q).mean() / 3.0 for p, q in ((a, a_next), (b, b_next))]
    product = (0.25 * (a + a_next) * (b + b_next)).mean()
    return np.array([[squares[0], product], [product, squares[1]]])


def steepest_facet(heights: ArrayLike, size: Sequence[float]) -> float:
    """The largest slope of a periodic height field, of any direction; arguments: see `facet_covariance`."""
    # Slopes are bilinear in a cell's corners: the largest are at its corners.
    along, across = (np.maximum(np.abs(p), np.abs(q)) for p, q in _edges(_checked(heights, size), size))
    return float(np.hypot(along, across).max())


def _edges(h: NDArray[np.float64], size: Sequence[float]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Slopes of both edges of each cell along the rows, and of both from row to row."""
    slopes = [(np.roll(h, -1, axis=k) - h) * (h.shape[k] / length) for k, length in ((1, size[0]), (0, size[1]))]
    return [(slope, np.roll(slope, -1, axis=k)) for k, slope in enumerate(slopes)]


def make_waves(heights: ArrayLike, size: Sequence[float], *, device: wp.DeviceLike = None) -> Waves:
    """A height field, for `make_sea`.

    Args:
        heights: Of the nodes above the mean plane [m], `[rows, columns]`, at least 2 of each; the field is periodic.
        size: Length of a row and of a column, the periods [m].
        device: Where the heights are stored.

    Raises:
        ArgumentError: Heights that are no such array, or no numbers; a size out of range.
    """
    h = _checked(heights, size)
    waves = Waves()
    waves.heights = wp.array(h.astype(np.float32), dtype=float, device=device)
    waves.cell = wp.vec2(size[0] / h.shape[1], size[1] / h.shape[0])
    margin = 0.01 * float(np.ptp(h)) + 1e-4
    waves.low, waves.high = float(h.min()) - margin, float(h.max()) + margin
    waves.steepest = steepest_facet(h, size)
    return waves


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
