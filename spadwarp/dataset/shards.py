"""The files of one shard: frames, the scenes that they are of, and histograms. The same recipe gives the same bytes."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.histograms import HistogramWriter
from spadwarp.dataset.render_analytic import render_analytic
from spadwarp.dataset.render_transport import render_transport
from spadwarp.dataset.rendered import RenderedScene
from spadwarp.dataset.sampling import Plan, Shard
from spadwarp.dataset.schema import FORMAT_VERSION, FRAME_COLUMNS, PACKED, describe, scene_columns, scene_row
from spadwarp.device import core_count, pick_device
from spadwarp.errors import DeviceError
from spadwarp.io.hdf5 import write_hdf5
from spadwarp.io.paths import remove_temporaries

__all__ = ["checksum", "render_scene", "write_scene_index", "write_shard"]

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
