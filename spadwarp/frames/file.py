"""Frames of a camera on disk, of a scene that stands still or moves: recorded part by part, and opened again."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats, Variable
from spadwarp.device import pick_devices
from spadwarp.frames.cramer_rao import ResultBound, bound_of_result, photons_for_noise
from spadwarp.frames.depth import METHODS, Method
from spadwarp.frames.response import InstrumentResponse, detector_response
from spadwarp.frames.spad import Frames, detect
from spadwarp.io.hdf5 import (
    PACKED,
    PIXELS,
    Hdf5File,
    hdf5_format,
    image_chunks,
    image_coordinates,
    name_dimensions,
    read_hdf5,
    write_hdf5,
)
from spadwarp.result.analysis import with_frames
from spadwarp.result.result import ARRAYS, Result, Truth
from spadwarp.scene import Scene, SceneLike, Trajectory, as_scene, load_trajectory
from spadwarp.scene.camera import camera_attributes
from spadwarp.scene.sight import depth_from_time, depth_per_time
from spadwarp.values import SEED, ArgumentError, ConfigError, FileError, SpadwarpWarning, check_integer

__all__ = ["FrameErrors", "FramesFile", "Recording", "SequenceFile", "is_frames_file", "record_frames"]
__all__ += ["simulate_sequence"]

Progress = Callable[[str, int, int], None]

FORMAT_VERSION = 1

_CHUNK_TAGS = 1 << 16
_PART_BYTES = 1 << 26  # of counts that are held at a time
_IMAGES, _DETECTION = ("frame", *PIXELS), "tags/detection"
_TAGS: dict[str, Any] = {"frame": np.int64, "y": np.int32, "x": np.int32, "pulse": np.int64, "bin": np.int32}
_TRUTH = {name.partition("/")[2]: entry for name, entry in ARRAYS.items() if name.startswith("truth/")}
_OF_A_FRAME = ("pulses", "seed", "gate_start", "bin_width", "edges", "period", "irf", "target_noise_ratio")

_READ_ME = (
    "Frames of a SPAD camera. Bin k covers gate_start + edges[k] to edges[k + 1] seconds of flight; without edges, "
    "bins are bin_width wide. NaN: nothing was detected, or there is no information. config: the scene, of frames "
    "in motion before the trajectory. Camera frame: +x right, +y down, +z forward. "
)


def is_frames_file(path: str | Path) -> bool:
    """Whether a file holds frames of a camera. Raises `FileError` if it is not an HDF5 file."""
    return hdf5_format(path) == FramesFile.FORMAT


# Opened


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class _StoredFrames:
    """Frames in a file; what `_own` does not read is read when it is asked for."""

    FORMAT: ClassVar[str]
    path: Path  # the file
    shape: tuple[int, int, int, int]  # (frames, H, W, T)
    pulses: int
    seed: int
    gate_start: float
    bin_width: float
    period: float | None
    methods: tuple[Method, ...]  # estimators whose depth frames the file holds

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Opens a file that `record_frames` or `simulate_sequence` wrote. Raises `FileError`."""
        with read_hdf5(path, cls.FORMAT, version=FORMAT_VERSION) as file:
            if "sample" in file:
                raise FileError(f"{path}: a shard of a dataset; name the dataset's folder")
            scene = Scene.from_toml(file.text("config"), source=file.text_attribute("source", "") or None)
            shape = file.stored("counts", np.int32, (None, scene.camera.height, scene.camera.width, None)).shape
            names, period = file.names("depth"), file.real("period", "(0, inf]")
            for name in names:
                if name not in METHODS:
                    file.refuse(f"depth/{name}", f"is not by one of {', '.join(METHODS)}")
                file.stored(f"depth/{name}", np.float32, shape[:3])
            file.stored("significance", np.float32, shape[:3])
            common: dict[str, Any] = {
                "path": Path(path),
                "shape": shape,
                "pulses": file.integer("pulses", "[1, 9223372036854775807]"),
                "seed": file.integer("seed"),
                "gate_start": file.real("gate_start"),
                "bin_width": file.real("bin_width", "(0, inf)"),
                "period": period if np.isfinite(period) else None,
                "methods": tuple(name for name in METHODS if name in names),
            }
            return cls(**common, **cls._own(file, scene, shape))

    @classmethod
    def _own(cls, file: Hdf5File, scene: Scene, shape: tuple[int, ...]) -> dict[str, Any]:
        """The fields that files of one kind have."""
        raise NotImplementedError

    def __repr__(self) -> str:
        frames, height, width, _ = self.shape
        return f"{type(self).__name__}({self.path}: {frames} frames of {self.pulses} pulses, {width} x {height} pixels)"

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.shape[0]

    @property
    def bins(self) -> int:
        """Bins of a histogram."""
        return self.shape[3]

    @property
    def best_method(self) -> Method | None:
        """The estimator that comes last in `METHODS`, which uses most of what is known; None without depth."""
        return max(self.methods, key=METHODS.index, default=None)

    def counts(self, frame: int | None = None) -> NDArray[np.int32]:
        """Counts of one frame `[H, W, T]`, or of all `[frames, H, W, T]`."""
        counts = self._read("counts", np.int32, frame, self.bins)
        if counts.size and counts.min() < 0:
            raise FileError(f"{self.path}: counts are negative in some bins")
        return counts

    def intensity(self, frame: int | None = None) -> NDArray[np.int64]:
        """Counts over all bins, `[H, W]` or `[frames, H, W]`."""
        return self._read("intensity", np.int64, frame)

    def depth(self, method: Method, frame: int | None = None) -> NDArray[np.float32]:
        """Depth by one of `methods` [m], `[H, W]` or `[frames, H, W]`."""
        return self._read(f"depth/{method}", np.float32, frame)

    def significance(self, frame: int | None = None) -> NDArray[np.float32]:
        """Detection significance, see `spadwarp.arrival_time`, `[H, W]` or `[frames, H, W]`."""
        return self._read("significance", np.float32, frame)

    def _check(self, frame: int | None) -> None:
        if frame is not None and not 0 <= frame < self.frames:
            raise ArgumentError(f"frame = {frame} is outside [0, {self.frames}), the frames of {self.path}")

    def _read(self, name: str, kind: Any, frame: int | None, *rest: int) -> NDArray[Any]:
        """An array `[frames, H, W, ...]`, or one frame of it."""
        self._check(frame)
        with read_hdf5(self.path, self.FORMAT) as file:
            return np.asarray(file.stored(name, kind, (*self.shape[:3], *rest))[... if frame is None else frame])


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FramesFile(_StoredFrames):
    """Frames in a file. Counts and depth frames are read when they are asked for, the rest is in memory."""

    FORMAT = "spadwarp frames"
    edges: NDArray[np.float64]
    irf: InstrumentResponse
    expected: NDArray[np.float32]  # as of `Frames`, as all others are
    background: NDArray[np.float32]
    scene: Scene  # of the result that the counts were drawn from
    truth_depth: NDArray[np.float32]  # of that result, float32 `[H, W]` [m]
    target_noise_ratio: float | None = None
    noise_ratio: NDArray[np.float32] | None = None  # `Result.noise_ratio` of frames of these pulses, `[H, W]`
    channel: str = "I"  # light that was counted: "I", all of it, or "co" or "cross" behind an analyser
    notes: tuple[str, ...] = ()

    @classmethod
    def _own(cls, file: Hdf5File, scene: Scene, shape: tuple[int, ...]) -> dict[str, Any]:
        image, bins = shape[1:3], shape[3]
        edges = file.array("edges", np.float64, (bins + 1,))
        if not (bins and np.isfinite(edges).all() and (np.diff(edges) > 0).all()):
            file.refuse("edges", "are not two or more ascending times")
        if "irf" in file:
            times, values = file.array("irf", np.float64, (2, None))
            irf = InstrumentResponse(times=times, values=values)
        else:
            irf = InstrumentResponse(sigma=file.real("irf_sigma", "[0, inf)"), tail=file.real("irf_tail", "[0, inf)"))
        is_even = file.stored("background", np.float32, (*image, None)).shape[2] == 1
        cubes = {"expected": bins, "background": 1 if is_even else bins}
        expectations = {name: file.array(name, np.float32, (*image, size)) for name, size in cubes.items()}
        for name, cube in expectations.items():
            if not (np.isfinite(cube).all() and (cube >= 0).all()):
                file.refuse(name, "is negative or not finite in some bins")
        noise = file.attribute("target_noise_ratio", None)
        return {
            "edges": edges,
            "irf": irf,
            "scene": scene,
            "truth_depth": file.array("truth/depth", np.float32, image),
            "channel": file.text_attribute("channel", "I"),
            "notes": tuple(map(str, np.atleast_1d(file.attribute("notes", ())))),
            "noise_ratio": file.array("noise_ratio", np.float32, image) if "noise_ratio" in file else None,
            "target_noise_ratio": None if noise is None else file.real("target_noise_ratio", "[0, inf]"),
            **expectations,
        }

    def plot(self, frame: int = 0, **options: Any) -> Any:
        """A figure of one frame: depth, error, bound, intensity, the counts of a pixel; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(self, frame=frame, **options)

    def frame(self, number: int) -> Frames:
        """One frame as `Frames`. Raises `ArgumentError` where it is not there."""
        return Frames(
            counts=self.counts(number)[None],
            frames=1,
            first_frame=number,
            expected=self.expected,
            background=self.background,
            detector=self.scene.detector,
            **{name: getattr(self, name) for name in _OF_A_FRAME},
        )

    def bound_depth(self) -> Floats:
        """Cramér–Rao bound of one frame [m], `[H, W]`; NaN where there is no information."""
        with read_hdf5(self.path, self.FORMAT) as file:
            return file.array("bound/depth", np.float64, self.shape[1:3])


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SequenceFile(_StoredFrames):
    """Frames of a scene that moves. Arrays of a frame are read when they are asked for."""

    FORMAT = "spadwarp sequence"
    base: Scene  # the scene before the trajectory
    trajectory: Trajectory  # the row of each frame. All others: as of `FramesFile`.

    @classmethod
    def _own(cls, file: Hdf5File, scene: Scene, shape: tuple[int, ...]) -> dict[str, Any]:
        times, names = file.array("frame_time", np.float64, shape[:1]), np.atleast_1d(file.attribute("fields"))
        values = file.array("trajectory", np.float64, (len(times), len(names)))
        if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
            file.refuse("frame_time", "or the trajectory is no table of finite numbers by ascending time")
        fields = tuple(map(str, names))
        moves = Trajectory(times=times, fields=fields, values=values, source=str(file.path))
        return {"base": scene, "trajectory": moves}

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


# Recorded


class _Layout(NamedTuple):
    """What a file holds beside counts and depth, with coordinates of `name_dimensions`. Of arrays whose first dimension
    is the frame the next rows; the rest is written with the first frames."""

    arrays: dict[str, Variable]
    attributes: dict[str, Any]
    coordinates: dict[str, Any]


class _Writer:
    """Writes frames to an open file of `write_hdf5`, part by part, and all else with the first part."""

    def __init__(self, file: Any, frames: int) -> None:
        self._file, self._frames, self._written = file, frames, 0

    def add(
        self, part: Frames, scene: Scene, depth: Mapping[Method, Floats], significance: Any, layout: _Layout
    ) -> None:
        """Writes the next frames, their tags, and their depth by each estimator `[frames, H, W]` [m]."""
        every: dict[str, Variable] = {
            "counts": ((*_IMAGES, "time"), part.counts, "1", "detections in the bin"),
            "intensity": (_IMAGES, part.intensity, "1", "counts over all bins"),
            "significance": (_IMAGES, significance, "1", "-log10 of the probability of a false alarm"),
            **layout.arrays,
        }
        for method, values in depth.items():
            every[f"depth/{method}"] = (_IMAGES, values.astype(np.float32), "m", f"planar depth by {method}")
        for name, column in ({} if part.tags is None else part.tags._asdict()).items():
            every[f"tags/{name}"] = ((_DETECTION,), column.astype(_TAGS[name]), "1", f"{name} of the detection")
        if not self._written:
            self._begin(part, scene, layout._replace(arrays=every))
        rows = slice(self._written, self._written + part.frames)
        for name, (dimensions, values, _, _) in every.items():
            stored = self._file[name]
            if dimensions[0] == "frame":
                stored[rows] = values
            elif dimensions[0] == _DETECTION:
                before = len(stored)
                stored.resize((before + len(values),))
                stored[before:] = values
                self._file[_DETECTION].resize(stored.shape)
        self._written = rows.stop

    def _begin(self, part: Frames, scene: Scene, layout: _Layout) -> None:
        """Writes what all frames share, reserves space for these, and names the dimensions."""
        file, arrays = self._file, layout.arrays
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
        words = [f"{name} ({', '.join(axes)}): {meaning} [{unit}]" for name, (axes, _, unit, meaning) in arrays.items()]
        file.attrs.update({**common, **layout.attributes, "read_me": _READ_ME + "; ".join(words)})
        file.create_dataset("config", data=scene.to_toml())
        for name, (dimensions, values, _, _) in arrays.items():
            array = np.asarray(values)
            if dimensions[0] == _DETECTION:
                file.create_dataset(name, (0,), array.dtype, maxshape=(None,), chunks=(_CHUNK_TAGS,), **PACKED)
            elif dimensions[0] != "frame":
                file.create_dataset(name, data=array, **(PACKED if array.ndim > 1 else {}))
            else:
                shape, packed = (self._frames, *array.shape[1:]), dimensions[:3] == _IMAGES
                chunks = {"chunks": (1, *image_chunks(shape[1:], array.itemsize)), **PACKED} if packed else {}
                file.create_dataset(name, shape, array.dtype, **chunks)
        edges, (height, width, _) = part.gate_start + part.edges, part.expected.shape
        axes: dict[str, Any] = {
            "frame": (np.arange(self._frames), "1", "number of the frame"),
            **image_coordinates(height, width),
            "time": (0.5 * (edges[:-1] + edges[1:]), "s", "time of flight at the centre of the bin"),
            _DETECTION: None,
            **layout.coordinates,
        }
        described = {}
        for name, (dimensions, _, unit, meaning) in arrays.items():
            if dimensions == (name,):  # a coordinate
                axes[name] = (name, unit, meaning)
            else:
                described[name] = (dimensions, unit, meaning)
        name_dimensions(file, axes, described)


@dataclass(frozen=True, kw_only=True)
class FrameErrors:
    """How far the depth frames of one estimator are from the truth, over all pixels and frames that have both: the
    estimates over pixels with a target; median and 90th percentile of the absolute errors [m]."""

    estimate_fraction: float
    median: float
    p90: float

    @classmethod
    def of(cls, depth: Floats, truth: NDArray[np.float32]) -> Self:
        """Of depth `[frames, H, W]` against the truth `[H, W]` [m]."""
        error = np.abs(depth - truth)[:, np.isfinite(truth)]
        known = error[np.isfinite(error)]
        median, p90 = map(float, np.quantile(known, (0.5, 0.9)) if known.size else (np.nan, np.nan))
        return cls(estimate_fraction=known.size / max(error.size, 1), median=median, p90=p90)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """Summary of what `record_frames` wrote."""

    file: FramesFile  # the file, opened
    errors: dict[Method, FrameErrors]  # of depth, by estimator; of at most the first 256 MiB of counts
    bound: ResultBound  # Cramér–Rao bound of one frame; `sigma` is NaN where `crlb` refuses, which the notes then say
    bound_photons: float  # photons that would make the noise in the bound a tenth
    detections: int  # counts of all frames


def record_frames(
    result: Result,
    path: str | Path,
    *,
    pulses: int | None = None,
    frames: int = 1,
    seed: int,
    methods: Sequence[Method] = METHODS,
    undo_pile_up: bool = False,
    tags: bool = False,
    window: tuple[float, int] | None = None,
    device: Any = None,
    progress: Progress | None = None,
) -> Recording:
    """Writes frames of counts that the camera would record, and their depth, to one HDF5 file, whole or not at all.

    Frames are drawn in parts, the same as `spadwarp.detect` draws: memory does not grow with their number.

    Args:
        result: Of `spadwarp.simulate`; its scene has the camera.
        path: The file.
        pulses, frames, seed, tags, window, device: As of `spadwarp.detect`.
        methods: Estimators of depth, see `spadwarp.arrival_time`. They know background and response.
        undo_pile_up: Estimate from Coates' correction of the counts.
        progress: Called with ("frames", done, frames), and before it with (step, 0, 0) of each part of them.

    Raises `ArgumentError`, and `FileError` where the file cannot be written.
    """
    frames = check_integer("frames", frames, "[1, 2147483647]")
    scene = result.scene
    pulses = scene.detector.pulses_per_frame if pulses is None else pulses
    bins = scene.gate.bins if window is None else window[1]
    size = max(1, _PART_BYTES // (4 * scene.camera.width * scene.camera.height * bins))
    options: dict[str, Any] = {"pulses": pulses, "seed": seed, "tags": tags, "window": window, "device": device}

    report = (lambda step, done, total: None) if progress is None else progress
    report("Cramér–Rao bound", 0, 0)
    bound = _bound(result, pulses, device)
    notes = () if bound.problem is None else (f"no Cramér–Rao bound: {bound.problem}",)
    errors: dict[Method, FrameErrors] = {}
    still: _Layout | None = None
    detections = 0
    with write_hdf5(path) as opened:
        writer = _Writer(opened, frames)
        for start in range(0, frames, size):
            number = min(size, frames - start)
            report(f"counts of frames {start + 1} to {start + number} of {frames}", 0, 0)
            with warnings.catch_warnings():
                if start:  # all parts say the same
                    warnings.simplefilter("ignore", SpadwarpWarning)
                part = detect(result, frames=number, first_frame=start, **options)
            part = replace(part, notes=(*part.notes, *notes))
            depth: dict[Method, Floats] = {}
            found: dict[str, Any] = {"significance": np.zeros(part.counts.shape[:-1], np.float32), "device": device}
            for method in methods:
                if not start:
                    report(f"their depth by {method}", 0, 0)
                time = part.arrival_time(method, undo_pile_up=undo_pile_up, **found)
                depth[method] = depth_from_time(time, scene=scene)
            still = still or _still(result, part, frames, bound.sigma)
            writer.add(part, scene, depth, found["significance"], still)
            detections += int(part.intensity.sum())
            errors = errors or {name: FrameErrors.of(values, result.truth.depth) for name, values in depth.items()}
            report("frames", start + part.frames, frames)
    return Recording(
        file=FramesFile.load(path),
        errors=errors,
        bound=bound,
        bound_photons=photons_for_noise(result.photons, bound.noise, 0.1),
        detections=detections,
    )


def _still(result: Result, part: Frames, frames: int, bound: Floats) -> _Layout:
    """What the file of a scene that stands still holds beside its frames: see `_Layout`."""
    scene, irf, distance = result.scene, part.irf, result.truth.range.astype(np.float64)
    attributes = {
        "format": FramesFile.FORMAT,
        "frames": frames,
        "laser_position": scene.beam.position,
        "pixel_tangent": scene.camera.pixel_tangent,
        **camera_attributes(scene.camera, result.focus_distance),
        "irf_sigma": irf.sigma,
        "irf_tail": irf.tail,
        **({} if part.target_noise_ratio is None else {"target_noise_ratio": part.target_noise_ratio}),
        "notes": list(part.notes),
        "photons": result.photons,
        "channel": result.provenance.get("channel", "I"),
    }
    bins = "whole_gate" if part.background.shape[-1] == 1 < part.expected.shape[-1] else "time"
    arrays: dict[str, Variable] = {
        "expected": ((*PIXELS, "time"), part.expected, "1", "expected detections per pulse before pile-up"),
        "background": ((*PIXELS, bins), part.background, "1", "the part of `expected` that is not target"),
        "bound/time": (PIXELS, bound, "s", "Cramér–Rao bound of one frame"),
        "bound/depth": (PIXELS, bound * depth_per_time(scene, distance), "m", "Cramér–Rao bound of one frame"),
        "truth/depth": (PIXELS, result.truth.depth, "m", "true planar depth"),
        "edges": (("edges",), part.edges, "s", "edges of the bins after the start of the gate"),
    }
    if result.batches > 1:
        ratio = with_frames(result, part.pulses).noise_ratio.astype(np.float32)
        arrays["noise_ratio"] = (PIXELS, ratio, "1", "variance by the simulation over that of a frame's photons")
    coordinates: dict[str, Any] = {"whole_gate": 1}
    if irf.times is not None and irf.values is not None:
        curve = np.array([irf.times, irf.values], np.float64)
        arrays["irf"] = (("quantity", "sample"), curve, "1", "measured instrument response")
        coordinates |= {"sample": curve.shape[1], "quantity": (["time [s]", "value"], "1", arrays["irf"][3])}
    return _Layout(arrays, attributes, coordinates)


def _bound(result: Result, pulses: int, device: Any) -> ResultBound:
    """The bound of one frame, NaN for a response without a derivative or too few photons."""
    missing = np.full(result.truth.range.shape, np.nan)
    if not detector_response(result.scene.detector, result.scene.laser).is_smooth:
        return ResultBound(missing, np.nan, None)
    law: Any = "poisson" if result.scene.detector.mode == "free_running" else "first_photon"
    bound = bound_of_result(result, pulses=pulses, law=law, device=device)
    return bound if bound.problem is None else bound._replace(sigma=missing)


def simulate_sequence(
    scene: SceneLike,
    trajectory: Trajectory | str | Path,
    path: str | Path,
    *,
    frame_rate: float | None = None,
    photons: int | Literal["auto"] | None = None,
    pulses: int | None = None,
    seed: int | None = None,
    methods: Sequence[Method] = ("matched",),
    tags: bool = False,
    device: str | None = None,
    progress: Progress | None = None,
) -> SequenceFile:
    """Simulates a frame at each row of a trajectory and writes counts, depth and truth of all to one HDF5 file.

    In a frame the scene stands still. The mesh stays on the device, and its tree is refitted where only poses change.
    Frame n has random numbers of its own, of `seed` and n.

    Args:
        scene: Of which the trajectory changes fields.
        trajectory: From `spadwarp.scene.load_trajectory`, or the path of its .csv file.
        path: The file, whole or not at all.
        frame_rate: Frames a second, at even times between the rows; None: a frame at each row.
        photons: Traced for each frame, as of `simulate`; default: the scene's. With "auto" the first frame decides.
        pulses, methods, tags, progress: As of `record_frames`.
        seed: 64 bits; default: the scene's.
        device: "cpu", "cuda:0", ...; by default the first GPU, else the CPU.

    Raises:
        ConfigError: A row whose scene cannot be simulated; all rows are tried before the first photon.
        FileError: A file cannot be read or written.
    """
    from spadwarp.transport import simulate

    base = as_scene(scene)
    moves = trajectory if isinstance(trajectory, Trajectory) else load_trajectory(trajectory)
    if frame_rate is not None:
        moves = moves.sampled(frame_rate)
    scenes = list(moves.scenes(base))
    fixed = ("camera.width", "camera.height", "gate.", "scan.")  # that all frames of a file share
    if wrong := [name for name in moves.fields if name.startswith(fixed)]:
        raise ConfigError([f"{wrong[0]} cannot change from frame to frame"], source=moves.source)
    seed = base.transport.seed if seed is None else check_integer("seed", seed, SEED)
    pulses = base.detector.pulses_per_frame if pulses is None else pulses
    asked = base.transport.photons if photons is None else photons
    first = pick_devices(device)[0]  # for all but the photons
    kept: dict[str, Any] = {}
    with write_hdf5(path) as opened:
        writer = _Writer(opened, len(moves))
        for number, at in enumerate(scenes):
            frame_seed = int(np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0])
            with warnings.catch_warnings():
                if number:  # said of the first frame
                    warnings.simplefilter("ignore", SpadwarpWarning)
                result = simulate(at, photons=asked, seed=frame_seed, device=device, mesh_cache=kept)
                asked = result.photons  # all frames have those of the first
                part = detect(result, first_frame=number, pulses=pulses, seed=seed, tags=tags, device=first)
            found: dict[str, Any] = {"significance": np.zeros(part.counts.shape[:-1], np.float32), "device": first}
            times = {method: part.arrival_time(method, **found) for method in methods}
            depth = {method: depth_from_time(time, scene=at) for method, time in times.items()}
            writer.add(part, base, depth, found["significance"], _moving(result, part, moves, number))
            if progress is not None:
                progress("frames", number + 1, len(scenes))
    return SequenceFile.load(path)


def _moving(result: Result, part: Frames, moves: Trajectory, row: int) -> _Layout:
    """What the file of a scene that moves holds of a frame beside its counts: see `_Layout`."""
    fields = list(moves.fields)
    attributes = {"format": SequenceFile.FORMAT, "photons": result.photons, "fields": fields}
    coordinates = {"camera_axis": (["x", "y", "z"], "1", "of the camera"), "field": (fields, "1", "of the scene")}
    camera: Any = camera_attributes(result.scene.camera, result.focus_distance)
    position, rotation = camera["camera_position"], camera["camera_rotation"].reshape(3, 3)
    background = np.broadcast_to(part.background, part.expected.shape).mean(dtype=np.float64)
    axes = ("frame", "axis", "camera_axis")
    arrays: dict[str, Variable] = {
        "frame_time": (("frame",), moves.times[row], "s", "time of the frame on the trajectory"),
        "trajectory": (("frame", "field"), moves.values[row], "", "values of the fields"),
        "expected": ((*_IMAGES, "time"), part.expected, "1", "expected detections per pulse before pile-up"),
        "background": (("frame",), background, "1", "part of `expected` that is not target, mean over pixels and bins"),
        "camera_position": (axes[:2], position, "m", "the lens in the world"),
        "camera_rotation": (axes, rotation, "1", "the camera's axes in the world as columns"),
    }
    for name, (_, dimensions, unit, meaning) in _TRUTH.items():
        arrays[f"truth/{name}"] = (("frame", *dimensions), getattr(result.truth, name), unit, meaning)
    rows = {name: (axes, np.asarray(values)[None], unit, text) for name, (axes, values, unit, text) in arrays.items()}
    return _Layout(rows, attributes, coordinates)
