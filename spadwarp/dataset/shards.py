"""The columns of a dataset's files: name, unit, meaning, and where a scene's values come from."""

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
from spadwarp.io.atomic import remove_temporaries
from spadwarp.io.hdf5 import open_hdf5, write_hdf5
from spadwarp.io.hdf5_file import Hdf5File
from spadwarp.scene import Scene, phase_function
from spadwarp.scene.sight import port_advance
from spadwarp.units import range_from_time

FORMAT_VERSION = 1

PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
"""How HDF5 packs arrays."""

FRAME_COLUMNS: dict[str, tuple[str, str]] = {
    "depth": ("m", "noisy planar depth = offset + step * code; code 0: no return"),
    "label": ("1", "the pixel reports backscatter or other background: np.packbits along rows, first pixel highest"),
    "intensity": ("1", "recorded photons = intensity_step of the frame * code, cut at 255"),
    "scene": ("1", "index into scenes.h5"),
    "sample": ("1", "id of the frame in the whole dataset"),
    "seed": ("1", "key of the frame's random numbers, together with its sample id"),
    "target": ("1", "index into the targets of manifest.json"),
    "backscatter_fraction": ("1", "requested part of the pixels that report backscatter; NaN: the photon rates decide"),
    "attenuation_lengths": ("1", "extinction times distance, one way"),
    "distance": ("m", "of the target's centre along the optical axis"),
    "pulses": ("1", "laser pulses of the frame"),
    "intensity_step": ("1", "recorded photons per unit of intensity"),
}
"""Datasets of a frames file, all with one first dimension: unit and meaning."""

HISTOGRAM_COLUMNS: dict[str, tuple[str, str]] = {
    "scene": ("1", "index into scenes.h5"),
    "expected": ("1", "expected counts of a frame before pile-up: target, scattered light, dark counts, ambient light"),
    "polarisation": ("1", "degree of polarisation of each bin's light, by both channels; NaN where none arrives"),
    "gate_start": ("s", "start of bin 0 after the pulse left the laser"),
    "bin_width": ("s", "width of a bin"),
    "sample": ("1", "id of the frame in the whole dataset"),
    "counts": ("1", "counts of the frame"),
    "event_start": ("1", "first event of each frame; one entry more than frames"),
    "event_index": ("1", "y * W * T + x * T + bin"),
    "event_count": ("1", "counts in that bin"),
}
"""Datasets of a histograms file: unit and meaning."""

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
    "reflectance": ("1", "of the target; NaN where each pixel has its own"),
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


@dataclass(frozen=True)
class Column:
    """A field of an exported frame: shape, type (`object`: text), unit and meaning."""

    shape: tuple[int, ...]
    kind: np.dtype[Any]
    unit: str
    meaning: str

    @property
    def is_text(self) -> bool:
        return self.kind.kind == "O"


def describe(file: Any, columns: Mapping[str, tuple[str, str]]) -> None:
    """Writes unit and meaning to the datasets that an open HDF5 file holds."""
    for name, stored in file.items():
        unit, text = columns[name]
        stored.attrs.update({"unit": unit, "description": text})


def scene_columns(shape: tuple[int, int]) -> dict[str, tuple[tuple[int, ...], Any, str, str]]:
    """Datasets of `scenes.h5`, all with one first dimension: shape of a row, type, unit, meaning.

    `shape`: height and width of the images.
    """
    height, width = shape
    real: Any = np.float32
    return {
        "depth": ((height, width), real, "m", "true planar depth; NaN where nothing is hit"),
        "bound": ((height, width), real, "m", "Cramér–Rao bound of the depth in one frame; NaN for no estimate"),
        "normal": ((height, width, 3), np.float16, "1", "unit normals towards the camera"),
        "albedo": ((height, width), np.float16, "1", "Lambertian reflectance"),
        "backscatter_profile": ((PROFILE_BINS,), real, "1/m", "density of the water's backscatter over depth, on axis"),
        "profile_edges": ((PROFILE_BINS + 1,), real, "m", "edges of the profile's bins"),
        "target": ((), np.int32, "1", "index into the targets of manifest.json"),
        "target_name": ((), "S64", "1", "its name"),
        "translation": ((3,), real, "m", "of the target"),
        "rotation_deg": ((3,), real, "deg", "of the target about its own x, y, z"),
        "scale": ((3,), real, "1", "of the target"),
        "laser_position": ((3,), real, "m", "in the camera frame"),
        **{name: ((), np.float64, unit, text) for name, (unit, text) in _SCENE_NUMBERS.items()},
        "config": ((), "S8192", "1", "the scene as TOML"),
    }


