"""The phase function of Henyey and Greenstein.

Phase functions are written in t = 1 - cos(theta), not in cos(theta): the float32 grid is finest at 0, where the forward
peak of natural water lies, while cos(theta) loses every angle below 3e-4 rad.
"""

import warp as wp

from spadwarp_kernels.medium.water import Medium

from .phase_function import Guiding, PhaseFunction, PhaseGuide

_INV_4PI = wp.constant(0.07957747154594767)


@wp.func
def henyey_greenstein_pdf(t: float, g: float) -> float:
    """Henyey-Greenstein density [1/sr] at t = 1 - cos(theta) in [0, 2], for g in (-1, 1); mean cosine g (Henyey &
    Greenstein 1941)."""
    root = 1.0 / wp.sqrt((1.0 - g) * (1.0 - g) + 2.0 * g * t)
    return _INV_4PI * (1.0 - g * g) * (root * root * root)


@wp.func
def henyey_greenstein_score(t: float, g: float) -> float:
    """d ln p/dg of the Henyey-Greenstein density at t = 1 - cos(theta) in [0, 2], for g in (-1, 1); nothing cancels at
    the forward peak."""
    d = 1.0 - g
    return -2.0 * g / (d * (1.0 + g)) - 3.0 * (t - d) / (d * d + 2.0 * g * t)


@wp.func
def sample_henyey_greenstein(xi: float, g: float) -> float:
    """t = 1 - cos(theta) drawn from Henyey-Greenstein for uniform xi in [0, 1); small xi is forward
    (eq 14, rearranged).

    Equal in distribution to cos(theta) = [1 + g^2 - ((1 - g^2)/(1 - g + 2 g xi))^2]/(2 g), without its cancellation
    at the peak and without its singularity at g = 0.
    """
    inverse = 1.0 / (1.0 + g - 2.0 * g * xi)
    return wp.min((1.0 - g) * xi * inverse * ((1.0 - g * g) * inverse + (1.0 - g)), 2.0)


@wp.func
def _hg_pdf(t: float, medium: Medium) -> float:
    return henyey_greenstein_pdf(t, medium.anisotropy)


@wp.func
def _hg_sample(xi: float, medium: Medium) -> float:
    return sample_henyey_greenstein(xi, medium.anisotropy)


HENYEY_GREENSTEIN = PhaseFunction("henyey_greenstein", _hg_pdf, _hg_sample)


@wp.func
def _a2(medium: Medium) -> float:
    """a^2 = (1 - g)^2/g of q ~ (a^2 + c^2)^(-3/2); nearly uniform for g < 0.05."""
    return (1.0 - medium.anisotropy) * (1.0 - medium.anisotropy) / wp.max(medium.anisotropy, 0.05)


@wp.func
def _hg_complement(chord: float, medium: Medium) -> float:
    """1 - c/sqrt(a^2 + c^2) without cancellation."""
    a2 = _a2(medium)
    s = wp.sqrt(a2 + chord * chord)
    return a2 / (s * (s + chord))


@wp.func
def _hg_chord(value: float, medium: Medium) -> float:
    """c = a F/sqrt(1 - F^2) with F = 1 - value."""
    return wp.sqrt(_a2(medium)) * (1.0 - value) / wp.sqrt(value * (2.0 - value))


@wp.func
def _hg_density(chord: float, medium: Medium) -> float:
    a2 = _a2(medium)
    q = a2 + chord * chord
    return a2 / (q * wp.sqrt(q))


@wp.func
def _hg_lobe_pdf(t: float, medium: Medium, guiding: Guiding) -> float:
    return henyey_greenstein_pdf(t, guiding.anisotropy)


@wp.func
def _hg_lobe_sample(xi: float, medium: Medium, guiding: Guiding) -> float:
    return sample_henyey_greenstein(xi, guiding.anisotropy)


HENYEY_GREENSTEIN_GUIDE = PhaseGuide(_hg_complement, _hg_chord, _hg_density, _hg_lobe_pdf, _hg_lobe_sample, chord=True)
