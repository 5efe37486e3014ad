"""Stokes vectors and scattering matrices, in float64: rotations, one scattering, reciprocity.

A Stokes vector (I, Q, U, V) counts from a unit vector `reference` normal to the direction k of propagation: with E1
along it and E2 along reference × k, Q = ⟨E1² − E2²⟩ and U = 2⟨E1·E2⟩. A new reference turned by φ from E1 towards E2
has Q' = Q cos2φ + U sin2φ and U' = −Q sin2φ + U cos2φ.

A reduced scattering matrix [..., 4, 4] is that of macroscopically isotropic, mirror-symmetric matter over its
element 11, with references *in* the scattering plane (Bohren & Huffman 1983, eq 4.77): m12 < 0 is light polarised
across that plane.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Matrix = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Reduced scattering matrices [..., 4, 4] over cosΘ [...]."""

MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
"""P of the reciprocity relation."""


def block_matrix(m12: ArrayLike, m22: ArrayLike, m33: ArrayLike, m34: ArrayLike, m44: ArrayLike) -> NDArray:
    """[..., 4, 4] with m11 = 1, m21 = m12 and m43 = −m34."""
    elements = np.broadcast_arrays(*(np.asarray(m, np.float64) for m in (m12, m22, m33, m34, m44)))
    m12, m22, m33, m34, m44 = elements
    matrix = np.zeros((*m12.shape, 4, 4))
    matrix[..., 0, 0] = 1.0
    matrix[..., 0, 1] = matrix[..., 1, 0] = m12
    matrix[..., 1, 1], matrix[..., 2, 2], matrix[..., 3, 3] = m22, m33, m44
    matrix[..., 2, 3], matrix[..., 3, 2] = m34, -m34
    return matrix


def rayleigh_matrix(cos_scatter: ArrayLike, depolarization: float = 0.0) -> NDArray:
    """Rayleigh scattering with a depolarisation ratio of unpolarised light at 90° (Hansen & Travis 1974)."""
    mu = np.asarray(cos_scatter, np.float64)
    isotropic = 2.0 * depolarization / (1.0 - depolarization)  # over the Rayleigh part's 1 + µ²
    p11 = 1.0 + mu**2 + isotropic
    circular = (1.0 - 2.0 * depolarization) / (1.0 - depolarization)
    return block_matrix((mu**2 - 1.0) / p11, (1.0 + mu**2) / p11, 2.0 * mu / p11, 0.0, circular * 2.0 * mu / p11)


def rayleigh_density(cos_scatter: ArrayLike, depolarization: float = 0.0) -> NDArray:
    """Its phase function [1/sr]."""
    mu2 = np.square(np.asarray(cos_scatter, np.float64))
    return 3.0 / (16.0 * np.pi) * (1.0 + depolarization + (1.0 - depolarization) * mu2) / (1.0 + 0.5 * depolarization)


def turned(stokes: ArrayLike, direction: ArrayLike, reference: ArrayLike, new: ArrayLike) -> NDArray:
    """The Stokes vectors [..., 4] counted from another reference normal to the same direction."""
    stokes, direction, reference, new = (np.asarray(one, np.float64) for one in (stokes, direction, reference, new))
    cosine = (reference * new).sum(-1)
    sine = (np.cross(reference, direction) * new).sum(-1)
    cos2, sin2 = cosine**2 - sine**2, 2.0 * sine * cosine
    i, q, u, v = np.moveaxis(stokes, -1, 0)
    return np.stack(np.broadcast_arrays(i, cos2 * q + sin2 * u, cos2 * u - sin2 * q, v), -1)


def carried(reference: ArrayLike, direction: ArrayLike, new: ArrayLike) -> NDArray:
    """The reference turned by the smallest rotation that takes `direction` to the direction `new`, not its opposite."""
    reference, direction, new = (np.asarray(one, np.float64) for one in (reference, direction, new))
    along = (reference * new).sum(-1, keepdims=True) / (1.0 + (direction * new).sum(-1, keepdims=True))
    return reference - along * (direction + new)


def scattered(
    stokes: ArrayLike, reference: ArrayLike, incoming: ArrayLike, outgoing: ArrayLike, new: ArrayLike, matrix: Matrix
) -> NDArray:
    """One scattering from unit directions `incoming` to `outgoing` [..., 3], by the reduced matrix; [..., 4].

    `reference` belongs to the incoming direction, `new` to the outgoing one. Straight on or back, where no plane is
    given, the reference's own is taken.
    """
    incoming, outgoing, reference = (np.asarray(one, np.float64) for one in (incoming, outgoing, reference))
    across = np.cross(incoming, outgoing)
    sine = np.linalg.norm(across, axis=-1, keepdims=True)
    own = np.cross(incoming, reference)
    across = np.where(sine > 1e-12, across / np.maximum(sine, 1e-300), own)
    cos_scatter = (incoming * outgoing).sum(-1)
    before = turned(stokes, incoming, reference, np.cross(across, incoming))
    after = np.einsum("...ij,...j->...i", matrix(cos_scatter), before)
    return turned(after, outgoing, np.cross(across, outgoing), new)


def analysed(stokes: ArrayLike, angle: float, *, extinction_ratio: float = np.inf) -> NDArray:
    """What passes an analyser at an angle [rad] from E1 towards E2, and one across it: [..., 2]."""
    i, q, u, _ = np.moveaxis(np.asarray(stokes, np.float64), -1, 0)
    leak, along = 1.0 / extinction_ratio, q * np.cos(2.0 * angle) + u * np.sin(2.0 * angle)
    return 0.5 * np.stack([(1.0 + leak) * i + (1.0 - leak) * along, (1.0 + leak) * i - (1.0 - leak) * along], -1)
