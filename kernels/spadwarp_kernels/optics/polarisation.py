"""What polarised light depends on: the laser's state, the scattering matrix of the water, facets, and the receiver."""

from collections.abc import Callable, Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.native import fill

__all__ = ["MATRIX_POINTS", "MOST_CHANNELS", "Polarisation", "make_polarisation", "matrix_cosines"]

# Points of the tables of a scattering matrix; an odd number.
MATRIX_POINTS = 1025

MOST_CHANNELS = 3

Channels = wp.types.matrix(shape=(3, 4), dtype=float)


@wp.struct
class Polarisation:
    """Parameters of a polarised spec, made by `make_polarisation`."""

    laser: wp.vec4  # Stokes vector of the beam on its axis, I = 1, with respect to the right of `beam_frame`
    first: wp.array(dtype=wp.vec4)  # table of m12, m22, m33, m34 at `matrix_cosines`, see `Elements`
    last: wp.array(dtype=float)  # table of m44 there
    channels: Channels
    """A row for each channel of the receiver, whose product with the Stokes vector it takes; with respect to the
    image's x, so that U is light at 45 degrees from x towards y less that at 135."""
    facet_index: wp.array(dtype=float)
    """Index of each face's specular facets over that of the water; empty without a specular lobe."""


def matrix_cosines() -> NDArray[np.float64]:
    """Cosines of the scattering angle at which a matrix is tabulated, `[MATRIX_POINTS]`: from forward, in equal steps
    of sin(theta/2), to 90 degrees, and on in equal steps of cos(theta/2) to backward; 0.16 degrees apart at both ends.
    """
    s = np.linspace(0.0, 1.0, (MATRIX_POINTS + 1) // 2)
    return np.concatenate([1.0 - s * s, (s * s - 1.0)[-2::-1]])


def make_polarisation(
    *,
    laser: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    matrix: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    channels: Sequence[Sequence[float]] = (),
    facet_index: ArrayLike = (),
    device: wp.DeviceLike = None,
) -> Polarisation:
    """Parameters of polarised light, for `Model.polarisation`.

    Args:
        laser: Stokes vector of the emitted light, I = 1, see `Polarisation`.
        matrix: Of cosines `[n]` of the scattering angle; returns `[n, 5]`: m12, m22, m33, m34 and m44 over m11, see
            `Elements`. None: light keeps its polarisation as it is turned.
        channels: Up to MOST_CHANNELS rows of four numbers; as many as the spec has.
        facet_index: Of each face, > 0; one number for each, or nothing.

    Raises:
        ArgumentError: Numbers that no light and no matrix can have.
    """
    device = check.device("device", device)
    stokes = check.numbers("laser", laser, (4,), "(-inf, inf)")
    if stokes[0] != 1.0 or float(np.linalg.norm(stokes[1:])) > 1.0 + 1e-6:
        raise ArgumentError(f"laser = {laser!r} is not a Stokes vector with I = 1, polarised by 1 at most")
    cosines = matrix_cosines()
    table = np.tile([0.0, 1.0, 1.0, 0.0, 1.0], (cosines.size, 1))
    if matrix is not None:
        check.kind("matrix", matrix, Callable)
        table = check.numbers("matrix(cosines)", matrix(cosines), table.shape, "[-1.000001, 1.000001]")
    rows, count = np.zeros((MOST_CHANNELS, 4)), check.integer("channels", len(channels), 0, MOST_CHANNELS)
    rows[:count] = check.numbers("channels", channels, (count, 4) if count else (0,), "[-1, 1]").reshape(count, 4)
    facets = check.numbers("facet_index", np.ravel(facet_index), (None,), "(0, inf)")
    made = fill(Polarisation(), device, laser=stokes, first=table[:, :4], last=table[:, 4])
    return fill(made, device, channels=rows, facet_index=facets)
