"""Histograms of traced scenes in one file a shard: expected counts of the scenes, counts of the frames.

Counts are stored as a cube for each frame, or event by event: indices of the bins that hold any, y · W · T + x · T + k,
and how many. Frame n's events are those from `event_start[n]` to `event_start[n + 1]`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.render_analytic import RenderedScene

__all__ = ["HistogramFile", "HistogramWriter"]

_PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}

MEANING = {
    "scene": ("1", "index into scenes.h5"),
    "expected": ("1", "expected counts of a frame before pile-up: target, scattered light, dark counts, ambient light"),
    "gate_start": ("s", "start of bin 0 after the pulse left the laser"),
    "bin_width": ("s", "of a bin"),
    "sample": ("1", "id of the frame in the whole dataset"),
    "counts": ("1", "counts of the frame"),
    "event_start": ("1", "first event of each frame; one entry more than frames"),
    "event_index": ("1", "y * W * T + x * T + bin"),
    "event_count": ("1", "counts in that bin"),
}


class HistogramWriter:
    """Takes the traced scenes of a shard one by one into an open file; `close` writes the rest."""

    def __init__(self, file: Any, scenes: int, *, counts: str) -> None:
        self._file, self._scenes, self._how = file, scenes, counts
        self._expected: Any = None
        self._numbers: dict[str, list[Any]] = {name: [] for name in ("scene", "gate_start", "bin_width", "sample")}
        self._events: list[tuple[NDArray[np.uint32], NDArray[np.int32]]] = []

    def add(self, one: RenderedScene, samples: NDArray[np.int64]) -> None:
        """The next scene."""
        found = one.histograms
        assert found is not None
        height, width, bins = found.expected.shape
        if self._expected is None:
            rows = max(1, min(height, (1 << 20) // (2 * width * bins)))  # chunks of 1 MiB
            shape, self._chunk = (self._scenes, height, width, bins), (1, rows, width, bins)
            self._expected = self._file.create_dataset(
                "expected", shape, np.float16, chunks=self._chunk, track_times=False, **_PACKED
            )
        self._expected[len(self._numbers["scene"])] = found.expected
        gate = one.scene.gate
        for name, value in (("scene", one.draw.index), ("gate_start", gate.start), ("bin_width", gate.bin_width)):
            self._numbers[name].append(value)
        self._numbers["sample"].extend(samples)
        if self._how != "none":
            for frame in found.counts.reshape(len(found.counts), -1):
                where = np.flatnonzero(frame)
                self._events.append((where.astype(np.uint32), frame[where]))

    def close(self) -> None:
        """Writes what could only be known at the end."""
        kinds = {"scene": np.int32, "gate_start": np.float64, "bin_width": np.float64, "sample": np.int64}
        for name, kind in kinds.items():
            self._file.create_dataset(name, data=np.array(self._numbers[name], kind), track_times=False)
        if self._events:
            self._write_counts()
        for name, one in self._file.items():
            unit, text = MEANING[name]
            one.attrs.update({"unit": unit, "description": text})

    def _write_counts(self) -> None:
        most = max((int(counts.max(initial=0)) for _, counts in self._events), default=0)
        kind = np.uint8 if most < 256 else np.uint16 if most < 65536 else np.uint32
        each = np.dtype(kind).itemsize
        total = sum(counts.size for _, counts in self._events)
        shape = self._expected.shape[1:]
        dense_bytes = len(self._events) * int(np.prod(shape)) * each
        if self._how == "dense" or (self._how == "smaller" and dense_bytes <= (4 + each) * total):
            options = {"chunks": self._chunk, "track_times": False, **_PACKED}
            stored = self._file.create_dataset("counts", (len(self._events), *shape), kind, **options)
            for row, (where, counts) in enumerate(self._events):
                stored[row] = _cube(where, counts, shape, kind)
            return
        starts = np.concatenate([[0], np.cumsum([counts.size for _, counts in self._events])]).astype(np.int64)
        self._file.create_dataset("event_start", data=starts, track_times=False)
        parts = {
            "event_index": np.concatenate([where for where, _ in self._events]),
            "event_count": np.concatenate([counts for _, counts in self._events]).astype(kind),
        }
        for name, values in parts.items():
            chunks = (max(1, min(values.size, 1 << 18)),)
            packed = {"chunks": chunks, **_PACKED} if values.size else {}
            self._file.create_dataset(name, data=values, track_times=False, **packed)


class HistogramFile:
    """The histograms of an open file, by scene index and by sample id."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._scenes = {int(one): row for row, one in enumerate(file["scene"][...])}
        self._samples = {int(one): row for row, one in enumerate(file["sample"][...])}
        self._starts = file["event_start"][...] if "event_start" in file else None
        self.shape: tuple[int, ...] = file["expected"].shape[1:]

    def expected(self, scene: int) -> NDArray[np.float32] | None:
        """Expected counts of a frame `[H, W, T]`; None for a scene that was not traced."""
        row = self._scenes.get(scene)
        return None if row is None else self._file["expected"][row].astype(np.float32)

    def counts(self, sample: int) -> NDArray[np.float32] | None:
        """Counts `[H, W, T]` of a frame; None where there are none."""
        row = self._samples.get(sample)
        if row is None or (self._starts is None and "counts" not in self._file):
            return None
        if self._starts is None:
            return self._file["counts"][row].astype(np.float32)
        part = slice(int(self._starts[row]), int(self._starts[row + 1]))
        return _cube(self._file["event_index"][part], self._file["event_count"][part], self.shape, np.float32)


def _cube(where: NDArray[Any], counts: NDArray[Any], shape: tuple[int, ...], kind: Any) -> NDArray[Any]:
    cube = np.zeros(int(np.prod(shape)), kind)
    cube[where] = counts
    return cube.reshape(shape)
