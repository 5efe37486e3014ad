"""Single scattering of a polarised pulse before a lens, by the quadratures of `single_scatter`, in float64.

The laser's Stokes vector counts from `right`, and its angles turn from there towards `down`, as the camera's image
shows them (for a laser along +z these are +x and +y). It is carried from the beam's axis to each ray by the smallest
rotation. What arrives is carried to −z in the same way and counts from the image's x: angles turn from +x towards +y.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from reference.single_scatter import Factor, Lidar
from reference.stokes import Matrix, carried, scattered


def linear(angle: float) -> tuple[float, float, float, float]:
    """Stokes vector of light with its field at an angle [rad] from `right` towards `down`, counted from `right`."""
    return (1.0, math.cos(2.0 * angle), -math.sin(2.0 * angle), 0.0)


def stokes_factor(
    lidar: Lidar, matrix: Matrix, stokes: Sequence[float], *, right: Sequence[float] = (1, 0, 0)
) -> Factor:
    """The Stokes vectors at the lens for `single_scatter(factor=...)` and `single_scatter_total(factor=...)`."""
    axis = np.array(lidar.laser_direction) / np.linalg.norm(lidar.laser_direction)
    first = np.asarray(right, np.float64)

    def factor(before: NDArray, after: NDArray) -> NDArray:
        emitted = carried(first, axis, before)
        seen = carried(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0]), after)
        return scattered(np.asarray(stokes, np.float64), emitted, before, after, seen, matrix)

    return factor


def pencil(lidar: Lidar, factor: Factor, *, order: int = 16) -> NDArray[np.float64]:
    """Light of a pencil beam along +z from `laser_position` that is scattered once, over the whole field: [bins, 4]."""
    start = np.array(lidar.laser_position, np.float64)
    x, y, z0 = start
    tangent = math.tan(lidar.field_of_view / 2.0)
    nearest = max(abs(x), abs(y)) / tangent
    # path = (z − z0) + sqrt(x² + y² + z²)
    reached = lidar.edges + z0
    cuts = np.maximum((reached**2 - x * x - y * y) / (2.0 * reached), max(nearest, z0))
    node, gauss = (v / 2.0 for v in np.polynomial.legendre.leggauss(order))
    width = np.diff(cuts)[:, None]
    z = cuts[:-1, None] + width * (node + 0.5)  # [bins, order]
    point = np.stack(np.broadcast_arrays(x, y, z), -1)
    r = np.linalg.norm(point, axis=-1)
    after = -point / r[..., None]
    before = np.broadcast_to(np.array([0.0, 0.0, 1.0]), point.shape)
    value = lidar.scattered(z, (z - z0) + r, after[..., 2]) * lidar.aperture_area * (z / r) / r**2
    return np.einsum("tn,tns->ts", value * width * gauss, factor(before, after))
