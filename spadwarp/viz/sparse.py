"""Histograms of simulated light with bins wide enough to mean something."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

__all__ = ["merged_edges", "merged_means", "shared_edges", "typical_weight"]

_ERROR = 1.0 / 3.0  # relative standard error at which a bin stands alone
_NEIGHBOURS = 6  # bins on each side that share a weight
_EVEN = 0.5  # (Σv)² / (n Σv²) of the n neighbours of one side, where light is not sparse
_NARROW = 8  # bins that are added up before a group may end for its width


def typical_weight(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Light that one photon adds to a bin, `[T]`, from how much neighbouring bins differ.

    A bin of n photons of weight w has the mean n w and the variance n w². The second difference of three bins has no
    part of a slope; its square over the sum of the bins, weighted as the variances are, estimates w. The median over
    the neighbours keeps peaks out; where a few photons make most of the light on both sides, the largest counts.
    """
    padded = np.pad(values, 1)
    left, middle, right = padded[:-2], padded[1:-1], padded[2:]
    spread = left + 4.0 * middle + right
    local = np.divide((left - 2.0 * middle + right) ** 2, spread, out=np.full(len(values), np.nan), where=spread > 0)
    around = sliding_window_view(np.pad(local, _NEIGHBOURS, constant_values=np.nan), 2 * _NEIGHBOURS + 1)
    one_side = sliding_window_view(np.pad(values, _NEIGHBOURS), _NEIGHBOURS)
    squares = np.maximum((one_side**2).mean(axis=1), np.finfo(float).tiny)
    even = one_side.mean(axis=1) ** 2 / squares
    sparse = np.maximum(even[: len(values)], even[_NEIGHBOURS + 1 :]) < _EVEN
    weight = np.zeros(len(values))
    some = np.isfinite(around).any(axis=1)
    weight[some] = np.nanmedian(around[some], axis=1)
    weight[some & sparse] = np.nanmax(around[some & sparse], axis=1, initial=0.0)
    return weight


def merged_edges(values: NDArray[np.float64], variance: NDArray[np.float64]) -> NDArray[np.intp]:
    """Edges, as indices of bins, of groups that are wide enough to mean something, `[G + 1]`.

    A bin that is known to a third stands alone. The bins between two such bins are added up from the left until their
    sum is known to a third, or until the group is as wide as what lies before it in that stretch. Bins before the first
    and after the last light stay apart, so that light does not seem to come before its time. `values`, `variance`:
    `[T]`.
    """
    alone = (values > 0) & (variance <= (_ERROR * values) ** 2)
    lit = np.flatnonzero(values)
    first, last = (int(lit[0]), int(lit[-1]) + 1) if len(lit) else (0, 0)
    edges = [0]
    changes = np.flatnonzero(np.diff(np.concatenate([[True], alone, [True]]).astype(np.int8)))
    for start, stop in changes.reshape(-1, 2):
        edges += list(range(edges[-1], start + 1))  # bins that stand alone
        if first < start < last and not values[start:stop].any():
            edges.pop()  # a stretch without light is part of the bin before it
        else:
            edges += _cuts(values, variance, max(start, first), min(stop, last))
        edges.append(int(stop))
    edges += list(range(edges[-1], len(values) + 1))
    return np.unique(edges)


def shared_edges(
    parts: NDArray[np.float64], variance: NDArray[np.float64]
) -> tuple[NDArray[np.intp], list[NDArray[np.intp]]]:
    """Edges of groups for the sum of components of light, and for each component.

    Groups of the sum, by `merged_edges`, do not go across the first or last light of a component. Where a component is
    more than half of a group, it has the same groups; where it is less, groups that are wide enough for itself.

    Args:
        parts: `[component, T]`.
        variance: Of their sum, `[T]`; each has a part of it as it has of the light.
    """
    total = parts.sum(axis=0)
    lit = [np.flatnonzero(part) for part in parts if part.any()]
    ends = sorted({0, len(total), *(int(end) for one in lit for end in (one[0], one[-1] + 1))})
    edges = _joined(low + merged_edges(total[low:high], variance[low:high]) for low, high in pairwise(ends))
    weight = np.divide(variance, total, out=np.zeros_like(total), where=total > 0)
    return edges, [_own_edges(part, total, weight * part, edges) for part in parts]


def _own_edges(
    part: NDArray[np.float64], total: NDArray[np.float64], variance: NDArray[np.float64], edges: NDArray[np.intp]
) -> NDArray[np.intp]:
    sums = (np.add.reduceat(values, edges[:-1]) for values in (part, 0.5 * total))
    major = np.repeat(np.greater(*sums), np.diff(edges))
    turns = [0, *(np.flatnonzero(np.diff(major)) + 1), len(part)]
    return _joined(
        edges[(edges >= low) & (edges <= high)]
        if major[low]
        else low + merged_edges(part[low:high], variance[low:high])
        for low, high in pairwise(turns)
    )


def _joined(stretches: Iterable[NDArray[np.intp]]) -> NDArray[np.intp]:
    return np.unique(np.concatenate(list(stretches)))


def _cuts(values: NDArray[np.float64], variance: NDArray[np.float64], start: int, stop: int) -> list[int]:
    """Edges of the groups in [start, stop)."""
    if stop <= start:
        return []
    cuts, total, error = [start], 0.0, 0.0
    for bin in range(start, stop):
        total, error = total + values[bin], error + variance[bin]
        width = bin + 1 - cuts[-1]
        if 0.0 < error <= (_ERROR * total) ** 2 or width >= max(_NARROW, cuts[-1] - start):
            cuts.append(bin + 1)
            total = error = 0.0
    if len(cuts) > 2 and stop - cuts[-1] < cuts[-1] - cuts[-2]:  # what is left over joins the group before it
        cuts.pop()
    return [*cuts, stop]


def merged_means(values: NDArray[np.float64], edges: NDArray[np.intp]) -> NDArray[np.float64]:
    """Mean over the bins of each group, `[G]`."""
    return np.add.reduceat(values, edges[:-1]) / np.diff(edges)
