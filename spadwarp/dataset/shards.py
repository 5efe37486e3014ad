"""The files of one shard: frames, the scenes that they are of, and histograms. The same recipe gives the same bytes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.histograms import HistogramWriter
from spadwarp.dataset.render_analytic import RenderedScene, render_scene
from spadwarp.dataset.sampling import Plan, Shard
from spadwarp.dataset.schema import FORMAT_VERSION, FRAME_COLUMNS, scene_columns, scene_row
from spadwarp.device import core_count, pick_device
from spadwarp.errors import DeviceError
from spadwarp.io.hdf5 import write_hdf5

__all__ = ["checksum", "write_scene_index", "write_shard"]

_PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
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
        _remove_leftovers(folder / name)
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
        for name, (shape, kind, unit, text) in scene_columns(plan).items():
            # h5py's own virtual datasets hold the time of day.
            how = h5p.create(h5p.DATASET_CREATE)
            how.set_layout(h5d.VIRTUAL)
            how.set_obj_track_times(False)
            whole, rest = (plan.scene_count, *shape), (0,) * len(shape)
            for shard in plan.shards:
                part = (shard.scenes, *shape)
                place = h5s.create_simple(whole)
                place.select_hyperslab((shard.first_scene, *rest), part)
                how.set_virtual(place, shard.scenes_file.encode(), name.encode(), h5s.create_simple(part))
            dtype = np.dtype(kind)
            if dtype.kind == "f":
                how.set_fill_value(np.array([np.nan], dtype))
            h5d.create(file.id, name.encode(), h5t.py_create(dtype, logical=True), h5s.create_simple(whole), how)
            file[name].attrs.update({"unit": unit, "description": text})


def checksum(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"bytes": path.stat().st_size, "sha256": digest}


def _remove_leftovers(path: Path) -> None:
    """Temporary files of runs that were killed over this one."""
    for one in path.parent.glob(f".{path.name}.*.tmp"):
        with suppress(OSError):
            one.unlink()


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
    each = plan.frames_per_scene
    height, width = plan.shape
    images: dict[str, tuple[tuple[int, ...], Any]] = {
        "depth": ((height, width), np.uint16),
        "label": ((height, (width + 7) // 8), np.uint8),
        "intensity": ((height, width), np.uint8),
    }
    packed = plan.recipe.frames.compression == "gzip"
    stored = {}
    for name, (shape, kind) in images.items():
        how: dict[str, Any] = {"chunks": (1, *shape), **_PACKED} if packed else {}
        stored[name] = frames_file.create_dataset(name, (shard.scenes * each, *shape), kind, track_times=False, **how)
    stored["depth"].attrs.update({"step": plan.depth_step, "offset": plan.depth_offset})
    stored["intensity"].attrs["step"] = 1.0
    rows: dict[str, list[NDArray[Any]]] = {name: [] for name in FRAME_COLUMNS if name not in images}
    records: dict[str, list[Any]] = {name: [] for name in scene_columns(plan)}
    histograms = None
    if len(files) > 2:
        traced = sum(plan.is_traced(index) for index in shard.indices)
        histograms = HistogramWriter(files[2], traced, counts=plan.recipe.monte_carlo.counts)

    for number, one in enumerate(_rendered(plan, shard, device, threads)):
        part = slice(number * each, (number + 1) * each)
        stored["depth"][part] = one.frames.depth
        stored["label"][part] = one.frames.labels
        stored["intensity"][part] = one.frames.intensity
        for name, value in _frame_rows(plan, shard, one).items():
            rows[name].append(value)
        for name, value in scene_row(plan, one).items():
            records[name].append(value)
        if histograms is not None and one.histograms is not None:
            histograms.add(one, rows["sample"][-1])

    if histograms is not None:
        histograms.close()
    for name, parts in rows.items():
        stored[name] = frames_file.create_dataset(name, data=np.concatenate(parts), track_times=False)
    for name, (unit, text) in FRAME_COLUMNS.items():
        stored[name].attrs.update({"unit": unit, "description": text})
    for name, (shape, kind, unit, text) in scene_columns(plan).items():
        how = {}
        if name == "config" or (len(shape) > 1 and (packed or name not in _READ_OFTEN)):
            how = {"chunks": (1, *shape), **_PACKED}
        column = scenes_file.create_dataset(name, data=np.array(records[name], dtype=kind), track_times=False, **how)
        column.attrs.update({"unit": unit, "description": text})


def _frame_rows(plan: Plan, shard: Shard, one: RenderedScene) -> dict[str, NDArray[Any]]:
    draw, count = one.draw, plan.frames_per_scene
    first = draw.index * count
    return {
        "scene": np.full(count, draw.index, np.int32),
        "sample": np.arange(first, first + count, dtype=np.int64),
        "seed": np.full(count, plan.split_seeds[shard.split] if draw.photons is None else draw.seed, np.uint64),
        "target": np.full(count, draw.target, np.int32),
        "backscatter_fraction": np.array(draw.fractions, np.float32),
        "attenuation_lengths": np.full(count, draw.attenuation_lengths, np.float32),
        "distance": np.full(count, draw.distance, np.float32),
        "pulses": np.full(count, one.scene.analytic.pulses_per_depth_frame, np.int64),
        "intensity_step": np.full(count, one.frames.intensity_step, np.float32),
    }


def _rendered(plan: Plan, shard: Shard, device: str | None, threads: int | None) -> Iterator[RenderedScene]:
    """The shard's scenes in order, the next one made while one is written; on the CPU one a core."""
    workers = 1
    if not pick_device(device).is_cuda and plan.recipe.monte_carlo.share == 0.0:
        workers = min(threads or core_count(), shard.scenes)

    def work(index: int) -> RenderedScene:
        try:
            return render_scene(plan, index, device=device, threads=threads)
        except RuntimeError as error:  # of the device; else it would pass for one of the file
            raise DeviceError(f"scene {index}: {error}") from error

    with ThreadPoolExecutor(workers) as pool:
        yield from _in_order(pool, work, shard.indices, ahead=workers + 1)


def _in_order(
    pool: ThreadPoolExecutor, work: Callable[[int], RenderedScene], indices: Iterable[int], *, ahead: int
) -> Iterator[RenderedScene]:
    waiting: list[Future[RenderedScene]] = []
    try:
        for index in indices:
            waiting.append(pool.submit(work, index))
            if len(waiting) > ahead:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        for one in waiting:
            one.cancel()
