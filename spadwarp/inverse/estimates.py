"""Estimates of a fit: values with covariance and intervals, maps, what limits them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.units import percent

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["Estimate", "EstimateMap", "Fit", "Iteration"]

Floats = NDArray[np.float64]

NORMAL_95 = 1.959963984540054
_CORRELATED = 0.99
_UNSURE = 0.5


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One value for the whole exposure.

    Attributes:
        name: Of the unknown; depth is that of the target in the pixel nearest to the middle of the image.
        value: The estimate, in SI units.
        standard_error: Of counts and simulation together.
        interval: 95 %; of positive values from the standard error of the logarithm.
        simulation: The part of the variance that is noise of the simulation.
        initial_guess: Where the search began.
        unit: "" for a plain number.
    """

    name: str
    value: float
    standard_error: float
    interval: tuple[float, float]
    simulation: float
    initial_guess: float
    unit: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class EstimateMap:
    """A value for each pixel, float64 `[H, W]`; NaN where the counts say nothing of it."""

    name: str
    value: Floats
    standard_error: Floats
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """A rendering and the step from it: `gain` is the log-likelihood that the step promises."""

    values: Mapping[str, float]
    gain: float
    photons: int
    coarse: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """A maximum-likelihood fit of counts.

    Attributes:
        scene: With the estimates in place of the unknowns.
        estimates: By name, what is one value for the whole exposure.
        maps: By name, what is a value for each pixel.
        names, covariance: Of the estimates on the scale that is searched, the logarithm for positive values.
        iterations: In order.
        converged: Whether the last step promised less than the noise of the likelihood.
        warnings: What may mislead, in words.
        depth: Depth of the targets by the fit, float64 `[H, W]` [m], NaN without a target; None unless it was unknown.
        counts, expected: `[H, W, T]`: what was fitted, and its mean by the last rendering, float32.
        edges: Of the bins in time of flight [s].
        pulses: In all.
        photons: Traced by the whole fit.
        seconds: It took.
    """

    scene: Scene
    estimates: Mapping[str, Estimate]
    maps: Mapping[str, EstimateMap]
    names: Sequence[str]
    covariance: Floats
    iterations: Sequence[Iteration]
    converged: bool
    warnings: Sequence[str]
    depth: Floats | None
    counts: NDArray[np.integer] = field(repr=False)
    expected: NDArray[np.float32] = field(repr=False)
    edges: Floats = field(repr=False)
    pulses: int
    photons: int
    seconds: float

    @property
    def correlation(self) -> Floats:
        """Correlations of the estimates, in the order of `names`."""
        return correlations(self.covariance)

    def __repr__(self) -> str:
        values = [f"{item.name} {item.value:.4g} ± {item.standard_error:.2g}" for item in self.estimates.values()]
        return f"Fit({', '.join([*values, *(f'{name} of each pixel' for name in self.maps)])})"

    def to_dict(self) -> dict[str, Any]:
        """The numbers without maps, for JSON."""
        return {
            "estimates": {name: vars(item) for name, item in self.estimates.items()},
            "names": list(self.names),
            "covariance": self.covariance.tolist(),
            "correlation": self.correlation.tolist(),
            "converged": self.converged,
            "warnings": list(self.warnings),
            "iterations": [{**vars(item), "values": dict(item.values)} for item in self.iterations],
            "pulses": self.pulses,
            "counts": int(self.counts.sum()),
            "photons": self.photons,
            "seconds": self.seconds,
        }

    def plot(self, **options: Any) -> Any:
        """A figure of counts, fit and residuals; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(self, **options)


def correlations(covariance: Floats) -> Floats:
    """Correlations of a covariance; 0 where a variance is 0."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(scale > 0, scale, np.inf)
    return covariance / np.outer(scale, scale)


def not_identifiable(names: Sequence[str], covariance: Floats, positive: Sequence[bool]) -> list[str]:
    """Sentences on unknowns that the counts do not tell apart, or not at all."""
    sentences = []
    correlation = correlations(covariance)
    for i, name in enumerate(names):
        for j in range(i):
            if abs(correlation[i, j]) > _CORRELATED:
                sentences.append(
                    f"{names[j]} and {name} are hardly told apart (correlation {correlation[i, j]:+.4f}): hold one of "
                    "them fixed, or give it a prior"
                )
        if positive[i] and np.sqrt(covariance[i, i]) > _UNSURE:
            error = percent(covariance[i, i] ** 0.5)
            sentences.append(f"{name}: the counts say little of it (standard error {error} %)")
    return sentences
