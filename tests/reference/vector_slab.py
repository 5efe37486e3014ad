"""Polarised radiative transfer in plane-parallel slabs by doubling and adding (de Haan et al. 1987), in float64.

As `adding_doubling`, with Stokes vectors and azimuth. Reflection and transmission functions are 4 × 4 matrices of the
pair of cosines; their dependence on the azimuth is a complex Fourier series exp(imφ), whose terms are independent of
each other. Light from below is that from above seen in a mirror, which changes the signs of U and V.

Zenith angles from the upward normal, azimuths φ of the directions of *propagation* (anticlockwise seen from above);
Q = ⟨E_φ² − E_θ²⟩ and U = 2⟨E_θ·E_φ⟩ with θ̂ and φ̂ of increasing zenith angle and azimuth; at the zenith those of the
meridian φ. That is, the reference of `stokes` is φ̂.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reference.stokes import Matrix, scattered

_START = 30  # doublings from the single-scattering layer to the slab
_SEEN_FROM_BELOW = np.array([1.0, 1.0, -1.0, -1.0])

Density = Callable[[NDArray[np.float64]], NDArray[np.float64]]
Layer = tuple[NDArray, NDArray, NDArray]  # reflection and diffuse transmission for light from above; direct beam


@dataclass(frozen=True)
class Radiance:
    """Stokes vectors [mu, phi, 4] that leave the upper and the lower face of a slab, without the direct beam."""

    upper: NDArray[np.float64]
    lower: NDArray[np.float64]


def radiance(
    matrix: Matrix,
    density: Density,
    *,
    optical_depth: float,
    mu0: float,
    mu: ArrayLike,
    phi: ArrayLike,
    albedo: float = 1.0,
    ground: float = 0.0,
    flux: float = math.pi,
    stokes: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    nodes: int = 22,
    orders: int = 2,
    components: int = 3,
) -> Radiance:
    """What leaves a uniform slab lit from above by a beam of irradiance `flux` normal to itself.

    Args:
        matrix: Reduced scattering matrices over cosΘ.
        density: Phase function over cosΘ [1/sr].
        mu0, mu: Cosines to the vertical of the beam and of what leaves; > 0.
        phi: Azimuths of propagation from that of the beam [rad].
        albedo: Of a scattering. `ground`: of a Lambertian ground below.
        stokes: Of the beam, with I = 1.
        orders: Of the azimuth; Rayleigh scattering has 2.
        components: 3 where m34 = 0 and the beam has no V, which then stays 0; else 4.
    """
    mu, phi = np.atleast_1d(np.asarray(mu, np.float64)), np.atleast_1d(np.asarray(phi, np.float64))
    x, gauss = np.polynomial.legendre.leggauss(nodes)
    cosines = np.concatenate([(x + 1.0) / 2.0, [mu0], mu])
    weights = np.zeros(cosines.size)
    weights[:nodes] = gauss * (x + 1.0) / 2.0  # 2 µ dµ, with dµ = gauss/2
    same, opposite = _fourier(matrix, density, cosines, orders, components)
    above = _Above(np.repeat(weights, components), np.tile(_SEEN_FROM_BELOW[:components], cosines.size))
    intensity = np.tile(np.eye(components)[0], cosines.size)
    lambert = ground * np.outer(intensity, intensity)
    beam = components * nodes + np.arange(components)
    upper, lower = np.zeros((2, mu.size, phi.size, 4))
    for order in range(orders + 1):
        layer = _slab(np.repeat(cosines, components), above, same[order], opposite[order], albedo, optical_depth)
        reflected, passed = above(layer, lambert if order == 0 else 0.0 * lambert)
        wave = (1.0 if order == 0 else 2.0) * np.exp(1j * order * phi)
        for result, kernel in ((upper, reflected), (lower, passed)):
            mode = kernel[beam[-1] + 1 :, beam] @ np.asarray(stokes, np.float64)[:components]
            seen = np.real(wave[:, None] * mode.reshape(mu.size, 1, components)) * mu0 * flux / math.pi
            result[..., :components] += seen
    return Radiance(upper, lower)


@dataclass(frozen=True)
class _Above:
    """A uniform layer above something that reflects: fluxes of the components, and signs of the mirrored light."""

    weights: NDArray[np.float64]
    mirror: NDArray[np.float64]

    def __call__(self, layer: Layer, below: NDArray) -> tuple[NDArray, NDArray]:
        """Reflection of both, lit from above, and the diffuse light downwards between them."""
        reflect, transmit, direct = layer
        weights, (from_below, up_through) = self.weights, (self.mirror[:, None] * k * self.mirror for k in layer[:2])
        twice = (from_below * weights) @ below
        down = np.linalg.solve(np.eye(weights.size) - twice * weights, transmit + twice * direct)
        up = below * direct + (below * weights) @ down
        return reflect + direct[:, None] * up + (up_through * weights) @ up, down


def _fourier(
    matrix: Matrix, density: Density, cosines: NDArray, orders: int, components: int
) -> tuple[NDArray, NDArray]:
    """Fourier terms over the azimuth of 4π·p·M [order, k·n, k·n], from downwards into downwards and into upwards."""
    count = 4 * orders + 4
    azimuths = 2.0 * np.pi * np.arange(count) / count
    into = _directions(-cosines, np.zeros(1))  # [n, 1, ...]
    results = []
    for side in (-1.0, 1.0):
        out = _directions(side * cosines, azimuths)
        k, r = (one[:, None, :, :] for one in out)  # outgoing first
        k0, r0 = (one[None, :, :, :] for one in into)
        cos_scatter = np.clip((k * k0).sum(-1), -1.0, 1.0)
        columns = [scattered(unit, r0, k0, k, r, matrix) for unit in np.eye(4)]
        values = 4.0 * np.pi * density(cos_scatter)[..., None, None] * np.stack(columns, -1)  # [out, in, phi, 4, 4]
        terms = np.fft.fft(values, axis=2)[:, :, : orders + 1] / count
        terms = terms[..., :components, :components]
        size = components * cosines.size
        results.append(np.transpose(terms, (2, 0, 3, 1, 4)).reshape(orders + 1, size, size))
    return results[0], results[1]


def _directions(cosines: NDArray, azimuths: NDArray) -> tuple[NDArray, NDArray]:
    """Unit directions and their φ̂ [cosine, azimuth, 3]."""
    sine = np.sqrt(np.maximum(1.0 - cosines**2, 0.0))[:, None]
    cos, sin = np.cos(azimuths), np.sin(azimuths)
    direction = np.stack(np.broadcast_arrays(sine * cos, sine * sin, cosines[:, None]), -1)
    reference = np.broadcast_to(np.stack([-sin, cos, np.zeros_like(cos)], -1), direction.shape)
    return direction, reference


def _slab(mu: NDArray, above: _Above, same: NDArray, opposite: NDArray, albedo: float, optical_depth: float) -> Layer:
    depth = optical_depth * 2.0**-_START
    out, into = mu[:, None], mu[None, :]
    # so thin that light scatters at most once
    reflect = albedo * opposite / 4.0 * -np.expm1(-depth * (1.0 / out + 1.0 / into)) / (out + into)
    transmit = albedo * same / 4.0 * np.exp(-depth / out) * depth / (out * into)
    for doubling in range(_START):
        direct = np.exp(-depth * 2.0**doubling / mu)
        reflect, down = above((reflect, transmit, direct), reflect)
        transmit = transmit * direct + direct[:, None] * down + (transmit * above.weights) @ down
    return reflect, transmit, np.exp(-optical_depth / mu)
