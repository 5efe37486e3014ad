"""Frames of counts or depth, wherever they lie: what `spadwarp.export` writes in other formats."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import on_host
from spadwarp.errors import ArgumentError, FileError, SpadwarpError
from spadwarp.result.file import load_result
from spadwarp.result.result import Result
from spadwarp.scene import Scene
from spadwarp.scene.geometry import path_from_range, pixel_directions, range_from_depth
from spadwarp.units import time_from_path

if TYPE_CHECKING:
    from spadwarp.frames.frames import Frames

__all__ = ["Exposure", "Exposures", "opened"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Exposure:
    """One frame.

    Attributes:
        images: Name → `[H, W]`; `Z` is the depth [m] where there is one.
        counts: `[H, W, T]`; None where there is depth alone.
        expected: Expected counts before pile-up `[H, W, T]`, of all light and noise.
        background: Part of that which is not target, counts of a pixel over all bins, mean over pixels.
        pulses: Of the frame.
        gate_start, bin_width: [s].
        period: At which time is folded [s], or None.
        scene: What was looked at.
        depth: True depth [m] `[H, W]`.
        about: Of the depth, in words.
    """

    images: dict[str, NDArray[Any]]
    counts: NDArray[Any] | None = None
    expected: NDArray[np.float32] | None = None
    background: float | None = None
    pulses: int = 0
    gate_start: float = 0.0
    bin_width: float = 0.0
    period: float | None = None
    scene: Scene | None = None
    depth: NDArray[np.float32] | None = None
    about: str = ""

    def true_bins(self) -> NDArray[np.float64]:
        """Bin of the true time of flight `[H, W]`, counted from 1; 0 where there is no target in the window."""
        assert self.scene is not None and self.depth is not None and self.counts is not None
        view = pixel_directions(self.scene.camera)
        distance = range_from_depth(self.depth.astype(np.float64), view)
        path = path_from_range(distance, view, self.scene.beam.position)
        time = time_from_path(path, self.scene.medium.group_index) - self.gate_start
        if self.period is not None:
            time = np.mod(time, self.period)
        found = np.floor(time / self.bin_width) + 1.0
        return np.where((found >= 1) & (found <= self.counts.shape[-1]), found, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Exposures:
    """Frames of one source, read one at a time.

    Attributes:
        place: What to call the source in an error.
        count: Of the frames.
        frame: Number of a frame, from 0 → the frame.
        most: Largest count of a pixel in any frame, if that is known.
    """

    place: str
    count: int
    frame: Callable[[int], Exposure]
    most: int | None = None


@contextmanager
def opened(source: Any, *, result: Result | None = None, split: str = "all") -> Iterator[Result | Exposures]:
    """A result or frames: in memory, in a file, or a dataset's folder. Raises `FileError`, `ArgumentError`."""
    if isinstance(source, Result):
        yield source
    elif isinstance(source, (str, Path)):
        with _opened_place(Path(source), split) as there:
            yield there
    elif hasattr(source, "counts"):
        yield _of_detection(source, result)
    else:
        raise ArgumentError(f"source is a {type(source).__name__}; a Result, Frames or a file of one is needed")


@contextmanager
def _opened_place(path: Path, split: str) -> Iterator[Result | Exposures]:
    import h5py

    if path.is_dir():
        with _opened_dataset(path, split) as exposures:
            yield exposures
        return
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    if not h5py.is_hdf5(path):
        raise FileError(f"{path}: not an HDF5 file")
    readers = {"spadwarp frames": _of_frames, "spadwarp analytic": _of_analytic}
    with h5py.File(path, "r") as file:
        kind = file.attrs.get("format")
        if kind == "spadwarp frames" and "sample" in file:
            raise FileError(f"{path}: a shard of a dataset; name the dataset's folder")
        if kind in readers:
            try:
                exposures = readers[kind](path, file)
            except (KeyError, ValueError, TypeError, OSError, RuntimeError, SpadwarpError) as error:
                raise FileError(f"{path}: damaged or not readable: {error}") from error
            yield exposures
            return
    yield load_result(path)


def _of_detection(detection: Frames, result: Result | None) -> Exposures:
    counts, expected, background = map(on_host, (detection.counts, detection.expected, detection.background))
    counts = counts[None] if detection.summed else counts
    truth = None if result is None else result.truth.depth

    def frame(one: int) -> Exposure:
        return Exposure(
            images={"intensity": counts[one].sum(axis=-1)} | ({} if truth is None else {"truth.Z": truth}),
            counts=counts[one],
            expected=expected * np.float32(detection.exposure),
            background=_mean_background(background, expected.shape) * detection.exposure,
            pulses=detection.exposure,
            gate_start=detection.gate_start,
            bin_width=detection.bin_width,
            period=detection.period,
            scene=None if result is None else result.scene,
            depth=truth,
        )

    return Exposures(
        place="Frames", count=len(counts), frame=frame, most=int(counts.sum(axis=-1, dtype=np.int64).max())
    )


