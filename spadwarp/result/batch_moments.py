"""Totals of the components over batches of photons: their standard errors, and whether few photons decide them."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from spadwarp.errors import ConfigError
from spadwarp.result.signed_tallies import standard_error
from spadwarp.units import percent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from spadwarp.result.result import Result

__all__ = ["ComponentError", "component_errors", "dominance_warnings", "joined_moments", "moments_of"]
__all__ += ["batches_of", "largest_share", "pixel_standard_error", "relative_error"]

# Share of the variance between batches from which one batch is said to decide a standard error. Chance alone exceeds
# it with a probability of _FALSE_ALARM at most, see `_threshold`.
_DECIDING_SHARE = 0.9
_FALSE_ALARM = 1e-4
# Relative standard errors that are smaller are good enough whatever carries them.
_SMALL_ERROR = 0.005


@dataclass(frozen=True)
class ComponentError:
    """How well a component's total is known.

    Attributes:
        relative_error: Relative standard error of the component's light, all pixels and bins together.
        largest_share: Squared deviation of the batch furthest from the mean, over the largest that it could have at the
            same variance, in [0, 1]: about 5/batches where many photons matter equally, near 1 where one decides.
        batches: Number of batches.
    """

    relative_error: float
    largest_share: float
    batches: int

    @property
    def is_dominated(self) -> bool:
        """Whether one batch decides the standard error, so that it may be far too small."""
        return self.relative_error > _SMALL_ERROR and self.largest_share > _threshold(self.batches)


def moments_of(names: Sequence[str], totals: Sequence[int]) -> dict[str, int]:
    """The moments of one batch from its components' names and totals [tally units]."""
    values = zip(names, totals, strict=True)
    return {
        f"{name}_{kind}": value
        for name, total in values
        for kind, value in (("squares", total * total), ("smallest", total), ("largest", total))
    }


def joined_moments(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    """The moments of the batches of both."""
    joins: dict[str, Callable[[int, int], int]] = {"squares": operator.add, "smallest": min, "largest": max}
    return {name: joins[name.rpartition("_")[2]](value, b[name]) for name, value in a.items()}


def component_errors(result: Result) -> dict[str, ComponentError]:
    """By component; empty without batches, and for components without light."""
    found = {}
    for name, (count, total, spread, furthest) in _spreads(result).items():
        error = math.sqrt(spread / (count - 1)) / total
        found[name] = ComponentError(error, furthest * furthest / ((count - 1) * spread), count)
    return found


def largest_share(result: Result) -> float:
    """As `ComponentError.largest_share`, of the variance of all components together; 1 where nothing is known."""
    spreads = list(_spreads(result).values())
    together = sum(spread for _, _, spread, _ in spreads)
    return max((furthest * furthest / ((count - 1) * together) for count, _, _, furthest in spreads), default=1.0)


def _spreads(result: Result) -> dict[str, tuple[int, int, int, int]]:
    """Of components that vary: number n of batches, total, n times the sum of squared deviations of the batches from
    their mean, n times the largest deviation."""
    moments = result.batch_moments
    if not moments or result.photons < 2 * result.batch_size:
        return {}
    names = [name.removesuffix("_squares") for name in moments if name.endswith("_squares")]
    count, found = result.photons // result.batch_size, {}
    for name, tally in zip(names, result.tallies, strict=True):
        # In rows and halves, since a sum over all voxels may exceed 64 bits.
        total = sum((int((row >> 32).sum()) << 32) + int((row & 0xFFFFFFFF).sum()) for row in tally)
        # count times the sum of squared deviations, in integers: no cancellation.
        spread = count * moments[f"{name}_squares"] - total * total
        furthest = max(count * moments[f"{name}_largest"] - total, total - count * moments[f"{name}_smallest"])
        if total > 0 and spread > 0:
            found[name] = count, total, spread, furthest
    return found


def batches_of(result: Result) -> tuple[NDArray[np.uint64], int]:
    """The second moments of a result's batches and their number. Raises `ConfigError` where there are too few."""
    if result.second_moment is None or result.photons < 2 * result.batch_size:
        raise ConfigError("the result holds no batches; simulate with uncertainty=True and more photons")
    return result.second_moment, result.photons // result.batch_size


def pixel_standard_error(result: Result, row: int, column: int) -> NDArray[np.float64]:
    """`Result.standard_error` of one pixel, float64 `[T]`, without that of the others."""
    moments, count = batches_of(result)
    own = standard_error(result.tallies[:, row, column], moments[:, row, column], count)
    return np.asarray(own * result.tally_value[row, column])


def relative_error(result: Result) -> float:
    """What `Result.relative_error` describes, row by row: of a large histogram nothing is copied."""
    moments, count = batches_of(result)
    peak = np.stack([row.sum(axis=0).argmax(axis=1) for row in result.tallies.swapaxes(0, 1)])[None, ..., None]
    tallies = np.take_along_axis(result.tallies, peak, axis=3)[..., 0]
    value = tallies.sum(axis=0)
    error = standard_error(tallies, np.take_along_axis(moments, peak, axis=3)[..., 0], count)
    target = np.isfinite(result.truth.depth)
    returned = (value > 0) & (target | ~target.any())
    return float(np.quantile(error[returned] / value[returned], 0.95)) if returned.any() else math.inf


def dominance_warnings(result: Result) -> list[str]:
    """A sentence for each component whose standard error rests on one batch."""
    transport, texts = result.scene.transport, []
    ways = ["more photons"]
    if transport.estimator != "guided":
        ways.append('estimator = "guided"')
    elif result.scene.targets:
        ways.append('in clear water between bright surfaces estimator = "next_event"')
    if transport.termination == "roulette":
        ways.append('termination = "cutoff"')
    for name, error in component_errors(result).items():
        if error.is_dominated:
            texts.append(
                f"{name}: one of {error.batches} batches has {100 * error.largest_share:.0f} % of the variance of its "
                f"light (relative standard error {percent(error.relative_error)} %): few heavy photons decide it, and "
                f"errors may be larger than they seem; what helps: {', '.join(ways)}"
            )
    return texts


def _threshold(count: int) -> float:
    """The share that equal batches exceed with a probability of _FALSE_ALARM at most, but _DECIDING_SHARE at least.

    The squared deviation of one of n normal numbers from their mean, over n - 1 times their variance, times n/(n - 1),
    is Beta(1/2, n/2 - 1) (Thompson 1935); the largest of n by Bonferroni, as in the test of Grubbs (1950).
    """
    from scipy.special import betaincinv

    if count < 4:
        return 1.0
    law = float(betaincinv(0.5, 0.5 * count - 1.0, 1.0 - _FALSE_ALARM / count))
    return max(_DECIDING_SHARE, law)
