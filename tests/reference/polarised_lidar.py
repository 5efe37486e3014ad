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