def scene_row(plan: Plan, rendered: RenderedScene) -> dict[str, Any]:
    """A scene's values of `scene_columns`."""
    scene, draw = rendered.scene, rendered.draw
    medium, source, advance = scene.medium, plan.targets[draw.target], port_advance(scene)
    placed: Any = scene.targets[0] if scene.targets else None
    vectors = {name: getattr(placed, name, (np.nan,) * 3) for name in ("translation", "rotation_deg", "scale")}
    config = scene.to_toml()
    if source.mesh is not None:
        config = config.replace(str(source.mesh), source.mesh.name)  # without the folders of this machine
    return {
        "depth": rendered.truth.depth,
        "bound": rendered.bound,
        "normal": rendered.truth.normal,
        "albedo": rendered.truth.reflectance,
        "backscatter_profile": rendered.profile[0],
        "profile_edges": rendered.profile[1],
        "target": draw.target,
        "target_name": source.name,
        **vectors,
        "laser_position": scene.beam.position,
        "distance": draw.distance,
        "attenuation_lengths": draw.attenuation_lengths,
        **{name: getattr(medium, name) for name in ("absorption", "scattering", "extinction", "group_index")},
        "anisotropy": phase_function(medium).mean_cosine,
        "gate_near": range_from_time(scene.gate.start, medium.group_index) + advance,
        "gate_far": range_from_time(scene.gate.stop, medium.group_index) + advance,
        "reflectance": getattr(placed, "reflectance", np.nan),
        "pulses": scene.pulses_per_depth_frame,
        "photons": draw.photons or 0,
        "signal": rendered.signal,
        "backscatter": rendered.backscatter,
        "pulse_energy": scene.laser.pulse_energy,
        "pulse_fwhm": 1e-12 * scene.laser.pulse_fwhm_ps,
        "jitter_fwhm": 1e-12 * scene.detector.jitter_fwhm_ps,
        "pde": scene.detections_per_photon,
        "dark_count_rate": scene.detector.dark_count_rate,
        "config": config.encode(),
    }


# ---- Histograms of traced scenes in one file a shard: expected counts of the scenes, counts of the frames.


HISTOGRAM_FIELDS = ("counts", "expected", "polarisation")
"""Cubes of a frame; methods of `HistogramFile` have these names."""

_COUNTS = (np.uint8, np.uint16, np.uint32, np.uint64)
_KINDS = {"scene": np.int32, "gate_start": np.float64, "bin_width": np.float64, "sample": np.int64}


