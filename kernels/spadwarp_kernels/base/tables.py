"""Tabulated probability densities on [0, 1] that resolve both ends.

The grid has sixteen cells an octave towards 0 and towards 1, down to 2^-33 from either end: the bits of a float give
its cell, without a search and without a logarithm. A coordinate x is given folded, z = x up to 1/2 and z = x - 1 above,
which keeps its distance from the nearer end exact.

Within a cell the density is linear, with the probability and the mean coordinate of the function that was tabulated. It
is the density of what `table_sample` draws, not an approximation to it.
"""

from collections.abc import Callable

import numpy as np
import warp as wp
from numpy.typing import NDArray

from . import check
from .check import ArgumentError
from .native import fill

Floats = NDArray[np.float64]

_OCTAVES = 32
_HALF = _OCTAVES * 16 + 1  # cells of one half; the first of them reaches to the end of the interval
TABLE_CELLS = 2 * _HALF

# Distances from the nearer end at which the cells of a half begin, and 1/2.
_NODES = np.concatenate(
    [[0.0], (2.0 ** np.arange(-_OCTAVES - 1, -1)[:, None] * (1.0 + np.arange(16) / 16.0)).ravel(), [0.5]]
)

_FIRST_BITS = wp.constant((127 - _OCTAVES - 1) << 23)  # of the float32 2^-33
_SHIFT = wp.constant(23 - 4)  # the bits of a float32 below a sixteenth of its octave
_LAST = wp.constant(_HALF - 1)
_LAST_CELL = wp.constant(2 * _HALF - 1)
_NEAREST = wp.constant(1.0e-12)  # least distance of a folded coordinate of the upper half from 0, so that it has a sign


@wp.struct
class DensityTables:
    """Densities on [0, 1], one a row, from `make_density_tables`."""

    # `[row, cell]`, cells in ascending order of x: probability below the cell, below its upper end, density at its end
    # nearer to 0 or 1, density at its other end
    cells: wp.array2d[wp.vec4]
    # `[row, cell]`: for each cell of a uniform number, on the same grid, the first cell that its sample can lie in
    guide: wp.array2d[int]


@wp.func
def fold(x: float) -> float:
    """The folded form of x in [0, 1]."""
    return wp.where(x > 0.5, wp.min(x - 1.0, -_NEAREST), x)


@wp.func
def _cell_at(z: float) -> int:
    j = wp.clamp(((wp.cast(wp.abs(z), int) - _FIRST_BITS) >> _SHIFT) + 1, 0, _LAST)
    return wp.where(z < 0.0, _LAST_CELL - j, j)


@wp.func
def _node(j: int) -> float:
    return wp.where(j > 0, wp.cast(_FIRST_BITS + ((j - 1) << _SHIFT), float), 0.0)


@wp.func
def _part(z: float, k: int) -> float:
    """Where z lies in its cell k: 0 at the end nearer to 0 or 1, 1 at the other."""
    j = wp.where(z < 0.0, _LAST_CELL - k, k)
    near = _node(j)
    return wp.clamp((wp.abs(z) - near) / (_node(j + 1) - near), 0.0, 1.0)


@wp.func
def table_density(tables: DensityTables, row: int, z: float) -> float:
    """Density over x at the folded coordinate z."""
    k = _cell_at(z)
    cell = tables.cells[row, k]
    return cell[2] + (cell[3] - cell[2]) * _part(z, k)


@wp.func
def table_cumulative(tables: DensityTables, row: int, z: float) -> float:
    """Probability below the folded coordinate z."""
    k = _cell_at(z)
    cell = tables.cells[row, k]
    f = _part(z, k)
    part = f * (2.0 * cell[2] + (cell[3] - cell[2]) * f) / wp.max(cell[2] + cell[3], 1.0e-30)
    return cell[0] + (cell[1] - cell[0]) * wp.where(z < 0.0, 1.0 - part, part)


@wp.func
def table_sample(tables: DensityTables, row: int, xi: float) -> float:
    """The folded coordinate below which the probability is xi, in [0, 1)."""
    k = tables.guide[row, _cell_at(fold(xi))]
    cell = tables.cells[row, k]
    while xi >= cell[1] and k < _LAST_CELL:
        k += 1
        cell = tables.cells[row, k]
    upper = k > _LAST
    r = wp.clamp((xi - cell[0]) / wp.max(cell[1] - cell[0], 1.0e-30), 0.0, 1.0)
    r = wp.where(upper, 1.0 - r, r)
    near = cell[2]
    far = cell[3]
    # The root of near f + (far - near) f^2/2 = r (near + far)/2 that does not cancel.
    root = wp.sqrt(wp.max(near * near + r * (far * far - near * near), 0.0))
    f = wp.min(r * (near + far) / wp.max(near + root, 1.0e-30), 1.0)
    j = wp.where(upper, _LAST_CELL - k, k)
    y = _node(j) + (_node(j + 1) - _node(j)) * f
    return wp.where(upper, -wp.max(y, _NEAREST), y)


def folded_quadrature() -> tuple[Floats, Floats]:
    """Folded coordinates and weights for an integral over [0, 1], `[2, cells of a half, 16]`, the upper half second.

    A function may rise towards either end as y^-0.95.
    """
    node, weight = np.polynomial.legendre.leggauss(16)
    node, weight = 0.5 * node + 0.5, 0.5 * weight
    width = np.diff(_NODES)[:, None]
    y, w = _NODES[:-1, None] + width * node, width * weight
    # To the end itself y = first node * u^32, which takes the edge off a power law.
    y[0], w[0] = _NODES[1] * node**32, _NODES[1] * 32.0 * node**31 * weight
    return np.stack([y, -y]), np.stack([w, w])


def tabulate(density: Callable[[Floats], Floats]) -> Floats:
    """The cells of a density in float64, `[cells, 4]`, from a density of any scale over folded coordinates.

    Up to 2^-33 from an end the density is replaced by its mean there. Raises `ArgumentError` if it is negative, not
    finite or zero everywhere.
    """
    z, weight = folded_quadrature()
    values = check.numbers("density(t)", density(z), z.shape, "[0, inf)")
    if not values.any():
        raise ArgumentError("density(t) is zero everywhere")
    width = np.diff(_NODES)
    mass = (values * weight).sum(axis=2)
    middle = 0.5 * (_NODES[1:] + _NODES[:-1])[:, None]
    moment = (values * weight * (np.abs(z) - middle)).sum(axis=2)
    # Least squares: the line with the cell's mass and first moment, where that is nowhere negative.
    mean = mass / width
    slope = np.clip(12.0 * moment / width**2, -2.0 * mean, 2.0 * mean)
    slope[:, 0] = 0.0
    ends = np.stack([mean - 0.5 * slope, mean + 0.5 * slope], axis=2)
    ends, mass = (np.concatenate([v[0], v[1, ::-1]]) / mass.sum() for v in (ends, mass))
    above = np.cumsum(mass)
    above[-1] = 1.0
    return np.column_stack([np.concatenate([[0.0], above[:-1]]), above, ends])


def lower_ends() -> Floats:
    """Where the cells begin, ascending x."""
    return np.concatenate([_NODES[:-1], 1.0 - _NODES[:0:-1]])


def make_density_tables(*rows: Floats, device: wp.DeviceLike = None) -> DensityTables:
    """The tables that kernels take, from the cells that `tabulate` gives for each row."""
    cells = np.stack(rows).astype(np.float32)
    guide = [np.searchsorted(row[:, 1], lower_ends(), side="right") for row in cells]
    return fill(DensityTables(), device, cells=cells, guide=np.minimum(guide, cells.shape[1] - 1))
