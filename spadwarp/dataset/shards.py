"""The files of one shard: frames, the scenes that they are of, and histograms; their columns, written and read.

The same recipe gives the same bytes. Counts are stored as a cube for each frame, or event by event: the index
y · W · T + x · T + k of each bin that holds counts, and their number. Frame n's events are those from `event_start[n]`
to `event_start[n + 1]`.
"""

from __future__ import annotations

import importlib.resources
import math
import os
import tomllib
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.plan import Plan, Shard
from spadwarp.dataset.render import PROFILE_BINS, RenderedScene, render_analytic, render_transport
from spadwarp.device import core_count, pick_device
from spadwarp.io.hdf5 import PACKED, Hdf5File, open_hdf5, write_hdf5
from spadwarp.io.paths import remove_temporaries, sha256
from spadwarp.scene import Scene, phase_function
from spadwarp.scene.sight import port_advance
from spadwarp.values import DeviceError, FileError, SpadwarpError, check_choice, range_from_time

FORMAT_VERSION = 1

_LIBRARY = ("v110", "v110")  # one version of the file format, whichever HDF5 writes it
_READ_OFTEN = ("depth", "label", "intensity", "bound")
_COUNTS = (np.uint8, np.uint16, np.uint32, np.uint64)


@dataclass(frozen=True)
class Column:
    """A dataset of a file, or a field of a frame."""

    kind: Any  # its type; `object`: text; a tuple: one of them
    unit: str
    meaning: str
    source: str = ""  # the attribute of a `RenderedScene` with its value; "": it is computed, or is none of a scene's
    shape: tuple[int, ...] = ()  # of a row
    axis: str = ""  # name of the first dimension of an image that has three

    @property
    def is_text(self) -> bool:
        return self.kind is object

    @property
    def type(self) -> str:
        """Type and shape, such as `float32 [24, 36]`."""
        name = "text" if self.is_text else str(np.dtype(self.kind))
        return f"{name} {list(self.shape)}" if self.shape else name

    @property
    def attributes(self) -> dict[str, str]:
        """What is written beside the values."""
        return {"unit": self.unit, "description": self.meaning}


def columns_of(table: str, **sides: int) -> dict[str, Column]:
    """The columns of a table of columns.toml, whose shapes name sides."""

    def column(kind: str | list[str], shape: Sequence[str | int] = (), **others: str) -> Column:
        types: Any = tuple(np.dtype(one).type for one in kind) if isinstance(kind, list) else kind
        if isinstance(kind, str) and kind[0] != "S":
            types = object if kind == "text" else np.dtype(kind).type
        return Column(types, shape=tuple(side if isinstance(side, int) else sides[side] for side in shape), **others)

    return {name: column(**entry) for name, entry in _TABLES[table].items()}


_TABLES = tomllib.loads((importlib.resources.files("spadwarp.dataset") / "columns.toml").read_text(encoding="utf-8"))
FRAME_COLUMNS, HISTOGRAM_COLUMNS, FIELDS = map(columns_of, ("frames", "histograms", "items"))
"""Datasets of a frames file and of a histograms file; images of an item, float32 `[1, H, W]` without another shape."""

HISTOGRAM_FIELDS = ("counts", "expected", "polarisation")
"""Cubes of a frame."""


def scene_columns(shape: tuple[int, int]) -> dict[str, Column]:
    """Datasets of `scenes.h5`; `shape`: height and width of the images."""
    return columns_of("scenes", height=shape[0], width=shape[1], bins=PROFILE_BINS, edges=PROFILE_BINS + 1)


_SCENE_FIELDS = {"clean": "depth", "bound": "bound", "normal": "normal", "reflectance": "reflectance"}


