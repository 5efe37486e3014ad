"""Frames of a camera on disk, of a scene that stands still or moves: the only file that knows their HDF5 layout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, FileError
from spadwarp.frames.depth import METHODS, Method
from spadwarp.frames.frames import Frames
from spadwarp.frames.response import InstrumentResponse
from spadwarp.io.hdf5 import (
    PIXELS,
    Coordinate,
    Hdf5File,
    hdf5_format,
    image_coordinates,
    name_dimensions,
    read_hdf5,
)
from spadwarp.result.result import Result, Truth
from spadwarp.scene import Scene, Trajectory
from spadwarp.scene.camera import camera_attributes

__all__ = ["FramesFile", "SequenceFile", "is_frames_file"]

FORMAT_VERSION = 1

_PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
_CHUNK_BYTES = 1 << 20
_CHUNK_TAGS = 1 << 16
_TAGS: dict[str, Any] = {"frame": np.int64, "y": np.int32, "x": np.int32, "pulse": np.int64, "bin": np.int32}
_TAG_DIMENSION = "tags/detection"
_TRUTH = {"depth": "m", "range": "m", "normal": "1", "reflectance": "1"}
_OF_A_FRAME = ("pulses", "seed", "gate_start", "bin_width", "edges", "period", "irf", "monte_carlo_noise")

_READ_ME = (
    "counts: [frame, height, width, bin], detections in bin k, which covers gate_start + edges[k] to edges[k + 1] "
    "seconds of flight. depth/NAME: [frame, height, width], planar depth in metres by that estimator, NaN where "
    "nothing was detected. intensity: counts over all bins. bound/time and bound/depth: Cramér–Rao standard deviation "
    "of one frame [s], [m], NaN where there is no information. expected, background: expected detections per pulse and "
    "bin of all light and noise, and of what is not target. "
    "tags, if present: detections one by one. Camera frame: +x right, +y down, +z forward."
)
_READ_ME_MOVING = (
    "Frames of a scene that moves; in each frame it stands still, at frame_time [s]. counts: [frame, height, width, "
    "bin], detections. depth/NAME: planar depth in metres by that estimator, NaN where nothing was detected. expected: "
    "expected detections per pulse and bin before pile-up; background: its part that is not target, mean over pixels "
    "and bins. truth/: of each frame, by ray casting. camera_position, camera_rotation: the lens and the camera's axes "
    "(columns) in the world. trajectory: values of the fields named in its coordinate. config: the scene before the "
    "trajectory. Camera frame: +x right, +y down, +z forward."
)


def is_frames_file(path: str | Path) -> bool:
    """Whether a file holds frames of a camera. Raises `FileError` if it is not an HDF5 file."""
    return hdf5_format(path) == FramesFile.FORMAT


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class _StoredFrames:
    """Frames in a file; counts and depth frames are read when they are asked for."""

    FORMAT: ClassVar[str]
    path: Path
    pulses: int
    seed: int
    gate_start: float
    bin_width: float
    period: float | None
    methods: tuple[Method, ...]

    @property
    def best_method(self) -> Method | None:
        """The estimator that comes last in `METHODS`, which uses most of what is known; None without depth."""
        return max(self.methods, key=METHODS.index, default=None)

    def counts(self, frame: int | None = None) -> NDArray[np.int32]:
        """Counts of one frame `[H, W, T]`, or of all `[frames, H, W, T]`."""
        counts = self._read("counts", np.int32, frame, None)
        if counts.size and counts.min() < 0:
            raise FileError(f"{self.path}: counts are negative in some bins")
        return counts

    def intensity(self, frame: int | None = None) -> NDArray[np.int64]:
        """Counts over all bins, `[H, W]` or `[frames, H, W]`."""
        return self._read("intensity", np.int64, frame)

    def depth(self, method: Method, frame: int | None = None) -> NDArray[np.float32]:
        """Depth by one of `methods` [m], `[H, W]` or `[frames, H, W]`."""
        return self._read(f"depth/{method}", np.float32, frame)

    @property
    def _shape(self) -> tuple[int, int, int]:
        """Number of frames, height and width."""
        raise NotImplementedError

    def _check(self, frame: int | None) -> None:
        if frame is not None and not 0 <= frame < self._shape[0]:
            raise ArgumentError(f"frame = {frame} is outside [0, {self._shape[0]}), the frames of {self.path}")

    def _read(self, name: str, kind: Any, frame: int | None, *rest: int | None) -> NDArray[Any]:
        """An array `[frames, H, W, ...]`, or one frame of it."""
        self._check(frame)
        with read_hdf5(self.path, self.FORMAT) as file:
            return np.asarray(file.stored(name, kind, (*self._shape, *rest))[... if frame is None else frame])

    @staticmethod
    def _common(file: Hdf5File, path: str | Path) -> dict[str, Any]:
        """Fields that files of both kinds have."""
        names = file.names("depth")
        if unknown := [name for name in names if name not in METHODS]:
            file.refuse(f"depth/{unknown[0]}", f"is not by one of {', '.join(METHODS)}")
        period = file.real("period", "(0, inf]")
        return {
            "path": Path(path),
            "pulses": file.integer("pulses", "[1, 9223372036854775807]"),
            "seed": file.integer("seed"),
            "gate_start": file.real("gate_start"),
            "bin_width": file.real("bin_width", "(0, inf)"),
            "period": period if np.isfinite(period) else None,
            "methods": tuple(name for name in METHODS if name in names),
        }


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FramesFile(_StoredFrames):
    """Frames in a file. Counts and depth frames are read when they are asked for, the rest is in memory.

    Attributes:
        path: The file.
        frames: Their number.
        pulses: Per frame.
        seed: Of the random numbers.
        gate_start, bin_width, edges, period, irf, expected, background: As in `Frames`; expected and background are
            None in a file that does not hold them.
        scene: Of the result that the counts were drawn from.
        truth_depth: float32 `[H, W]` [m].
        methods: Estimators whose depth frames the file holds.
        monte_carlo_noise: As of `Frames`.
        channel: Light that was counted: "I", all of it, or "co" or "cross" behind an analyser.
    """

    FORMAT = "spadwarp frames"
    frames: int
    edges: NDArray[np.float64]
    irf: InstrumentResponse
    expected: NDArray[np.float32] | None
    background: NDArray[np.float32] | None
    scene: Scene
    truth_depth: NDArray[np.float32]
    monte_carlo_noise: float | None = None
    channel: str = "I"

    def __repr__(self) -> str:
        height, width = self.truth_depth.shape
        return f"FramesFile({self.path}: {self.frames} frames of {self.pulses} pulses, {width} x {height} pixels)"

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Opens a file that `record_frames` wrote. Raises `FileError`."""
        with read_hdf5(path, cls.FORMAT, version=FORMAT_VERSION) as file:
            if "sample" in file:
                raise FileError(f"{path}: a shard of a dataset; name the dataset's folder")
            scene = Scene.from_toml(file.text("config"), source=file.text_attribute("source", "") or None)
            edges = file.array("edges", np.float64, (None,))
            if edges.size < 2 or not (np.isfinite(edges).all() and (np.diff(edges) > 0).all()):
                file.refuse("edges", "are not two or more ascending times")
            shape = (scene.camera.height, scene.camera.width, edges.size - 1)
            common, frames = cls._common(file, path), len(file.stored("counts", np.int32, (None, *shape)))
            for name in common["methods"]:
                file.stored(f"depth/{name}", np.float32, (frames, *shape[:2]))
            noise = file.attribute("monte_carlo_noise", None)
            return cls(
                **common,
                frames=frames,
                edges=edges,
                irf=_response(file),
                scene=scene,
                truth_depth=file.array("truth/depth", np.float32, shape[:2]),
                channel=file.text_attribute("channel", "I"),
                expected=_expectation(file, "expected", shape),
                background=_expectation(file, "background", shape),
                monte_carlo_noise=None if noise is None else file.real("monte_carlo_noise", "[0, inf)"),
            )

    def plot(self, frame: int = 0, **options: Any) -> Any:
        """A figure of one frame: depth, error, bound, intensity, the counts of a pixel; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(self, frame=frame, **options)

    def frame(self, number: int) -> Frames:
        """One frame as `Frames`. Raises `ArgumentError` where it is not there or the file holds no expected counts."""
        if self.expected is None or self.background is None:
            raise ArgumentError(f"{self.path}: holds no expected counts")
        return Frames(
            counts=self.counts(number)[None],
            frames=1,
            first_frame=number,
            expected=self.expected,
            background=self.background,
            **{name: getattr(self, name) for name in _OF_A_FRAME},
        )

    def bound_depth(self) -> NDArray[np.float64]:
        """Cramér–Rao bound of one frame [m], `[H, W]`; NaN where there is no information."""
        with read_hdf5(self.path, self.FORMAT) as file:
            return file.array("bound/depth", np.float64, self.truth_depth.shape)

    @property
    def _shape(self) -> tuple[int, int, int]:
        return self.frames, self.scene.camera.height, self.scene.camera.width


def _response(file: Hdf5File) -> InstrumentResponse:
    if "irf" in file:
        times, values = file.array("irf", np.float64, (2, None))
        return InstrumentResponse(times=times, values=values)
    return InstrumentResponse(sigma=file.real("irf_sigma", "[0, inf)"), tail=file.real("irf_tail", "[0, inf)"))


def _expectation(file: Hdf5File, name: str, shape: tuple[int, int, int]) -> NDArray[np.float32] | None:
    """Expected detections `[H, W, T]`, or `[H, W, 1]`; None where the file has none."""
    if name not in file:
        return None
    is_even = file.stored(name, np.float32, (*shape[:2], None)).shape[2] == 1 and name == "background"
    values = file.array(name, np.float32, (*shape[:2], 1) if is_even else shape)
    if not (np.isfinite(values).all() and (values >= 0).all()):
        file.refuse(name, "is negative or not finite in some bins")
    return values


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SequenceFile(_StoredFrames):
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

    FORMAT = "spadwarp sequence"
    base: Scene
    trajectory: Trajectory
    bins: int

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Opens a file that `simulate_sequence` wrote. Raises `FileError`."""
        with read_hdf5(path, cls.FORMAT, version=FORMAT_VERSION) as file:
            base = Scene.from_toml(file.text("config"), source=file.text_attribute("source", "") or None)
            times = file.array("frame_time", np.float64, (None,))
            names = tuple(map(str, np.atleast_1d(file.attribute("fields"))))
            values = file.array("trajectory", np.float64, (len(times), len(names)))
            if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
                file.refuse("frame_time", "or the trajectory is no table of finite numbers by ascending time")
            shape = (base.camera.height, base.camera.width)
            return cls(
                **cls._common(file, path),
                base=base,
                trajectory=Trajectory(times=times, fields=names, values=values, source=str(path)),
                bins=file.stored("counts", np.int32, (len(times), *shape, None)).shape[-1],
            )

    def __repr__(self) -> str:
        camera = self.base.camera
        return f"SequenceFile({self.path}: {self.frames} frames in motion, {camera.width} x {camera.height} pixels)"

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.trajectory)

    def scene(self, frame: int) -> Scene:
        """The scene at a frame."""
        self._check(frame)
        return self.trajectory.scene(self.base, frame)

    def expected(self, frame: int) -> NDArray[np.float32]:
        """Expected detections per pulse and bin before pile-up `[H, W, T]`."""
        return self._read("expected", np.float32, frame, self.bins)

    def background(self, frame: int) -> float:
        """Its part that is not target: mean over pixels and bins."""
        self._check(frame)
        with read_hdf5(self.path, self.FORMAT) as file:
            return float(file.array("background", np.float64, (self.frames,))[frame])

    def truth(self, frame: int) -> Truth:
        """Depth, range, normal and reflectance of the scene at the frame."""
        sides = {name: (3,) if name == "normal" else () for name in _TRUTH}
        return Truth(**{name: self._read(f"truth/{name}", np.float32, frame, *rest) for name, rest in sides.items()})

    @property
    def _shape(self) -> tuple[int, int, int]:
        return self.frames, self.base.camera.height, self.base.camera.width


