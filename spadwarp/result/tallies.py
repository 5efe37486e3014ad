"""Tallies of photons as integers: sums that do not depend on their order, moments of batches, signed tallies."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ConfigError, SpadwarpError

__all__ = ["SignedTallies", "Tallies"]

OVERFLOW = (
    "a histogram bin overflowed: the scene is brighter than the tally's unit allows for; run fewer photons at a time "
    "and average their histograms"
)

_JOINS: dict[str, Callable[[int, int], int]] = {"squares": operator.add, "smallest": min, "largest": max}


@dataclass(frozen=True, eq=False)
class SignedTallies:
    """Tallies of the derivatives of a histogram, or of channels.

    Attributes:
        names: Of the P parameters, such as "medium.absorption", or channels, such as "cross".
        tallies: int64 `[P, 3, H, W, T]`, by component; derivative or channel = tally · unit / photons.
        units: Fraction of one emitted photon, per unit of the parameter, that a tally unit stands for; powers of two.
        second_moment: uint64 `[2, P, H, W, T]`, as `Tallies.second_moment`; None without batches.
    """

    names: tuple[str, ...]
    tallies: NDArray[np.int64]
    units: tuple[float, ...]
    second_moment: NDArray[np.uint64] | None = None

    def copy(self) -> SignedTallies:
        """The same with arrays of its own."""
        moments = None if self.second_moment is None else self.second_moment.copy()
        return replace(self, tallies=self.tallies.copy(), second_moment=moments)

    def add(self, other: SignedTallies) -> None:
        """Adds those of other photons. Raises `ConfigError` where they are of other parameters."""
        if (self.names, self.units) != (other.names, other.units):
            first, second = (", ".join(one.names) or "nothing" for one in (self, other))
            raise ConfigError(f"the results have tallies of {first} and of {second}")
        self.tallies[...] += other.tallies
        if np.abs(self.tallies.sum(axis=1, dtype=np.float64)).max(initial=0.0) >= 2.0**62:
            raise SpadwarpError(
                "a bin of a derivative or a channel overflowed; run fewer photons at a time and average the results"
            )
        if self.second_moment is not None and other.second_moment is not None:
            _add_moments(self.second_moment, other.second_moment)


@dataclass(frozen=True, eq=False, kw_only=True)
class Tallies:
    """What photons left: their histograms in fixed point, their energy balance and counts of events.

    Attributes:
        tallies: int64 `[3, H, W, T]` in the order of `COMPONENTS`.
        energy_balance: Where the emitted weight went, in units of `energy_balance_unit` photons. Entries are
            differences of fixed-point weights (before − after; a gain is negative), so that their sum is exactly the
            emitted weight.
        counters: Numbers of events, of contributions that were clipped or not a number, and by component of those of
            less than one tally unit, see `Result.rounding_error`; light before and after the gate in tally units
            (`guided` aims inside the gate and counts there what its surfaces score alone).
        second_moment: uint64 `[2, H, W, T]`, low and high half of the 128-bit sum over batches of the squared tally of
            all components; None without batches.
        batch_moments: By component, over batches of its tally summed over voxels: `…_squares` (their sum),
            `…_smallest` and `…_largest`; empty without batches.
        derivative_tallies: Of the derivatives that were asked for; None if there are none.
        channel_tallies: Of the camera's channels but "I", which is the histogram; None if there are none.
    """

    tallies: NDArray[np.int64]
    energy_balance: Mapping[str, int]
    counters: Mapping[str, int]
    second_moment: NDArray[np.uint64] | None = None
    batch_moments: Mapping[str, int] = field(default_factory=dict)
    derivative_tallies: SignedTallies | None = None
    channel_tallies: SignedTallies | None = None


def total_of(first: Tallies, *others: Tallies) -> Tallies:
    """The sum of tallies of disjoint photons, with arrays of its own.

    Raises `ConfigError` where they count different things, `SpadwarpError` where a bin overflows.
    """
    check_capacity(first.tallies, *(other.tallies for other in others))
    signed = [None if found is None else found.copy() for found in (first.derivative_tallies, first.channel_tallies)]
    total, counts = first.tallies.copy(), {name: dict(getattr(first, name)) for name in ("energy_balance", "counters")}
    second_moment = None if first.second_moment is None else first.second_moment.copy()
    batch_moments = first.batch_moments
    for other in others:
        for name, entries in counts.items():
            more = getattr(other, name)
            if strange := entries.keys() ^ more.keys():
                raise ConfigError(f"the results count different things in their {name}: {', '.join(sorted(strange))}")
            counts[name] = added(entries, more)
        total += other.tallies
        if second_moment is not None:
            assert other.second_moment is not None
            _add_moments(second_moment, other.second_moment)
        for mine, theirs in zip(signed, (other.derivative_tallies, other.channel_tallies), strict=True):
            if mine is not None:
                assert theirs is not None
                mine.add(theirs)
        batch_moments = joined_moments(batch_moments, other.batch_moments)
    return Tallies(
        tallies=total,
        **counts,
        second_moment=second_moment,
        batch_moments=batch_moments,
        derivative_tallies=signed[0],
        channel_tallies=signed[1],
    )


def added(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    """Entry by entry the sum of both, which have the same names."""
    return {name: value + b[name] for name, value in a.items()}


def _add_moments(total: NDArray[np.uint64], more: NDArray[np.uint64]) -> None:
    """Adds 128-bit integers in place; both `[2, ...]`, low and high halves."""
    low, high = total
    low += more[0]
    high += more[1]
    high += low < more[0]  # the carry


def check_capacity(*tallies: NDArray[np.int64]) -> None:
    """Raises `SpadwarpError` where a bin's sum over components and parts leaves the range of its 64-bit integer."""
    # Almost always the largest number times that of components is enough; a negative one is large without its sign.
    if sum(int(part.view(np.uint64).max(initial=0)) * len(part) for part in tallies) < 2**62:
        return
    for row in zip(*(part.swapaxes(0, 1) for part in tallies), strict=True):  # in pieces that a cache holds
        total = np.sum([part.sum(axis=0, dtype=np.float64) for part in row], axis=0)
        if total.size and (total.max() >= 2.0**62 or min(part.min() for part in row) < 0):
            raise SpadwarpError(OVERFLOW)


def moments_of(names: Sequence[str], totals: Sequence[int]) -> dict[str, int]:
    """`Tallies.batch_moments` of one batch, from its components' names and totals [tally units]."""
    values = zip(names, totals, strict=True)
    return {
        f"{name}_{kind}": value
        for name, total in values
        for kind, value in (("squares", total * total), ("smallest", total), ("largest", total))
    }


def joined_moments(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    """`Tallies.batch_moments` of the batches of both."""
    return {name: _JOINS[name.rpartition("_")[2]](value, b[name]) for name, value in a.items()}


def standard_error(tallies: NDArray[np.int64], second_moment: NDArray[np.uint64], batches: int) -> NDArray[np.float64]:
    """Standard error of the sum over components of tallies `[3, ...]`, in their unit, from the spread of batches."""
    total = tallies.sum(axis=0).astype(np.float64)
    squares = second_moment[1] * 2.0**64 + second_moment[0]
    variance = np.maximum(squares - total**2 / batches, 0.0) / (batches - 1)
    return np.sqrt(batches * variance)
