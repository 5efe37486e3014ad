"""The files of one shard: frames, the scenes that they are of, and histograms; their columns, written and read.

The same recipe gives the same bytes. Counts are stored as a cube for each frame, or event by event: the index
y · W · T + x · T + k of each bin that holds counts, and their number. Frame n's events are those from `event_start[n]`
to `event_start[n + 1]`.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.plan import Plan, Shard
from spadwarp.dataset.render import PROFILE_BINS, RenderedScene, render_analytic, render_transport
from spadwarp.device import core_count, pick_device
from spadwarp.errors import DeviceError, FileError, SpadwarpError
from spadwarp.io.hdf5 import Hdf5File, open_hdf5, write_hdf5
from spadwarp.io.paths import remove_temporaries
from spadwarp.scene import Scene, phase_function
from spadwarp.scene.sight import port_advance
from spadwarp.units import range_from_time

FORMAT_VERSION = 1

HISTOGRAM_FIELDS = ("counts", "expected", "polarisation")
"""Cubes of a frame."""

_LIBRARY = ("v110", "v110")  # one version of the file format, whichever HDF5 writes it
_PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
_READ_OFTEN = ("depth", "bound")
_COUNTS = (np.uint8, np.uint16, np.uint32, np.uint64)
_READ_COLUMNS = (
    "scene",
    "sample",
    "target",
    "backscatter_fraction",
    "attenuation_lengths",
    "distance",
    "intensity_step",
)
_SCENE_FIELDS = {"clean": "depth", "bound": "bound", "normal": "normal", "reflectance": "reflectance"}


@dataclass(frozen=True)
class Column:
    """A dataset of a file, or a field of an exported frame: type (`object`: text; a tuple: one of them), unit, meaning,
    and the shape of a row."""

    kind: Any
    unit: str
    meaning: str
    shape: tuple[int, ...] = ()

    @property
    def is_text(self) -> bool:
        return self.kind is object


FRAME_COLUMNS: dict[str, Column] = {
    "depth": Column(np.uint16, "m", "noisy planar depth = offset + step * code; code 0: no return"),
    "label": Column(
        np.uint8, "1", "the pixel reports backscatter or other background: np.packbits along rows, first pixel highest"
    ),
    "intensity": Column(np.uint8, "1", "recorded photons = intensity_step of the frame * code, cut at 255"),
    "scene": Column(np.int32, "1", "index into scenes.h5"),
    "sample": Column(np.int64, "1", "id of the frame in the whole dataset"),
    "seed": Column(np.uint64, "1", "key of the frame's random numbers, together with its sample id"),
    "target": Column(np.int32, "1", "index into the targets of manifest.json"),
    "backscatter_fraction": Column(
        np.float32, "1", "requested part of the pixels that report backscatter; NaN: the photon rates decide"
    ),
    "attenuation_lengths": Column(np.float32, "1", "extinction times distance, one way"),
    "distance": Column(np.float32, "m", "of the target's centre along the optical axis"),
    "pulses": Column(np.int64, "1", "laser pulses of the frame"),
    "intensity_step": Column(np.float32, "1", "recorded photons per unit of intensity"),
}
"""Datasets of a frames file, all with one first dimension."""

HISTOGRAM_COLUMNS: dict[str, Column] = {
    "scene": FRAME_COLUMNS["scene"],
    "expected": Column(
        np.float16,
        "1",
        "expected counts of a frame before pile-up: target, scattered light, dark counts, ambient light",
    ),
    "polarisation": Column(
        np.float16, "1", "degree of polarisation of each bin's light, by both channels; NaN where none arrives"
    ),
    "gate_start": Column(np.float64, "s", "start of bin 0 after the pulse left the laser"),
    "bin_width": Column(np.float64, "s", "width of a bin"),
    "sample": FRAME_COLUMNS["sample"],
    "counts": Column(_COUNTS, "1", "counts of the frame"),
    "event_start": Column(np.int64, "1", "first event of each frame; one entry more than frames"),
    "event_index": Column(np.uint32, "1", "y * W * T + x * T + bin"),
    "event_count": Column(_COUNTS, "1", "counts in that bin"),
}
"""Datasets of a histograms file."""

_SCENE_NUMBERS: dict[str, tuple[str, str]] = {
    "distance": ("m", "of the target's centre along the optical axis"),
    "attenuation_lengths": ("1", "extinction times distance, one way"),
    "absorption": ("1/m", "a"),
    "scattering": ("1/m", "b"),
    "extinction": ("1/m", "c = a + b"),
    "anisotropy": ("1", "g, mean cosine of the scattering angle"),
    "group_index": ("1", "light travels at 299792458 m/s over this"),
    "gate_near": ("m", "range at which the gate opens"),
    "gate_far": ("m", "range at which the gate closes"),
    "target_reflectance": ("1", "of the target; NaN where each pixel has its own"),
    "pulses": ("1", "laser pulses of a frame"),
    "photons": ("1", "photons that were traced; 0: analytic"),
    "signal": ("1", "expected detections of the return per pulse, median over the target's pixels"),
    "backscatter": ("1", "expected backscatter detections per pulse within the gate, median over pixels"),
    "pulse_energy": ("J", "of the laser"),
    "pulse_fwhm": ("s", "of the laser"),
    "jitter_fwhm": ("s", "of the detector"),
    "pde": ("1", "photon detection efficiency"),
    "dark_count_rate": ("1/s", "of a pixel"),
}


def scene_columns(shape: tuple[int, int]) -> dict[str, Column]:
    """Datasets of `scenes.h5`, all with one first dimension; `shape`: height and width of the images."""
    real, bins = np.float32, PROFILE_BINS
    return {
        "depth": Column(real, "m", "true planar depth; NaN where nothing is hit", shape),
        "bound": Column(real, "m", "Cramér–Rao bound of the depth in one frame; NaN for no estimate", shape),
        "normal": Column(np.float16, "1", "unit normals towards the camera", (*shape, 3)),
        "reflectance": Column(np.float16, "1", "Lambertian reflectance", shape),
        "backscatter_profile": Column(real, "1/m", "density of the water's backscatter over depth, on axis", (bins,)),
        "profile_edges": Column(real, "m", "edges of the profile's bins", (bins + 1,)),
        "target": FRAME_COLUMNS["target"],
        "target_name": Column("S64", "1", "its name"),
        "translation": Column(real, "m", "of the target", (3,)),
        "rotation_deg": Column(real, "deg", "of the target about its own x, y, z", (3,)),
        "scale": Column(real, "1", "of the target", (3,)),
        "laser_position": Column(real, "m", "in the camera frame", (3,)),
        **{name: Column(np.float64, unit, text) for name, (unit, text) in _SCENE_NUMBERS.items()},
        "config": Column("S8192", "1", "the scene as TOML"),
    }


def checksum(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"bytes": path.stat().st_size, "sha256": digest}


# Writing


def write_shard(
    plan: Plan, shard: Shard, folder: Path, *, device: str | None = None, threads: int | None = None
) -> dict[str, dict[str, Any]]:
    """Makes a shard's files in `folder`, each whole or not at all; returns their sizes and checksums by name.

    They are put together in memory. Raises `FileError` where they cannot be written.
    """
    names = plan.files_of(shard)
    for name in names:
        remove_temporaries(folder / name)
    with ExitStack() as stack:
        files = [stack.enter_context(write_hdf5(folder / name, libver=_LIBRARY)) for name in names]
        for name, file in zip(names, files, strict=True):
            file.attrs.update(_attributes(plan, shard, name))
        _fill(plan, shard, files, device=device, threads=threads)
    return {name: checksum(folder / name) for name in names}


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
        _describe(file, columns)


def _attributes(plan: Plan, shard: Shard, name: str) -> dict[str, Any]:
    from spadwarp import __version__

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


def _describe(file: Any, columns: Mapping[str, Column]) -> None:
    """Writes unit and meaning to the datasets that an open file holds."""
    for name, stored in file.items():
        stored.attrs.update({"unit": columns[name].unit, "description": columns[name].meaning})


def _image_widths(width: int) -> dict[str, int]:
    """Columns of the stored images of a frame."""
    return {"depth": width, "label": (width + 7) // 8, "intensity": width}


def _fill(plan: Plan, shard: Shard, files: list[Any], *, device: str | None, threads: int | None) -> None:
    frames_file, scenes_file = files[:2]
    each, (height, width) = plan.frames_per_scene, plan.shape
    packed = plan.recipe.frames.compression == "gzip"
    images = {}
    for name, across in _image_widths(width).items():
        how: dict[str, Any] = {"chunks": (1, height, across), **_PACKED} if packed else {}
        shape = (shard.scenes * each, height, across)
        images[name] = frames_file.create_dataset(name, shape, FRAME_COLUMNS[name].kind, track_times=False, **how)
    images["depth"].attrs.update({"step": plan.depth_step, "offset": plan.depth_offset})
    images["intensity"].attrs["step"] = 1.0
    columns = scene_columns(plan.shape)
    rows: dict[str, list[NDArray[Any]]] = {name: [] for name in FRAME_COLUMNS if name not in images}
    records: dict[str, list[Any]] = {name: [] for name in columns}
    histograms = _HistogramWriter(files[2], plan, shard) if len(files) > 2 else None

    for number, rendered in enumerate(_rendered(plan, shard, device, threads)):
        for name, stored in images.items():
            stored[number * each : (number + 1) * each] = getattr(rendered.frames, name)
        for name, value in _frame_rows(plan, shard, rendered).items():
            rows[name].append(np.broadcast_to(np.asarray(value, FRAME_COLUMNS[name].kind), each))
        for name, value in _scene_row(plan, rendered).items():
            records[name].append(value)
        if histograms is not None and rendered.expected is not None:
            histograms.add(rendered, rows["sample"][-1])

    if histograms is not None:
        histograms.close()
    for name, parts in rows.items():
        frames_file.create_dataset(name, data=np.concatenate(parts), track_times=False)
    _describe(frames_file, FRAME_COLUMNS)
    for name, column in columns.items():
        pack = name == "config" or (len(column.shape) > 1 and (packed or name not in _READ_OFTEN))
        how = {"chunks": (1, *column.shape), **_PACKED} if pack else {}
        scenes_file.create_dataset(name, data=np.array(records[name], dtype=column.kind), track_times=False, **how)
    _describe(scenes_file, columns)


def _frame_rows(plan: Plan, shard: Shard, rendered: RenderedScene) -> dict[str, Any]:
    """Values of `FRAME_COLUMNS` but images, for each frame or for all."""
    draw, first = rendered.draw, rendered.draw.index * plan.frames_per_scene
    return {
        "scene": draw.index,
        "sample": np.arange(first, first + plan.frames_per_scene),
        "seed": plan.split_seeds[shard.split] if draw.photons is None else draw.seed,
        "target": draw.target,
        "backscatter_fraction": draw.fractions,
        "attenuation_lengths": draw.attenuation_lengths,
        "distance": draw.distance,
        "pulses": rendered.scene.pulses_per_depth_frame,
        "intensity_step": rendered.frames.intensity_step,
    }


def _scene_row(plan: Plan, rendered: RenderedScene) -> dict[str, Any]:
    """A scene's values of `scene_columns`."""
    scene, draw = rendered.scene, rendered.draw
    medium, source, advance = scene.medium, plan.targets[draw.target], port_advance(scene)
    placed: Any = scene.targets[0] if scene.targets else None
    config = scene.to_toml()
    if source.mesh is not None:
        config = config.replace(str(source.mesh), source.mesh.name)  # without the folders of this machine
    return {
        "depth": rendered.truth.depth,
        "bound": rendered.bound,
        "normal": rendered.truth.normal,
        "reflectance": rendered.truth.reflectance,
        "backscatter_profile": rendered.profile[0],
        "profile_edges": rendered.profile[1],
        "target": draw.target,
        "target_name": source.name,
        **{name: getattr(placed, name, (np.nan,) * 3) for name in ("translation", "rotation_deg", "scale")},
        "laser_position": scene.beam.position,
        **{name: getattr(draw, name) for name in ("distance", "attenuation_lengths")},
        **{name: getattr(medium, name) for name in ("absorption", "scattering", "extinction", "group_index")},
        "anisotropy": phase_function(medium).mean_cosine,
        "gate_near": range_from_time(scene.gate.start, medium.group_index) + advance,
        "gate_far": range_from_time(scene.gate.stop, medium.group_index) + advance,
        "target_reflectance": getattr(placed, "reflectance", np.nan),
        "pulses": scene.pulses_per_depth_frame,
        "photons": draw.photons or 0,
        **{name: getattr(rendered, name) for name in ("signal", "backscatter")},
        "pulse_energy": scene.laser.pulse_energy,
        "pulse_fwhm": 1e-12 * scene.laser.pulse_fwhm_ps,
        "jitter_fwhm": 1e-12 * scene.detector.jitter_fwhm_ps,
        "pde": scene.detections_per_photon,
        "dark_count_rate": scene.detector.dark_count_rate,
        "config": config.encode(),
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

    def add(self, rendered: RenderedScene, samples: NDArray[np.int64]) -> None:
        """The next scene, and the ids of its frames."""
        counts, gate, row = rendered.frames.counts, rendered.scene.gate, len(self._numbers["scene"])
        assert counts is not None
        self._cubes["expected"][row] = rendered.expected
        if rendered.polarisation is not None:
            if "polarisation" not in self._cubes:  # NaN in scenes without
                self._cubes["polarisation"] = self._create("polarisation", self._shape, np.float16, fillvalue=np.nan)
            self._cubes["polarisation"][row] = rendered.polarisation
        for name, value in (("scene", rendered.draw.index), ("gate_start", gate.start), ("bin_width", gate.bin_width)):
            self._numbers[name].append(value)
        self._numbers["sample"].extend(samples)
        if self._counts != "none":
            for frame in counts.reshape(len(counts), -1):
                filled = np.flatnonzero(frame)
                self._events.append((filled.astype(np.uint32), frame[filled]))

    def close(self) -> None:
        """Writes what is only known at the end."""
        for name, values in self._numbers.items():
            data = np.array(values, HISTOGRAM_COLUMNS[name].kind)
            self._file.create_dataset(name, data=data, track_times=False)
        if self._events:
            self._write_counts()
        _describe(self._file, HISTOGRAM_COLUMNS)

    def _create(self, name: str, shape: tuple[int, ...], kind: Any, **choices: Any) -> Any:
        return self._file.create_dataset(name, shape, kind, chunks=self._chunk, track_times=False, **_PACKED, **choices)

    def _write_counts(self) -> None:
        indices, counts = zip(*self._events, strict=True)
        sizes = [part.size for part in counts]
        kind = np.min_scalar_type(max((int(part.max(initial=0)) for part in counts), default=0))
        shape = self._shape[1:]
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
            packed = {"chunks": (min(values.size, 1 << 18),), **_PACKED} if values.size else {}
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
        try:
            self.count = len(self.file.stored("distance", np.float64, (None,)))
        except BaseException:
            self.file.close()
            raise

    def stored(self, name: str) -> Any:
        """A column of `scene_columns`, its first dimension the scenes."""
        column = self._columns[name]
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
        self._rows = {
            name: {int(number): row for row, number in enumerate(file.array(name, FRAME_COLUMNS[name].kind, (None,)))}
            for name in ("scene", "sample")
        }
        scenes, samples = (len(file.stored(name, FRAME_COLUMNS[name].kind, (None,))) for name in self._rows)
        expected = file.stored("expected", np.float16, (scenes, *shape, None))
        self.shape: tuple[int, ...] = expected.shape[1:]
        self._of_scenes = {"expected": expected}
        self.fields = HISTOGRAM_FIELDS if "polarisation" in file else HISTOGRAM_FIELDS[:-1]
        if "polarisation" in file:
            self._of_scenes["polarisation"] = file.stored("polarisation", np.float16, expected.shape)
        self._counts = file.stored("counts", _COUNTS, (samples, *self.shape)) if "counts" in file else None
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
        if name == "counts":
            return self._counts_of(sample)
        row, stored = self._rows["scene"].get(scene), self._of_scenes.get(name)
        return None if row is None or stored is None else stored[row].astype(np.float32)

    def _counts_of(self, sample: int) -> NDArray[np.float32] | None:
        row = self._rows["sample"].get(sample)
        if row is None or (self._starts is None and self._counts is None):
            return None
        if self._starts is None:
            assert self._counts is not None
            return self._counts[row].astype(np.float32)
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
        with ExitStack() as opened:  # closed again where one of them is refused
            self._open(opened, folder, name, manifest)
            opened.pop_all()

    def _open(self, opened: ExitStack, folder: Path, name: str, manifest: dict[str, Any]) -> None:
        shape, targets = (manifest["height"], manifest["width"]), len(manifest["targets"])
        self.frames = opened.enter_context(closing(_opened(folder / name, "spadwarp frames")))
        self.scenes = SceneFile(folder, name, shape)
        opened.enter_context(closing(self.scenes.file))
        count = len(self.frames.stored("sample", np.int64, (None,)))
        self.columns = {
            column: self.frames.array(column, FRAME_COLUMNS[column].kind, (count,)) for column in _READ_COLUMNS
        }
        self.first_scene = int(self.columns["scene"][0]) if count else 0
        last = self.first_scene + self.scenes.count
        if not 0 <= self.first_scene <= last <= manifest["scenes"] or not _within(
            self.columns["scene"], range(self.first_scene, last)
        ):
            self.frames.refuse("scene", f"names scenes that are not among the {self.scenes.count} of the shard")
        if not _within(self.columns["target"], range(targets)):
            self.frames.refuse("target", f"names targets that are not among the {targets} of the dataset")
        self.width = shape[1]
        self.stored = {
            field: self.frames.stored(field, FRAME_COLUMNS[field].kind, (count, shape[0], across)).mapped()
            for field, across in _image_widths(shape[1]).items()
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
        scene, sample = (int(self.columns[column][row]) for column in ("scene", "sample"))
        if self.histograms is not None:
            cube = self.histograms.cube(name, scene=scene, sample=sample)
            if name not in self.histograms.fields:
                path = self.histograms.path
        if cube is None:
            raise FileError(f"{path}: frame {sample} has no {name!r}")
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
