"""Results added up: tallies are integers, so that the order and the devices make no difference."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, ConfigError, SpadwarpError
from spadwarp.limits import shown
from spadwarp.result.batch_moments import joined_moments
from spadwarp.result.file import ResultLike, as_result
from spadwarp.result.photon_ids import Range, joined
from spadwarp.result.result import Result, Truth, physics_of
from spadwarp.result.signed_tallies import SignedTallies, add_moments

__all__ = ["Tallies", "merge"]


@dataclass
class Tallies:
    """Tallies, ledger and counters of photons; the arrays as in `Result`."""

    tallies: NDArray[np.int64]
    ledger: dict[str, int]
    counters: dict[str, int]
    second_moment: NDArray[np.uint64] | None = None
    batch_moments: Mapping[str, int] = field(default_factory=dict)
    derivative_tallies: SignedTallies | None = None
    channel_tallies: SignedTallies | None = None

    @classmethod
    def of(cls, result: Tallies | Result) -> Tallies:
        """A copy, with arrays of its own."""
        second_moment = None if result.second_moment is None else result.second_moment.copy()
        signed = [result.derivative_tallies, result.channel_tallies]
        return cls(
            result.tallies.copy(),
            dict(result.ledger),
            dict(result.counters),
            second_moment,
            result.batch_moments,
            *(None if found is None else found.copy() for found in signed),
        )

    def add(self, other: Tallies | Result) -> None:
        """Adds the tallies of other photons; `ConfigError` where they count other things."""
        for name in ("ledger", "counters"):
            if strange := getattr(self, name).keys() ^ getattr(other, name).keys():
                raise ConfigError(f"the results count different things in their {name}: {', '.join(sorted(strange))}")
        self.tallies += other.tallies
        self.ledger = {name: value + other.ledger[name] for name, value in self.ledger.items()}
        names = dict.fromkeys([*self.counters, *other.counters])  # older results have fewer
        self.counters = {name: self.counters.get(name, 0) + other.counters.get(name, 0) for name in names}
        if self.second_moment is not None:
            assert other.second_moment is not None
            add_moments(self.second_moment, other.second_moment)
        for name in ("derivative_tallies", "channel_tallies"):
            if (signed := getattr(self, name)) is not None:
                signed.add(getattr(other, name))
        # Older results have none, and their sum with others has none.
        known = self.batch_moments and other.batch_moments
        self.batch_moments = joined_moments(self.batch_moments, other.batch_moments) if known else {}


def merge(results: Iterable[ResultLike]) -> Result:
    """Adds results of the same scene, seed and unit with disjoint photon ids; bit-identical to one run of all the ids.

    `results` are results or their paths.

    The ids may leave gaps, which `simulate(resume=)` fills. Each part's provenance is kept, with its ids, in
    `provenance["parts"]`.

    Raises:
        ArgumentError: No list of results.
        ConfigError: Different scenes (photons and output aside), seeds, units or batches, or ids that overlap.
    """
    if isinstance(results, str | os.PathLike | Result) or not isinstance(results, Iterable):
        raise ArgumentError(f"results = {shown(results)} is not a list of results or of their paths")
    parts = [as_result(one, "results: an item") for one in results]
    if not parts:
        raise ConfigError("merge: no results given")
    first = parts[0]
    for other in parts[1:]:
        for name, a, b in (
            ("scene", physics_of(first.scene), physics_of(other.scene)),
            ("seed", first.seed, other.seed),
            ("tally unit", first.unit, other.unit),
            ("batch size", first.batch_size, other.batch_size),
            ("list of derivatives", tuple(first.derivatives), tuple(other.derivatives)),
            ("channel", first.provenance.get("channel"), other.provenance.get("channel")),
        ):
            if a != b:
                detail = f" ({a} and {b})"
                if name == "scene":
                    sections = [key for key in type(first.scene).model_fields if getattr(a, key) != getattr(b, key)]
                    detail = f" in {', '.join(sections)}: only photons and output may differ"
                raise ConfigError(f"merge: the {name} of the results differs{detail}")
    try:
        ranges = joined(r for part in parts for r in part.photon_ranges)
    except ConfigError as error:
        raise ConfigError(f"merge: {error}") from error
    for other in parts[1:]:
        check_targets(first.truth, other.truth, "merge")
        check_focus(first.focus_distance, other.focus_distance, "merge")
    check_capacity(*(part.tallies for part in parts))
    total = Tallies.of(first)
    for other in parts[1:]:
        total.add(other)
    return replace(
        first,
        **vars(total),
        photons=sum(part.photons for part in parts),
        timing=add_timing(part.timing for part in parts),
        provenance=join_provenance((part.provenance, part.photon_ranges) for part in parts),
        partial=any(part.partial for part in parts),
        photon_ranges=ranges,
        requested=(min(part.requested[0] for part in parts), max(part.requested[1] for part in parts)),
    )


def add_timing(timings: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Seconds of each stage, of all parts together."""
    parts = list(timings)
    return {name: sum(part.get(name, 0.0) for part in parts) for name in parts[0]}


def join_provenance(parts: Iterable[tuple[Mapping[str, Any], Iterable[Range]]]) -> dict[str, Any]:
    """The first provenance, and under `parts` each with its photon ids."""
    each: list[dict[str, Any]] = []
    for provenance, ranges in parts:
        own = dict(provenance)
        each += own.pop("parts", None) or [{**own, "photon_ranges": [list(ids) for ids in ranges]}]
    head = {name: value for name, value in each[0].items() if name != "photon_ranges"}
    return head if len(each) == 1 else {**head, "parts": each}


def check_capacity(*tallies: NDArray[np.int64]) -> None:
    """Raises `SpadwarpError` where a bin's sum over components and parts leaves the range of its 64-bit integer."""
    # Almost always the largest number times that of components is enough; a negative one is large without its sign.
    if sum(int(part.view(np.uint64).max(initial=0)) * len(part) for part in tallies) < 2**62:
        return
    for row in zip(*(part.swapaxes(0, 1) for part in tallies), strict=True):  # in pieces that a cache holds
        total = np.sum([part.sum(axis=0, dtype=np.float64) for part in row], axis=0)
        if total.size and (total.max() >= 2.0**62 or min(part.min() for part in row) < 0):
            raise SpadwarpError(OVERFLOW)


OVERFLOW = (
    "a histogram bin overflowed: the scene is brighter than the tally's unit allows for; run fewer photons at a time "
    "and average their histograms"
)


def check_targets(a: Truth, b: Truth, action: str) -> None:
    """Raises `ConfigError` where two truth maps are not of the same targets."""
    if not np.allclose(a.range, b.range, rtol=1e-4, equal_nan=True):
        raise ConfigError(f"{action}: the targets of the results differ, by their truth maps: was a mesh file changed?")


def check_focus(a: float | None, b: float | None, action: str) -> None:
    """Raises `ConfigError` where two lenses are not focused at the same depth [m], or one images all depths sharply."""
    if a != b and (a is None or b is None or not np.isclose(a, b, rtol=1e-4, atol=0.0)):
        raise ConfigError(f"{action}: the lenses of the results differ: focus_distance is {a} and {b} m")