def checksum(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a file."""
    return {"bytes": path.stat().st_size, "sha256": sha256(path)}


# Writing


def write_shard(
    plan: Plan, shard: Shard, folder: Path, *, device: str | None = None, threads: int | None = None
) -> dict[str, dict[str, Any]]:
    """Makes a shard's files in `folder`, each whole or not at all; returns their sizes and checksums by name.

    They are put together in memory. Raises `FileError` where they cannot be written.
    """
    names, each = plan.files_of(shard), plan.frames_per_scene
    for name in names:
        remove_temporaries(folder / name)
    of_scenes = scene_columns(plan.shape)
    frames: dict[str, list[Any]] = {name: [] for name in FRAME_COLUMNS}
    scenes: dict[str, list[Any]] = {name: [] for name in of_scenes}
    with ExitStack() as stack:
        files = [stack.enter_context(write_hdf5(folder / name, libver=_LIBRARY)) for name in names]
        for name, file in zip(names, files, strict=True):
            file.attrs.update(_attributes(plan, shard, name))
        histograms = _HistogramWriter(files[2], plan, shard) if len(files) > 2 else None
        for rendered in _rendered(plan, shard, device, threads):
            for name, column in FRAME_COLUMNS.items():
                value = np.asarray(attrgetter(column.source)(rendered), column.kind)
                frames[name].append(np.broadcast_to(value, (each, *value.shape[1:])))
            computed = _computed(rendered)
            for name, column in of_scenes.items():
                scenes[name].append(attrgetter(column.source)(rendered) if column.source else computed[name])
            if histograms is not None and rendered.expected is not None:
                histograms.add(rendered)
        if histograms is not None:
            histograms.close()
        packed = plan.recipe.frames.compression == "gzip"
        for name, column in FRAME_COLUMNS.items():
            _store(files[0], name, column, np.concatenate(frames[name]), packed)
        files[0]["depth"].attrs.update({"step": plan.depth_step, "offset": plan.depth_offset})
        files[0]["intensity"].attrs["step"] = 1.0
        for name, column in of_scenes.items():
            _store(files[1], name, column, np.array(scenes[name], dtype=column.kind), packed)
    return {name: checksum(folder / name) for name in names}


def _store(file: Any, name: str, column: Column, data: NDArray[Any], packed: bool) -> None:
    """Writes a column; what is read often is not packed unless the recipe says so."""
    pack = name == "config" or (data.ndim > 2 and (packed or name not in _READ_OFTEN))
    how = {"chunks": (1, *data.shape[1:]), **PACKED} if pack else {}
    file.create_dataset(name, data=data, track_times=False, **how).attrs.update(column.attributes)


def _computed(rendered: RenderedScene) -> dict[str, Any]:
    """Values of `scene_columns` that no attribute has."""
    scene, draw = rendered.scene, rendered.draw
    index, advance = scene.medium.group_index, port_advance(scene)
    placed: Any = scene.targets[0] if scene.targets else None
    config = scene.to_toml()
    if draw.source.mesh is not None:
        config = config.replace(str(draw.source.mesh), draw.source.mesh.name)  # without the folders of this machine
    return {
        **{name: getattr(placed, name, (np.nan,) * 3) for name in ("translation", "rotation_deg", "scale")},
        "anisotropy": phase_function(scene.medium).mean_cosine,
        "gate_near": range_from_time(scene.gate.start, index) + advance,
        "gate_far": range_from_time(scene.gate.stop, index) + advance,
        "target_reflectance": getattr(placed, "reflectance", np.nan),
        "pulse_fwhm": 1e-12 * scene.laser.pulse_fwhm_ps,
        "jitter_fwhm": 1e-12 * scene.detector.jitter_fwhm_ps,
        "config": config.encode(),
    }


def write_scene_index(plan: Plan, folder: Path) -> None:
    """`scenes.h5`: the scenes of all shards as one, by reference; rows of shards that are not there are NaN or 0."""
    from h5py import h5d, h5p, h5s, h5t

    with write_hdf5(folder / "scenes.h5", libver=_LIBRARY) as file:
        file.attrs.update({"format": "spadwarp scenes", "format_version": FORMAT_VERSION, "name": plan.recipe.name})
        columns = scene_columns(plan.shape)
        for name, column in columns.items():
            # The low-level interface, since h5py's own virtual datasets hold the time of day.
            layout = h5p.create(h5p.DATASET_CREATE)
            layout.set_layout(h5d.VIRTUAL)
            layout.set_obj_track_times(False)
            whole, rest = (plan.scene_count, *column.shape), (0,) * len(column.shape)
            for shard in plan.shards:
                part = (shard.scenes, *column.shape)
                space = h5s.create_simple(whole)
                space.select_hyperslab((shard.first_scene, *rest), part)
                layout.set_virtual(space, shard.scenes_file.encode(), name.encode(), h5s.create_simple(part))
            dtype = np.dtype(column.kind)
            if dtype.kind == "f":
                layout.set_fill_value(np.array([np.nan], dtype))
            h5d.create(file.id, name.encode(), h5t.py_create(dtype, logical=True), h5s.create_simple(whole), layout)
            file[name].attrs.update(column.attributes)


def _attributes(plan: Plan, shard: Shard, name: str) -> dict[str, Any]:
    from spadwarp.values import __version__

    return {
        "format": f"spadwarp {Path(name).name.partition('-')[0]}",
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "name": plan.recipe.name,
        "recipe_seed": str(plan.recipe.seed),
        "split": shard.split,
        "split_seed": str(plan.split_seeds[shard.split]),
        "target": plan.targets[shard.target].name,
        "shard": shard.index,
        "shards": len(plan.shards),
        "read_me": "Images [frame, height, width]; +x right, +y down, +z away from the camera; depth is z.",
    }


class _HistogramWriter:
    """Takes the traced scenes of a shard one by one into an open file; `close` writes the rest."""

    def __init__(self, file: Any, plan: Plan, shard: Shard) -> None:
        self._file, self._counts = file, plan.recipe.monte_carlo.counts
        (height, width), bins = plan.shape, plan.recipe.gate.bins
        self._chunk = (1, max(1, min(height, (1 << 20) // (2 * width * bins))), width, bins)  # of 1 MiB
        self._shape = (sum(map(plan.is_traced, shard.indices)), height, width, bins)
        self._cubes = {"expected": self._create("expected", self._shape, np.float16)}
        self._numbers: dict[str, list[Any]] = {"scene": [], "gate_start": [], "bin_width": [], "sample": []}
        self._events: list[tuple[NDArray[np.uint32], NDArray[np.int32]]] = []

    def add(self, rendered: RenderedScene) -> None:
        """The next scene."""
        counts, row = rendered.counts, len(self._numbers["scene"])
        assert counts is not None
        self._cubes["expected"][row] = rendered.expected
        if rendered.polarisation is not None:
            if "polarisation" not in self._cubes:  # NaN in scenes without
                self._cubes["polarisation"] = self._create("polarisation", self._shape, np.float16, fillvalue=np.nan)
            self._cubes["polarisation"][row] = rendered.polarisation
        for name, values in self._numbers.items():
            values.extend(np.atleast_1d(attrgetter(HISTOGRAM_COLUMNS[name].source)(rendered)))
        if self._counts != "none":
            for frame in counts.reshape(len(counts), -1):
                filled = np.flatnonzero(frame)
                self._events.append((filled.astype(np.uint32), frame[filled]))

    def close(self) -> None:
        """Writes what is only known at the end."""
        for name, values in self._numbers.items():
            self._file.create_dataset(name, data=np.array(values, HISTOGRAM_COLUMNS[name].kind), track_times=False)
        if self._events:
            self._write_counts()
        for name, stored in self._file.items():
            stored.attrs.update(HISTOGRAM_COLUMNS[name].attributes)

    def _create(self, name: str, shape: tuple[int, ...], kind: Any, **choices: Any) -> Any:
        return self._file.create_dataset(name, shape, kind, chunks=self._chunk, track_times=False, **PACKED, **choices)

    def _write_counts(self) -> None:
        indices, counts = zip(*self._events, strict=True)
        sizes, shape = [part.size for part in counts], self._shape[1:]
        kind = np.min_scalar_type(max(int(part.max(initial=0)) for part in counts))
        dense_bytes = len(counts) * math.prod(shape) * kind.itemsize
        if self._counts == "dense" or (self._counts == "smaller" and dense_bytes <= (4 + kind.itemsize) * sum(sizes)):
            stored = self._create("counts", (len(counts), *shape), kind)
            for row, (index, count) in enumerate(self._events):
                stored[row] = _cube(index, count, shape, kind)
            return
        starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        self._file.create_dataset("event_start", data=starts, track_times=False)
        events = {"event_index": np.concatenate(indices), "event_count": np.concatenate(counts).astype(kind)}
        for name, values in events.items():
            packed = {"chunks": (min(values.size, 1 << 18),), **PACKED} if values.size else {}
            self._file.create_dataset(name, data=values, track_times=False, **packed)


def _cube(index: NDArray[Any], counts: NDArray[Any], shape: tuple[int, ...], kind: Any) -> NDArray[Any]:
    cube = np.zeros(math.prod(shape), kind)
    cube[index] = counts
    return cube.reshape(shape)


def _render(plan: Plan, index: int, *, device: str | None, threads: int | None) -> RenderedScene:
    draw = plan.scene(index)
    try:
        if draw.photons is None:
            return render_analytic(plan, draw, device=device)
        return render_transport(plan, draw, device=device, threads=threads)
    except RuntimeError as error:  # of the device; not to be taken for one of the file
        raise DeviceError(f"scene {index}: {error}") from error


def _rendered(plan: Plan, shard: Shard, device: str | None, threads: int | None) -> Iterator[RenderedScene]:
    """The shard's scenes in order, later ones made while one is written: one thread, on the CPU one for each core."""
    workers = 1
    if not pick_device(device).is_cuda and plan.recipe.monte_carlo.share == 0.0:
        workers = min(threads or core_count(), shard.scenes)
    waiting: deque[Future[RenderedScene]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for index in shard.indices:
                waiting.append(pool.submit(_render, plan, index, device=device, threads=threads))
                if len(waiting) > workers + 1:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


# Reading, compared with the dataset's manifest before anything is read


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
        self.count = len(self.file.stored("distance", np.float64, (None,)))

    def stored(self, name: str) -> Any:
        """A column of `scene_columns`, its first dimension the scenes."""
        column = self._columns[check_choice("name", name, list(self._columns))]
        return self.file.stored(name, "S" if isinstance(column.kind, str) else column.kind, (self.count, *column.shape))

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


class HistogramFile:
    """The histograms of an open file, by scene index and by sample id; `fields`: which of `HISTOGRAM_FIELDS` it may
    hold."""

    def __init__(self, file: Hdf5File, shape: tuple[int, int]) -> None:
        self.path = file.path
        numbers = {name: file.array(name, FRAME_COLUMNS[name].kind, (None,)) for name in ("scene", "sample")}
        self._rows = {name: {int(id): row for row, id in enumerate(ids)} for name, ids in numbers.items()}
        scenes, samples = map(len, numbers.values())
        self._cubes = {"expected": file.stored("expected", np.float16, (scenes, *shape, None))}
        self.shape: tuple[int, ...] = self._cubes["expected"].shape[1:]
        self.fields = HISTOGRAM_FIELDS if "polarisation" in file else HISTOGRAM_FIELDS[:-1]
        if "polarisation" in file:
            self._cubes["polarisation"] = file.stored("polarisation", np.float16, (scenes, *self.shape))
        if "counts" in file:
            self._cubes["counts"] = file.stored("counts", _COUNTS, (samples, *self.shape))
        self._starts: NDArray[np.int64] | None = None
        if "event_start" in file:
            self._starts = file.array("event_start", np.int64, (samples + 1,))
            self._index = file.stored("event_index", np.uint32, (None,))
            self._events = file.stored("event_count", _COUNTS, (len(self._index),))
            if self._starts[0] != 0 or self._starts[-1] != len(self._index) or (np.diff(self._starts) < 0).any():
                file.refuse("event_start", f"does not divide {len(self._index)} events")

    def cube(self, name: str, *, scene: int, sample: int) -> NDArray[np.float32] | None:
        """Counts of a frame, or of a scene the expected counts of a frame or the degree of polarisation, `[H, W, T]`;
        None where there are none."""
        row = self._rows["sample"].get(sample) if name == "counts" else self._rows["scene"].get(scene)
        if row is None:
            return None
        if name != "counts" or self._starts is None:
            return self._cubes[name][row].astype(np.float32) if name in self._cubes else None
        part = slice(int(self._starts[row]), int(self._starts[row + 1]))
        index = self._index[part]
        if index.size and index.max() >= math.prod(self.shape):
            raise FileError(f"{self.path}: event_index is outside the histograms {self.shape} in row {row}")
        return _cube(index, self._events[part], self.shape, np.float32)


class ShardFile:
    """Two or three open files. What is stored without compression is read past HDF5, through a memory map.

    Args:
        folder: The dataset.
        name: Of the shard's file of frames.
        manifest: From `read_manifest`.
    """

    def __init__(self, folder: Path, name: str, manifest: dict[str, Any]) -> None:
        height, self.width = shape = (manifest["height"], manifest["width"])
        self.frames, self.scenes = _opened(folder / name, "spadwarp frames"), SceneFile(folder, name, shape)
        count = len(self.frames.stored("sample", np.int64, (None,)))
        widths = {"depth": self.width, "label": (self.width + 7) // 8, "intensity": self.width}
        numbers = [column for column in FRAME_COLUMNS if column not in widths]
        self.columns = {column: self.frames.array(column, FRAME_COLUMNS[column].kind, (count,)) for column in numbers}
        self.first_scene = int(self.columns["scene"][0]) if count else 0
        scenes, targets = range(self.first_scene, self.first_scene + self.scenes.count), range(len(manifest["targets"]))
        if not 0 <= scenes.start <= scenes.stop <= manifest["scenes"] or not _within(self.columns["scene"], scenes):
            self.frames.refuse("scene", f"names scenes that are not among the {len(scenes)} of the shard")
        if not _within(self.columns["target"], targets):
            self.frames.refuse("target", f"names targets that are not among the {len(targets)} of the dataset")
        self.stored = {
            field: self.frames.stored(field, FRAME_COLUMNS[field].kind, (count, height, across)).mapped()
            for field, across in widths.items()
        }
        self.step = np.float32(self.frames.real("step", "(0, inf)", of="depth"))
        self.offset = np.float32(self.frames.real("offset", of="depth"))
        self.scene_images = {field: self.scenes.stored(column).mapped() for field, column in _SCENE_FIELDS.items()}
        self.gate = self.scenes.gate()
        self.profiles, self.edges = self.scenes.array("backscatter_profile"), self.scenes.array("profile_edges")
        cubes = folder / name.replace("frames-", "histograms-")
        found = os.path.isfile(cubes)
        self.histograms = HistogramFile(_opened(cubes, "spadwarp histograms"), shape) if found else None

    def numbers(self, row: int) -> dict[str, Any]:
        """The numbers of an item."""
        whole, real = ("sample", "scene", "target"), ("backscatter_fraction", "attenuation_lengths", "distance")
        return {
            **{name: int(self.columns[name][row]) for name in whole},
            **{name: np.float32(self.columns[name][row]) for name in real},
            "gate": self.gate[self.scene_row(row)].copy(),
        }

    def scene_row(self, row: int) -> int:
        """Row of a frame's scene in `scenes`."""
        return int(self.columns["scene"][row]) - self.first_scene

    def image(self, name: str, row: int, window: tuple[slice, slice]) -> NDArray[np.float32]:
        """A part of an image of a frame, by its name in `FIELDS`, `[C, H, W]`."""
        image: NDArray[Any]
        if name in HISTOGRAM_FIELDS:
            return np.moveaxis(self._histogram(name, row)[window], -1, 0)
        if name in ("noisy", "prior"):
            codes = self.stored["depth"][(row, *window)]
            image = codes.astype(np.float32)
            image *= self.step
            image += self.offset
            np.copyto(image, np.nan, where=codes == 0)
            image = image if name == "noisy" else self._prior(self.scene_row(row), image)
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
        scene, sample = (int(self.columns[column][row]) for column in ("scene", "sample"))
        held = self.histograms
        cube = None if held is None else held.cube(name, scene=scene, sample=sample)
        if cube is None:
            path = self.frames.path if held is None or name in held.fields else held.path
            raise FileError(f"{path}: frame {sample} has no {name!r}")
        return cube

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
