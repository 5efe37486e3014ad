"""Maps and depth frames of the analytic simulator on disk, and as labelled arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.model import response_sigma
from spadwarp.analytic.result import AnalyticResult
from spadwarp.errors import ArgumentError
from spadwarp.interop import labelled
from spadwarp.io.hdf5 import PIXELS, Coordinate, image_coordinates, name_dimensions, read_hdf5, write_hdf5
from spadwarp.limits import check_integer
from spadwarp.result import Truth
from spadwarp.scene import Scene

if TYPE_CHECKING:
    import xarray

__all__ = ["AnalyticFile", "save_analytic", "to_xarray"]

_FORMAT = "spadwarp analytic"
_FORMAT_VERSION = 1
_PART_BYTES = 1 << 28  # of frames that are held at a time
_PACKED = {"compression": "gzip", "shuffle": True, "compression_opts": 1}
_READ_ME = (
    "Depth frames [frame, height, width] in metres along z, NaN for no estimate; labels: the pixel reports background "
    "light. maps/: signal, backscatter and alpha are expected detections per pulse within the gate, arrival and "
    "sigma_time are seconds, sigma_depth metres, fisher 1/s^2 per detected photon. "
    "Camera frame: +x right, +y down, +z forward."
)
_MAP_UNITS = {
    "signal": "1",
    "arrival": "s",
    "backscatter": "1",
    "alpha": "1",
    "fisher": "s^-2",
    "sigma_time": "s",
    "sigma_depth": "m",
    "signal_to_backscatter": "1",
    "background_level": "1",
    "outlier_probability": "1",
    "background_probability": "1",
}
_TRUTH_UNITS = {"depth": "m", "range": "m", "normal": "1", "reflectance": "1"}
# Dimensions, unit and meaning of the arrays of a file, by name.
_ARRAYS = {
    **{f"maps/{name}": (PIXELS, unit, name.replace("_", " ")) for name, unit in _MAP_UNITS.items()},
    **{
        f"truth/{name}": ((*PIXELS, "axis") if name == "normal" else PIXELS, unit, f"true {name}")
        for name, unit in _TRUTH_UNITS.items()
    },
    "depth": (("frame", *PIXELS), "m", "planar depth of the frame"),
    "labels": (("frame", *PIXELS), "1", "whether the pixel reports background"),
}


def _array(result: AnalyticResult, name: str) -> NDArray[Any]:
    """An array of the file by its name."""
    section, _, name = name.rpartition("/")
    values: NDArray[Any] = getattr(result.truth if section == "truth" else result, name)
    return values


def _coordinates(frames: int, shape: tuple[int, ...]) -> dict[str, Coordinate]:
    return {"frame": (np.arange(frames), "1", "number of the frame"), **image_coordinates(*shape)}


def to_xarray(result: AnalyticResult) -> xarray.Dataset:
    """The maps (y, x) of an `AnalyticResult`, its truth and its depth frames (frame, y, x), with units.

    Raises:
        FileError: xarray is not installed.
    """
    held = {name: f"maps/{name}" for name in _MAP_UNITS}
    held |= {"true_depth": "truth/depth", "true_range": "truth/range", "reflectance": "truth/reflectance"}
    held |= {"depth": "depth", "label": "labels"}
    variables = {
        name: (_ARRAYS[stored][0], _array(result, stored), *_ARRAYS[stored][1:]) for name, stored in held.items()
    }
    axes = _coordinates(len(result.depth), result.truth.depth.shape)
    coordinates = {name: ((name,), *axes[name]) for name in ("frame", *PIXELS)}
    return labelled(variables, coordinates, {"seed": str(result.seed), "scene": result.scene.to_toml()})


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
    from spadwarp import __version__

    if frames is not None:
        frames = check_integer("frames", frames, "[0, 2147483647]")
    count, shape, scene = len(result.depth) if frames is None else frames, result.truth.depth.shape, result.scene
    attributes = {
        "format": _FORMAT,
        "format_version": _FORMAT_VERSION,
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
    with write_hdf5(path) as file:
        file.attrs.update(attributes)
        file.create_dataset("config", data=scene.to_toml())
        for name, (dimensions, _, _) in _ARRAYS.items():
            if frames is None or "frame" not in dimensions:
                values = _array(result, name)
                file.create_dataset(name, data=values, **(_PACKED if values.size else {}))
        if frames is not None:
            packed = {"chunks": (1, *shape), **_PACKED} if frames else {}
            depth = file.create_dataset("depth", (frames, *shape), np.float32, **packed)
            labels = file.create_dataset("labels", (frames, *shape), np.bool_, **packed)
            part = max(1, _PART_BYTES // (5 * result.truth.depth.size))
            for first in range(0, frames, part):
                stop = min(first + part, frames)
                depth[first:stop], labels[first:stop] = result.sample(stop - first, first=first, device=device)
        name_dimensions(file, _coordinates(count, shape), _ARRAYS)
    return Path(path)


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
        with read_hdf5(path, _FORMAT, version=_FORMAT_VERSION) as file:
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
                maps={name: file.array(f"maps/{name}", np.float64, shape) for name in _MAP_UNITS},
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
        with read_hdf5(self.path, _FORMAT) as file:
            return np.asarray(
                file.stored(name, kind, (self.frames, *self.truth.depth.shape))[... if frame is None else frame]
            )
