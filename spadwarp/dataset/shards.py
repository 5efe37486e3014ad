"""The files of one shard: frames, and the scenes that they are of. The same recipe gives the same bytes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.files import atomic_path
from spadwarp.hardware import core_count, pick_device

from .plan import Plan, Shard
from .scenes import PROFILE_BINS, RenderedScene, render_scene

__all__ = ["FORMAT_VERSION", "FRAME_COLUMNS", "checksum", "scene_columns", "write_scene_index", "write_shard"]

FORMAT_VERSION = 1

FRAME_COLUMNS: dict[str, tuple[str, str]] = {
    "depth": ("m", "noisy planar depth = offset + step * code; code 0: no return"),
    "label": ("1", "the pixel reports backscatter or other background: np.packbits along rows, first pixel highest"),
    "intensity": ("1", "recorded photons = intensity_step of the frame * code, cut at 255"),
    "scene": ("1", "index into scenes.h5"),
    "sample": ("1", "id of the frame in the whole dataset"),
    "seed": ("1", "key of the frame's random numbers, together with its sample id"),
    "target": ("1", "index into the targets of manifest.json"),
    "backscatter_fraction": ("1", "BS, requested part of the pixels that report backscatter; NaN: by the photon rates"),
    "attenuation_lengths": ("1", "extinction times distance, one way"),
    "distance": ("m", "of the target's centre along the optical axis"),
    "pulses": ("1", "laser pulses of the frame"),
    "intensity_step": ("1", "recorded photons per unit of intensity"),
}
"""Datasets of a frames file, all with one first dimension: unit and meaning."""

_PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
_READ_OFTEN = ("depth", "bound")
_LIBRARY = ("v110", "v110")  # one version of the file format, whichever HDF5 writes it


def scene_columns(plan: Plan) -> dict[str, tuple[tuple[int, ...], Any, str, str]]:
    """Datasets of `scenes.h5`, all with one first dimension: shape of a row, type, unit, meaning."""
    height, width = plan.shape
    real: Any = np.float32
    numbers = {
        "distance": ("m", "of the target's centre along the optical axis"),
        "attenuation_lengths": ("1", "extinction times distance, one way"),
        "absorption": ("1/m", "a"),
        "scattering": ("1/m", "b"),
        "extinction": ("1/m", "c = a + b"),
        "anisotropy": ("1", "g, mean cosine of the scattering angle"),
        "group_index": ("1", "light travels at 299792458 m/s over this"),
        "gate_near": ("m", "range at which the gate opens"),
        "gate_far": ("m", "range at which the gate closes"),
        "reflectance": ("1", "of the target"),
        "pulses": ("1", "laser pulses of a frame"),
        "signal": ("1", "expected detections of the return per pulse, median over the target's pixels"),
        "backscatter": ("1", "expected backscatter detections per pulse within the gate, median over pixels"),
        "pulse_energy": ("J", "of the laser"),
        "pulse_fwhm": ("s", "of the laser"),
        "jitter_fwhm": ("s", "of the detector"),
        "pde": ("1", "photon detection efficiency"),
        "dark_count_rate": ("1/s", "of a pixel"),
    }
    return {
        "depth": ((height, width), real, "m", "true planar depth; NaN where nothing is hit"),
        "bound": ((height, width), real, "m", "Cramér–Rao bound of the depth in one frame; NaN for no estimate"),
        "normal": ((height, width, 3), np.float16, "1", "unit normals towards the camera"),
        "albedo": ((height, width), np.float16, "1", "Lambertian reflectance"),
        "backscatter_profile": (
            (PROFILE_BINS,),
            real,
            "1/m",
            "density of the water's backscatter over depth on the axis",
        ),
        "profile_edges": ((PROFILE_BINS + 1,), real, "m", "edges of the profile's bins"),
        "target": ((), np.int32, "1", "index into the targets of manifest.json"),
        "target_name": ((), "S64", "1", "its name"),
        "translation": ((3,), real, "m", "of the target"),
        "rotation_deg": ((3,), real, "deg", "of the target about its own x, y, z"),
        "scale": ((3,), real, "1", "of the target"),
        "laser_position": ((3,), real, "m", "in the camera frame"),
        **{name: ((), np.float64, unit, text) for name, (unit, text) in numbers.items()},
        "config": ((), "S8192", "1", "the scene as TOML"),
    }


def write_shard(
    plan: Plan,
    shard: Shard,
    folder: Path,
    *,
    device: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Makes a shard's two files in `folder`, each whole or not at all; returns their sizes and checksums by name.

    `progress` is told how many frames more there are. Raises `FileError` where they cannot be written.
    """
    import h5py

    frames, row = shard.scenes * plan.frames_per_scene, (plan.frames_per_scene,)
    height, width = plan.shape
    images: dict[str, tuple[tuple[int, ...], Any]] = {
        "depth": ((height, width), np.uint16),
        "label": ((height, (width + 7) // 8), np.uint8),
        "intensity": ((height, width), np.uint8),
    }
    packed = plan.recipe.frames.compression == "gzip"
    rows: dict[str, list[NDArray[Any]]] = {name: [] for name in FRAME_COLUMNS if name not in images}
    records: dict[str, list[Any]] = {name: [] for name in scene_columns(plan)}
    with atomic_path(folder / shard.frames_file) as temporary, h5py.File(temporary, "w", libver=_LIBRARY) as file:
        file.attrs.update(_shard_attributes(plan, shard, "spadwarp frames"))
        stored = {}
        for name, (shape, kind) in images.items():
            how: dict[str, Any] = {"chunks": (1, *shape), **_PACKED} if packed else {}
            stored[name] = file.create_dataset(name, (frames, *shape), kind, track_times=False, **how)
        stored["depth"].attrs.update({"step": plan.depth_step, "offset": plan.depth_offset})
        stored["intensity"].attrs["step"] = 1.0
        for number, one in enumerate(_rendered(plan, shard, device)):
            part = slice(number * plan.frames_per_scene, (number + 1) * plan.frames_per_scene)
            stored["depth"][part] = one.depth_codes
            stored["label"][part] = one.label_bytes
            stored["intensity"][part] = one.intensity_codes
            draw = one.draw
            first = draw.index * plan.frames_per_scene
            values: dict[str, NDArray[Any]] = {
                "scene": np.full(row, draw.index, np.int32),
                "sample": np.arange(first, first + plan.frames_per_scene, dtype=np.int64),
                "seed": np.full(row, plan.split_seeds[shard.split], np.uint64),
                "target": np.full(row, draw.target, np.int32),
                "backscatter_fraction": np.array(draw.fractions, np.float32),
                "attenuation_lengths": np.full(row, draw.attenuation_lengths, np.float32),
                "distance": np.full(row, draw.distance, np.float32),
                "pulses": np.full(row, one.scene.analytic.pulses, np.int64),
                "intensity_step": np.full(row, one.intensity_step, np.float32),
            }
            for name, value in values.items():
                rows[name].append(value)
            for name, value in _scene_row(plan, one).items():
                records[name].append(value)
            if progress is not None:
                progress(plan.frames_per_scene)
        for name, parts in rows.items():
            stored[name] = file.create_dataset(name, data=np.concatenate(parts), track_times=False)
        for name, (unit, text) in FRAME_COLUMNS.items():
            stored[name].attrs.update({"unit": unit, "description": text})
    with atomic_path(folder / shard.scenes_file) as temporary, h5py.File(temporary, "w", libver=_LIBRARY) as file:
        file.attrs.update(_shard_attributes(plan, shard, "spadwarp scenes"))
        for name, (shape, kind, unit, text) in scene_columns(plan).items():
            how = {}
            if name == "config" or (len(shape) > 1 and (packed or name not in _READ_OFTEN)):
                how = {"chunks": (1, *shape), **_PACKED}
            data = np.array(records[name], dtype=kind)
            one_set = file.create_dataset(name, data=data, track_times=False, **how)
            one_set.attrs.update({"unit": unit, "description": text})
    return {name: checksum(folder / name) for name in (shard.frames_file, shard.scenes_file)}


def write_scene_index(plan: Plan, folder: Path) -> dict[str, Any]:
    """`scenes.h5`: the scenes of all shards as one, by reference; rows of shards that are not there are NaN or 0."""
    import h5py
    from h5py import h5d, h5p, h5s, h5t

    with atomic_path(folder / "scenes.h5") as temporary, h5py.File(temporary, "w", libver=_LIBRARY) as file:
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
    return checksum(folder / "scenes.h5")


def checksum(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"bytes": path.stat().st_size, "sha256": digest}


def _rendered(plan: Plan, shard: Shard, device: str | None) -> Iterator[RenderedScene]:
    """The shard's scenes in order, a few made at a time where the CPU makes them."""

    def work(index: int) -> RenderedScene:
        return render_scene(plan, plan.scene(index), device=device)

    indices = range(shard.first_scene, shard.first_scene + shard.scenes)
    workers = 1 if pick_device(device).is_cuda else min(core_count(), shard.scenes)
    with ThreadPoolExecutor(workers) as pool:
        yield from _in_order(pool, work, indices, ahead=workers + 1)


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


def _shard_attributes(plan: Plan, shard: Shard, kind: str) -> dict[str, Any]:
    from spadwarp import __version__

    return {
        "format": kind,
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "name": plan.recipe.name,
        "recipe_seed": str(plan.recipe.seed),
        "split": shard.split,
        "split_seed": str(plan.split_seeds[shard.split]),
        "target": plan.targets[shard.target].name,
        "shard": shard.index,
        "shards": len(plan.shards),
        "read_me": "Images [frame, height, width]; camera frame +x right, +y down, +z forward; depth is planar (z).",
    }


def _scene_row(plan: Plan, one: RenderedScene) -> dict[str, Any]:
    scene, draw = one.scene, one.draw
    target, medium = scene.targets[0], scene.medium
    speed = 299_792_458.0 / medium.group_index
    return {
        "depth": one.depth,
        "bound": one.bound,
        "normal": one.normal,
        "albedo": one.albedo,
        "backscatter_profile": one.profile,
        "profile_edges": one.profile_edges,
        "target": draw.target,
        "target_name": plan.targets[draw.target].name,
        "translation": target.translation,
        "rotation_deg": target.rotation_deg,
        "scale": target.scale,
        "laser_position": scene.laser.position,
        "distance": draw.distance,
        "attenuation_lengths": draw.attenuation_lengths,
        "absorption": medium.absorption,
        "scattering": medium.scattering,
        "extinction": medium.extinction,
        "anisotropy": medium.anisotropy,
        "group_index": medium.group_index,
        "gate_near": 0.5 * scene.gate.start * speed,
        "gate_far": 0.5 * scene.gate.stop * speed,
        "reflectance": target.reflectance,
        "pulses": scene.analytic.pulses,
        "signal": one.signal,
        "backscatter": one.backscatter,
        "pulse_energy": scene.laser.pulse_energy,
        "pulse_fwhm": 1e-12 * scene.laser.pulse_fwhm_ps,
        "jitter_fwhm": 1e-12 * scene.detector.jitter_fwhm_ps,
        "pde": scene.detector.pde,
        "dark_count_rate": scene.detector.dark_count_rate,
        "config": scene.to_toml().encode(),
    }
