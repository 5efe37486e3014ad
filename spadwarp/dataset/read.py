"""Reading datasets: frame by frame as NumPy arrays, or as torch tensors for a `DataLoader`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.histograms import HistogramFile
from spadwarp.dataset.manifest import read_manifest
from spadwarp.dataset.recipe import SPLITS
from spadwarp.errors import ArgumentError, FileError

__all__ = ["FIELDS", "FrameReader", "SpadDataset", "iterate_dataset"]

FIELDS = ("noisy", "clean", "label", "intensity", "bound", "normal", "albedo", "prior", "counts", "expected")
"""Images that an item can hold, float32 `[1, H, W]`; normals `[3, H, W]`, histograms `[T, H, W]`."""

_SCENE_FIELDS = {"clean": "depth", "bound": "bound", "normal": "normal", "albedo": "albedo"}


class FrameReader:
    """The frames of a split as a sequence of dicts of float32 NumPy arrays `[C, H, W]`.

    - `noisy`: depth frame [m], NaN where there was no return.
    - `clean`: true planar depth [m], NaN where nothing is hit.
    - `label`: 1 where the pixel reports backscatter or other background, else 0.
    - `intensity`: recorded photons.
    - `bound`: Cramér–Rao bound of the depth [m], NaN for no estimate.
    - `normal`: `[3, H, W]`, unit vectors towards the camera. `albedo`: Lambertian reflectance.
    - `counts`: histograms of the frame `[T, H, W]`; `expected`: their expectation. Of traced scenes only.
    - `prior`: density [1/m] with which the water alone reports the depth in `noisy`; NaN where `noisy` is.

    And numbers: `sample`, `scene`, `target` (int64), `backscatter_fraction`, `attenuation_lengths`, `distance`
    (float32), `gate` (float32 `[2]`, ranges at which it opens and closes [m]).

    Args:
        path: The dataset's folder.
        split: "train", "validation", "test", or "all".
        fields: Images of an item, from `FIELDS`.
        crop: Side, or height and width, of a random part of the frame; None for the whole.
        augment: Whether items are rotated by random multiples of 90° (180° where they are not square) and mirrored.
        repeats: How many differently cropped and rotated items there are of each frame.
        seed: Of crops and rotations. They depend on it, on the epoch (`set_epoch`) and on the item's index alone.

    Each process opens the files for itself when it first reads: workers of a `DataLoader` need no extra care.

    Raises:
        FileError: No dataset, or one that is not whole.
        ArgumentError: An argument out of range.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        split: str = "train",
        *,
        fields: Sequence[str] = ("noisy", "clean", "label", "intensity"),
        crop: int | tuple[int, int] | None = None,
        augment: bool = False,
        repeats: int = 1,
        seed: int = 0,
    ) -> None:
        self.path = Path(path)
        self.manifest = read_manifest(self.path)
        if split not in (*SPLITS, "all"):
            raise ArgumentError(f"split = {split!r} is not one of {', '.join(map(repr, (*SPLITS, 'all')))}")
        if unknown := [name for name in fields if name not in FIELDS]:
            raise ArgumentError(f"fields: {unknown[0]!r} is not one of {', '.join(map(repr, FIELDS))}")
        if repeats < 1:
            raise ArgumentError(f"repeats = {repeats} is outside [1, inf)")
        self.split, self.fields, self.repeats, self.seed = split, tuple(fields), repeats, seed
        self.augment, self.epoch = augment, 0
        self.shape: tuple[int, int] = (self.manifest["height"], self.manifest["width"])
        self.crop = (crop, crop) if isinstance(crop, int) else crop
        if self.crop is not None and not all(1 <= a <= b for a, b in zip(self.crop, self.shape, strict=True)):
            raise ArgumentError(f"crop = {crop} is outside [1, {self.shape[0]}] x [1, {self.shape[1]}]")
        splits = [self.manifest["splits"][name] for name in (SPLITS if split == "all" else (split,))]
        self.shards: list[str] = [shard for described in splits for shard in described["shards"]]
        self._stops = np.cumsum([_frame_count(self.path / name) for name in self.shards], dtype=np.int64)
        self._open: dict[int, _Shard] = {}
        self._process = os.getpid()

    def __len__(self) -> int:
        return self.repeats * self.frame_count

    @property
    def frame_count(self) -> int:
        """Frames of the split."""
        return int(self._stops[-1]) if len(self._stops) else 0

    def set_epoch(self, epoch: int) -> None:
        """Crops and rotations differ from epoch to epoch."""
        self.epoch = epoch

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"index = {index} is outside [{-len(self)}, {len(self)})")
        index %= len(self)
        frame = index % self.frame_count
        number = int(np.searchsorted(self._stops, frame, side="right"))
        shard = self._shard(number)
        row = frame - (int(self._stops[number - 1]) if number else 0)
        window, turns, mirrored = self._changes(index)
        item: dict[str, Any] = {}
        for name, image in shard.images(row, self.fields, window).items():
            if turns:
                image = np.rot90(image, turns, axes=(-2, -1))
            item[name] = np.ascontiguousarray(image[..., ::-1] if mirrored else image)
        if "normal" in item:
            item["normal"] = _rotated(item["normal"], turns, mirrored)
        return item | shard.numbers(row)

    def _changes(self, index: int) -> tuple[tuple[slice, slice], int, bool]:
        """The part of the frame, the rotations by 90°, and whether it is mirrored."""
        generator = np.random.Generator(np.random.Philox(key=[self.seed, self.epoch], counter=[0, 0, index, 0]))
        height, width = self.crop or self.shape
        top = left = turns = 0
        mirrored = False
        if self.crop is not None:
            top, left = (int(generator.integers(b - a + 1)) for a, b in zip(self.crop, self.shape, strict=True))
        if self.augment:
            turns = int(generator.integers(4)) if height == width else 2 * int(generator.integers(2))
            mirrored = bool(generator.integers(2))
        return (slice(top, top + height), slice(left, left + width)), turns, mirrored

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for index in range(len(self)):
            yield self[index]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}

    def _shard(self, number: int) -> _Shard:
        if self._process != os.getpid():  # files opened before a fork are the parent's
            self._open, self._process = {}, os.getpid()
        if number not in self._open:
            self._open[number] = _Shard(self.path, self.shards[number])
        return self._open[number]


