"""How much of a frame's noise is that of the simulation: it is the same in every frame, which no camera's is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.result.result import Result
from spadwarp.scene import detection_efficiency, noise_rate

if TYPE_CHECKING:
    from spadwarp.scene import Detector, Laser

__all__ = ["LIMIT", "MonteCarloNoise", "monte_carlo_noise", "noise_caption"]

LIMIT = 0.5
"""Standard error of a pixel over its shot noise from which on it counts: variances then add up to 1.25 times."""

_PART = 0.95  # of the pixels that have to be below the limit


@dataclass(frozen=True, kw_only=True)
class MonteCarloNoise:
    """The standard error of a result against the shot noise of one frame, both of the counts of a pixel.

    Attributes:
        pulses: Of the frame.
        ratio: Standard error over shot noise, at the 95th percentile of the pixels.
        pixels: Part of the pixels in which it is above 0.5.
        photons: That were traced.
        photons_needed: That would bring `ratio` to 0.5, from its fall with the square root of their number.
    """

    pulses: int
    ratio: float
    pixels: float
    photons: int
    photons_needed: float

    @property
    def exceeds(self) -> bool:
        """Whether the frames show it."""
        return self.ratio > LIMIT

    def __str__(self) -> str:
        return (
            f"Monte Carlo noise, the same in every frame: the standard error of the simulation is above {LIMIT:g} of "
            f"the shot noise of {self.pulses} pulses in {100 * self.pixels:.3g} % of the pixels, and {self.ratio:.2g} "
            f"of it at the 95th percentile; about {self.photons_needed:.1e} photons instead of {self.photons:.1e} "
            f"would make that {LIMIT:g}"
        )


UNKNOWN = (
    "Monte Carlo noise is unknown: the result keeps no standard errors (simulate with --uncertainty); the noise of its "
    "histograms is drawn as if it were light, the same in every frame, and counts as information in the Cramér–Rao "
    "bound, which is too small where few photons were traced"
)


def noise_caption(ratio: float | None) -> str:
    """For the caption of a picture of frames that show the noise of the simulation; else empty."""
    if ratio is None or ratio <= LIMIT:
        return ""
    return f"; too few photons traced: Monte Carlo noise of expected and counts {ratio:.2g} times the shot noise"


def monte_carlo_noise(
    result: Any, *, pulses: int, detector: Detector | None = None, laser: Laser | None = None
) -> MonteCarloNoise | None:
    """The noise that frames of so many pulses inherit from a result; None where it keeps no standard errors.

    Args:
        result: A `Result`.
        pulses: Of one frame.
        detector, laser: Sections of a scene; default: those of the result's.
    """
    if not isinstance(result, Result) or result.second_moment is None or result.photons < 2 * result.batch_size:
        return None
    scene = result.scene
    detector, laser = detector or scene.detector, laser or scene.laser
    scale = laser.photons_per_pulse * detection_efficiency(laser, detector)
    # Bins are nearly independent: a history adds to few of those of one pixel.
    error = np.sqrt(np.square(result.standard_error).sum(axis=2)) * scale
    seen = scene.model_copy(update={"detector": detector, "laser": laser})
    noise = noise_rate(seen, result.truth)
    expected = result.intensity * scale + (noise[..., 0] if np.ndim(noise) else noise) * (
        scene.gate.stop - scene.gate.start
    )
    # A first-photon detector counts one a pulse at most, of light and error in the same measure.
    counted = pulses * (-np.expm1(-expected) if detector.mode == "first_photon" else expected)
    ratios = np.sqrt(counted) * np.divide(error, expected, out=np.zeros_like(error), where=expected > 0)
    ratio = float(np.quantile(ratios, _PART))
    return MonteCarloNoise(
        pulses=pulses,
        ratio=ratio,
        pixels=float(np.mean(ratios > LIMIT)),
        photons=result.photons,
        photons_needed=result.photons * (ratio / LIMIT) ** 2,
    )
