"""Whether a fit describes its counts: their deviance, and what it is in the mean if the fitted model is right.

The deviance of counts n with mean m is D = 2 Σ [n ln(n/m) − n + m]. Of few counts it is not χ²: its mean and variance
are sums over the Poisson distribution, for binomial counts times v/m and its square. Fitted unknowns lower the mean,
noise of the simulation raises it, and both are computed. Besides that of all pixels and bins, there is one of the sums
over the pixels and one of those over time: they see what is small in each pixel and bin. A response of another width
has one degree of freedom, which none of these singles out: it has a score of its own (Rao 1948).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats
from spadwarp.values import percent

__all__ = ["Deviance", "Goodness"]

Rows = NDArray[np.float32]

_ENOUGH = 5.0  # counts that a cell expects: then noise of its mean is small against the mean
_LEAST = 1e-12  # mean counts of the table
_TURNS = 30  # of an iteration for the amount of light
COMPONENTS = ("target", "water", "noise")


@dataclass(frozen=True, kw_only=True)
class Deviance:
    """The deviance of counts from a fit."""

    deviance: float  # the sum over bins, pixels, or both
    expected: float  # of it, if the model is right
    standard_deviation: float  # of it, likewise
    p: float  # probability of one as large or larger, if the model is right; NaN where nothing is expected
    counts: int  # in them

    def __str__(self) -> str:
        return f"{self.deviance:.4g}, expected {self.expected:.4g} ± {self.standard_deviation:.2g}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Goodness:
    """Whether a fit describes its counts."""

    p: float  # probability of deviances as large or larger than those of `parts`, if the model is right; NaN: not known
    parts: Mapping[str, Deviance]
    """Deviances: "pixels and bins"; "image", the bins added up; the pixels added up, "time of the target" by the time
    since the return, in bins in which light of targets is the largest part, and "time of the rest" in the others;
    "width": the square of the score by the width of the response, in its variances."""
    components: Mapping[str, Deviance]
    """Those of pixels and bins in which light of the "target", light of the "water", or "noise" (dark counts and
    ambient light) is the largest part of the mean."""
    misfit: float  # root mean square difference of counts and fit over time, beyond their noise, over the counts
    pixels: Floats = field(repr=False)  # deviance of each pixel less the expected one, in standard deviations, `[H, W]`

    @property
    def is_bad(self) -> bool:
        """Whether p is below 0.001."""
        return self.p < 1e-3

    def to_dict(self) -> dict[str, Any]:
        """The numbers without the map, for JSON."""
        groups = {name: {k: vars(one) for k, one in getattr(self, name).items()} for name in ("parts", "components")}
        return {"p": self.p, "is_bad": self.is_bad, "misfit": self.misfit, **groups}

    def summary(self) -> str:
        """One line."""
        name, worst = min(self.parts.items(), key=lambda item: item[1].p)
        return f"deviance of {name} {worst}, p = {self.p:.2g}"

    def warnings(self) -> list[str]:
        """The sentence on a bad fit."""
        if not self.is_bad:
            return []
        shares = ", ".join(f"of {name} {one}" for name, one in self.components.items())
        return [
            f"bad fit: {self.summary()} ({shares}): the counts differ from the fit by {percent(self.misfit)} % of them "
            "beyond noise. The scene is not that of the counts; the standard errors do not contain what is wrong"
        ]


class Lost(NamedTuple):
    """What fitted unknowns take of the deviance: tr(A F), with F the information of cells by two independent slopes."""

    shared: Sequence[Floats]  # two slopes of the mean by the unknowns of all pixels, [S, pixel, bin]
    own: Sequence[Floats]  # by those of each pixel, [Q, pixel, bin]
    matrix: Floats  # A, [S, S]
    own_matrix: Floats  # [pixel, Q, Q]

    def of(self, mean: Floats, add_up: Callable[[Any], Any], pixel: NDArray[np.intp] | None) -> float:
        """Of cells with a `mean`, into which `add_up` adds `[…, pixel, bin]`; without `pixel` each has them all."""
        left, right = map(add_up, self.shared)
        loss = float(np.einsum("ic,jc,ij->", left / mean, right, self.matrix, optimize=True))
        most = len(self.matrix)
        if pixel is not None and len(self.own[0]):
            left, right = map(add_up, self.own)
            loss += float(np.einsum("ic,jc,cij->", left / mean, right, self.own_matrix[pixel], optimize=True))
            most += self.own_matrix[..., 0].size
        return min(max(loss, 0.0), float(most))

    def beside(self, change: Floats, mean: Floats) -> Floats:
        """Of a change of the mean `[pixel, bin]`, what no change of the fitted unknowns makes up for."""
        (left, right), (own_left, own_right) = self.shared, self.own
        taken = self.matrix @ np.einsum("ipt,pt->i", right, change / mean)
        own = np.einsum("pij,jpt,pt->pi", self.own_matrix, own_right, change / mean)
        return change - np.einsum("ipt,i->pt", left, taken) - np.einsum("ipt,pi->pt", own_left, own)


def goodness_of(
    counts: NDArray[np.integer],
    mean: Rows,
    variance: Rows,
    batches: Sequence[Rows],
    trials: Rows,
    lost: Lost,
    parts: Sequence[Rows],
) -> Goodness:
    """Goodness of a fit from counts `[H, W, T]`.

    Args:
        counts, mean, variance: Of the fitted model, float32 `[pixel, bin]`.
        batches: The mean by each batch of photons of it.
        trials: Pulses that can still count in each bin, of which the mean is a part.
        lost: To the fitted unknowns.
        parts: Of the mean, in the order of `COMPONENTS`.
    """
    image, rows = counts.shape[:2], counts.reshape(mean.shape)
    pieces, number = np.stack([mean, variance, *batches, *parts]).astype(np.float64), 2 + len(batches)
    first, pixel = _cells(pieces[0])
    ways: dict[str, tuple[Callable[[Any], Any], Any]] = {
        "pixels and bins": (lambda x: np.add.reduceat(x.reshape(*x.shape[:-2], rows.size), first, axis=-1), pixel),
        "image": (lambda x: x.sum(axis=-1), np.arange(len(rows))),
    }
    # A wrong response shows in the few bins of the return, is little among all, and lost where pixels are added up
    # whose returns lie apart.
    bins, times = np.arange(mean.shape[1]), list[str]()
    returns = np.argmax(pieces[number], axis=1)[:, None]
    for name, shift in (("time of the target", returns - bins.size // 2), ("time of the rest", 0 * returns)):
        order = (bins + shift) % bins.size
        starts, _ = _cells(np.take_along_axis(pieces[0], order, axis=1).sum(axis=0, keepdims=True))
        over_time = functools.partial(_over_time, order, starts)
        chosen = (np.argmax(over_time(pieces[number:]), axis=0) == 0) == (name == "time of the target")
        if chosen.any():
            times.append(name)
            ways[name] = functools.partial(over_time, chosen=chosen), None
    sums = ways["pixels and bins"][0](pieces)
    found = {name: _Cells(add_up(rows), add_up(pieces[:number])) for name, (add_up, _) in ways.items()}
    deviances = {name: one.deviance(lost.of(one.mean, *ways[name])) for name, one in found.items()}
    if len(batches) > 1 and pieces[0].any():
        deviances["width"] = _width(rows, pieces[:number], trials, lost)
    cells = found["pixels and bins"]
    kinds = np.argmax(sums[number:], axis=0)
    excess, variances = (np.bincount(pixel, x) for x in (cells.each - cells.expected, cells.variance))
    # Cells are parts of pixels: what they have beyond these is independent of it.
    whole, per_pixel = deviances["pixels and bins"], deviances["image"]
    within = _tail(
        whole.deviance - per_pixel.deviance,
        whole.expected - per_pixel.expected,
        whole.standard_deviation**2 - per_pixel.standard_deviation**2,
    )
    known = [within, per_pixel.p, *(one.p for name, one in deviances.items() if name in (*times, "width"))]
    known = [p for p in known if not np.isnan(p)]
    beyond = sum(deviances[name].deviance - deviances[name].expected for name in times)
    return Goodness(
        p=float(-np.expm1(len(known) * np.log1p(-min(known)))) if known and min(known) < 1.0 else 1.0,
        parts=deviances,
        components={name: cells.of(kinds == k).deviance() for k, name in enumerate(COMPONENTS) if (kinds == k).any()},
        misfit=float(np.sqrt(max(beyond, 0.0) / max(rows.sum(), 1))),
        pixels=(excess / np.sqrt(np.maximum(variances, 1e-300))).reshape(image),
    )


def _width(counts: NDArray[np.integer], pieces: Floats, trials: Rows, lost: Lost) -> Deviance:
    """The square of the score of counts `[pixel, bin]` by the width of the response, in its variances: 1 in the mean.

    A little more width adds the second difference over time of the part of `trials` that is counted: that of the mean
    itself would depend on the count of its own bin, which later trials lack. Taken from one half of the batches, it is
    independent of the noise of the other half; what it is weighted by is the mean of a cell.
    """
    variance, batches, pulses = pieces[1], pieces[2:], np.maximum(trials, 1.0).astype(np.float64)
    first, _ = _cells(pieces[0])
    sizes = np.diff(first, append=counts.size)
    mean = np.maximum(np.repeat(np.add.reduceat(pieces[0].ravel(), first) / sizes, sizes), _LEAST).reshape(counts.shape)
    score = spread = 0.0
    for half, other in ((batches[::2], batches[1::2]), (batches[1::2], batches[::2])):
        share = np.pad(half.mean(axis=0) / pulses, ((0, 0), (1, 1)), "edge")
        change = lost.beside(pulses * np.diff(share, 2, axis=1), mean) / mean
        score += 0.5 * float((change * (counts - other.mean(axis=0))).sum())
        noise = np.einsum("bpt,pt->b", other, change).var(ddof=1) / len(other) if len(other) > 1 else 0.0
        # The counts are the same for both halves, the noise is not.
        spread += 0.5 * float((change**2 * variance).sum()) + 0.25 * noise
    square = score**2 / spread if spread > 0.0 else 0.0
    return Deviance(
        deviance=square, expected=1.0, standard_deviation=2.0**0.5, p=_tail(square, 1.0, 2.0), counts=int(counts.sum())
    )


def _over_time(order: NDArray[np.intp], starts: NDArray[np.intp], x: Any, chosen: Any = slice(None)) -> Any:
    """Pixels of `[…, pixel, bin]`, each with its bins in an `order`, added up in those chosen of the cells."""
    summed = [np.take_along_axis(image, order, axis=1).sum(axis=0) for image in x.reshape(-1, *x.shape[-2:])]
    return np.add.reduceat(np.reshape(summed, (*x.shape[:-2], x.shape[-1])), starts, axis=-1)[..., chosen]


def _cells(mean: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Neighbouring bins that together expect enough counts: the first of each in a flat `[pixel, bin]`, its pixel."""
    total = mean.sum(axis=1, keepdims=True)
    cell = np.minimum((np.cumsum(mean, axis=1) - mean) // _ENOUGH, np.maximum(total // _ENOUGH - 1.0, 0.0))
    first = np.flatnonzero(np.diff(cell, axis=1, prepend=-1.0) > 0)
    return first, first // mean.shape[1]


def significance(counts: NDArray[np.integer], mean: Rows, light: Rows) -> Floats:
    """Significance of light in counts, in standard deviations `[row]`, from the likelihood with as much of it as is
    likeliest, over that without. `mean`, and the part of it that is `light`: `[row, bin]`."""
    light = np.maximum(light, 0.0)  # a convolution rounds below
    rest, total = np.maximum(mean - light, 1e-9).astype(np.float64), light.sum(axis=1, dtype=np.float64)
    amount = np.ones((len(mean), 1))
    for _ in range(_TURNS):  # expectation maximisation
        with np.errstate(divide="ignore", invalid="ignore"):
            amount *= np.nan_to_num((counts * light / (rest + amount * light)).sum(axis=1) / total)[:, None]
    ratio = 2.0 * (counts * np.log1p(amount * light / rest)).sum(axis=1) - 2.0 * amount[:, 0] * total
    return np.sqrt(np.maximum(ratio, 0.0))


class _Cells:
    """Counts of cells with the pieces mean, variance and batches of the mean, and the moments of their deviances."""

    def __init__(self, counts: NDArray[np.integer], pieces: Floats) -> None:
        self.counts, self.pieces, self.number = counts, pieces, len(pieces) - 2
        self.mean = mean = np.maximum(pieces[0], _LEAST)
        self.each = 2.0 * (counts * np.log(np.maximum(counts, 1) / mean) * (counts > 0) - counts + mean)
        noise, share = pieces[2:].var(axis=0, ddof=1) / self.number / mean, pieces[1] / mean
        nodes, first, second = _poisson_table()
        self.expected = share * np.interp(np.log(mean), nodes, first) + noise
        self.variance = share**2 * np.interp(np.log(mean), nodes, second) + 4.0 * share * noise

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


@functools.cache
def _poisson_table() -> tuple[Floats, Floats, Floats]:
    """Logarithms of means, and of the deviance of a Poisson count mean and variance: sums over the distribution."""
    from scipy.special import gammaln

    nodes, n = np.geomspace(_LEAST, 1e3, 800)[:, None], np.arange(1400)
    weights = np.exp(n * np.log(nodes) - nodes - gammaln(n + 1.0))
    each = 2.0 * (n * np.log(np.maximum(n, 1) / nodes) - n + nodes)
    mean = (weights * each).sum(axis=1)
    return np.log(nodes[:, 0]), mean, (weights * (each - mean[:, None]) ** 2).sum(axis=1)
