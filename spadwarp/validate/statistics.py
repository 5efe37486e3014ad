"""From scores to z values, and from many z values to one verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Estimate", "Quantity", "ScoreMeans", "batch_means", "holm", "quantities", "two_sided_p"]


@dataclass(frozen=True)
class Estimate:
    """A measured number with its standard error, and the degrees of freedom of that error (inf: exactly known)."""

    value: float
    standard_error: float
    degrees: float = math.inf


@dataclass(frozen=True)
class Quantity:
    """One measured number of a case beside its reference.

    Attributes:
        name: What was measured, with its unit.
        estimate: The simulator's value.
        reference: The known value.
        reference_error: Standard error of the reference, 0 where it is known.
        rounding: Half a unit of the last published digit: the reference lies within it, and z counts from its edge.
    """

    name: str
    estimate: Estimate
    reference: float
    reference_error: float = 0.0
    rounding: float = 0.0

    @property
    def standard_error(self) -> float:
        """Of the difference between value and reference."""
        return math.hypot(self.estimate.standard_error, self.reference_error)

    @property
    def z(self) -> float:
        """Standard normal deviate of the difference; without any error 0 for equality and ±inf else."""
        distance = self.estimate.value - self.reference
        difference = math.copysign(max(abs(distance) - self.rounding, 0.0), distance)
        if self.standard_error == 0.0:
            return math.copysign(math.inf, difference) if difference else 0.0
        return _normal_from_t(difference / self.standard_error, self.estimate.degrees)


def quantities(
    names: Iterable[str], estimates: Iterable[Estimate], references: Iterable[float], *, rounding: float = 0.0
) -> list[Quantity]:
    """One quantity for each name, estimate and reference, which are equally many."""
    return [
        Quantity(name, estimate, reference, rounding=rounding)
        for name, estimate, reference in zip(names, estimates, references, strict=True)
    ]


@dataclass
class ScoreMeans:
    """Means over photons of several scores that arrive block by block: `add` arrays `[N, scores]` or `[N]`."""

    count: int = 0
    total: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    square: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))

    def add(self, scores: ArrayLike) -> None:
        array = np.asarray(scores, np.float64)
        array = array.reshape(len(array), -1)
        self.count += len(array)
        self.total = self.total + array.sum(axis=0)
        self.square = self.square + (array**2).sum(axis=0)

    def estimates(self) -> list[Estimate]:
        """One estimate a score."""
        mean = self.total / self.count
        variance = np.maximum(self.square / self.count - mean**2, 0.0) / max(self.count - 1, 1)
        return [Estimate(float(m), float(v)) for m, v in zip(mean, np.sqrt(variance), strict=True)]


def batch_means(batches: ArrayLike) -> list[Estimate]:
    """Estimates from independent runs of equal size: `[batches, quantities]`, at least two batches."""
    array = np.asarray(batches, np.float64)
    array = array.reshape(len(array), -1)
    error = array.std(axis=0, ddof=1) / math.sqrt(len(array))
    degrees = float(len(array) - 1)
    return [Estimate(float(m), float(e), degrees) for m, e in zip(array.mean(axis=0), error, strict=True)]


def two_sided_p(z: float) -> float:
    """Probability that a standard normal number is at least as far from zero."""
    return math.erfc(abs(z) / math.sqrt(2.0))


def holm(p_values: Iterable[float]) -> list[float]:
    """Holm's family-wise p-values (1979), in the order given: reject where below the level of the whole family."""
    p: Sequence[float] = list(p_values)
    adjusted = [0.0] * len(p)
    largest = 0.0
    for rank, i in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        largest = max(largest, min(1.0, (len(p) - rank) * p[i]))
        adjusted[i] = largest
    return adjusted


def _normal_from_t(t: float, degrees: float) -> float:
    """The normal deviate as likely as Student's t, by Wallace (1959): within 0.04 from seven degrees of freedom on."""
    if math.isinf(degrees):
        return t
    z = math.sqrt(degrees * math.log1p(t * t / degrees)) * (8 * degrees + 1) / (8 * degrees + 3)
    return math.copysign(z, t)
