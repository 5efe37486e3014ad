"""Whether a fit describes its counts: their deviance, and what it is in the mean if the fitted model is right.

The deviance of counts n with mean m is D = 2 Σ [n ln(n/m) − n + m]. Where counts are few it is far from χ²: its mean and
variance are sums over the Poisson distribution, for binomial counts times v/m and its square. Fitted unknowns lower the
mean, the noise of the simulation in m raises it; both are computed. D is taken over all pixels and bins, over the bins
of all pixels together and over the pixels with all bins together: the sums see what is small in each pixel.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.inverse.equations import Moments, Rows, Solution, pseudo_inverse
from spadwarp.values import percent

__all__ = ["Deviance", "Goodness"]

Floats = NDArray[np.float64]

_ENOUGH = 5.0  # counts that a cell expects: then noise of its mean is small against the mean
_BAD = 1e-3  # p-value
_LEAST = 1e-12  # mean counts of the table
PARTS, COMPONENTS = ("pixels and bins", "time", "image"), ("target", "water", "noise")


@dataclass(frozen=True, kw_only=True)
class Deviance:
    """The deviance of counts from a fit.

    Attributes:
        deviance: The sum over bins, pixels, or both.
        expected, standard_deviation: Of it, if the model is right.
        p: Probability of one as large or larger, if the model is right; NaN where nothing is expected.
        counts: In them.
    """

    deviance: float
    expected: float
    standard_deviation: float
    p: float
    counts: int

    @property
    def variance(self) -> float:
        """Square of `standard_deviation`."""
        return self.standard_deviation**2


@dataclass(frozen=True, eq=False, kw_only=True)
class Goodness:
    """Whether a fit describes its counts.

    Attributes:
        p: Probability of deviances as large or larger than those of `parts`, if the model is right; NaN: not known.
        parts: Deviances: "pixels and bins", "time" (pixels added up), "image" (bins added up).
        components: Those of pixels and bins in which light of the "target", light of the "water", or "noise" (dark
            counts and ambient light) is the largest part of the mean.
        misfit: Root mean square difference of counts and fit over time, beyond their noise, over the counts.
        pixels: Deviance of each pixel less the expected one, in standard deviations, `[H, W]`.
    """

    p: float
    parts: Mapping[str, Deviance]
    components: Mapping[str, Deviance]
    misfit: float
    pixels: Floats = field(repr=False)

    @property
    def is_bad(self) -> bool:
        """Whether p is below 0.001."""
        return self.p < _BAD

    def to_dict(self) -> dict[str, Any]:
        """The numbers without the map, for JSON."""
        groups = {name: {k: vars(one) for k, one in getattr(self, name).items()} for name in ("parts", "components")}
        return {"p": self.p, "is_bad": self.is_bad, "misfit": self.misfit, **groups}

    def summary(self) -> str:
        """One line."""
        name, worst = min(self.parts.items(), key=lambda item: item[1].p)
        text = f"deviance of {name} {worst.deviance:.4g}, expected {worst.expected:.4g} ± {worst.standard_deviation:.2g}"
        return f"{text}, p = {self.p:.2g}"

    def warnings(self) -> list[str]:
        """The sentence on a bad fit."""
        if not self.is_bad:
            return []
        shares = ", ".join(
            f"{name} {one.deviance:.4g} ({one.expected:.4g} ± {one.standard_deviation:.2g} expected)"
            for name, one in self.components.items()
        )
        return [
            f"bad fit: {self.summary()}; the counts differ from it by {percent(self.misfit)} % beyond their noise. The "
            f"scene is not that of the counts, and the standard errors do not contain what is wrong. Deviance by "
            f"component: {shares}"
        ]


def goodness(
    counts: NDArray[np.integer], mean: Rows, variance: Rows, batches: Sequence[Rows], lowered: Floats, parts: Sequence[Rows]
) -> Goodness:
    """Goodness of a fit from counts `[H, W, T]`.

    Args:
        counts, mean, variance: Of the fitted model, float32 `[pixel, bin]`.
        batches: The mean by each batch of photons of it.
        lowered: By how much the fitted unknowns lower the expected deviance of `parts`, in their order.
        parts: Of the mean of light of the targets, of water and of noise.
    """
    image, rows = counts.shape[:2], counts.reshape(mean.shape)
    pieces = np.stack([mean, variance, *batches, *parts]).astype(np.float64)
    number = 2 + len(batches)
    first, pixel = _cells(pieces[0])
    sums = np.add.reduceat(pieces.reshape(len(pieces), -1), first, axis=1)
    cells = _Cells(np.add.reduceat(rows.ravel(), first), sums[:number])
    in_time, of_image = pieces[:number].sum(axis=1), pieces[:number].sum(axis=2)
    first = _cells(in_time[:1])[0]
    time = _Cells(np.add.reduceat(rows.sum(axis=0), first), np.add.reduceat(in_time, first, axis=1))
    found = dict(zip(PARTS, (cells, time, _Cells(rows.sum(axis=1), of_image)), strict=True))
    deviances = {name: one.deviance(loss) for (name, one), loss in zip(found.items(), lowered, strict=True)}
    kinds = np.argmax(sums[number:], axis=0)
    excess, variances = (np.bincount(pixel, x) for x in (cells.each - cells.expected, cells.variance))
    # Cells are parts of pixels: what they have beyond these is independent of it.
    whole, per_pixel = deviances[PARTS[0]], deviances["image"]
    within = (getattr(whole, name) - getattr(per_pixel, name) for name in ("deviance", "expected", "variance"))
    known = [p for p in (_tail(*within), deviances["time"].p, per_pixel.p) if not np.isnan(p)]
    beyond = deviances["time"].deviance - deviances["time"].expected
    return Goodness(
        p=float(-np.expm1(len(known) * np.log1p(-min(known)))) if known and min(known) < 1.0 else 1.0,
        parts=deviances,
        components={name: cells.of(kinds == k).deviance() for k, name in enumerate(COMPONENTS) if (kinds == k).any()},
        misfit=float(np.sqrt(max(beyond, 0.0) / max(rows.sum(), 1))),
        pixels=(excess / np.sqrt(np.maximum(variances, 1e-300))).reshape(image),
    )


def _cells(mean: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Neighbouring bins that together expect enough counts: the first of each in a flat `[pixel, bin]`, its pixel."""
    total = mean.sum(axis=1, keepdims=True)
    cell = np.minimum((np.cumsum(mean, axis=1) - mean) // _ENOUGH, np.maximum(total // _ENOUGH - 1.0, 0.0))
    starts = np.diff(cell, axis=1, prepend=-1.0) > 0
    first = np.flatnonzero(starts)
    return first, first // mean.shape[1]


class _Cells:
    """Counts of cells with the pieces mean, variance and batches of the mean, and the moments of their deviances."""

    def __init__(self, counts: NDArray[np.integer], pieces: Floats) -> None:
        self.counts, self.pieces, self.number = counts, pieces, len(pieces) - 2
        mean = np.maximum(pieces[0], _LEAST)
        self.each = 2.0 * (counts * np.log(np.maximum(counts, 1) / mean) * (counts > 0) - counts + mean)
        noise, share = pieces[2:].var(axis=0, ddof=1) / self.number, pieces[1] / mean
        first, second, bend = _poisson_moments(mean)
        self.expected = share * first + noise / mean * bend
        self.variance = share**2 * second + 4.0 * share * noise / mean

    def of(self, chosen: NDArray[np.bool_]) -> _Cells:
        """Some of them."""
        return _Cells(self.counts[chosen], self.pieces[:, chosen])

    def deviance(self, lowered: float = 0.0) -> Deviance:
        """Of all together; the fitted unknowns have lowered the expected one."""
        # tr C² of the covariance of the mean, whose cells share photons, from products of different batches.
        batches = self.pieces[2:]
        white = (batches - batches.mean(axis=0)) / np.sqrt(np.maximum(self.pieces[0], _LEAST))
        products = (white @ white.T)[np.triu_indices(self.number, 1)]
        shared = 2.0 * float(np.var(products)) / self.number**2 * (1.0 + 1.0 / (self.number - 1))
        total, expected = float(self.each.sum()), float(self.expected.sum()) - lowered
        variance = float(self.variance.sum()) + shared
        p, number = _tail(total, expected, variance), int(self.counts.sum())
        return Deviance(deviance=total, expected=expected, standard_deviation=variance**0.5, p=p, counts=number)


def _tail(deviance: float, expected: float, variance: float) -> float:
    """Probability of a deviance as large or larger: of the gamma distribution, which χ² is, with these moments."""
    from scipy.stats import gamma

    if not (expected > 0.0 and variance > 0.0):
        return np.nan
    return float(gamma.sf(deviance, expected**2 / variance, scale=variance / expected))


def _poisson_moments(mean: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean and variance of the deviance of a Poisson count, and by how much the variance of its mean, over the mean,
    raises D − E[D]."""
    nodes, *tables = _poisson_table()
    low, high = np.log(np.clip(mean, _LEAST, nodes[-1])), 1.0 / np.maximum(mean, nodes[-1])
    beyond = (1.0 + high / 6.0, 2.0 + 2.0 * high / 3.0, 1.0 + 0.0 * high)
    first, second, bend = (
        np.where(mean > nodes[-1], far, np.interp(low, np.log(nodes), table))
        for far, table in zip(beyond, tables, strict=True)
    )
    return first, second, bend


@functools.cache
def _poisson_table() -> tuple[Floats, ...]:
    """Means, and of each the sums over the Poisson distribution."""
    from scipy.special import gammaln

    nodes, n = np.geomspace(_LEAST, 50.0, 800)[:, None], np.arange(160)
    weights = np.exp(n * np.log(nodes) - nodes - gammaln(n + 1.0))
    logarithm = n * np.log(np.maximum(n, 1))
    each = 2.0 * (logarithm - n * np.log(nodes) - n + nodes)
    first = (weights * each).sum(axis=1)
    second = (weights * (each - first[:, None]) ** 2).sum(axis=1)
    bend = 2.0 - nodes[:, 0] * (weights[:, :-2] @ np.diff(logarithm, 2))
    return nodes[:, 0], first, second, bend
