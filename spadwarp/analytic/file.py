"""Depth frames of the analytic simulator on disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.labelled import MAP_UNITS
from spadwarp.analytic.model import response_sigma
from spadwarp.errors import ArgumentError
from spadwarp.io.hdf5 import PIXELS, Coordinate, image_coordinates, name_dimensions, read_hdf5, write_hdf5
from spadwarp.limits import check_integer
from spadwarp.result.result import Truth
from spadwarp.scene import Scene

if TYPE_CHECKING:
    from spadwarp.analytic.result import AnalyticResult

__all__ = ["FORMAT", "AnalyticFile", "save_analytic"]

FORMAT = "spadwarp analytic"
FORMAT_VERSION = 1

_PART_BYTES = 1 << 28  # of frames that are held at a time
_PACKED = {"compression": "gzip", "shuffle": True, "compression_opts": 1}
_TRUTH_UNITS = {"depth": "m", "range": "m", "normal": "1", "reflectance": "1"}
_READ_ME = (
    "Depth frames [frame, height, width] in metres along z, NaN for no estimate; labels: the pixel reports background "
    "light. maps/: signal, backscatter and alpha are expected detections per pulse within the gate, arrival and "
    "sigma_time are seconds, sigma_depth metres, fisher 1/s^2 per detected photon. "
    "Camera frame: +x right, +y down, +z forward."
)


def save_analytic(result: AnalyticResult, path: str | Path, *, frames: int | None = None, device: Any = None) -> Path:
    """Writes maps, truth, frames and scene to one HDF5 file, whole or not at all; returns its path.

    Args:
        result: Of `spadwarp.simulate_analytic`.
        path: The file.
        frames: Number of frames to draw and write in parts, however many; default: those that the result holds.
        device: Warp device that draws them.

    Raises:
        FileError: The file cannot be written.
    """

    def write(name: str, values: NDArray[Any]) -> None:
        file.create_dataset(name, data=values, **(_PACKED if values.size else {}))

    if frames is not None:
        frames = check_integer("frames", frames, "[0, 2147483647]")
    count, shape = len(result.depth) if frames is None else frames, result.truth.depth.shape
    with write_hdf5(path) as file:
        file.attrs.update(_metadata(result))
        file.create_dataset("config", data=result.scene.to_toml())
        for name in MAP_UNITS:
            write(f"maps/{name}", getattr(result, name))
        for name in _TRUTH_UNITS:
            write(f"truth/{name}", getattr(result.truth, name))
        if frames is None:
            write("depth", result.depth)
            write("labels", result.labels)
        else:
            packed = {"chunks": (1, *shape), **_PACKED} if frames else {}
            depth = file.create_dataset("depth", (frames, *shape), np.float32, **packed)
            labels = file.create_dataset("labels", (frames, *shape), np.bool_, **packed)
            part = max(1, _PART_BYTES // (5 * result.truth.depth.size))
            for first in range(0, frames, part):
                stop = min(first + part, frames)
                depth[first:stop], labels[first:stop] = result.sample(stop - first, first=first, device=device)
        number: Coordinate = (np.arange(count), "1", "number of the frame")
        name_dimensions(file, {"frame": number, **image_coordinates(*shape)}, _DIMENSIONS)
    return Path(path)


_DIMENSIONS = {
    "depth": (("frame", *PIXELS), "m", "planar depth of the frame"),
    "labels": (("frame", *PIXELS), "1", "whether the pixel reports background"),
    **{f"maps/{name}": (PIXELS, unit, name.replace("_", " ")) for name, unit in MAP_UNITS.items()},
    **{
        f"truth/{name}": ((*PIXELS, "axis") if name == "normal" else PIXELS, unit, f"true {name}")
        for name, unit in _TRUTH_UNITS.items()
    },
}


def _metadata(result: AnalyticResult) -> dict[str, Any]:
    from spadwarp import __version__

    scene = result.scene
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "read_me": _READ_ME,
        "version": __version__,
        "source": str(scene.source or ""),
        "seed": str(result.seed),
        "form": scene.analytic.form,
        "backscatter": scene.analytic.backscatter,
        "count_law": scene.analytic.count_law,
        "response_sigma": response_sigma(scene),
        "gate_start": scene.gate.start,
        "bin_width": scene.gate.bin_width,
        "bins": scene.gate.bins,
        "group_index": scene.medium.group_index,
    }


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class AnalyticFile:
    """A file of the analytic simulator; depth frames are read when they are asked for, the rest is in memory.

    Attributes:
        path: The file.
        frames: Their number.
        seed: Of the frames.
        scene: The scene.
        truth: Depth, range, normal and reflectance.
        maps: Name → float64 `[H, W]`, as the attributes of `AnalyticResult`.
    """

    path: Path
    frames: int
    seed: int
    scene: Scene
    truth: Truth
    maps: dict[str, NDArray[np.float64]]

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Opens a file that `save_analytic` wrote. Raises `FileError`."""
        with read_hdf5(path, FORMAT, version=FORMAT_VERSION) as file:
            scene = Scene.from_toml(file.text("config"), source=file.text_attribute("source", "") or None)
            shape = scene.camera.height, scene.camera.width
            kinds = {name: (np.float32, (*shape, 3) if name == "normal" else shape) for name in _TRUTH_UNITS}
            truth = {name: file.array(f"truth/{name}", kind, sides) for name, (kind, sides) in kinds.items()}
            count = len(file.stored("depth", np.float32, (None, *shape)))
            file.stored("labels", np.bool_, (count, *shape))
            return cls(
                path=Path(path),
                frames=count,
                seed=file.integer("seed"),
                scene=scene,
                truth=Truth(**truth),
                maps={name: file.array(f"maps/{name}", np.float64, shape) for name in MAP_UNITS},
            )

    def __repr__(self) -> str:
        height, width = self.truth.depth.shape
        return f"AnalyticFile({self.path}: {self.frames} depth frames, {width} x {height} pixels)"

    def depth(self, frame: int | None = None) -> NDArray[np.float32]:
        """Depth of one frame `[H, W]`, or of all `[frames, H, W]` [m]; NaN for no estimate."""
        return self._read("depth", np.float32, frame)

    def labels(self, frame: int | None = None) -> NDArray[np.bool_]:
        """Whether pixels report a background photon, `[H, W]` or `[frames, H, W]`."""
        return self._read("labels", np.bool_, frame)

    def _read(self, name: str, kind: Any, frame: int | None) -> NDArray[Any]:
        if frame is not None and not 0 <= frame < self.frames:
            raise ArgumentError(f"frame = {frame} is outside [0, {self.frames}), the frames of {self.path}")
        with read_hdf5(self.path, FORMAT) as file:
            return np.asarray(
                file.stored(name, kind, (self.frames, *self.truth.depth.shape))[... if frame is None else frame]
            )