# Writing: everything but the frames at the first part, and then each part


class _Writer:
    """Writes frames to an open file from `write_hdf5`, part by part."""

    def __init__(self, file: Any) -> None:
        self._file, self._written = file, 0

    def _begin(
        self,
        part: Frames,
        scene: Scene,
        frames: int,
        methods: Sequence[Method],
        attributes: Mapping[str, Any],
        coordinates: Mapping[str, Coordinate | int | None],
        arrays: Mapping[str, tuple[tuple[str, ...], str, str]],
    ) -> None:
        """Writes what files of both kinds hold, reserves space for the frames, and names the dimensions."""
        file = self._file
        common = {
            "format_version": FORMAT_VERSION,
            "pulses": part.pulses,
            "seed": str(part.seed),
            "gate_start": part.gate_start,
            "bin_width": part.bin_width,
            "period": np.inf if part.period is None else part.period,
            "group_index": scene.medium.group_index,
            "source": str(scene.source or ""),
        }
        file.attrs.update({**common, **attributes})
        file.create_dataset("config", data=scene.to_toml())
        height, width, bins = part.expected.shape
        self._reserve("counts", np.int32, frames, height, width, bins)
        self._reserve("intensity", np.int64, frames, height, width)
        for method in methods:
            self._reserve(f"depth/{method}", np.float32, frames, height, width)
        for name, kind in _TAGS.items() if part.tags is not None else ():
            file.create_dataset(f"tags/{name}", (0,), kind, maxshape=(None,), chunks=(_CHUNK_TAGS,), **_PACKED)
        edges, images = part.gate_start + part.edges, ("frame", *PIXELS)
        name_dimensions(
            file,
            {
                "frame": (np.arange(frames), "1", "number of the frame"),
                **image_coordinates(height, width),
                "time": (0.5 * (edges[:-1] + edges[1:]), "s", "time of flight at the centre of the bin"),
                **coordinates,
                _TAG_DIMENSION: None,
            },
            {
                "counts": ((*images, "time"), "1", "detections in the bin"),
                "intensity": (images, "1", "counts over all bins"),
                **{f"depth/{method}": (images, "m", f"planar depth by {method}") for method in methods},
                **arrays,
                **{f"tags/{name}": ((_TAG_DIMENSION,), "1", f"{name} of the detection") for name in _TAGS},
            },
        )

    def _reserve(self, name: str, kind: Any, frames: int, height: int, width: int, *rest: int) -> None:
        """An array `[frames, H, W, ...]` in chunks of a part of a frame."""
        row = np.dtype(kind).itemsize * int(np.prod(rest))
        columns = max(1, min(width, _CHUNK_BYTES // row))
        lines = max(1, min(height, _CHUNK_BYTES // (row * columns)))
        chunks = (1, lines, columns, *rest)
        self._file.create_dataset(name, (frames, height, width, *rest), kind, chunks=chunks, **_PACKED)

    def add(self, part: Frames, depth: Mapping[Method, NDArray[np.float64]]) -> None:
        """Writes the next frames, and their depth by each estimator `[frames, H, W]` [m]."""
        file, rows = self._file, slice(self._written, self._written + part.frames)
        file["counts"][rows] = part.counts
        file["intensity"][rows] = part.intensity
        for method, frames in depth.items():
            file[f"depth/{method}"][rows] = frames
        for name, values in ({} if part.tags is None else part.tags._asdict()).items():
            column = file[f"tags/{name}"]
            before = column.shape[0]
            column.resize((before + len(values),))
            column[before:] = values
            file[_TAG_DIMENSION].resize(column.shape)
        self._written = rows.stop


class FramesWriter(_Writer):
    """Writes frames of a scene that stands still: `begin` once, then `add` for each part."""

    def begin(
        self, result: Result, part: Frames, *, frames: int, methods: Sequence[Method], **bound: NDArray[np.float64]
    ) -> None:
        """Writes everything but the frames, and reserves space for these.

        Args:
            result: From which the counts were drawn.
            part: The first frames; tags are written if they have any.
            frames: Number of all frames.
            methods: Estimators of depth.
            bound: `time` [s] and `depth` [m], Cramér–Rao bounds `[H, W]`.
        """
        file, scene = self._file, result.scene
        attributes = {
            "format": FramesFile.FORMAT,
            "read_me": _READ_ME,
            "frames": frames,
            "laser_position": scene.beam.position,
            "pixel_tangent": scene.camera.pixel_tangent,
            **camera_attributes(scene.camera, result.focus_distance),
            "irf_sigma": part.irf.sigma,
            "irf_tail": part.irf.tail,
            **({} if part.monte_carlo_noise is None else {"monte_carlo_noise": part.monte_carlo_noise}),
            "notes": list(part.notes),
            "photons": result.photons,
            "channel": result.provenance.get("channel", "I"),
        }
        file.create_dataset("edges", data=part.edges)
        if part.irf.times is not None:
            file.create_dataset("irf", data=np.array([part.irf.times, part.irf.values], np.float64))
        truth = result.truth.depth
        for name, values in {"expected": part.expected, "background": part.background, "truth/depth": truth}.items():
            file.create_dataset(name, data=values, **_PACKED)
        for name, sigma in bound.items():
            file.create_dataset(f"bound/{name}", data=sigma)
        coordinates: dict[str, Coordinate | int | None] = {
            "whole_gate": 1,
            "edges": ("edges", "s", "edges of the bins after the start of the gate"),
            "sample": 0 if part.irf.times is None else np.size(part.irf.times),
            "quantity": (["time [s]", "value"], "1", "of the measured instrument response"),
        }
        bins = "whole_gate" if part.background.shape[-1] == 1 < part.expected.shape[-1] else "time"
        arrays = {
            "expected": ((*PIXELS, "time"), "1", "expected detections per pulse before pile-up"),
            "background": ((*PIXELS, bins), "1", "the part of `expected` that is not target"),
            "bound/time": (PIXELS, "s", "Cramér–Rao bound of one frame"),
            "bound/depth": (PIXELS, "m", "Cramér–Rao bound of one frame"),
            "truth/depth": (PIXELS, "m", "true planar depth"),
            "irf": (("quantity", "sample"), "1", "measured instrument response"),
        }
        self._begin(part, scene, frames, methods, attributes, coordinates, arrays)


class SequenceWriter(_Writer):
    """Writes one frame of a scene that moves after the other.

    Args:
        file: From `write_hdf5`.
        base: The scene before the trajectory.
        trajectory: A row for each frame.
        photons: Traced for each frame.
    """

    def __init__(self, file: Any, base: Scene, trajectory: Trajectory, *, photons: int) -> None:
        super().__init__(file)
        self._base, self._trajectory, self._photons = base, trajectory, photons

    def add_frame(self, result: Result, part: Frames, depth: Mapping[Method, NDArray[np.float64]]) -> None:
        """Writes the next frame: its simulation, its counts `[1, H, W, T]` and its depth `[1, H, W]`."""
        file, row = self._file, self._written
        if not row:
            self._reserve_all(part, list(depth))
        file["expected"][row] = part.expected
        file["background"][row] = float(np.broadcast_to(part.background, part.expected.shape).mean(dtype=np.float64))
        for name in _TRUTH:
            file[f"truth/{name}"][row] = getattr(result.truth, name)
        camera: Any = camera_attributes(result.scene.camera, result.focus_distance)
        file["camera_position"][row] = camera["camera_position"]
        file["camera_rotation"][row] = camera["camera_rotation"].reshape(3, 3)
        self.add(part, depth)

    def _reserve_all(self, part: Frames, methods: Sequence[Method]) -> None:
        """Writes everything but the frames, and reserves space for these, which are like the first one."""
        file, trajectory = self._file, self._trajectory
        frames, (height, width, bins) = len(trajectory), part.expected.shape
        file.create_dataset("frame_time", data=trajectory.times)
        file.create_dataset("trajectory", data=trajectory.values)
        self._reserve("expected", np.float32, frames, height, width, bins)
        for name in _TRUTH:
            self._reserve(f"truth/{name}", np.float32, frames, height, width, *((3,) if name == "normal" else ()))
        for name, shape in {"background": (), "camera_position": (3,), "camera_rotation": (3, 3)}.items():
            file.create_dataset(name, (frames, *shape), np.float64)
        attributes = {
            "format": SequenceFile.FORMAT,
            "read_me": _READ_ME_MOVING,
            "photons": self._photons,
            "fields": list(trajectory.fields),
        }
        coordinates: dict[str, Coordinate | int | None] = {
            "camera_axis": (["x", "y", "z"], "1", "of the camera"),
            "field": (list(trajectory.fields), "1", "of the scene"),
        }
        images, axis = ("frame", *PIXELS), {"normal": ("axis",)}
        arrays = {
            "frame_time": (("frame",), "s", "time of the frame on the trajectory"),
            "trajectory": (("frame", "field"), "", "values of the fields"),
            "expected": ((*images, "time"), "1", "expected detections per pulse before pile-up"),
            "background": (("frame",), "1", "part of `expected` that is not target, mean over pixels and bins"),
            **{
                f"truth/{name}": ((*images, *axis.get(name, ())), unit, f"true {name}") for name, unit in _TRUTH.items()
            },
            "camera_position": (("frame", "axis"), "m", "the lens in the world"),
            "camera_rotation": (("frame", "axis", "camera_axis"), "1", "the camera's axes in the world as columns"),
        }
        self._begin(part, self._base, frames, methods, attributes, coordinates, arrays)