def _of_frames(path: Path, file: Any) -> Exposures:
    about = file.attrs
    pulses, period = int(about["pulses"]), float(about["period"])
    scene, truth = _scene(file["config"], about.get("source")), file["truth/depth"][...]
    expected = file["expected"][...] if "expected" in file else None
    background = None if expected is None else _mean_background(file["background"][...], expected.shape)
    methods = list(file["depth"])
    best = _best(methods)

    def frame(one: int) -> Exposure:
        depths = {f"{method}.Z": file[f"depth/{method}"][one] for method in methods}
        return Exposure(
            images={
                **({"Z": depths[f"{best}.Z"]} if best else {}),
                "intensity": file["intensity"][one],
                **depths,
                "truth.Z": truth,
            },
            counts=file["counts"][one],
            expected=None if expected is None else expected * np.float32(pulses),
            background=None if background is None else background * pulses,
            pulses=pulses,
            gate_start=float(about["gate_start"]),
            bin_width=float(about["bin_width"]),
            period=period if np.isfinite(period) else None,
            scene=scene,
            depth=truth,
            about=f"Z by {best}" if best else "",
        )

    count = int(about["frames"])
    return Exposures(
        place=str(path),
        count=count,
        frame=frame,
        most=max(int(file["intensity"][one].max()) for one in range(count)),
    )


def _of_analytic(path: Path, file: Any) -> Exposures:
    scene, truth = _scene(file["config"], file.attrs.get("source")), file["truth/depth"][...]

    def frame(one: int) -> Exposure:
        images = {"Z": file["depth"][one], "background": file["labels"][one].astype(np.float32), "truth.Z": truth}
        return Exposure(images=images, scene=scene, depth=truth, about="Z by the analytic simulator")

    return Exposures(place=str(path), count=len(file["depth"]), frame=frame)


@contextmanager
def _opened_dataset(folder: Path, split: str) -> Iterator[Exposures]:
    import h5py

    from spadwarp.dataset.read import FrameReader

    plain = FrameReader(folder, split, fields=("noisy", "clean", "label", "intensity", "bound"))
    traced = FrameReader(folder, split, fields=("counts", "expected"))
    with h5py.File(folder / "scenes.h5", "r") as scenes:

        def frame(one: int) -> Exposure:
            item = plain[one]
            row = int(item["scene"])
            images = {
                "Z": item["noisy"][0],
                "truth.Z": item["clean"][0],
                "background": item["label"][0],
                "intensity": item["intensity"][0],
                "bound": item["bound"][0],
            }
            scene = Scene.from_dict(tomllib.loads(scenes["config"][row].decode()))
            common: dict[str, Any] = {"images": images, "scene": scene, "depth": item["clean"][0]}
            common["about"] = f"sample {int(item['sample'])}"
            if not scenes["photons"][row]:
                return Exposure(**common)
            cubes, pulses = traced[one], int(scenes["pulses"][row])
            dark = (scene.detector.dark_count_rate + scene.detector.ambient_rate) * scene.gate.bins
            return Exposure(
                counts=np.moveaxis(cubes["counts"], 0, -1).astype(np.uint32),
                expected=np.ascontiguousarray(np.moveaxis(cubes["expected"], 0, -1)),
                background=(float(scenes["backscatter"][row]) + dark * scene.gate.bin_width) * pulses,
                pulses=pulses,
                gate_start=scene.gate.start,
                bin_width=scene.gate.bin_width,
                period=1.0 / scene.laser.repetition_rate if scene.detector.fold else None,
                **common,
            )

        yield Exposures(place=str(folder), count=len(plain), frame=frame)


# Parts


def _scene(stored: Any, source: str | None) -> Scene:
    return Scene.from_dict(tomllib.loads(stored.asstr()[()]), source=source or None)


def _mean_background(background: NDArray[np.float32], shape: tuple[int, ...]) -> float:
    """Of a pixel per pulse over all bins."""
    return float(np.broadcast_to(background, shape).mean(dtype=np.float64)) * shape[-1]


def _best(methods: Sequence[str]) -> str | None:
    """The estimator that comes last in `METHODS`: the one that uses most of what is known."""
    from spadwarp.frames.arrival_time import METHODS

    known: tuple[str, ...] = METHODS
    return max(methods, key=lambda name: known.index(name) if name in known else -1, default=None)
