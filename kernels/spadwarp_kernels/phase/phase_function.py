"""What a phase function is to the transport kernels, and what the estimator `guided` draws from instead."""

from typing import NamedTuple

import warp as wp


@wp.struct
class Guiding:
    """How strongly directions are drawn towards the lens; where weights have grown or a vessel is likely, `guided_part`
    lowers the probabilities.

    Attributes:
        probability: Chance p that a water collision draws its direction from the lobe about the lens, in [0, 1);
            with delta tracking 1 - (1 - p)^2 for light that comes back, along u_z < 0.
        surface_probability: The same at a surface.
        anisotropy: g of that Henyey-Greenstein lobe; phase functions with a guide have one of their own.
        return_probability: Chance that an event outside the view draws its direction from a lobe towards the optical
            axis, so that light that strayed comes back into the view more often, in [0, 1).
        return_anisotropy: g of that lobe.
    """

    probability: float
    surface_probability: float
    anisotropy: float
    return_probability: float
    return_anisotropy: float


class PhaseGuide(NamedTuple):
    """What `guided` draws from instead of a phase function p that it cannot invert; all are Warp functions.

    The angle theta in (0, pi) by which light on a flight turns to reach the lens has the density q(theta), per radian
    and of any scale: best is p(theta). Directions towards the lens have the density of a lobe [1/sr]: best is the
    integral of p from theta to pi, which the flight in such a direction brings, over the sine of theta, its distance
    from the lens. The lobe is about the very point of the lens at which that flight is scored.

    Attributes:
        complement: ``(theta: float, medium: Medium) -> float``, integral of q from theta to pi; falls with theta.
        angle: ``(value: float, medium: Medium) -> float``, the inverse of it.
        density: ``(theta: float, medium: Medium) -> float``, q itself.
        lobe_pdf: ``(t: float, medium: Medium, guiding: Guiding) -> float``, t = 1 - cos of the angle to the lens.
        lobe_sample: ``(xi: float, medium: Medium, guiding: Guiding) -> float``, returns t.
        chord: The functions take, and q is over, the chord c = 2 sin(theta/2) in (0, 2) instead of theta, which needs
            no trigonometry: Henyey-Greenstein is (a^2 + c^2)^(-3/2) without approximation, a^2 = (1 - g)^2/g.
    """

    complement: wp.Function
    angle: wp.Function
    density: wp.Function
    lobe_pdf: wp.Function
    lobe_sample: wp.Function
    chord: bool = False


class PhaseFunction(NamedTuple):
    """A phase function as the transport kernels take it.

    Attributes:
        name: Identifies it in the kernel cache and in files.
        pdf: Warp function ``(t: float, medium: Medium) -> float``, density [1/sr].
        sample: Warp function ``(xi: float, medium: Medium) -> float``, returns t = 1 - cos(theta).
        guide: How the estimator `guided` follows it; None: as it follows Henyey-Greenstein with the medium's
            anisotropy. No guide makes it wrong, a poor one makes it noisy.
    """

    name: str
    pdf: wp.Function
    sample: wp.Function
    guide: PhaseGuide | None = None
