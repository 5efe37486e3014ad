"""Tallies of photons as integers, whose sums do not depend on their order."""

from __future__ import annotations

import itertools
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene import Scene
from spadwarp.scene.flux import FluxArray
from spadwarp.values import ArgumentError, ConfigError, SpadwarpError, shown

__all__ = ["FluxTallies", "SignedTallies", "Tallies"]

OVERFLOW = (
    "a histogram bin overflowed: the scene is brighter than the tally's unit allows for; run fewer photons at a time "
    "and average their histograms"
)

NO_BATCHES = "the result has no errors: fewer than two batches of photons were kept; simulate with more photons"

GROUPS = ("signed_tallies", "flux_tallies")

Number = TypeVar("Number", int, float)


@dataclass(frozen=True, eq=False)
class SignedTallies:
    """Tallies of the derivatives of a histogram, or of channels: a run has one of the two groups at most."""

    group: Literal["derivatives", "channels"]
    names: tuple[str, ...]  # of the P parameters, such as "medium.absorption", or channels, such as "cross"
    tallies: NDArray[np.int64]  # int64 `[P, 3, H, W, T]`, by component; derivative or channel = tally · unit / photons
    units: tuple[float, ...]
    """Fraction of one emitted photon, per unit of the parameter, that a tally unit stands for; powers of two."""
    second_moment: NDArray[np.uint64] | None = None
    """uint64 `[2, P, H, W, T]`, as `Tallies.second_moment`; None without batches."""


@dataclass(frozen=True, eq=False)
class FluxTallies:
    """Tallies of all sections of flux one after another, see `Flux.arrays`."""

    tallies: NDArray[np.int64]  # int64 `[E]`
    second_moment: NDArray[np.uint64] | None = None  # uint64 `[2, E]`, as `Tallies.second_moment`; None without batches


@dataclass(frozen=True, eq=False, kw_only=True)
class Tallies:
    """What photons left: their histograms in fixed point, their energy balance and counts of events."""

    tallies: NDArray[np.int64]  # int64 `[3, H, W, T]` in the order of `COMPONENTS`
    energy_balance: Mapping[str, int]
    """Where the emitted weight went, in units of `energy_balance_unit` photons. Entries are differences of fixed-point
    weights (before − after; a gain is negative), so that their sum is exactly the emitted weight."""
    counters: Mapping[str, int]
    """Numbers of events, of contributions that were clipped or not a number, and by component of those of less than one
    tally unit, see `Result.rounding_error`; light before and after the gate in tally units (`guided` aims inside the
    gate and counts there what its surfaces score alone)."""
    batches: int = 0  # batches of photons whose spread gives standard errors; 0: none were kept
    half: NDArray[np.int64] | None = None
    """int64 `[3, H, W, T]`, the tallies of the batches of one half: those with an even number, first photon id over
    `batch_size`; `tallies - half` is the other half, independent of it. None without batches."""
    half_photons: int = 0  # emitted photons of that half
    second_moment: NDArray[np.uint64] | None = None
    """uint64 `[2, H, W, T]`, low and high half of the 128-bit sum over batches of the squared tally of all components,
    over the photons of the batch in units of `batch_size`; None without batches."""
    batch_moments: Mapping[str, int] = field(default_factory=dict)
    """By component, over batches of its tally summed over voxels: `…_squares` (their sum, as that of `second_moment`),
    and over batches of `batch_size` photons `…_smallest` and `…_largest`; empty without batches."""
    signed_tallies: SignedTallies | None = None
    """Of the derivatives that were asked for, or of the channels but "I", the histogram; None if there are none."""
    flux_tallies: FluxTallies | None = None  # of the scene's sections of flux; None if there are none

    @property
    def known_moment(self) -> NDArray[np.uint64]:
        """`second_moment`. Raises `ConfigError` where there are fewer than two batches."""
        if self.second_moment is None or self.batches < 2:
            raise ConfigError(NO_BATCHES)
        return self.second_moment


