"""Any of our files opened: results, frames of a camera or of the analytic simulator, datasets."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import on_host
from spadwarp.dataset import FrameReader
from spadwarp.errors import ArgumentError
from spadwarp.frames.export import FrameSequence, SequenceFrame
from spadwarp.frames.file import FORMAT, FramesFile
from spadwarp.frames.frames import Frames
from spadwarp.io.hdf5 import hdf5_format
from spadwarp.result.file import load_result
from spadwarp.result.result import Result
from spadwarp.run import analytic_file

__all__ = ["open_source"]


@contextmanager
def open_source(source: Any, *, result: Result | None = None, split: str = "all") -> Iterator[Result | FrameSequence]:
    """A result or frames: in memory, in a file, or a dataset's folder.

    Args:
        source: A `Result`, `Frames`, a path.
        result: From which `Frames` were drawn.
        split: Of a dataset.

    Raises:
        ArgumentError: A source of another type.
        FileError: Not a file of ours, or damaged.
    """
    if isinstance(source, Result):
        yield source
    elif isinstance(source, (str, Path)):
        path = Path(source)
        if path.is_dir():
            yield _of_dataset(path, split)
        elif (kind := hdf5_format(path)) == FORMAT:
            yield _of_file(FramesFile.load(path))
        elif kind == analytic_file.FORMAT:
            yield analytic_file.load_analytic(path)
        else:
            yield load_result(path)
    elif hasattr(source, "counts"):
        yield _of_frames(source, result)
    else:
        raise ArgumentError(f"source is a {type(source).__name__}; a Result, Frames or a file of one is needed")


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


def _of_dataset(folder: Path, split: str) -> FrameSequence:
    depth = FrameReader(folder, split, fields=("noisy", "clean", "label", "intensity", "bound"))
    histograms = FrameReader(folder, split, fields=("counts", "expected"))
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
        noise = scene.detector.noise_rate * scene.gate.bins * scene.gate.bin_width
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

    return FrameSequence(name=str(folder), count=len(depth), frame=frame)


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
