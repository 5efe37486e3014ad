"""Reading datasets: frame by frame as NumPy arrays, or as torch tensors for a `DataLoader`."""

from __future__ import annotations

import copy
import functools
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Self, TypedDict, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.make import read_manifest
from spadwarp.dataset.recipe import SPLITS
from spadwarp.dataset.shards import FIELDS, HistogramFile, ShardFile, frame_count
from spadwarp.scene import Scene
from spadwarp.values import SEED, ArgumentError, FileError, check_choice, check_integer

if TYPE_CHECKING:
    from torch import Tensor  # noqa: F401, in the text of `TensorItem`

__all__ = ["FIELDS", "FrameItem", "FrameReader", "SpadDataset", "TensorItem"]

Integer = TypeVar("Integer")
Real = TypeVar("Real")
Array = TypeVar("Array")


class Numbers(TypedDict, Generic[Integer, Real, Array]):
    """What every item has."""

    sample: Integer
    scene: Integer
    target: Integer
    backscatter_fraction: Real
    attenuation_lengths: Real
    distance: Real
    gate: Array


class Item(Numbers[Integer, Real, Array], Generic[Integer, Real, Array], total=False):
    """Besides those images of `FIELDS` that a reader was asked for, `[C, H, W]`."""

    noisy: Array
    clean: Array
    label: Array
    intensity: Array
    bound: Array
    normal: Array
    reflectance: Array
    prior: Array
    counts: Array
    expected: Array
    polarisation: Array


FrameItem = Item[int, np.float32, NDArray[np.float32]]
"""An item of `FrameReader` for type checkers."""

TensorItem = Item["Tensor", "Tensor", "Tensor"]
"""An item of `SpadDataset` for type checkers."""


class FrameReader:
    """The frames of a split as a sequence of dicts of float32 NumPy arrays `[C, H, W]`.

    An item has images by the names of `FIELDS`, and numbers: `sample`, `scene`, `target` (int64),
    `backscatter_fraction`, `attenuation_lengths`, `distance` (float32), `gate` (float32 `[2]`, ranges at which it opens
    and closes [m]).

    Args:
        path: The dataset's folder, or the file of one of its shards, whose frames are read alone.
        split: "train", "validation", "test", or "all".
        fields: Images of an item, from `FIELDS`.
        crop: Side, or height and width, of a random part of the frame; None for the whole.
        augment: Whether items are rotated by random multiples of 90° (180° where they are not square) and mirrored.
        repeats: How many differently cropped and rotated items there are of each frame.
        seed: Of crops and rotations. They depend on it, on the epoch (`set_epoch`) and on the item's index alone.

    Each process opens the files for itself when it first reads: workers of a `DataLoader` need no extra care.

    Raises `FileError`: no dataset, or one that is not whole; `ArgumentError`: an argument out of range.
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
        self.path, only = Path(path), None
        if self.path.is_file():  # a shard's
            only = f"frames-{self.path.name.partition('-')[2]}"
            self.path = self.path.parent.parent if self.path.parent.name == "scenes" else self.path.parent
        self.manifest = read_manifest(self.path)
        check_choice("split", split, (*SPLITS, "all"))
        for name in fields:
            check_choice("fields", name, [*FIELDS])
        repeats, seed = check_integer("repeats", repeats, "[1, 1000000000]"), check_integer("seed", seed, SEED)
        self.split, self.fields, self.repeats, self.seed = split, tuple(fields), repeats, seed
        self.augment, self.epoch = augment, 0
        self.shape: tuple[int, int] = (self.manifest["height"], self.manifest["width"])
        self.crop = (crop, crop) if isinstance(crop, int) else crop
        if self.crop is not None and not all(1 <= a <= b for a, b in zip(self.crop, self.shape, strict=True)):
            raise ArgumentError(f"crop = {crop} is outside [1, {self.shape[0]}] x [1, {self.shape[1]}]")
        splits = [self.manifest["splits"][name] for name in (SPLITS if split == "all" else (split,))]
        self.shards: list[str] = [shard for described in splits for shard in described["shards"]]
        if not self.shards:
            held = [name for name in SPLITS if self.manifest["splits"][name]["frames"]]
            raise ArgumentError(f"split = {split!r}: {self.path} has no frames in it; it has {', '.join(held)}")
        if only is not None:
            if only not in self.shards:
                raise FileError(f"{path}: not a shard of {self.path}, split {split!r}")
            self.shards = [only]
        self._open: dict[int, ShardFile] = {}
        self._process = os.getpid()
        self._stops = np.cumsum([frame_count(self.path, name) for name in self.shards], dtype=np.int64)

    def __repr__(self) -> str:
        shards = self.shards[0] if len(self.shards) == 1 else f"{len(self.shards)} shards"
        return f"{type(self).__name__}({self.path}, {self.split!r}: {len(self)} frames in {shards})"

    def with_fields(self, *fields: str) -> Self:
        """The same frames with other images, whole and not augmented."""
        changed = copy.copy(self)
        changed.fields, changed.crop, changed.augment, changed._open = fields, None, False, {}
        return changed

    def same_scene(self, index: int) -> range:
        """Indices of the frames of the same scene."""
        shard, row = self._row(index % self.frame_count)
        rows = np.flatnonzero(shard.columns["scene"] == shard.columns["scene"][row])
        first = index - row
        return range(first + int(rows[0]), first + int(rows[-1]) + 1)

    def __len__(self) -> int:
        return self.repeats * self.frame_count

    @property
    def frame_count(self) -> int:
        """Frames of the split."""
        return int(self._stops[-1]) if len(self._stops) else 0

    def set_epoch(self, epoch: int) -> None:
        """Crops and rotations differ from epoch to epoch."""
        self.epoch = epoch

    def __getitem__(self, index: int) -> FrameItem:
        if not -len(self) <= index < len(self):
            raise IndexError(f"index = {index} is outside [{-len(self)}, {len(self)})")
        index %= len(self)
        shard, row = self._row(index % self.frame_count)
        window, turns, mirrored = self._changes(index)
        item: dict[str, Any] = {}
        for name in self.fields:
            image = np.rot90(shard.image(name, row, window), turns, axes=(-2, -1))
            item[name] = np.ascontiguousarray(image[..., ::-1] if mirrored else image)
        if "normal" in item:  # x and y of normals rotate with the image
            x, y, z = item["normal"]
            for _ in range(turns):  # np.rot90: what pointed right (+x) points up (−y)
                x, y = y, -x
            item["normal"] = np.stack([-x if mirrored else x, y, z])
        return cast(FrameItem, item | shard.numbers(row))

    def scene(self, index: int) -> Scene:
        """The scene of a frame, given by its index."""
        shard, row = self._row(index % self.frame_count)
        return shard.scenes.scene(shard.scene_row(row))

    def scene_numbers(self, name: str) -> NDArray[np.float64]:
        """A number of each scene by the scene's index, such as "signal"; NaN for scenes of other splits."""
        values = np.full(self.manifest["scenes"], np.nan)
        for number in range(len(self.shards)):
            shard = self._shard(number)
            values[shard.first_scene : shard.first_scene + shard.scenes.count] = shard.scenes.array(name)
        return values

    @property
    def histogram_bins(self) -> int:
        """Bins of the histograms of traced scenes; 0 where no scene was traced."""
        return 0 if (histograms := self._histograms()) is None else histograms.shape[-1]

    @property
    def histogram_fields(self) -> tuple[str, ...]:
        """Those of `FIELDS` that frames of traced scenes have besides; none where no scene was traced."""
        return () if (histograms := self._histograms()) is None else histograms.fields

    def _histograms(self) -> HistogramFile | None:
        """Of the first shard that has some."""
        names = [name.replace("frames-", "histograms-") in self.manifest["files"] for name in self.shards]
        return self._shard(names.index(True)).histograms if any(names) else None

    def _row(self, frame: int) -> tuple[ShardFile, int]:
        """The shard of a frame, and the frame's row in it."""
        number = int(np.searchsorted(self._stops, frame, side="right"))
        return self._shard(number), frame - (int(self._stops[number - 1]) if number else 0)

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

    def __iter__(self) -> Iterator[FrameItem]:
        for index in range(len(self)):
            yield self[index]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}

    def _shard(self, number: int) -> ShardFile:
        if self._process != os.getpid():  # files opened before a fork are the parent's
            self._open, self._process = {}, os.getpid()
        if number not in self._open:
            self._open[number] = ShardFile(self.path, self.shards[number], self.manifest)
        return self._open[number]


