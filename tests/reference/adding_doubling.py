"""Radiative transfer in plane-parallel, index-matched slabs by doubling and adding (van de Hulst 1980, chapter 4).

In float64. Everything is averaged over azimuth, which is all that normal incidence asks for. Kernels R(μ, μ') are
reflection functions: the radiance that leaves along μ is R(μ, μ')·μ'·F for a beam of irradiance πF normal to itself, so
that a diffuse kernel acts on another by (A∘B)(μ, μ'') = 2∫A(μ, μ')·B(μ', μ'')·μ' dμ'. The undeviated beam is kept apart
from the diffuse kernels, which lets the start be a layer so thin (τ·2⁻⁴⁰) that single scattering is exact for it.

Nodes of weight zero (the beam's cosine 1, and any cosine where the exit density is wanted) take part as rows and
columns and carry no flux, so the result at them is as exact as the quadrature and needs no interpolation.

Henyey–Greenstein's azimuthal average is its Legendre series, summed until its terms vanish, with so many Gauss nodes
that the quadrature still resolves it (g^{2N} < 1e-12): the forward peak needs no truncation (delta-M) then.

The same equations hold for complex optical depth and albedo. With a = s, R(s) is the Laplace transform over path
length of the time-resolved reflectance; `cumulative_reflectance` inverts it numerically.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

_START = 40  # doublings from the single-scattering layer to the slab


@dataclass(frozen=True)
class Slab:
    """What a pencil or plane beam at normal incidence leaves through: fractions of the incident power.

    reflected, transmitted (diffuse and direct together), direct: floats (complex for a complex medium).
    mu [M]: the cosines asked for; reflection [M], transmission [M]: R(μ), diffuse T(μ) with R = 2∫R(μ)μ dμ.
    """

    reflected: complex
    transmitted: complex
    direct: complex
    mu: NDArray[np.float64]
    reflection: NDArray[np.complex128]
    transmission: NDArray[np.complex128]


def slab(
    *, anisotropy: float, albedo: complex, optical_depth: complex, mu: ArrayLike = (), nodes: int | None = None
) -> Slab:
    """Solve a slab, or with optical_depth = math.inf the half-space; `nodes` per hemisphere (None: by g)."""
    beam = nodes or _needed_nodes(anisotropy)
    asked = np.maximum(np.atleast_1d(np.asarray(mu, np.float64)), 1e-14)
    cosines, flux = _nodes(beam, asked)
    reflect, transmit, _ = _doubled(cosines, flux, anisotropy, albedo, optical_depth)
    direct = 0.0 if optical_depth == math.inf else np.exp(-optical_depth)
    return Slab(
        reflected=_real(flux @ reflect[:, beam]),
        transmitted=_real(flux @ transmit[:, beam] + direct),
        direct=_real(direct),
        mu=asked,
        reflection=_real(reflect[beam + 1 :, beam]),
        transmission=_real(transmit[beam + 1 :, beam]),
    )


def exit_cosine_fractions(
    *, anisotropy: float, albedo: float, optical_depth: float, edges: ArrayLike
) -> tuple[NDArray, NDArray]:
    """Diffuse power out of (the lit face, the far face) with an exit cosine in each [edges[i], edges[i + 1])."""
    edges = np.asarray(edges, np.float64)
    x, gauss = np.polynomial.legendre.leggauss(12)
    width = np.diff(edges)[:, None]
    mu = edges[:-1, None] + width * (x + 1) / 2
    solved = slab(anisotropy=anisotropy, albedo=albedo, optical_depth=optical_depth, mu=mu.ravel())
    weight = 2 * mu * width * gauss / 2
    back, forth = ((face.reshape(mu.shape) * weight).sum(1) for face in (solved.reflection, solved.transmission))
    return back, forth


def cumulative_reflectance(
    path: float, *, anisotropy: float, scattering: float, absorption: float, nodes: int | None = None
) -> float:
    """Fraction of a pulse on a half-space, at normal incidence, that has left it after at most `path` [m] in it.

    The Laplace transform over path is R at the absorption s; inverted for its running integral with the Euler
    summation of Abate and Whitt (1995), and with the absorption's own decay put back by shifting s. Error about 1e-8.
    """
    terms, euler, a = 24, 14, 19.0

    def transform(s: complex) -> complex:
        albedo = scattering / (scattering + absorption + s)
        return slab(anisotropy=anisotropy, albedo=albedo, optical_depth=math.inf, nodes=nodes).reflected / s

    values = [transform(complex(a, 2 * math.pi * k) / (2 * path)).real for k in range(terms + euler + 1)]
    series = values[0] / 2 + np.cumsum([0.0] + [(-1) ** k * values[k] for k in range(1, terms + euler + 1)])
    tail = [math.comb(euler, m) * 2.0**-euler * series[terms + m] for m in range(euler + 1)]
    return math.exp(a / 2) / path * math.fsum(tail)


def reflected_by_order(
    orders: int, *, anisotropy: float, albedo: float, optical_depth: float = math.inf, nodes: int | None = None
) -> NDArray[np.float64]:
    """Fractions reflected after 0, 1, … orders − 1 scatterings: coefficients of R's power series in the albedo, ωⁿRₙ.

    From R on the circle |ω| = albedo; orders beyond twice `orders` alias into the result, so take albedo**(2·orders) ≪
    1.
    """
    phases = 2j * math.pi * np.arange(2 * orders) / (2 * orders)
    values = [
        slab(anisotropy=anisotropy, albedo=albedo * np.exp(phase), optical_depth=optical_depth, nodes=nodes).reflected
        for phase in phases[: orders + 1]
    ]
    return np.fft.irfft(np.conj(values), 2 * orders)[:orders]


def _real(value):
    return value.real if np.all(np.imag(value) == 0) else value


def _redistribution(cosines: NDArray, g: float) -> tuple[NDArray, NDArray]:
    """Henyey–Greenstein averaged over azimuth, Σ(2k + 1)gᵏP_k(μ)P_k(±μ'): same and opposite side."""
    same, opposite = np.ones((2, cosines.size, cosines.size))
    previous, current = np.ones_like(cosines), cosines
    k = 1
    while (2 * k + 1) * abs(g) ** k > 1e-15:
        term = (2 * k + 1) * g**k * np.outer(current, current)
        same = same + term
        opposite = opposite + (-1) ** k * term
        previous, current = current, ((2 * k + 1) * cosines * current - k * previous) / (k + 1)
        k += 1
    return same, opposite


def _single_scattering(cosines: NDArray, same: NDArray, opposite: NDArray, albedo: complex, depth: complex):
    """Reflection and diffuse transmission of a layer in which light scatters at most once."""
    out, into = cosines[:, None], cosines[None, :]
    sum_ = 1 / out + 1 / into
    reflect = albedo * opposite / 4 * -np.expm1(-depth * sum_) / (out + into)
    difference = depth * (1 / into - 1 / out)
    small = np.abs(difference) < 1e-13
    safe = np.where(small, 1.0, difference)
    # (e^{-τ/μ} − e^{-τ/μ'})/(μ − μ') = e^{-τ/μ'}·(e^{δ} − 1)/δ·τ/(μμ'), δ = τ/μ' − τ/μ; written from the slower decay
    # to avoid overflow
    decay = np.where(np.real(difference) > 0, np.exp(-depth / out), np.exp(-depth / into))
    ratio = np.where(small, 1.0, np.where(np.real(difference) > 0, -np.expm1(-safe), np.expm1(safe)) / safe)
    transmit = albedo * same / 4 * decay * ratio * depth / (out * into)
    return reflect, transmit


def _doubled(cosines: NDArray, flux: NDArray, anisotropy: float, albedo: complex, optical_depth: complex):
    """Reflection, diffuse transmission and direct beam of a uniform layer, from one so thin that it scatters once."""
    half_space = optical_depth == math.inf
    depth = (64.0 if half_space else optical_depth) * 2.0**-_START
    reflect, transmit = _single_scattering(cosines, *_redistribution(cosines, anisotropy), albedo, depth)
    doublings = 0
    while doublings < _START or (half_space and np.abs(transmit).max() > 1e-14):
        # not by squaring: forty squarings of 1 - 1e-12 would leave an error of 1e-6 in the energy
        layer = (reflect, transmit, np.exp(-depth * 2.0**doublings / cosines))
        reflect, transmit, _ = _add(layer, layer, flux)
        doublings += 1
    return reflect, transmit, np.exp(-depth * 2.0**doublings / cosines)


def _add(upper: tuple[NDArray, NDArray, NDArray], lower: tuple[NDArray, NDArray, NDArray], flux: NDArray):
    """Reflection, transmission and direct beam of a uniform layer on top of another or of a stack, lit from above.

    Each is (reflect, transmit, direct); down and up are the diffuse kernels at the interface between them.
    """
    reflect, transmit, direct = upper
    below, passed, direct_below = lower
    twice = (reflect * flux) @ below
    down = np.linalg.solve(np.eye(flux.size) - twice * flux, transmit + twice * direct)
    up = below * direct + (below * flux) @ down
    return (
        reflect + direct[:, None] * up + (transmit * flux) @ up,
        passed * direct + direct_below[:, None] * down + (passed * flux) @ down,
        direct * direct_below,
    )


def stack(layers: Sequence[tuple[float, float, float]], *, nodes: int | None = None) -> tuple[float, float]:
    """Reflected and transmitted fractions of layers (anisotropy, albedo, optical depth) from the lit one on, normal
    incidence."""
    nodes = nodes or max(_needed_nodes(anisotropy) for anisotropy, *_ in layers)
    cosines, flux = _nodes(nodes)
    *others, whole = (_doubled(cosines, flux, *layer) for layer in layers)
    while others:
        whole = _add(others.pop(), whole, flux)
    reflect, transmit, direct = whole
    return float(flux @ reflect[:, nodes]), float(flux @ transmit[:, nodes] + direct[nodes])


def _needed_nodes(anisotropy: float) -> int:
    """Gauss nodes per hemisphere that resolve the phase function: g^{2N} < 1e-12."""
    needed = 0 if abs(anisotropy) < 1e-3 else math.log(1e-12) / (2 * math.log(abs(anisotropy)))
    return max(48, math.ceil(needed))


def _nodes(count: int, asked: ArrayLike = ()) -> tuple[NDArray, NDArray]:
    """Cosines: Gauss nodes, the beam's 1 at index `count`, those asked for; and their fluxes, 0 for the latter."""
    x, gauss = np.polynomial.legendre.leggauss(count)
    cosines = np.concatenate([(x + 1) / 2, [1.0], np.asarray(asked, np.float64)])
    flux = np.zeros(cosines.size)
    flux[:count] = gauss * (x + 1) / 2  # 2 μ dμ, with dμ = gauss/2
    return cosines, flux
