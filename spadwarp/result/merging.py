"""Results added up: tallies are integers, so that the order and the devices make no difference."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.limits import shown
from spadwarp.result.file import ResultLike, as_result
from spadwarp.result.result import Result, Truth, difference
from spadwarp.result.tallies import Range, added, joined, total_of

__all__ = ["merge"]


def merge(results: Iterable[ResultLike]) -> Result:
    """Adds results of the same scene, seed and unit with disjoint photon ids; bit-identical to one run of all the ids.

    `results` are results or their paths.

    The ids may leave gaps, which `simulate(resume=)` fills. Each part's provenance is in `provenance["parts"]`,
    with its ids.

    Raises:
        ArgumentError: No list of results.
        ConfigError: Different scenes (photons and output aside), seeds, units or batches, or ids that overlap.
    """
    if isinstance(results, str | os.PathLike | Result) or not isinstance(results, Iterable):
        raise ArgumentError(f"results = {shown(results)} is not a list of results or of their paths")
    parts = [as_result(item, "results: an item") for item in results]
    if not parts:
        raise ConfigError("merge: no results given")
    first = parts[0]
    for other in parts[1:]:
        if problem := difference(first, other):
            raise ConfigError(f"merge: {problem}")
        for name, a, b in (
            ("list of derivatives", tuple(first.derivatives), tuple(other.derivatives)),
            ("channel", first.provenance.get("channel"), other.provenance.get("channel")),
        ):
            if a != b:
                raise ConfigError(f"merge: the {name} of the results differs ({a} and {b})")
        check_targets(first.truth, other.truth, "merge")
    try:
        ranges = joined(ids for part in parts for ids in part.photon_ranges)
    except ConfigError as error:
        raise ConfigError(f"merge: {error}") from error
    return replace(
        first,
        **vars(total_of(*parts)),
        photons=sum(part.photons for part in parts),
        timing=added(*(part.timing for part in parts)),
        provenance=_joined_provenance((part.provenance, part.photon_ranges) for part in parts),
        partial=any(part.partial for part in parts),
        photon_ranges=ranges,
        requested=(min(part.requested[0] for part in parts), max(part.requested[1] for part in parts)),
    )


def _joined_provenance(parts: Iterable[tuple[Mapping[str, Any], Iterable[Range]]]) -> dict[str, Any]:
    """The first provenance, and under `parts` each with its photon ids."""
    each: list[dict[str, Any]] = []
    for provenance, ranges in parts:
        made = dict(provenance)
        each += made.pop("parts", None) or [{**made, "photon_ranges": [list(ids) for ids in ranges]}]
    head = {name: value for name, value in each[0].items() if name != "photon_ranges"}
    return head if len(each) == 1 else {**head, "parts": each}


def check_targets(a: Truth, b: Truth, action: str) -> None:
    """Raises `ConfigError` where two truth maps are not of the same targets."""
    if not np.allclose(a.range, b.range, rtol=1e-4, equal_nan=True):
        raise ConfigError(f"{action}: the targets of the results differ, by their truth maps: was a mesh file changed?")
