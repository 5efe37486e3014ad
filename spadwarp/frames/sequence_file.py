"""Frames of a scene that moves, on disk: counts, depth and truth of each frame, and the scene at its time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError
from spadwarp.frames.estimators import METHODS, Method
from spadwarp.frames.frames import Frames
from spadwarp.frames.tag_columns import PACKED, TAG_DIMENSION, add_tags, create_tag_columns, described_tags
from spadwarp.io.hdf5 import read_hdf5, write_hdf5
from spadwarp.io.hdf5_dimensions import PIXELS, Coordinate, image_coordinates, name_dimensions
from spadwarp.result.result import Result, Truth
from spadwarp.scene import Scene, Trajectory
from spadwarp.scene.camera import camera_attributes

__all__ = ["FORMAT", "SequenceFile", "SequenceWriter"]

FORMAT = "spadwarp sequence"
FORMAT_VERSION = 1

_TRUTH = {"depth": "m", "range": "m", "normal": "1", "reflectance": "1"}
_READ_ME = (
    "Frames of a scene that moves; in each frame it stands still, at frame_time [s]. counts: [frame, height, width, "
    "bin], detections. depth/NAME: planar depth in metres by that estimator, NaN where nothing was detected. expected: "
    "expected detections per pulse and bin before pile-up; background: its part that is not target, mean over pixels "
    "and bins. truth/: of each frame, by ray casting. camera_position, camera_rotation: the lens and the camera's axes "
    "(columns) in the world. trajectory: values of the fields named in its coordinate. config: the scene before the "
    "trajectory. Camera frame: +x right, +y down, +z forward."
)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SequenceFile:
    """Frames of a scene that moves. Arrays of a frame are read when they are asked for.

    Attributes:
        path: The file.
        base: The scene before the trajectory.
        trajectory: The row of each frame.
        pulses: Of a frame.
        seed: Of the random numbers.
        bins: Of a histogram.
        gate_start, bin_width: [s].
        period: At which time wraps [s], or None.
        methods: Estimators whose depth the file holds.
    """

    path: Path
    base: Scene
    trajectory: Trajectory
    pulses: int
    seed: int
    bins: int
    gate_start: float
    bin_width: float
    period: float | None
    methods: tuple[Method, ...]

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Opens a file that `spadwarp.run.simulate_sequence` wrote. Raises `FileError`."""
        with read_hdf5(path, FORMAT, version=FORMAT_VERSION) as file:
            base = Scene.from_toml(file.text("config"), source=file.text_attribute("source", "") or None)
            times = file.array("frame_time", np.float64, (None,))
            fields = file.attribute("fields")
            names = tuple(map(str, np.atleast_1d(fields)))
            values = file.array("trajectory", np.float64, (len(times), len(names)))
            if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
                file.refuse("frame_time", "or the trajectory is no table of finite numbers by ascending time")
            shape = (base.camera.height, base.camera.width)
            bins = file.stored("counts", np.int32, (len(times), *shape, None)).shape[-1]
            found, period = file.names("depth"), file.real("period", "(0, inf]")
            return cls(
                path=Path(path),
                base=base,
                trajectory=Trajectory(times=times, fields=names, values=values, source=str(path)),
                pulses=file.integer("pulses", "[1, 9223372036854775807]"),
                seed=file.integer("seed"),
                bins=bins,
                gate_start=file.real("gate_start"),
                bin_width=file.real("bin_width", "(0, inf)"),
                period=period if np.isfinite(period) else None,
                methods=tuple(name for name in METHODS if name in found),
            )

    def __repr__(self) -> str:
        camera = self.base.camera
        return f"SequenceFile({self.path}: {self.frames} frames in motion, {camera.width} x {camera.height} pixels)"

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.trajectory)

    @property
    def best_method(self) -> Method | None:
        """The estimator that comes last in `METHODS`; None without depth."""
        return max(self.methods, key=METHODS.index, default=None)

    def scene(self, frame: int) -> Scene:
        """The scene at a frame."""
        self._check(frame)
        return self.trajectory.scene(self.base, frame)

    def counts(self, frame: int) -> NDArray[np.int32]:
        """Counts `[H, W, T]`."""
        return self._read("counts", np.int32, frame, (self.bins,))

    def expected(self, frame: int) -> NDArray[np.float32]:
        """Expected detections per pulse and bin before pile-up `[H, W, T]`."""
        return self._read("expected", np.float32, frame, (self.bins,))

    def background(self, frame: int) -> float:
        """Its part that is not target: mean over pixels and bins."""
        self._check(frame)
        with read_hdf5(self.path, FORMAT) as file:
            return float(file.array("background", np.float64, (self.frames,))[frame])

    def depth(self, method: Method, frame: int) -> NDArray[np.float32]:
        """Depth by one of `methods` `[H, W]` [m]."""
        return self._read(f"depth/{method}", np.float32, frame)

    def truth(self, frame: int) -> Truth:
        """Depth, range, normal and reflectance of the scene at the frame."""
        maps = {name: self._read(f"truth/{name}", np.float32, frame, (3,) * (name == "normal")) for name in _TRUTH}
        return Truth(**maps)

    def _read(self, name: str, kind: Any, frame: int, rest: tuple[int, ...] = ()) -> NDArray[Any]:
        self._check(frame)
        shape = (self.frames, self.base.camera.height, self.base.camera.width, *rest)
        with read_hdf5(self.path, FORMAT) as file:
            return np.asarray(file.stored(name, kind, shape)[frame])

    def _check(self, frame: int) -> None:
        if not 0 <= frame < self.frames:
            raise ArgumentError(f"frame = {frame} is outside [0, {self.frames}), the frames of {self.path}")

    @staticmethod
    @contextmanager
    def create(path: str | Path, base: Scene, trajectory: Trajectory, **facts: Any) -> Iterator[SequenceWriter]:
        """A file to write frames to; at `path` it appears whole or not at all. Raises `FileError`."""
        with write_hdf5(path) as file:
            yield SequenceWriter(file, base, trajectory, **facts)


