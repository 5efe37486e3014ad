"""Histograms of traced scenes in one file a shard: expected counts of the scenes, counts of the frames.

Counts are stored as a cube for each frame, or event by event: the index y · W · T + x · T + k of each bin that holds
counts, and their number. Frame n's events are those from `event_start[n]` to `event_start[n + 1]`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.rendered import RenderedScene
from spadwarp.dataset.schema import HISTOGRAM_COLUMNS, PACKED, describe
from spadwarp.errors import FileError
from spadwarp.io.hdf5 import Hdf5File

__all__ = ["HISTOGRAM_FIELDS", "HistogramFile", "HistogramWriter"]

HISTOGRAM_FIELDS = ("counts", "expected", "polarisation")
"""Cubes of a frame; methods of `HistogramFile` have these names."""

_COUNTS = (np.uint8, np.uint16, np.uint32, np.uint64)
_KINDS = {"scene": np.int32, "gate_start": np.float64, "bin_width": np.float64, "sample": np.int64}


class HistogramWriter:
    """Takes the traced scenes of a shard one by one into an open file; `close` writes the rest."""

    def __init__(self, file: Any, scenes: int, *, counts: str) -> None:
        self._file, self._scenes, self._counts = file, scenes, counts
        self._expected: Any = None
        self._polarisation: Any = None
        self._numbers: dict[str, list[Any]] = {name: [] for name in _KINDS}
        self._events: list[tuple[NDArray[np.uint32], NDArray[np.int32]]] = []

    def add(self, rendered: RenderedScene, samples: NDArray[np.int64]) -> None:
        """The next scene, and the ids of its frames."""
        histograms, gate = rendered.histograms, rendered.scene.gate
        assert histograms is not None
        height, width, bins = histograms.expected.shape
        if self._expected is None:
            rows = max(1, min(height, (1 << 20) // (2 * width * bins)))  # chunks of 1 MiB
            self._chunk = (1, rows, width, bins)
            self._expected = self._create("expected", (self._scenes, height, width, bins), np.float16)
        self._expected[len(self._numbers["scene"])] = histograms.expected
        if histograms.polarisation is not None:
            if self._polarisation is None:  # NaN in scenes without
                self._polarisation = self._create("polarisation", self._expected.shape, np.float16, fillvalue=np.nan)
            self._polarisation[len(self._numbers["scene"])] = histograms.polarisation
        for name, value in (("scene", rendered.draw.index), ("gate_start", gate.start), ("bin_width", gate.bin_width)):
            self._numbers[name].append(value)
        self._numbers["sample"].extend(samples)
        if self._counts != "none":
            for frame in histograms.counts.reshape(len(histograms.counts), -1):
                filled = np.flatnonzero(frame)
                self._events.append((filled.astype(np.uint32), frame[filled]))

    def close(self) -> None:
        """Writes what is only known at the end."""
        for name, kind in _KINDS.items():
            self._file.create_dataset(name, data=np.array(self._numbers[name], kind), track_times=False)
        if self._events:
            self._write_counts()
        describe(self._file, HISTOGRAM_COLUMNS)

    def _create(self, name: str, shape: tuple[int, ...], kind: Any, **choices: Any) -> Any:
        return self._file.create_dataset(name, shape, kind, chunks=self._chunk, track_times=False, **PACKED, **choices)

    def _write_counts(self) -> None:
        indices, counts = zip(*self._events, strict=True)
        sizes = [part.size for part in counts]
        kind = np.min_scalar_type(max((int(part.max(initial=0)) for part in counts), default=0))
        shape = self._expected.shape[1:]
        dense_bytes = len(counts) * math.prod(shape) * kind.itemsize
        if self._counts == "dense" or (self._counts == "smaller" and dense_bytes <= (4 + kind.itemsize) * sum(sizes)):
            stored = self._create("counts", (len(counts), *shape), kind)
            for row, (index, count) in enumerate(self._events):
                stored[row] = _cube(index, count, shape, kind)
            return
        starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        self._file.create_dataset("event_start", data=starts, track_times=False)
        events = {"event_index": np.concatenate(indices), "event_count": np.concatenate(counts).astype(kind)}
        for name, values in events.items():
            packed = {"chunks": (min(values.size, 1 << 18),), **PACKED} if values.size else {}
            self._file.create_dataset(name, data=values, track_times=False, **packed)


class HistogramFile:
    """The histograms of an open file, by scene index and by sample id; `fields`: which of `HISTOGRAM_FIELDS` it may
    hold."""

    def __init__(self, file: Hdf5File, shape: tuple[int, int]) -> None:
        self._scenes, self._samples = (
            {int(number): row for row, number in enumerate(file.array(name, _KINDS[name], (None,)))}
            for name in ("scene", "sample")
        )
        scenes, samples = len(file.stored("scene", np.int32, (None,))), len(file.stored("sample", np.int64, (None,)))
        self._expected = file.stored("expected", np.float16, (scenes, *shape, None))
        self.shape: tuple[int, ...] = self._expected.shape[1:]
        self._polarisation = None
        self.fields = HISTOGRAM_FIELDS if "polarisation" in file else HISTOGRAM_FIELDS[:-1]
        if "polarisation" in file:
            self._polarisation = file.stored("polarisation", np.float16, self._expected.shape)
        self._counts = file.stored("counts", _COUNTS, (samples, *self.shape)) if "counts" in file else None
        self._starts: NDArray[np.int64] | None = None
        if "event_start" in file:
            self._starts = file.array("event_start", np.int64, (samples + 1,))
            self._index = file.stored("event_index", np.uint32, (None,))
            self._events = file.stored("event_count", _COUNTS, (len(self._index),))
            if self._starts[0] != 0 or self._starts[-1] != len(self._index) or (np.diff(self._starts) < 0).any():
                file.refuse("event_start", f"does not divide {len(self._index)} events")
        self.path = file.path

    def expected(self, scene: int) -> NDArray[np.float32] | None:
        """Expected counts of a frame `[H, W, T]`; None for a scene that was not traced."""
        row = self._scenes.get(scene)
        return None if row is None else self._expected[row].astype(np.float32)

    def polarisation(self, scene: int) -> NDArray[np.float32] | None:
        """Degree of polarisation `[H, W, T]`; None for a scene that was not traced, or without polarised light."""
        row = self._scenes.get(scene)
        return None if row is None or self._polarisation is None else self._polarisation[row].astype(np.float32)

    def counts(self, sample: int) -> NDArray[np.float32] | None:
        """Counts `[H, W, T]` of a frame; None where there are none."""
        row = self._samples.get(sample)
        if row is None or (self._starts is None and self._counts is None):
            return None
        if self._starts is None:
            assert self._counts is not None
            return self._counts[row].astype(np.float32)
        part = slice(int(self._starts[row]), int(self._starts[row + 1]))
        index = self._index[part]
        if index.size and index.max() >= math.prod(self.shape):
            raise FileError(f"{self.path}: event_index is outside the histograms {self.shape} in row {row}")
        return _cube(index, self._events[part], self.shape, np.float32)


def _cube(index: NDArray[Any], counts: NDArray[Any], shape: tuple[int, ...], kind: Any) -> NDArray[Any]:
    cube = np.zeros(int(np.prod(shape)), kind)
    cube[index] = counts
    return cube.reshape(shape)
