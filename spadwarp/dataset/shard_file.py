"""A shard's files open for reading, compared with the dataset's manifest before anything is read."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.histograms import HISTOGRAM_FIELDS, HistogramFile
from spadwarp.dataset.rendered import PROFILE_BINS
from spadwarp.dataset.schema import FORMAT_VERSION, scene_columns
from spadwarp.errors import FileError, SpadwarpError
from spadwarp.io.hdf5 import open_hdf5
from spadwarp.io.hdf5_file import Hdf5File
from spadwarp.scene import Scene

__all__ = ["SceneFile", "ShardFile", "frame_count"]

_SCENE_FIELDS = {"clean": "depth", "bound": "bound", "normal": "normal", "albedo": "albedo"}
_COLUMNS = {
    "scene": np.int32,
    "sample": np.int64,
    "target": np.int32,
    "backscatter_fraction": np.float32,
    "attenuation_lengths": np.float32,
    "distance": np.float32,
    "intensity_step": np.float32,
}


class SceneFile:
    """The scenes of a shard.

    Args:
        folder: The dataset.
        name: Of the shard's file of frames.
        shape: Height and width of the images.
    """

    def __init__(self, folder: Path, name: str, shape: tuple[int, int]) -> None:
        self.file = _opened(folder / "scenes" / name.replace("frames-", "scenes-"), "spadwarp scenes")
        self._columns = scene_columns(shape)
        try:
            self.count = len(self.file.stored("distance", np.float64, (None,)))
        except BaseException:
            self.file.close()
            raise

    def stored(self, name: str) -> Any:
        """A column of `spadwarp.dataset.schema.scene_columns`, its first dimension the scenes."""
        shape, kind, _, _ = self._columns[name]
        return self.file.stored(name, "S" if np.dtype(kind).kind == "S" else kind, (self.count, *shape))

    def array(self, name: str) -> NDArray[Any]:
        """The same, read."""
        return np.asarray(self.stored(name)[...])

    def gate(self) -> NDArray[np.float32]:
        """Ranges at which the gates open and close [m], `[scenes, 2]`."""
        return np.stack([self.array("gate_near"), self.array("gate_far")], axis=1).astype(np.float32)

    def scene(self, row: int) -> Scene:
        """The scene of a row."""
        text = self.stored("config")[row]
        try:
            return Scene.from_toml(text.decode())
        except (ValueError, SpadwarpError) as error:
            return self.file.refuse("config", f"is no scene in row {row}: {error}")


class ShardFile:
    """Two or three open files. What is stored without compression is read past HDF5, through a memory map.

    Args:
        folder: The dataset.
        name: Of the shard's file of frames.
        manifest: From `read_manifest`.
    """

    def __init__(self, folder: Path, name: str, manifest: dict[str, Any]) -> None:
        with ExitStack() as opened:  # closed again where one of them is refused
            self._open(opened, folder, name, manifest)
            opened.pop_all()

    def _open(self, opened: ExitStack, folder: Path, name: str, manifest: dict[str, Any]) -> None:
        shape, targets = (manifest["height"], manifest["width"]), len(manifest["targets"])
        self.frames = opened.enter_context(closing(_opened(folder / name, "spadwarp frames")))
        self.scenes = SceneFile(folder, name, shape)
        opened.enter_context(closing(self.scenes.file))
        count = len(self.frames.stored("sample", np.int64, (None,)))
        self.columns = {column: self.frames.array(column, kind, (count,)) for column, kind in _COLUMNS.items()}
        self.first_scene = int(self.columns["scene"][0]) if count else 0
        last = self.first_scene + self.scenes.count
        if not 0 <= self.first_scene <= last <= manifest["scenes"] or not _within(
            self.columns["scene"], range(self.first_scene, last)
        ):
            self.frames.refuse("scene", f"names scenes that are not among the {self.scenes.count} of the shard")
        if not _within(self.columns["target"], range(targets)):
            self.frames.refuse("target", f"names targets that are not among the {targets} of the dataset")
        self.width = shape[1]
        sides: dict[str, tuple[Any, int]] = {
            "depth": (np.uint16, shape[1]),
            "label": (np.uint8, (shape[1] + 7) // 8),
            "intensity": (np.uint8, shape[1]),
        }
        self.stored = {
            field: self.frames.stored(field, kind, (count, shape[0], columns)).mapped()
            for field, (kind, columns) in sides.items()
        }
        self.step = np.float32(self.frames.real("step", "(0, inf)", of="depth"))
        self.offset = np.float32(self.frames.real("offset", of="depth"))
        self.scene_images = {field: self.scenes.stored(column).mapped() for field, column in _SCENE_FIELDS.items()}
        self.gate = self.scenes.gate()
        self.profiles, self.edges = self.scenes.array("backscatter_profile"), self.scenes.array("profile_edges")
        cubes = folder / name.replace("frames-", "histograms-")
        self.histograms = None
        if os.path.isfile(cubes):
            file = opened.enter_context(closing(_opened(cubes, "spadwarp histograms")))
            self.histograms = HistogramFile(file, shape)

    def images(self, row: int, fields: Sequence[str], window: tuple[slice, slice]) -> dict[str, NDArray[np.float32]]:
        """A frame's images by field, `[C, H, W]` each."""
        return {name: self._image(name, row, window) for name in fields}

    def numbers(self, row: int) -> dict[str, Any]:
        """What else an item holds."""
        whole, real = ("sample", "scene", "target"), ("backscatter_fraction", "attenuation_lengths", "distance")
        return {
            **{name: int(self.columns[name][row]) for name in whole},
            **{name: np.float32(self.columns[name][row]) for name in real},
            "gate": self.gate[self.scene_row(row)].copy(),
        }

    def scene_row(self, row: int) -> int:
        """Row of a frame's scene in `scenes`."""
        return int(self.columns["scene"][row]) - self.first_scene

    def _image(self, name: str, row: int, window: tuple[slice, slice]) -> NDArray[np.float32]:
        image: NDArray[Any]
        if name in HISTOGRAM_FIELDS:
            return np.moveaxis(self._histogram(name, row)[window], -1, 0)
        if name == "noisy":
            image = self._noisy(row, window)
        elif name == "prior":
            image = self._prior(self.scene_row(row), self._noisy(row, window))
        elif name == "label":
            rows, columns = window
            image = np.unpackbits(self.stored["label"][row, rows], axis=-1, count=self.width)[:, columns]
        elif name == "intensity":
            scale = self.columns["intensity_step"][row]
            image = np.multiply(self.stored["intensity"][(row, *window)], scale, dtype=np.float32)
        else:
            image = np.array(self.scene_images[name][(self.scene_row(row), *window)])
        image = image.astype(np.float32, copy=False)
        return np.moveaxis(image, -1, 0) if name == "normal" else image[None]

    def _histogram(self, name: str, row: int) -> NDArray[np.float32]:
        cube, path = None, self.frames.path
        if self.histograms is not None:
            number = int(self.columns["sample" if name == "counts" else "scene"][row])
            cube = getattr(self.histograms, name)(number)
            if name not in self.histograms.fields:
                path = self.histograms.path
        if cube is None:
            raise FileError(f"{path}: frame {int(self.columns['sample'][row])} has no {name!r}")
        return cube

    def _noisy(self, row: int, window: tuple[slice, slice]) -> NDArray[np.float32]:
        codes = self.stored["depth"][(row, *window)]
        depth = codes.astype(np.float32)
        depth *= self.step
        depth += self.offset
        np.copyto(depth, np.nan, where=codes == 0)
        return depth

    def _prior(self, scene: int, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        edges, profile = self.edges[scene], self.profiles[scene]
        # Density 0 on both sides of the profile.
        density = np.concatenate([[0.0], profile, [0.0]]).astype(np.float32)
        place = (depth - edges[0]) * np.float32(PROFILE_BINS / (edges[-1] - edges[0])) + np.float32(1.0)
        place = np.nan_to_num(np.clip(place, 0.0, np.float32(len(density) - 1)), copy=False)
        prior = density[place.astype(np.intp)]
        np.copyto(prior, np.nan, where=np.isnan(depth))
        return prior


def frame_count(folder: Path, name: str) -> int:
    """Frames of a shard."""
    with closing(_opened(folder / name, "spadwarp frames")) as file:
        return len(file.stored("sample", np.int64, (None,)))


def _within(numbers: NDArray[Any], allowed: range) -> bool:
    return not numbers.size or (int(numbers.min()) in allowed and int(numbers.max()) in allowed)


def _opened(path: Path, format: str) -> Hdf5File:
    if not os.path.exists(path):
        raise FileError(f"{path}: no such file; `spadwarp dataset` makes what is missing")
    return open_hdf5(path, format, version=FORMAT_VERSION)