def total_of(*parts: Tallies) -> Tallies:
    """The sum of tallies of disjoint photons, with arrays of its own.

    Raises `ConfigError` where they count different things, `SpadwarpError` where a bin overflows.
    """
    check_capacity(*(part.tallies for part in parts))
    counts: dict[str, Any] = {}
    for name in ("energy_balance", "counters"):
        each = [getattr(part, name) for part in parts]
        if strange := set[str]().union(*each) - set(each[0]).intersection(*each):
            raise ConfigError(f"the results count different things in their {name}: {', '.join(sorted(strange))}")
        counts[name] = added(*each)
    tallies, second_moment = _added_arrays(parts)
    halves = [part.half for part in parts if part.half is not None]
    return Tallies(
        tallies=tallies,
        **counts,
        batches=sum(part.batches for part in parts),
        half=np.sum(halves, axis=0) if len(halves) == len(parts) else None,
        half_photons=sum(part.half_photons for part in parts),
        second_moment=second_moment,
        batch_moments=joined_moments(*(part.batch_moments for part in parts)),
        **{name: _group_total([getattr(part, name) for part in parts]) for name in GROUPS},
    )


def _group_total(parts: Sequence[Any]) -> Any:
    """Of derivatives, channels or flux; None where there are none."""
    found = [part for part in parts if part is not None]
    if not found:
        return None
    first, of_flux = found[0], isinstance(found[0], FluxTallies)
    kinds = set() if of_flux else {(part.group, part.names, part.units) for part in found}
    if len(found) < len(parts) or len(kinds) > 1:
        raise ConfigError("the results have tallies of different derivatives, channels or flux")
    tallies, second_moment = _added_arrays(found)
    # Flux is never negative; a negative integer is large without its sign.
    light = tallies.view(np.uint64) if of_flux else np.abs(tallies.sum(axis=1, dtype=np.float64))
    if light.max(initial=0) >= 2**62:
        text = "a bin of a derivative, a channel or flux overflowed"
        raise SpadwarpError(f"{text}; run fewer photons at a time and average the results")
    return replace(first, tallies=tallies, second_moment=second_moment)


def _added_arrays(
    parts: Sequence[Tallies | SignedTallies | FluxTallies],
) -> tuple[NDArray[np.int64], NDArray[np.uint64] | None]:
    """The sum of the tallies, and of the second moments where all have one: 128-bit integers, low and high halves."""
    total = parts[0].tallies.copy()
    for part in parts[1:]:
        total += part.tallies
    moments = [part.second_moment for part in parts if part.second_moment is not None]
    if len(moments) < len(parts):
        return total, None
    low, high = squares = moments[0].copy()
    for more in moments[1:]:
        low += more[0]
        high += more[1]
        high += low < more[0]  # the carry
    return total, squares


def added(*parts: Mapping[str, Number]) -> dict[str, Number]:
    """The sum of the entries of each name of the first."""
    return {name: sum((part.get(name, 0) for part in parts[1:]), start) for name, start in parts[0].items()}


def check_capacity(*tallies: NDArray[np.int64]) -> None:
    """Raises `SpadwarpError` where a bin's sum over components and parts leaves the range of its 64-bit integer."""
    # Almost always the largest number times that of components is enough; a negative one is large without its sign.
    if sum(int(part.view(np.uint64).max(initial=0)) * len(part) for part in tallies) < 2**62:
        return
    for row in zip(*(part.swapaxes(0, 1) for part in tallies), strict=True):  # in pieces that a cache holds
        total = np.sum([part.sum(axis=0, dtype=np.float64) for part in row], axis=0)
        if total.size and (total.max() >= 2.0**62 or min(part.min() for part in row) < 0):
            raise SpadwarpError(OVERFLOW)


# Moments of batches

_JOINS: dict[str, Callable[[int, int], int]] = {"squares": operator.add, "smallest": min, "largest": max}


def moments_of(names: Sequence[str], totals: Sequence[int], photons: int, batch_size: int) -> dict[str, int]:
    """`Tallies.batch_moments` of one batch, from its components' names and totals [tally units]."""
    moments = dict[str, int]()
    for name, total in zip(names, totals, strict=True):
        moments[f"{name}_squares"] = total * total * batch_size // photons
        if photons == batch_size:
            moments |= {f"{name}_smallest": total, f"{name}_largest": total}
    return moments


def joined_moments(*parts: Mapping[str, int]) -> dict[str, int]:
    """`Tallies.batch_moments` of the batches of all."""
    total = dict[str, int]()
    for part in parts:
        for name, value in part.items():
            total[name] = _JOINS[name.rpartition("_")[2]](total[name], value) if name in total else value
    return total