class SpadDataset(FrameReader):
    """`FrameReader` for torch: a map-style dataset whose items hold tensors; goes into a `DataLoader` as it is.

    `SpadDataset(path, crop=128, augment=True, repeats=20)` makes the paper's 400 000 pairs of 20 000 frames. Arguments,
    fields and errors are those of `FrameReader`; NaN marks what is not there.
    """

    def __getitem__(self, index: int) -> dict[str, Any]:
        import torch

        item = super().__getitem__(index)
        return {
            name: torch.from_numpy(value) if isinstance(value, np.ndarray) else torch.tensor(value)
            for name, value in item.items()
        }


def iterate_dataset(
    path: str | os.PathLike[str],
    split: str = "train",
    *,
    fields: Sequence[str] = ("noisy", "clean", "label", "intensity"),
    shuffle: int | None = None,
) -> Iterator[dict[str, Any]]:
    """The frames of a split, one dict of NumPy arrays each, as `FrameReader` has them.

    `shuffle`: seed of a random order; in their own order if None. Raises as `FrameReader`, before the first frame.
    """
    reader = FrameReader(path, split, fields=fields)
    order = np.arange(len(reader))
    if shuffle is not None:
        np.random.Generator(np.random.Philox(shuffle)).shuffle(order)
    return (reader[int(index)] for index in order)


