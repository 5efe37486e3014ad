"""Frames of a camera on disk: the only file that knows the HDF5 layout."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, FileError
from spadwarp.frames.estimators import METHODS, Method
from spadwarp.frames.frames import Frames
from spadwarp.frames.response import InstrumentResponse
from spadwarp.frames.tag_columns import PACKED, TAG_DIMENSION, add_tags, create_tag_columns, described_tags
from spadwarp.io.hdf5 import hdf5_format, read_hdf5, write_hdf5
from spadwarp.io.hdf5_dimensions import PIXELS, Coordinate, image_coordinates, name_dimensions
from spadwarp.io.hdf5_file import Hdf5File
from spadwarp.result.result import Result
from spadwarp.scene import Scene
from spadwarp.scene.camera import camera_attributes

__all__ = ["FORMAT", "FORMAT_VERSION", "FramesFile", "FramesWriter", "is_frames_file"]

FORMAT = "spadwarp frames"
FORMAT_VERSION = 1

_CHUNK_BYTES = 1 << 20
_READ_ME = (
    "counts: [frame, height, width, bin], detections in bin k, which covers gate_start + edges[k] to edges[k + 1] "
    "seconds of flight. depth/NAME: [frame, height, width], planar depth in metres by that estimator, NaN where "
    "nothing was detected. intensity: counts over all bins. bound/time and bound/depth: Cramér–Rao standard deviation "
    "of one frame [s], [m], NaN where there is no information. expected, background: expected detections per pulse and "
    "bin of all light and noise, and of what is not target. "
    "tags, if present: detections one by one. Camera frame: +x right, +y down, +z forward."
)


def is_frames_file(path: str | Path) -> bool:
    """Whether a file holds frames of a camera. Raises `FileError` if it is not an HDF5 file."""
    return hdf5_format(path) == FORMAT


_OF_A_FRAME = ("pulses", "seed", "gate_start", "bin_width", "edges", "period", "irf", "monte_carlo_noise")


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FramesFile:
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

    path: Path
    frames: int
    pulses: int
    seed: int
    gate_start: float
    bin_width: float
    edges: NDArray[np.float64]
    period: float | None
    irf: InstrumentResponse
    expected: NDArray[np.float32] | None
    background: NDArray[np.float32] | None
    scene: Scene
    truth_depth: NDArray[np.float32]
    methods: tuple[Method, ...]
    monte_carlo_noise: float | None = None
    channel: str = "I"

    def __repr__(self) -> str:
        height, width = self.truth_depth.shape
        return f"FramesFile({self.path}: {self.frames} frames of {self.pulses} pulses, {width} x {height} pixels)"

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Opens a file that `record_frames` wrote. Raises `FileError`."""
        with read_hdf5(path, FORMAT, version=FORMAT_VERSION) as file:
            if "sample" in file:
                raise FileError(f"{path}: a shard of a dataset; name the dataset's folder")
            scene = Scene.from_toml(file.text("config"), source=file.text_attribute("source", "") or None)
            edges = file.array("edges", np.float64, (None,))
            if edges.size < 2 or not (np.isfinite(edges).all() and (np.diff(edges) > 0).all()):
                file.refuse("edges", "are not two or more ascending times")
            shape = (scene.camera.height, scene.camera.width, edges.size - 1)
            period = file.real("period", "(0, inf]")
            noise = file.attribute("monte_carlo_noise", None)
            found = file.names("depth")
            methods = tuple(name for name in METHODS if name in found)
            if unknown := [name for name in found if name not in METHODS]:
                file.refuse(f"depth/{unknown[0]}", f"is not by one of {', '.join(METHODS)}")
            counts = file.stored("counts", np.int32, (None, *shape))
            for name in methods:
                file.stored(f"depth/{name}", np.float32, (len(counts), *shape[:2]))
            return cls(
                path=Path(path),
                frames=len(counts),
                pulses=file.integer("pulses", "[1, 9223372036854775807]"),
                seed=file.integer("seed"),
                gate_start=file.real("gate_start"),
                bin_width=file.real("bin_width", "(0, inf)"),
                edges=edges,
                period=period if np.isfinite(period) else None,
                irf=_response(file),
                scene=scene,
                truth_depth=file.array("truth/depth", np.float32, shape[:2]),
                methods=methods,
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

    @property
    def best_method(self) -> Method | None:
        """The estimator that comes last in `METHODS`, which uses most of what is known; None without depth."""
        return max(self.methods, key=METHODS.index, default=None)

    def counts(self, frame: int | None = None) -> NDArray[np.int32]:
        """Counts of one frame `[H, W, T]`, or of all `[frames, H, W, T]`."""
        counts = self._read("counts", np.int32, (*self._shape, self.edges.size - 1), frame)
        if counts.size and counts.min() < 0:
            raise FileError(f"{self.path}: counts are negative in some bins")
        return counts

    def intensity(self, frame: int | None = None) -> NDArray[np.int64]:
        """Counts over all bins, `[H, W]` or `[frames, H, W]`."""
        return self._read("intensity", np.int64, self._shape, frame)

    def depth(self, method: Method, frame: int | None = None) -> NDArray[np.float32]:
        """Depth by one of `methods` [m], `[H, W]` or `[frames, H, W]`."""
        return self._read(f"depth/{method}", np.float32, self._shape, frame)

    def bound_depth(self) -> NDArray[np.float64]:
        """Cramér–Rao bound of one frame [m], `[H, W]`; NaN where there is no information."""
        with read_hdf5(self.path, FORMAT) as file:
            return file.array("bound/depth", np.float64, self._shape)

    @property
    def _shape(self) -> tuple[int, int]:
        return self.scene.camera.height, self.scene.camera.width

    def _read(self, name: str, kind: Any, shape: tuple[int, ...], frame: int | None) -> NDArray[Any]:
        if frame is not None and not 0 <= frame < self.frames:
            raise ArgumentError(f"frame = {frame} is outside [0, {self.frames}), the frames of {self.path}")
        with read_hdf5(self.path, FORMAT) as file:
            return file.stored(name, kind, (self.frames, *shape))[... if frame is None else frame]

    @staticmethod
    @contextmanager
    def create(path: str | Path) -> Iterator[FramesWriter]:
        """A file to write frames to, part by part; at `path` it appears whole or not at all. Raises `FileError`."""
        with write_hdf5(path) as file:
            yield FramesWriter(file)


def _response(file: Hdf5File) -> InstrumentResponse:
    if "irf" in file:
        times, values = file.array("irf", np.float64, (2, None))
        return InstrumentResponse(times=times, values=values)
    return InstrumentResponse(sigma=file.real("irf_sigma", "[0, inf)"), tail=file.real("irf_tail", "[0, inf)"))


def _expectation(file: Hdf5File, name: str, shape: tuple[int, int, int]) -> NDArray[np.float32] | None:
    """Expected detections `[H, W, T]`, or `[H, W, 1]`; None where the file has none."""
    if name not in file:
        return None
    one = file.stored(name, np.float32, (*shape[:2], None)).shape[2] == 1 and name == "background"
    values = file.array(name, np.float32, (*shape[:2], 1) if one else shape)
    if not (np.isfinite(values).all() and (values >= 0).all()):
        file.refuse(name, "is negative or not finite in some bins")
    return values


class FramesWriter:
    """Writes frames to an open file: `begin` once, then `add` for each part."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._written = 0

    def begin(
        self, result: Result, part: Frames, *, frames: int, methods: Sequence[Method], **bound: NDArray[np.float64]
    ) -> None:
        """Writes everything but the frames, and reserves space for these.

        Args:
            result: From which the counts were drawn.
            part: The first frames; tags are kept if they have any.
            frames: Number of all frames.
            methods: Estimators of depth.
            bound: `time` [s] and `depth` [m], Cramér–Rao bounds `[H, W]`.
        """
        file, scene = self._file, result.scene
        file.attrs.update(_metadata(result, part, frames))
        file.create_dataset("config", data=scene.to_toml())
        file.create_dataset("edges", data=part.edges)
        if part.irf.times is not None:
            file.create_dataset("irf", data=np.array([part.irf.times, part.irf.values], np.float64))
        for name, values in {"expected": part.expected, "background": part.background}.items():
            file.create_dataset(name, data=values, **PACKED)
        file.create_dataset("truth/depth", data=result.truth.depth, **PACKED)
        for name, sigma in bound.items():
            file.create_dataset(f"bound/{name}", data=sigma)
        height, width, bins = part.expected.shape
        columns = max(1, min(width, _CHUNK_BYTES // (4 * bins)))
        lines = max(1, min(height, _CHUNK_BYTES // (4 * bins * columns)))
        chunks = (1, lines, columns, bins)
        file.create_dataset("counts", (frames, height, width, bins), np.int32, chunks=chunks, **PACKED)
        image: dict[str, Any] = {"shape": (frames, height, width), "chunks": (1, height, width), **PACKED}
        file.create_dataset("intensity", dtype=np.int64, **image)
        for method in methods:
            file.create_dataset(f"depth/{method}", dtype=np.float32, **image)
        if part.tags is not None:
            create_tag_columns(file)
        name_dimensions(file, _coordinates(part, frames, (height, width)), _dimensions(part, methods))

    def add(self, part: Frames, depth: dict[Method, NDArray[np.float64]]) -> None:
        """Writes the next frames, and their depth by each estimator `[frames, H, W]` [m]."""
        file, rows = self._file, slice(self._written, self._written + part.frames)
        file["counts"][rows] = part.counts
        file["intensity"][rows] = part.intensity
        for method, frames in depth.items():
            file[f"depth/{method}"][rows] = frames
        if part.tags is not None:
            add_tags(file, part.tags)
        self._written = rows.stop


def _coordinates(part: Frames, frames: int, shape: tuple[int, int]) -> dict[str, Coordinate | int | None]:
    edges = part.gate_start + part.edges
    return {
        "frame": (np.arange(frames), "1", "number of the frame"),
        **image_coordinates(*shape),
        "time": (0.5 * (edges[:-1] + edges[1:]), "s", "time of flight at the centre of the bin"),
        "whole_gate": 1,
        "edges": ("edges", "s", "edges of the bins after the start of the gate"),
        "sample": 0 if part.irf.times is None else np.size(part.irf.times),
        "quantity": (["time [s]", "value"], "1", "of the measured instrument response"),
        TAG_DIMENSION: None,
    }


def _dimensions(part: Frames, methods: Sequence[Method]) -> dict[str, tuple[tuple[str, ...], str, str]]:
    image, images = PIXELS, ("frame", *PIXELS)
    bins = "whole_gate" if part.background.shape[-1] == 1 < part.expected.shape[-1] else "time"
    return {
        "counts": ((*images, "time"), "1", "detections in the bin"),
        "intensity": (images, "1", "counts over all bins"),
        **{f"depth/{method}": (images, "m", f"planar depth by {method}") for method in methods},
        "expected": ((*image, "time"), "1", "expected detections per pulse before pile-up"),
        "background": ((*image, bins), "1", "the part of `expected` that is not target"),
        "bound/time": (image, "s", "Cramér–Rao bound of one frame"),
        "bound/depth": (image, "m", "Cramér–Rao bound of one frame"),
        "truth/depth": (image, "m", "true planar depth"),
        "irf": (("quantity", "sample"), "1", "measured instrument response"),
        **described_tags(),
    }


def _metadata(result: Result, part: Frames, frames: int) -> dict[str, Any]:
    scene = result.scene
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "read_me": _READ_ME,
        "pulses": part.pulses,
        "frames": frames,
        "seed": str(part.seed),
        "gate_start": part.gate_start,
        "bin_width": part.bin_width,
        "period": np.inf if part.period is None else part.period,
        "group_index": scene.medium.group_index,
        "laser_position": scene.beam.position,
        "pixel_tangent": scene.camera.pixel_tangent,
        **camera_attributes(scene.camera, result.focus_distance),
        "irf_sigma": part.irf.sigma,
        "irf_tail": part.irf.tail,
        **({} if part.monte_carlo_noise is None else {"monte_carlo_noise": part.monte_carlo_noise}),
        "notes": list(part.notes),
        "source": str(scene.source or ""),
        "photons": result.photons,
        "channel": result.provenance.get("channel", "I"),
    }