class SequenceWriter:
    """Writes one frame after the other to an open file.

    Args:
        file: From `write_hdf5`.
        base: The scene before the trajectory.
        trajectory: A row for each frame.
        pulses: Of a frame.
        seed: Of the random numbers.
        photons: Traced for each frame.
        methods: Estimators of depth.
        tags: Whether detections are kept one by one.
    """

    def __init__(
        self,
        file: Any,
        base: Scene,
        trajectory: Trajectory,
        *,
        pulses: int,
        seed: int,
        photons: int,
        methods: Sequence[Method],
        tags: bool,
    ) -> None:
        self._file, self._base, self._trajectory, self._written = file, base, trajectory, 0
        self._facts = {"pulses": pulses, "seed": str(seed), "photons": photons}
        self._methods, self._tags = tuple(methods), tags

    def _begin(self, part: Frames) -> None:
        """Writes everything but the frames, and reserves space for these, which are like the first one."""
        file, base, trajectory = self._file, self._base, self._trajectory
        frames, (height, width, bins) = len(trajectory), part.expected.shape
        file.attrs.update(
            {
                "format": FORMAT,
                "format_version": FORMAT_VERSION,
                "read_me": _READ_ME,
                **self._facts,
                "gate_start": part.gate_start,
                "bin_width": part.bin_width,
                "period": np.inf if part.period is None else part.period,
                "group_index": base.medium.group_index,
                "fields": list(trajectory.fields),
                "source": str(base.source or ""),
            }
        )
        file.create_dataset("config", data=base.to_toml())
        file.create_dataset("frame_time", data=trajectory.times)
        file.create_dataset("trajectory", data=trajectory.values)
        kinds: dict[str, Any] = {"counts": np.int32, "expected": np.float32}
        for name, kind in kinds.items():
            file.create_dataset(name, (frames, height, width, bins), kind, chunks=(1, 1, width, bins), **PACKED)
        file.create_dataset("background", (frames,), np.float64)
        images = ("intensity", *(f"depth/{method}" for method in self._methods), *(f"truth/{name}" for name in _TRUTH))
        for name in images:
            shape = (height, width, *((3,) if name == "truth/normal" else ()))
            kind = np.int64 if name == "intensity" else np.float32
            file.create_dataset(name, (frames, *shape), kind, chunks=(1, *shape), **PACKED)
        file.create_dataset("camera_position", (frames, 3), np.float64)
        file.create_dataset("camera_rotation", (frames, 3, 3), np.float64)
        if self._tags:
            create_tag_columns(file)
        name_dimensions(file, _coordinates(part, trajectory), _dimensions(self._methods))

    def add(self, result: Result, part: Frames, depth: dict[Method, NDArray[np.float64]]) -> None:
        """Writes the next frame: its simulation, its counts `[1, H, W, T]` and its depth `[1, H, W]`."""
        file, row = self._file, self._written
        if not row:
            self._begin(part)
        file["counts"][row] = part.counts[0]
        file["expected"][row] = part.expected
        file["background"][row] = float(np.broadcast_to(part.background, part.expected.shape).mean(dtype=np.float64))
        file["intensity"][row] = part.intensity[0]
        for method, frames in depth.items():
            file[f"depth/{method}"][row] = frames[0]
        for name in _TRUTH:
            file[f"truth/{name}"][row] = getattr(result.truth, name)
        camera: Any = camera_attributes(result.scene.camera, result.focus_distance)
        file["camera_position"][row] = camera["camera_position"]
        file["camera_rotation"][row] = camera["camera_rotation"].reshape(3, 3)
        if part.tags is not None:
            add_tags(file, part.tags)
        self._written += 1


def _coordinates(part: Frames, trajectory: Trajectory) -> dict[str, Coordinate | int | None]:
    height, width, _ = part.expected.shape
    edges = part.gate_start + part.edges
    centres = 0.5 * (edges[:-1] + edges[1:])
    return {
        "frame": (np.arange(len(trajectory)), "1", "number of the frame"),
        **image_coordinates(height, width),
        "time": (centres, "s", "time of flight at the centre of the bin"),
        "camera_axis": (["x", "y", "z"], "1", "of the camera"),
        "field": (list(trajectory.fields), "1", "of the scene"),
        TAG_DIMENSION: None,
    }


def _dimensions(methods: Sequence[Method]) -> dict[str, tuple[tuple[str, ...], str, str]]:
    images = ("frame", *PIXELS)
    return {
        "frame_time": (("frame",), "s", "time of the frame on the trajectory"),
        "trajectory": (("frame", "field"), "", "values of the fields"),
        "counts": ((*images, "time"), "1", "detections in the bin"),
        "expected": ((*images, "time"), "1", "expected detections per pulse before pile-up"),
        "background": (("frame",), "1", "part of `expected` that is not target, mean over pixels and bins"),
        "intensity": (images, "1", "counts over all bins"),
        **{f"depth/{method}": (images, "m", f"planar depth by {method}") for method in methods},
        **{
            f"truth/{name}": ((*images, "axis") if name == "normal" else images, unit, f"true {name}")
            for name, unit in _TRUTH.items()
        },
        "camera_position": (("frame", "axis"), "m", "the lens in the world"),
        "camera_rotation": (("frame", "axis", "camera_axis"), "1", "the camera's axes in the world as columns"),
        **described_tags(),
    }