class HistogramWriter:
    """Takes the traced scenes of a shard one by one into an open file; `close` writes the rest."""

    def __init__(self, file: Any, scenes: int, *, counts: str) -> None:
        self._file, self._scenes, self._counts = file, scenes, counts
        self._expected: Any = None
        self._polarisation: Any = None
        self._numbers: dict[str, list[Any]] = {name: [] for name in _KINDS}
        self._events: list[tuple[NDArray[np.uint32], NDArray[np.int32]]] = []

    def add(self, rendered: RenderedScene, samples: NDArray[np.int64]) -> None:
        """The next scene, and the ids of its frames."""
        histograms, gate = rendered.histograms, rendered.scene.gate
        assert histograms is not None
        height, width, bins = histograms.expected.shape
        if self._expected is None:
            rows = max(1, min(height, (1 << 20) // (2 * width * bins)))  # chunks of 1 MiB
            self._chunk = (1, rows, width, bins)
            self._expected = self._create("expected", (self._scenes, height, width, bins), np.float16)
        self._expected[len(self._numbers["scene"])] = histograms.expected
        if histograms.polarisation is not None:
            if self._polarisation is None:  # NaN in scenes without
                self._polarisation = self._create("polarisation", self._expected.shape, np.float16, fillvalue=np.nan)
            self._polarisation[len(self._numbers["scene"])] = histograms.polarisation
        for name, value in (("scene", rendered.draw.index), ("gate_start", gate.start), ("bin_width", gate.bin_width)):
            self._numbers[name].append(value)
        self._numbers["sample"].extend(samples)
        if self._counts != "none":
            for frame in histograms.counts.reshape(len(histograms.counts), -1):
                filled = np.flatnonzero(frame)
                self._events.append((filled.astype(np.uint32), frame[filled]))

    def close(self) -> None:
        """Writes what is only known at the end."""
        for name, kind in _KINDS.items():
            self._file.create_dataset(name, data=np.array(self._numbers[name], kind), track_times=False)
        if self._events:
            self._write_counts()
        describe(self._file, HISTOGRAM_COLUMNS)

    def _create(self, name: str, shape: tuple[int, ...], kind: Any, **choices: Any) -> Any:
        return self._file.create_dataset(name, shape, kind, chunks=self._chunk, track_times=False, **PACKED, **choices)

    def _write_counts(self) -> None:
        indices, counts = zip(*self._events, strict=True)
        sizes = [part.size for part in counts]
        kind = np.min_scalar_type(max((int(part.max(initial=0)) for part in counts), default=0))
        shape = self._expected.shape[1:]
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


class HistogramFile:
    """The histograms of an open file, by scene index and by sample id; `fields`: which of `HISTOGRAM_FIELDS` it may
    hold."""

    def __init__(self, file: Hdf5File, shape: tuple[int, int]) -> None:
        self._scenes, self._samples = (
            {int(number): row for row, number in enumerate(file.array(name, _KINDS[name], (None,)))}
            for name in ("scene", "sample")
        )
        scenes, samples = len(file.stored("scene", np.int32, (None,))), len(file.stored("sample", np.int64, (None,)))
        self._expected = file.stored("expected", np.float16, (scenes, *shape, None))
        self.shape: tuple[int, ...] = self._expected.shape[1:]
        self._polarisation = None
        self.fields = HISTOGRAM_FIELDS if "polarisation" in file else HISTOGRAM_FIELDS[:-1]
        if "polarisation" in file:
            self._polarisation = file.stored("polarisation", np.float16, self._expected.shape)
        self._counts = file.stored("counts", _COUNTS, (samples, *self.shape)) if "counts" in file else None
        self._starts: NDArray[np.int64] | None = None
        if "event_start" in file:
            self._starts = file.array("event_start", np.int64, (samples + 1,))
            self._index = file.stored("event_index", np.uint32, (None,))
            self._events = file.stored("event_count", _COUNTS, (len(self._index),))
            if self._starts[0] != 0 or self._starts[-1] != len(self._index) or (np.diff(self._starts) < 0).any():
                file.refuse("event_start", f"does not divide {len(self._index)} events")
        self.path = file.path

    def expected(self, scene: int) -> NDArray[np.float32] | None:
        """Expected counts of a frame `[H, W, T]`; None for a scene that was not traced."""
        row = self._scenes.get(scene)
        return None if row is None else self._expected[row].astype(np.float32)

    def polarisation(self, scene: int) -> NDArray[np.float32] | None:
        """Degree of polarisation `[H, W, T]`; None for a scene that was not traced, or without polarised light."""
        row = self._scenes.get(scene)
        return None if row is None or self._polarisation is None else self._polarisation[row].astype(np.float32)

    def counts(self, sample: int) -> NDArray[np.float32] | None:
        """Counts `[H, W, T]` of a frame; None where there are none."""
        row = self._samples.get(sample)
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


def _cube(index: NDArray[Any], counts: NDArray[Any], shape: tuple[int, ...], kind: Any) -> NDArray[Any]:
    cube = np.zeros(int(np.prod(shape)), kind)
    cube[index] = counts
    return cube.reshape(shape)


# ---- The files of one shard, put together in memory; the same recipe gives the same bytes.


_LIBRARY = ("v110", "v110")  # one version of the file format, whichever HDF5 writes it
_READ_OFTEN = ("depth", "bound")


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
        for name, (shape, kind, unit, text) in scene_columns(plan.shape).items():
            # The low-level interface, since h5py's own virtual datasets hold the time of day.
            layout = h5p.create(h5p.DATASET_CREATE)
            layout.set_layout(h5d.VIRTUAL)
            layout.set_obj_track_times(False)
            whole, rest = (plan.scene_count, *shape), (0,) * len(shape)
            for shard in plan.shards:
                part = (shard.scenes, *shape)
                space = h5s.create_simple(whole)
                space.select_hyperslab((shard.first_scene, *rest), part)
                layout.set_virtual(space, shard.scenes_file.encode(), name.encode(), h5s.create_simple(part))
            dtype = np.dtype(kind)
            if dtype.kind == "f":
                layout.set_fill_value(np.array([np.nan], dtype))
            h5d.create(file.id, name.encode(), h5t.py_create(dtype, logical=True), h5s.create_simple(whole), layout)
            file[name].attrs.update({"unit": unit, "description": text})


def checksum(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"bytes": path.stat().st_size, "sha256": digest}


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


def _fill(plan: Plan, shard: Shard, files: list[Any], *, device: str | None, threads: int | None) -> None:
    frames_file, scenes_file = files[:2]
    each, (height, width) = plan.frames_per_scene, plan.shape
    packed = plan.recipe.frames.compression == "gzip"
    stored, count = {}, shard.scenes * each
    for name, columns, kind in (
        ("depth", width, np.uint16),
        ("label", (width + 7) // 8, np.uint8),
        ("intensity", width, np.uint8),
    ):
        how: dict[str, Any] = {"chunks": (1, height, columns), **PACKED} if packed else {}
        stored[name] = frames_file.create_dataset(name, (count, height, columns), kind, track_times=False, **how)
    stored["depth"].attrs.update({"step": plan.depth_step, "offset": plan.depth_offset})
    stored["intensity"].attrs["step"] = 1.0
    rows: dict[str, list[NDArray[Any]]] = {name: [] for name in FRAME_COLUMNS if name not in stored}
    table = scene_columns(plan.shape)
    records: dict[str, list[Any]] = {name: [] for name in table}
    histograms = None
    if len(files) > 2:
        traced = sum(plan.is_traced(index) for index in shard.indices)
        histograms = HistogramWriter(files[2], traced, counts=plan.recipe.monte_carlo.counts)

    for number, rendered in enumerate(_rendered(plan, shard, device, threads)):
        part, frames = slice(number * each, (number + 1) * each), rendered.frames
        for name, codes in (("depth", frames.depth), ("label", frames.labels), ("intensity", frames.intensity)):
            stored[name][part] = codes
        for name, value in _frame_rows(plan, shard, rendered).items():
            rows[name].append(value)
        for name, value in scene_row(plan, rendered).items():
            records[name].append(value)
        if histograms is not None and rendered.histograms is not None:
            histograms.add(rendered, rows["sample"][-1])

    if histograms is not None:
        histograms.close()
    for name, parts in rows.items():
        frames_file.create_dataset(name, data=np.concatenate(parts), track_times=False)
    describe(frames_file, FRAME_COLUMNS)
    for name, (shape, kind, _, _) in table.items():
        pack = name == "config" or (len(shape) > 1 and (packed or name not in _READ_OFTEN))
        how = {"chunks": (1, *shape), **PACKED} if pack else {}
        scenes_file.create_dataset(name, data=np.array(records[name], dtype=kind), track_times=False, **how)
    describe(scenes_file, {name: column[2:] for name, column in table.items()})


def _frame_rows(plan: Plan, shard: Shard, rendered: RenderedScene) -> dict[str, NDArray[Any]]:
    draw, count = rendered.draw, plan.frames_per_scene
    first = draw.index * count
    same = {
        "scene": np.int32(draw.index),
        "seed": np.uint64(plan.split_seeds[shard.split] if draw.photons is None else draw.seed),
        "target": np.int32(draw.target),
        "attenuation_lengths": np.float32(draw.attenuation_lengths),
        "distance": np.float32(draw.distance),
        "pulses": np.int64(rendered.scene.pulses_per_depth_frame),
        "intensity_step": np.float32(rendered.frames.intensity_step),
    }
    return {
        **{name: np.full(count, value) for name, value in same.items()},
        "sample": np.arange(first, first + count, dtype=np.int64),
        "backscatter_fraction": np.array(draw.fractions, np.float32),
    }


def render_scene(plan: Plan, index: int, *, device: str | None = None, threads: int | None = None) -> RenderedScene:
    """Draws the scene `index` and renders it on a device.

    Raises `ConfigError` for one that shows nothing, `DeviceError` where the device fails.
    """
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
                waiting.append(pool.submit(render_scene, plan, index, device=device, threads=threads))
                if len(waiting) > workers + 1:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


# ---- A shard's files open for reading, compared with the dataset's manifest before anything is read.


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
        """A column of `spadwarp.dataset.shards.scene_columns`, its first dimension the scenes."""
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
        raise FileError(f"{path}: no such file; `spadwarp dataset make` makes what is missing")
    return open_hdf5(path, format, version=FORMAT_VERSION)
