"""Photon ids as [start, stop) ranges."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ConfigError

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["IdQueue", "Range", "Ranges", "count", "joined", "photons_per_position", "shard_of", "without"]

Range = tuple[int, int]
Ranges = tuple[Range, ...]


def joined(ranges: Iterable[Range]) -> Ranges:
    """The ranges in order, adjoining ones made one.

    Raises:
        ConfigError: Ids are in more than one of them.
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
    for first, last in done:
        if start < min(first, stop):
            left.append((start, min(first, stop)))
        start = max(start, last)
    if start < stop:
        left.append((start, stop))
    return tuple(left)


def count(ranges: Iterable[Range]) -> int:
    """How many ids there are."""
    return sum(stop - start for start, stop in ranges)


def shard_of(span: Range, shard: tuple[int, int], unit: int) -> Range:
    """Part `shard[0]`, from 1, of `shard[1]` equal parts of a span of whole units.

    Raises:
        ConfigError: There are more parts than units.
    """
    (number, parts), (start, stop) = shard, span
    units = (stop - start) // unit
    if units < parts:
        raise ConfigError(f"shard = {number}/{parts}: {stop - start} photons are {units} units of {unit}, too few")
    return start + unit * (units * (number - 1) // parts), start + unit * (units * number // parts)


class IdQueue:
    """Ids that wait, taken from the front; those of lost workers are put back."""

    def __init__(self, ranges: Iterable[Range]) -> None:
        self._ranges = sorted(ranges, reverse=True)
        self.left = count(self._ranges)

    def take(self, size: int) -> Range | None:
        """At most `size` ids; None if none are left."""
        if not self._ranges:
            return None
        start, stop = self._ranges.pop()
        if stop - start > size:
            self._ranges.append((start + size, stop))
            stop = start + size
        self.left -= stop - start
        return start, stop

    def put_back(self, ranges: Iterable[Range]) -> None:
        """Ids that are to be done again."""
        self._ranges = sorted([*self._ranges, *ranges], reverse=True)
        self.left = count(self._ranges)


def photons_per_position(scene: Scene, photon_ranges: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
    """Photons whose light each pixel may hold, float64 `[H, W]`: all of them, or in a scan those of its position, but 1
    at least."""
    shape = (scene.camera.height, scene.camera.width)
    if scene.scan_positions == 1:
        return np.full(shape, float(sum(stop - start for start, stop in photon_ranges)))
    pixels = shape[0] * shape[1]
    position = np.arange(pixels)
    count = np.zeros(pixels)
    for start, stop in photon_ranges:  # ids that are the position modulo the number of positions
        count += (stop - position + pixels - 1) // pixels - (start - position + pixels - 1) // pixels
    return np.maximum(count, 1.0).reshape(shape)
