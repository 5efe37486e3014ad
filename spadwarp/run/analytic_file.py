"""Depth frames of the analytic simulator on disk."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.labelled import MAP_UNITS
from spadwarp.analytic.model import response_sigma
from spadwarp.frames.export import FrameSequence, SequenceFrame
from spadwarp.io.hdf5 import read_hdf5, write_hdf5
from spadwarp.scene import Scene

if TYPE_CHECKING:
    from spadwarp.analytic.result import AnalyticResult

__all__ = ["FORMAT", "load_analytic", "save_analytic"]

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

    def write(name: str, values: NDArray[Any], unit: str) -> None:
        file.create_dataset(name, data=values, **(_PACKED if values.size else {})).attrs["unit"] = unit

    with write_hdf5(path) as file:
        file.attrs.update(_metadata(result))
        file.create_dataset("config", data=result.scene.to_toml())
        for name, unit in MAP_UNITS.items():
            write(f"maps/{name}", getattr(result, name), unit)
        for name, unit in _TRUTH_UNITS.items():
            write(f"truth/{name}", getattr(result.truth, name), unit)
        if frames is None:
            write("depth", result.depth, "m")
            write("labels", result.labels, "1")
            return Path(path)
        shape = result.truth.depth.shape
        packed = {"chunks": (1, *shape), **_PACKED} if frames else {}
        depth = file.create_dataset("depth", (frames, *shape), np.float32, **packed)
        labels = file.create_dataset("labels", (frames, *shape), np.bool_, **packed)
        depth.attrs["unit"], labels.attrs["unit"] = "m", "1"
        part = max(1, _PART_BYTES // (5 * result.truth.depth.size))
        for first in range(0, frames, part):
            stop = min(first + part, frames)
            depth[first:stop], labels[first:stop] = result.sample(stop - first, first=first, device=device)
    return Path(path)


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


def load_analytic(path: str | Path) -> FrameSequence:
    """The depth frames in a file of `save_analytic`. Raises `FileError`."""
    with read_hdf5(path, FORMAT, version=FORMAT_VERSION) as file:
        scene = Scene.from_toml(file.text("config"), source=file.text_attribute("source", "") or None)
        shape = scene.camera.height, scene.camera.width
        truth = file.array("truth/depth", np.float32, shape)
        count = len(file.stored("depth", np.float32, (None, *shape)))
        file.stored("labels", np.bool_, (count, *shape))

    def frame(number: int) -> SequenceFrame:
        with read_hdf5(path, FORMAT) as file:
            depth = file.stored("depth", np.float32, (count, *shape))[number]
            labels = file.stored("labels", np.bool_, (count, *shape))[number].astype(np.float32)
        images = {"Z": depth, "background": labels, "truth.Z": truth}
        return SequenceFrame(images=images, scene=scene, depth=truth, content="Z by the analytic simulator")

    return FrameSequence(name=str(path), count=count, frame=frame)