def rebatched(part: Tallies, ratio: int) -> Tallies:
    """Tallies whose squares are in units of `ratio` times their batch size, a power of two: those of more photons."""
    if ratio == 1 or part.second_moment is None:
        return part
    shift = np.uint64(ratio.bit_length() - 1)
    moments = {name: value * ratio for name, value in part.batch_moments.items() if name.endswith("_squares")}
    others = {}
    for name in GROUPS:
        if (group := getattr(part, name)) is not None:
            assert group.second_moment is not None
            others[name] = replace(group, second_moment=_shifted(group.second_moment, shift))
    return replace(part, batch_moments=moments, second_moment=_shifted(part.second_moment, shift), **others)


def _shifted(wide: NDArray[np.uint64], shift: np.uint64) -> NDArray[np.uint64]:
    """128-bit integers, low and high halves, times a power of two > 1."""
    low, high = wide
    return np.stack([low << shift, high << shift | low >> np.uint64(64) - shift])


# Names of derivatives by block of a grid's cells

GRID = "medium.grid."
_BLOCK_NAME = re.compile(r"medium\.grid\.(\w+)(?:\[(\d+),(\d+),(\d+)\])?")


class BlockParameters(NamedTuple):
    """Coefficients of a grid's cells, block by block: kinds, and number of blocks along the edges of the box."""

    kinds: tuple[str, ...] = ()
    shape: tuple[int, ...] = (1, 1, 1)

    @property
    def names(self) -> tuple[str, ...]:
        """Of each block, such as "medium.grid.absorption[0,2,1]"; kind by kind, the last index fastest."""
        indices = list(itertools.product(*map(range, self.shape)))
        return tuple(f"{GRID}{kind}[{i},{j},{k}]" for kind in self.kinds for i, j, k in indices)


def is_block_name(name: Any) -> bool:
    """Whether a name is that of a coefficient of the grid's cells, of one block or of all."""
    return isinstance(name, str) and _BLOCK_NAME.fullmatch(name) is not None


def block_parameters(names: Sequence[str]) -> BlockParameters:
    """Those of full names, of all blocks in their order; other names are left out.

    Raises `ArgumentError` where blocks are missing.
    """
    found = [match for match in map(_BLOCK_NAME.fullmatch, names) if match is not None]
    if not found:
        return BlockParameters()
    kinds = tuple(dict.fromkeys(match[1] for match in found))
    whole = BlockParameters(kinds, tuple(max(int(match[axis] or 0) for match in found) + 1 for axis in (2, 3, 4)))
    if tuple(match[0] for match in found) != whole.names:
        raise ArgumentError(
            f"derivatives: {shown(found[0][0])} ... are not all blocks in their order; ask for {GRID}{kinds[0]} and "
            "give blocks, the number of them along the edges"
        )
    return whole


# Flux, of all sections one after another


def flux_arrays(scene: Scene) -> dict[str, FluxArray]:
    """Of all sections of a scene, such as "around/fluence", in the order of the tally."""
    found, first, absorption = dict[str, FluxArray](), 0, scene.medium.range.absorption
    for section in scene.flux:
        found |= {f"{section.name}/{name}": array for name, array in section.arrays(absorption, first).items()}
        first += section.size
    return found


def part_of(entries: NDArray[Any], array: FluxArray) -> NDArray[Any]:
    """An array of a tally, or of its words: a view."""
    words = entries.shape[:-1]
    rows = entries[..., array.entries].reshape(*words, array.shape[0], -1)
    return rows[..., array.columns].reshape(*words, *array.shape)


def check_flux(scene: Scene, tallies: FluxTallies | None, batches: int) -> None:
    """Refuses tallies that are not those of the scene's sections."""
    size, moments = sum(section.size for section in scene.flux), None if tallies is None else tallies.second_moment
    shapes = [None if one is None else one.shape for one in (None if tallies is None else tallies.tallies, moments)]
    needed = [(size,), (2, size) if batches else None] if scene.flux else [None, None]
    if shapes != needed:
        raise ArgumentError(f"flux_tallies and their second moment have the shapes {shapes}; {needed} are needed")
