"""One loader for all files that spadwarp writes as HDF5, and what they hold: depth, the gate, a summary."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic import AnalyticFile, AnalyticResult, Proposal
from spadwarp.arrays import on_host
from spadwarp.checks import summary as scene_summary
from spadwarp.dataset import FrameReader
from spadwarp.frames import Frames, FramesFile, Reduction, SequenceFile
from spadwarp.frames.measured import is_own
from spadwarp.io.hdf5 import read_hdf5
from spadwarp.io.paths import file_within
from spadwarp.result import Result, Truth, load_result
from spadwarp.scene import Scene
from spadwarp.scene.sight import lines_of_sight, port_advance
from spadwarp.transport import PhotonRecords, load_records
from spadwarp.values import FileError, range_from_time

__all__ = ["Held", "gate_of", "holds_own_file", "is_own_file", "load", "locate", "stored_depth", "summary"]

Held = Result | FramesFile | SequenceFile | AnalyticFile | FrameReader | PhotonRecords
"""Content of a file of ours."""

_NAMES = ("frames.h5", "result.h5", "analytic.h5", "sequence.h5")
_DATASET, _CHECKPOINT = "manifest.json", "checkpoint.h5"
_LOADERS: dict[str, Callable[[Path], Held]] = {
    "spadwarp result": load_result,
    "spadwarp frames": FramesFile.load,
    "spadwarp analytic": AnalyticFile.load,
    "spadwarp records": load_records,
    "spadwarp sequence": SequenceFile.load,
}


def load(path: str | os.PathLike[str]) -> Held:
    """Loads a file that spadwarp wrote: what each gives (`Held`) stands in docs/formats.md, "One loader".

    A directory with one of these files, such as that of a run, is as the file; a checkpoint counts if there is no
    result; of a dataset's folder or a shard all frames. Raises `FileError`: not a file of ours, damaged, or a directory
    that holds none or several of them.
    """
    place = locate(path)
    kind, is_dataset = None, place.is_dir()
    if not is_dataset:
        with read_hdf5(place) as file:
            kind, is_dataset = file.attribute("format", None), file.attribute("shard", None) is not None
    if is_dataset:
        return FrameReader(place, "all")
    if (loader := _LOADERS.get(str(kind))) is None:
        raise FileError(f"{place}: an HDF5 file, but none of ours: its format is {kind!r}, not {', '.join(_LOADERS)}")
    return loader(place)


def locate(path: str | os.PathLike[str]) -> Path:
    """A file as it is; of a directory the only result, frames or analytic file in it, else its checkpoint.

    A dataset's folder stays a folder. Raises `FileError` for a directory that holds none of them, or several.
    """
    place = Path(path)
    if not os.path.isdir(place) or (place / _DATASET).is_file():
        return place
    if not any((place / name).is_file() for name in _NAMES) and (place / _CHECKPOINT).is_file():
        return place / _CHECKPOINT
    return file_within(place, _NAMES)


def holds_own_file(folder: str | os.PathLike[str]) -> bool:
    """Whether a directory is that of a run, of frames, of an analytic file or of a dataset."""
    return any((Path(folder) / name).is_file() for name in (*_NAMES, _DATASET, _CHECKPOINT))


def is_own_file(place: Path) -> bool:
    """Whether a path from `locate` is a dataset's folder, or an HDF5 file that spadwarp wrote; raises `FileError` for a
    damaged one."""
    return place.is_dir() or is_own(place)


def stored_depth(held: Held) -> Reduction | None:
    """The depth frames of an analytic file, a dataset, a shard or a scene that moves; None for what holds histograms.

    The camera of a scene that moves is that of its first frame. `intensity` is that of a dataset's frames, the counts
    of a scene that moves, and the expected signal of the analytic model.
    """
    intensity: NDArray[Any]
    if isinstance(held, AnalyticFile):
        depth, scene = held.depth().astype(np.float64), held.scene
        intensity = np.broadcast_to(np.nan_to_num(held.maps["signal"]), depth.shape)
    elif isinstance(held, FrameReader):
        items = [(item["noisy"][0], item["intensity"][0]) for item in held]
        depth, scene = np.array([noisy for noisy, _ in items], np.float64), held.scene(0)
        intensity = np.array([counts for _, counts in items])
    elif isinstance(held, SequenceFile) and held.best_method is not None:
        depth, scene = held.depth(held.best_method).astype(np.float64), held.scene(0)
        intensity = held.intensity()
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


def gate_of(held: Held, times: tuple[float, float] | None = None) -> tuple[float, float] | None:
    """Ranges at which the gate of an analytic file, a dataset or a scene that moves opens and closes [m], of all its
    scenes together; or of light at other `times` [s]."""
    if isinstance(held, FrameReader) and times is None:
        gates = np.array([item["gate"] for item in held.with_fields()])
        return float(gates[:, 0].min()), float(gates[:, 1].max())
    if isinstance(held, SequenceFile):
        scene, own = held.base, (held.gate_start, held.gate_start + held.bins * held.bin_width)
    elif isinstance(held, AnalyticFile | FrameReader):
        scene = held.scene if isinstance(held, AnalyticFile) else held.scene(0)
        own = scene.gate.start, scene.gate.stop
    else:
        return None
    near, far = (range_from_time(time, scene.medium.group_index) + port_advance(scene) for time in times or own)
    return near, far


# Summaries


def summary(held: Held | Scene | Frames | AnalyticResult | Proposal) -> dict[str, Any]:
    """Facts about what a loaded file holds, or is in memory, in numbers and text that JSON can hold; `kind` names it.

    Raises `MeshError` where a target of a scene cannot be read.
    """
    if isinstance(held, Result):
        return {"kind": "result", **held.summary()}
    if isinstance(held, Proposal):
        return {"kind": "proposal", **held.to_dict()}
    if isinstance(held, Scene):
        return {"kind": "scene", **scene_summary(held)}
    if isinstance(held, PhotonRecords):
        ended = {name: int(np.count_nonzero(held.reason == number)) for number, name in enumerate(held.reasons)}
        ended = {name: count for name, count in ended.items() if count}
        return {"kind": "records", "photons": len(held.id), "ended": ended}
    if isinstance(held, FrameReader):
        shards, targets = held.shards, list(held.manifest["targets"])
        facts = {"kind": "dataset", "name": held.manifest["name"], "folder": str(held.path)}
        facts |= {"shards": shards if len(shards) == 1 else len(shards), "frames": len(held)}
        facts |= _median_ratio(held.scene_numbers("noise_ratio"))
        return {**facts, "image": {"width": held.shape[1], "height": held.shape[0]}, "targets": targets}
    if isinstance(held, Frames):
        intensity = on_host(held.intensity)
        facts = {"kind": "frames", "frames": held.frames, "added_up": held.summed, "bins": held.expected.shape[-1]}
        return {**facts, **_of_frames(held, float(intensity.mean())), "notes": list(held.notes)}
    scene = held.base if isinstance(held, SequenceFile) else held.scene
    if isinstance(held, AnalyticResult):
        return {"kind": "analytic", "seed": held.seed, **_of_analytic(scene, vars(held), held.truth)}
    common = {
        "scene": str(scene.source) if scene.source else None,
        "frames": held.frames,
        "seed": held.seed,
        "image": {"width": scene.camera.width, "height": scene.camera.height},
        "bins": scene.gate.bins if isinstance(held, AnalyticFile) else held.bins,
    }
    if isinstance(held, AnalyticFile):
        return {"kind": "analytic", **common, **_of_analytic(scene, held.maps, held.truth)}
    if isinstance(held, SequenceFile):
        times = held.trajectory.times
        facts = {"times_s": [float(times[0]), float(times[-1])], "moving": list(held.trajectory.fields)}
        return {"kind": "sequence", **common, "pulses": held.pulses, **facts, "depth_by": list(held.methods)}
    mean = [float(held.intensity(number).mean()) for number in range(held.frames)]
    more: dict[str, Any] = {} if held.channel == "I" else {"channel": held.channel}
    more |= _median_ratio(held.noise_ratio)
    counts = _of_frames(held, float(np.mean(mean)) if mean else None)
    return {"kind": "frames", **common, **counts, "depth_by": list(held.methods), **more}


def _median_ratio(ratios: NDArray[Any] | None) -> dict[str, float]:
    """Of pixels or scenes that have a noise ratio."""
    return {"noise_ratio": float(np.nanmedian(ratios))} if ratios is not None and np.isfinite(ratios).any() else {}


def _of_frames(held: Frames | FramesFile, counts_per_pixel: float | None) -> dict[str, Any]:
    return {
        "pulses": held.pulses,
        "seed": held.seed,
        "gate_start_ns": 1e9 * held.gate_start,
        "bin_width_ps": 1e12 * held.bin_width,
        "period_ns": None if held.period is None else 1e9 * held.period,
        "counts_per_pixel": counts_per_pixel,
        "response_fwhm_ps": 1e12 * held.irf.fwhm,
    }


_MEDIANS = ("signal", "backscatter", "alpha", "signal_to_backscatter", "sigma_time", "sigma_depth")
_MEANS = ("outlier_probability", "background_probability")


def _of_analytic(scene: Scene, maps: Mapping[str, NDArray[Any]], truth: Truth) -> dict[str, Any]:
    """Settings, numbers of pixels, and medians or means of those with an estimate."""
    known = maps["fisher"] > 0
    facts: dict[str, Any] = {name: getattr(scene.analytic, name) for name in ("form", "backscatter", "count_law")}
    facts["pixels_with_target"] = int(np.isfinite(truth.depth).sum())
    facts["pixels_with_estimate"] = int(known.sum())
    for names, average in ((_MEDIANS, np.median), (_MEANS, np.mean)):
        facts |= {name: float(average(maps[name][known])) if known.any() else None for name in names}
    return facts
