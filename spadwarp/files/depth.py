"""Depth frames that a file holds, without an estimator."""

from __future__ import annotations

import numpy as np

from spadwarp.analytic import AnalyticFile
from spadwarp.dataset import FrameReader
from spadwarp.files.loader import Held
from spadwarp.frames import Reduction
from spadwarp.frames.sequence_file import SequenceFile
from spadwarp.scene.sight import lines_of_sight, port_advance
from spadwarp.units import range_from_time

__all__ = ["gate_of", "stored_depth"]


def stored_depth(held: Held) -> Reduction | None:
    """The depth frames of an analytic file, a dataset, a shard or a scene that moves; None for what holds histograms.

    The camera of a scene that moves is that of its first frame. `intensity` is that of a dataset's frames, the counts
    of a scene that moves, and the expected signal of the analytic model.
    """
    if isinstance(held, AnalyticFile):
        depth = held.depth().astype(np.float64)
        intensity = np.broadcast_to(np.nan_to_num(held.maps["signal"]), depth.shape)
        scene = held.scene
    elif isinstance(held, FrameReader):
        items = [(item["noisy"][0], item["intensity"][0]) for item in held]
        depth = np.array([noisy for noisy, _ in items], np.float64)
        intensity = np.array([counts for _, counts in items])
        scene = held.scene(0)
    elif isinstance(held, SequenceFile) and held.best_method is not None:
        numbers = range(held.frames)
        depth = np.array([held.depth(held.best_method, number) for number in numbers], np.float64)
        intensity = np.array([held.counts(number).sum(axis=-1) for number in numbers])
        scene = held.scene(0)
    else:
        return None
    lines = lines_of_sight(scene)
    return Reduction(
        quantity="depth",
        values=depth,
        range=lines.range_from_depth(depth),
        intensity=intensity,
        lines=lines,
        method="stored",
        camera=scene.camera,
    )


def gate_of(held: Held) -> tuple[float, float] | None:
    """Ranges at which the gate of an analytic file, a dataset or a scene that moves opens and closes [m], of all its
    scenes together."""
    if isinstance(held, AnalyticFile):
        gate, index, advance = held.scene.gate, held.scene.medium.group_index, port_advance(held.scene)
        return range_from_time(gate.start, index) + advance, range_from_time(gate.stop, index) + advance
    if isinstance(held, SequenceFile):
        start, stop = held.gate_start, held.gate_start + held.bins * held.bin_width
        index, advance = held.base.medium.group_index, port_advance(held.base)
        return range_from_time(start, index) + advance, range_from_time(stop, index) + advance
    if isinstance(held, FrameReader):
        gates = np.array([item["gate"] for item in held.with_fields()])
        return float(gates[:, 0].min()), float(gates[:, 1].max())
    return None