class _Shard:
    """Two or three open files. What is stored without compression is read past HDF5, through a memory map."""

    def __init__(self, folder: Path, name: str) -> None:
        self.frames = _opened(folder / name)
        self.scenes = _opened(folder / "scenes" / name.replace("frames-", "scenes-"))
        cubes = folder / name.replace("frames-", "histograms-")
        self.histograms = HistogramFile(_opened(cubes)) if cubes.is_file() else None
        depth = self.frames["depth"]
        self.step, self.offset = np.float32(depth.attrs["step"]), np.float32(depth.attrs["offset"])
        self.width: int = depth.shape[2]
        self.stored = {field: _mapped(self.frames[field]) for field in ("depth", "label", "intensity")}
        self.scene_images = {field: _mapped(self.scenes[column]) for field, column in _SCENE_FIELDS.items()}
        self.columns: dict[str, NDArray[Any]] = {
            column: stored[...] for column, stored in self.frames.items() if stored.ndim == 1
        }
        self.gate = np.stack([self.scenes["gate_near"][...], self.scenes["gate_far"][...]], axis=1).astype(np.float32)
        self.profiles, self.edges = self.scenes["backscatter_profile"][...], self.scenes["profile_edges"][...]
        self.first_scene = int(self.columns["scene"][0])

    def images(self, row: int, fields: Sequence[str], window: tuple[slice, slice]) -> dict[str, NDArray[np.float32]]:
        """A frame's images by field, `[C, H, W]` each."""
        return {name: self._image(name, row, window) for name in fields}

    def numbers(self, row: int) -> dict[str, Any]:
        """What else an item holds."""
        whole, real = ("sample", "scene", "target"), ("backscatter_fraction", "attenuation_lengths", "distance")
        return {
            **{name: int(self.columns[name][row]) for name in whole},
            **{name: np.float32(self.columns[name][row]) for name in real},
            "gate": self.gate[self._scene(row)].copy(),
        }

    def _scene(self, row: int) -> int:
        return int(self.columns["scene"][row]) - self.first_scene

    def _image(self, name: str, row: int, window: tuple[slice, slice]) -> NDArray[np.float32]:
        image: NDArray[Any]
        if name in ("counts", "expected"):
            return np.moveaxis(self._histogram(name, row)[window], -1, 0)
        if name == "noisy":
            image = self._noisy(row, window)
        elif name == "prior":
            image = self._prior(self._scene(row), self._noisy(row, window))
        elif name == "label":
            rows, columns = window
            image = np.unpackbits(self.stored["label"][row, rows], axis=-1, count=self.width)[:, columns]
        elif name == "intensity":
            scale = self.columns["intensity_step"][row]
            image = np.multiply(self.stored["intensity"][(row, *window)], scale, dtype=np.float32)
        else:
            image = np.array(self.scene_images[name][(self._scene(row), *window)])
        image = image.astype(np.float32, copy=False)
        return np.moveaxis(image, -1, 0) if name == "normal" else image[None]

    def _histogram(self, name: str, row: int) -> NDArray[np.float32]:
        cube = None
        if self.histograms is not None:
            number = int(self.columns["sample" if name == "counts" else "scene"][row])
            cube = self.histograms.counts(number) if name == "counts" else self.histograms.expected(number)
        if cube is None:
            raise FileError(f"{self.frames.filename}: frame {int(self.columns['sample'][row])} has no {name!r}")
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
        place = (depth - edges[0]) * np.float32(len(profile) / (edges[-1] - edges[0])) + np.float32(1.0)
        place = np.nan_to_num(np.clip(place, 0.0, np.float32(len(density) - 1)), copy=False)
        prior = density[place.astype(np.intp)]
        np.copyto(prior, np.nan, where=np.isnan(depth))
        return prior


def _opened(path: Path) -> Any:
    import h5py

    try:
        return h5py.File(path, "r")
    except FileNotFoundError:
        raise FileError(f"{path}: no such file; `spadwarp dataset make` makes what is missing") from None
    except OSError as error:
        raise FileError(f"{path}: damaged or not readable: {error}") from error


def _mapped(stored: Any) -> Any:
    """A dataset's values without a copy where they lie in one piece, else the dataset itself."""
    offset = stored.id.get_offset()
    if offset is None:
        return stored
    path, kind = stored.file.filename, stored.dtype
    return np.memmap(path, dtype=kind, mode="r", offset=offset, shape=stored.shape).view(np.ndarray)


def _frame_count(path: Path) -> int:
    with _opened(path) as file:
        return int(file["sample"].shape[0])


def _rotated(normal: NDArray[np.float32], turns: int, mirrored: bool) -> NDArray[np.float32]:
    """Normals of an image that was rotated: their x and y rotate with it."""
    x, y, z = normal
    for _ in range(turns):  # np.rot90: what pointed right (+x) points up (−y)
        x, y = y, -x
    return np.ascontiguousarray(np.stack([-x if mirrored else x, y, z]))
