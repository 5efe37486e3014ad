"""Ids of photons as ranges [start, stop): what is done, what is left, and how many photons that is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene import Scene
from spadwarp.values import ConfigError

Range = tuple[int, int]
Ranges = tuple[Range, ...]


def joined(ranges: Iterable[Range]) -> Ranges:
    """The ranges in order, adjoining ones made one.

    Raises `ConfigError`: ids are in more than one of them.
    """
    whole: list[Range] = []
    for start, stop in sorted(ranges):
        if whole and start < whole[-1][1]:
            raise ConfigError(f"photon ids {start} to {min(stop, whole[-1][1]) - 1} are in more than one result")
        if whole and start == whole[-1][1]:
            whole[-1] = (whole[-1][0], stop)
        elif start < stop:
            whole.append((start, stop))
    return tuple(whole)


def without(span: Range, done: Ranges) -> Ranges:
    """The parts of a span that are not in `done`, which are joined ranges."""
    left: list[Range] = []
    start, stop = span
    for first, last in (*done, (stop, stop)):
        if start < min(first, stop):
            left.append((start, min(first, stop)))
        start = max(start, last)
    return tuple(left)


def count(ranges: Iterable[Range]) -> int:
    """How many ids there are."""
    return sum(stop - start for start, stop in ranges)


def shard_of(span: Range, shard: tuple[int, int], unit: int) -> Range:
    """Part `shard[0]`, from 1, of `shard[1]` nearly equal parts of a span, cut at multiples of a unit.

    Raises `ConfigError`: there are more parts than units.
    """
    (number, parts), (start, stop) = shard, span
    units = (stop - start) // unit
    if units < parts:
        raise ConfigError(f"shard = {number}/{parts}: {stop - start} photons are {units} units of {unit}, too few")
    inner = [unit * (start // unit + units * part // parts) for part in range(1, parts)]
    edges = [start, *inner, stop]
    return edges[number - 1], edges[number]


class IdQueue:
    """Ids that wait, taken from the front; those of lost workers are put back."""

    def __init__(self, ranges: Iterable[Range]) -> None:
        self._ranges = sorted(ranges)

    @property
    def left(self) -> int:
        """How many wait."""
        return count(self._ranges)

    def take(self, size: int, unit: int = 1) -> Range | None:
        """At most `size` ids, up to a multiple of `unit` where more are left; None if none are left."""
        if not self._ranges:
            return None
        start, stop = self._ranges.pop(0)
        end = min((start // unit + max(size // unit, 1)) * unit, stop)
        if end < stop:
            self._ranges.insert(0, (end, stop))
        return start, end

    def put_back(self, ranges: Iterable[Range]) -> None:
        """Ids that are to be done again."""
        self._ranges = sorted([*self._ranges, *ranges])


def photons_per_position(scene: Scene, photon_ranges: Sequence[Range]) -> NDArray[np.float64]:
    """Photons whose light each pixel may hold, float64 `[H, W]`: all of them, or in a scan those of its position, but 1
    at least."""
    shape = (scene.camera.height, scene.camera.width)
    if scene.scan_positions == 1:
        return np.full(shape, float(count(photon_ranges)))
    positions = scene.scan_positions
    position = np.arange(positions)
    photons = np.zeros(positions)
    for start, stop in photon_ranges:  # ids that are the position modulo the number of positions
        photons += (stop - position + positions - 1) // positions - (start - position + positions - 1) // positions
    return np.repeat(np.maximum(photons, 1.0), shape[0] * shape[1] // positions).reshape(shape)
