"""Exact moments and densities of light in an infinite medium, in float64."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Moments:
    """Of photons from the origin along +z: mean depth [m], mean square distance [m²], mean cosine of the direction."""

    z: float
    r2: float
    cos_theta: float


def after_collisions(count: int, *, extinction: float, anisotropy: float) -> Moments:
    """At the position of the count-th collision, and with the direction after it.

    Flights are independent with mean 1/c and mean square 2/c²; directions k flights apart have a mean cosine of gᵏ.
    """
    g = anisotropy
    z = sum(g**k for k in range(count))
    r2 = 2 * count + 2 * sum((count - k) * g**k for k in range(1, count))
    return Moments(z / extinction, r2 / extinction**2, g**count)


def after_path(path: float, *, scattering: float, anisotropy: float) -> Moments:
    """After a fixed path. The direction forgets itself at the rate of the transport coefficient b(1 − g)."""
    rate = scattering * (1 - anisotropy)
    decay = -math.expm1(-rate * path)
    return Moments(decay / rate, 2 * (path - decay / rate) / rate, 1 - decay)


def snapped_mean_cosines(count: int, *, anisotropy: float, axis_threshold: float) -> NDArray[np.float64]:
    """Mean cosine of the direction after 0, 1, … `count` collisions of a beam along +z under the near-axis rule.

    The rule takes an incoming direction with |u_z| >= axis_threshold for the axis itself. The density of the cosine is
    followed from collision to collision by quadrature: what is snapped scatters from the poles, the rest from where it
    is.
    """
    g, degree = anisotropy, 600
    node, gauss = np.polynomial.legendre.leggauss(700)
    mu, weight = axis_threshold * node, axis_threshold * gauss
    orders = np.arange(degree + 1)
    coefficients = (2 * orders + 1) / 2 * g**orders  # of Henyey–Greenstein's density in the cosine
    polynomials = np.polynomial.legendre.legvander(mu, degree)
    integrals = np.stack([_legendre_integral(axis_threshold, degree), _legendre_integral(-axis_threshold, degree)])
    means = [1.0]
    moments = np.ones(degree + 1)  # of the snapped incoming direction: ⟨P_k⟩
    for _ in range(count):
        expansion = coefficients * moments
        means.append(g * moments[1])
        density = polynomials @ expansion
        # mass beyond the threshold at either pole: ∫P_k from t to 1, and from −1 to −t
        forward = expansion @ integrals[0]
        backward = expansion @ (2 * (orders == 0) - integrals[1])
        moments = forward + backward * (-1.0) ** orders + (weight * density) @ polynomials
    return np.array(means)


def _legendre_integral(start: float, degree: int) -> NDArray[np.float64]:
    """∫P_k from `start` to 1 for k = 0 … degree."""
    p = np.polynomial.legendre.legvander(np.array([start]), degree + 1)[0]
    k = np.arange(1, degree + 1)
    return np.concatenate([[1 - start], (p[:-2] - p[2:]) / (2 * k + 1)])


def isotropic_radial_cdf(radius: ArrayLike, *, path: float, scattering: float) -> NDArray[np.float64]:
    """Probability that a photon from an isotropic point source is within `radius` [m] after `path`; isotropic
    scattering.

    This is the time-resolved fluence, integrated over a ball and freed of absorption. From the exact Fourier–Laplace
    solution of the transport equation in units of mean free paths, P(k, s) = A/(1 − A) with A = [ln(s + 1 + ik) − ln(s
    + 1 − ik)]/(2ik): a pole at s + 1 = k·cot k while k < π, and cuts from ±ik to ±ik − ∞. The unscattered front (e⁻ᵗ
    at r = t, outside of every radius < path) and the light scattered once (density ∝ ln((t + r)/(t − r))/r) are taken
    out in closed form (A + A² out of A/(1 − A)), so that what is transformed back numerically falls as k⁻³. Error
    below 1e-6.
    """
    t = path * scattering
    x = np.atleast_1d(np.asarray(radius, np.float64)) / path
    inside = x < 1
    once = np.where(inside, x - (1 - x * x) * np.arctanh(np.where(inside, x, 0.0)), 1.0)

    panels = np.concatenate([np.linspace(0, math.pi, 33), np.arange(math.pi, 4000 / t, 2 / t)[1:]])
    node, gauss = np.polynomial.legendre.leggauss(8)
    width = np.diff(panels)[:, None] / 2
    k = (panels[:-1, None] + width * (node + 1)).ravel()
    weight = (width * gauss).ravel()
    pole = np.zeros_like(k)
    near = k[k < math.pi]
    pole[k < math.pi] = near**2 / np.sin(near) ** 2 * np.exp(t * near / np.tan(near))

    # along the cut s + 1 = ik − ξ, ξ = e^η: the logarithm at the branch point decays exponentially in η
    eta, step = np.linspace(-36.0, math.log(40 / t), 500, retstep=True)
    xi = np.exp(eta)
    cut = np.empty_like(k)
    for part in np.array_split(np.arange(k.size), max(1, k.size // 2000)):
        wave = k[part, None]
        mean = np.log(-xi + 2j * wave) - eta
        below, above = ((mean + sign * 1j * math.pi) / (2j * wave) for sign in (1, -1))
        jump = below**3 / (1 - below) - above**3 / (1 - above)
        integral = (np.exp(-t * xi) * xi * jump).sum(1) * step
        cut[part] = (np.exp(1j * t * k[part]) * integral / (1j * math.pi)).real
    kr = k * (x * t)[:, None]
    twice = 2 / math.pi * ((np.sin(kr) - kr * np.cos(kr)) / k * (pole + cut) * weight).sum(1)
    return np.where(inside, math.exp(-t) * (t * once + twice), 1.0)
