"""Frames of any source, one at a time: of a camera, of the analytic simulator, of a dataset."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic import AnalyticFile
from spadwarp.arrays import on_host
from spadwarp.dataset import FrameReader
from spadwarp.errors import ArgumentError
from spadwarp.files.loader import load, locate
from spadwarp.frames.export import FrameSequence, SequenceFrame
from spadwarp.frames.file import FramesFile
from spadwarp.frames.frames import Frames
from spadwarp.frames.sequence_file import SequenceFile
from spadwarp.result.result import Result
from spadwarp.scene import noise_rate

__all__ = ["open_source", "sequence"]


@contextmanager
def open_source(source: Any, *, result: Result | None = None, split: str = "all") -> Iterator[Result | FrameSequence]:
    """A result or frames: in memory, in a file, or in a directory; see `load`.

    Args:
        source: A `Result`, `Frames`, what `load` returns, or a path.
        result: From which `Frames` were drawn.
        split: Of a dataset.

    Raises:
        ArgumentError: A source of another type.
        FileError: Not a file of ours, or damaged.
    """
    if isinstance(source, Frames):
        yield _of_frames(source, result)
        return
    if isinstance(source, (str, os.PathLike)):
        place = locate(source)
        source = FrameReader(place, split) if place.is_dir() else load(place)
    yield source if isinstance(source, Result) else sequence(source)


def sequence(held: Any) -> FrameSequence:
    """The frames of a `FramesFile`, a `SequenceFile`, an `AnalyticFile` or a `FrameReader`.

    Raises `ArgumentError` for others.
    """
    if isinstance(held, FramesFile):
        return _of_file(held)
    if isinstance(held, SequenceFile):
        return _of_moving(held)
    if isinstance(held, AnalyticFile):
        return _of_analytic(held)
    if isinstance(held, FrameReader):
        return _of_dataset(held)
    raise ArgumentError(f"source is a {type(held).__name__}; a Result, Frames or a file of one is needed")


def _of_frames(frames: Frames, result: Result | None) -> FrameSequence:
    counts, expected, background = map(on_host, (frames.counts, frames.expected, frames.background))
    counts = counts[None] if frames.summed else counts
    truth = None if result is None else result.truth.depth

    def frame(number: int) -> SequenceFrame:
        return SequenceFrame(
            images={"intensity": counts[number].sum(axis=-1)} | ({} if truth is None else {"truth.Z": truth}),
            counts=counts[number],
            expected=expected * np.float32(frames.exposure),
            background=_mean_background(background, expected.shape) * frames.exposure,
            pulses=frames.exposure,
            gate_start=frames.gate_start,
            bin_width=frames.bin_width,
            period=frames.period,
            scene=None if result is None else result.scene,
            depth=truth,
        )

    most = int(counts.sum(axis=-1, dtype=np.int64).max())
    return FrameSequence(name="Frames", count=len(counts), frame=frame, largest_count=most)


def _of_file(file: FramesFile) -> FrameSequence:
    background = None
    if file.expected is not None and file.background is not None:
        background = _mean_background(file.background, file.expected.shape) * file.pulses
    best = file.best_method

    def frame(number: int) -> SequenceFrame:
        depths = {f"{method}.Z": file.depth(method, number) for method in file.methods}
        return SequenceFrame(
            images={
                **({"Z": depths[f"{best}.Z"]} if best else {}),
                "intensity": file.intensity(number),
                **depths,
                "truth.Z": file.truth_depth,
            },
            counts=file.counts(number),
            expected=None if file.expected is None else file.expected * np.float32(file.pulses),
            background=background,
            pulses=file.pulses,
            gate_start=file.gate_start,
            bin_width=file.bin_width,
            period=file.period,
            scene=file.scene,
            depth=file.truth_depth,
            content=f"Z by {best}" if best else "",
        )

    most = max(int(file.intensity(number).max()) for number in range(file.frames))
    return FrameSequence(name=str(file.path), count=file.frames, frame=frame, largest_count=most)


def _of_moving(file: SequenceFile) -> FrameSequence:
    best = file.best_method

    def frame(number: int) -> SequenceFrame:
        scene, truth, counts = file.scene(number), file.truth(number), file.counts(number)
        depths = {f"{method}.Z": file.depth(method, number) for method in file.methods}
        return SequenceFrame(
            images={
                **({"Z": depths[f"{best}.Z"]} if best else {}),
                "intensity": counts.sum(axis=-1, dtype=np.int64),
                **depths,
                "truth.Z": truth.depth,
            },
            counts=counts,
            expected=file.expected(number) * np.float32(file.pulses),
            background=file.background(number) * file.bins * file.pulses,
            pulses=file.pulses,
            gate_start=file.gate_start,
            bin_width=file.bin_width,
            period=file.period,
            scene=scene,
            depth=truth.depth,
            content=f"Z by {best}, {file.trajectory.times[number]:g} s",
        )

    return FrameSequence(name=str(file.path), count=file.frames, frame=frame)


def _of_analytic(file: AnalyticFile) -> FrameSequence:
    truth = file.truth.depth

    def frame(number: int) -> SequenceFrame:
        images = {"Z": file.depth(number), "background": file.labels(number).astype(np.float32), "truth.Z": truth}
        return SequenceFrame(images=images, scene=file.scene, depth=truth, content="Z by the analytic simulator")

    return FrameSequence(name=str(file.path), count=file.frames, frame=frame, same_scene=lambda _: range(file.frames))


def _of_dataset(reader: FrameReader) -> FrameSequence:
    depth = reader.with_fields("noisy", "clean", "label", "intensity", "bound")
    histograms = reader.with_fields("counts", "expected")
    photons, pulses, backscatter = map(depth.scene_numbers, ("photons", "pulses", "backscatter"))

    def frame(number: int) -> SequenceFrame:
        item, scene = depth[number], depth.scene(number)
        row = int(item["scene"])
        common: dict[str, Any] = {
            "images": {name: item[field][0] for name, field in _DATASET_IMAGES.items()},
            "scene": scene,
            "depth": item["clean"][0],
            "content": f"sample {int(item['sample'])}",
        }
        if not photons[row]:
            return SequenceFrame(**common)
        cubes = histograms[number]
        noise = float(np.mean(noise_rate(scene))) * scene.gate.bins * scene.gate.bin_width
        return SequenceFrame(
            counts=np.moveaxis(cubes["counts"], 0, -1).astype(np.uint32),
            expected=np.ascontiguousarray(np.moveaxis(cubes["expected"], 0, -1)),
            background=(float(backscatter[row]) + noise) * int(pulses[row]),
            pulses=int(pulses[row]),
            gate_start=scene.gate.start,
            bin_width=scene.gate.bin_width,
            period=1.0 / scene.laser.repetition_rate if scene.detector.wrap else None,
            **common,
        )

    return FrameSequence(name=str(reader.path), count=len(depth), frame=frame, same_scene=depth.same_scene)


_DATASET_IMAGES = {
    "Z": "noisy",
    "truth.Z": "clean",
    "background": "label",
    "intensity": "intensity",
    "bound": "bound",
}


def _mean_background(background: NDArray[np.float32], shape: tuple[int, ...]) -> float:
    """Expected background of a pixel per pulse over all bins, mean over pixels."""
    return float(np.broadcast_to(background, shape).mean(dtype=np.float64)) * shape[-1]
