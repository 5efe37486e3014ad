"""Phase functions of the water, as densities per steradian over the scattering angle.

Everything is written in t = 1 - cos(theta), not in cos(theta): the float32 grid is finest at 0, where the forward peak
of
natural water lies, while cos(theta) loses every angle below 3e-4 rad.
"""

from typing import TYPE_CHECKING, NamedTuple

import warp as wp

from .medium import Medium

if TYPE_CHECKING:
    from .guided import PhaseGuide

_INV_4PI = wp.constant(0.07957747154594767)


@wp.func
def henyey_greenstein_pdf(t: float, g: float) -> float:
    """Henyey-Greenstein density [1/sr] at t = 1 - cos(theta) in [0, 2], for g in (-1, 1); mean cosine g (Henyey &
    Greenstein 1941)."""
    root = 1.0 / wp.sqrt((1.0 - g) * (1.0 - g) + 2.0 * g * t)
    return _INV_4PI * (1.0 - g * g) * (root * root * root)


@wp.func
def sample_henyey_greenstein(xi: float, g: float) -> float:
    """t = 1 - cos(theta) drawn from Henyey-Greenstein for uniform xi in [0, 1); small xi is forward
    (eq 14, rearranged).

    Equal in distribution to cos(theta) = [1 + g^2 - ((1 - g^2)/(1 - g + 2 g xi))^2]/(2 g), without its cancellation
    at the peak and without its singularity at g = 0.
    """
    inverse = 1.0 / (1.0 + g - 2.0 * g * xi)
    return wp.min((1.0 - g) * xi * inverse * ((1.0 - g * g) * inverse + (1.0 - g)), 2.0)


class PhaseFunction(NamedTuple):
    """A phase function as the transport kernels take it.

    Attributes:
        name: Told apart by name in the kernel cache and in files.
        pdf: Warp function ``(t: float, medium: Medium) -> float``, density [1/sr].
        sample: Warp function ``(xi: float, medium: Medium) -> float``, returns t = 1 - cos(theta).
        guide: How the estimator `guided` follows it; None: as it follows Henyey-Greenstein with the medium's
            anisotropy. No guide makes it wrong, a poor one makes it noisy.
    """

    name: str
    pdf: wp.Function
    sample: wp.Function
    guide: "PhaseGuide | None" = None


@wp.func
def _hg_pdf(t: float, medium: Medium) -> float:
    return henyey_greenstein_pdf(t, medium.anisotropy)


@wp.func
def _hg_sample(xi: float, medium: Medium) -> float:
    return sample_henyey_greenstein(xi, medium.anisotropy)


HENYEY_GREENSTEIN = PhaseFunction("henyey_greenstein", _hg_pdf, _hg_sample)