class SpadDataset(FrameReader):
    """`FrameReader` for torch: a map-style dataset whose items hold tensors; goes into a `DataLoader` as it is.

    `SpadDataset(path, crop=128, augment=True, repeats=20)` makes the paper's 400 000 pairs of 20 000 frames. Arguments,
    fields and errors are those of `FrameReader`; NaN marks what is not there.
    """

    def __getitem__(self, index: int) -> TensorItem:  # type: ignore[override]  # tensors where the other has arrays
        import torch

        _collate_ours()
        tensors = SpadItem(
            (name, torch.from_numpy(value) if isinstance(value, np.ndarray) else torch.tensor(value))
            for name, value in super().__getitem__(index).items()
        )
        return cast(TensorItem, tensors)


class SpadItem(dict[str, Any]):
    """Tensors of `SpadDataset` by name. A worker of a `DataLoader` hands a batch of them over in one piece of shared
    memory, not one for each name: three quarters of the processor time."""


@functools.cache
def _collate_ours() -> None:
    """Tells torch's `default_collate` what to do with items, in this process."""
    from torch.utils.data._utils.collate import default_collate_fn_map

    default_collate_fn_map[SpadItem] = _collate


def _collate(items: list[SpadItem], *, collate_fn_map: Any = None) -> dict[str, Any]:
    """A batch of items: tensors by name, their first dimension the items."""
    import torch

    if torch.utils.data.get_worker_info() is None:
        return {name: torch.stack([item[name] for item in items]) for name in items[0]}
    shapes = {name: (len(items), *first.shape) for name, first in items[0].items()}
    sizes = [math.prod(shape) * items[0][name].element_size() for name, shape in shapes.items()]
    starts = [0, *np.cumsum([-(-size // 64) * 64 for size in sizes]).tolist()]  # each at the beginning of a cache line
    memory = torch.empty(0, dtype=torch.uint8).set_(torch.UntypedStorage._new_shared(starts[-1]))
    batch = {}
    for (name, shape), start, size in zip(shapes.items(), starts, sizes, strict=False):
        batch[name] = memory[start : start + size].view(items[0][name].dtype).view(shape)
        torch.stack([item[name] for item in items], out=batch[name])
    return batch
