"""A result as one HDF5 file; results added up; depth and truth as EXR, also from other programs."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.io.arrays import read_exr, write_exr
from spadwarp.io.hdf5 import Coordinate, Hdf5File, image_chunks, name_dimensions, read_hdf5, write_hdf5, write_packed
from spadwarp.io.paths import file_within
from spadwarp.io.text import read_toml
from spadwarp.result.photon_ids import joined
from spadwarp.result.result import (
    ARRAYS,
    DIMENSION_OF,
    TABLES,
    Reconstruction,
    Result,
    ResultHead,
    Truth,
    arrays_of,
    coordinates_of,
    shape_of,
    water_of,
)
from spadwarp.result.tallies import (
    FluxTallies,
    SignedTallies,
    added,
    flux_arrays,
    moments_of,
    part_of,
    rebatched,
    total_of,
)
from spadwarp.scene import Scene
from spadwarp.scene.camera import camera_attributes, pixel_directions
from spadwarp.scene.scan import shots_of
from spadwarp.values import ArgumentError, ConfigError, FileError, check_choice, check_integer, check_real, shown

__all__ = ["ResultLike", "as_result", "load_result", "load_truth_exr", "load_truth_maps", "merge"]
__all__ += ["save_depth_exr", "save_result", "save_truth_maps"]

FORMAT = "spadwarp result"
FORMAT_VERSION = 1

_UNITS = "[1e-30, 1e30]"  # photons
# As JSON: its integers have no limit.
_RECORDS = ("energy_balance", "counters", "batch_moments", "timing", "provenance")
_DIMENSIONS = {
    name: (tuple(entry["dimensions"]), entry["unit"], entry["meaning"])
    for name, entry in (TABLES["arrays"] | TABLES["described"]).items()
}


def save_result(result: Result, path: str | Path, *, compression: int = 1) -> Path:
    """Writes a result to one HDF5 file from which `load_result` makes an equal one; returns its path.

    Args:
        result: What to write.
        path: The file; an existing one is replaced when the new one is whole.
        compression: Level of gzip, 1 (fast) to 9.

    Raises `FileError`: the file cannot be written.
    """
    compression = check_integer("compression", compression, "[1, 9]")
    chunk = image_chunks(result.tallies.shape[1:], 8)
    options = {"compression": "gzip", "compression_opts": compression, "shuffle": True, "fletcher32": True}
    arrays = arrays_of(result)
    if result.scene.scan_positions > 1:
        arrays["photons_per_position"] = result.unit / result.tally_value
    if result.scene.scan.mode == "trajectory":  # when and where each pixel sees, for readers of the file alone
        shots = shots_of(result.scene)
        position, line = shots.lines()
        arrays |= {"shot/time": shots.time[shots.number], "shot/position": position, "shot/line_of_sight": line}
    arrays |= {name: np.array(getattr(result, name), dtype=np.uint64) for name in ("photon_ranges", "requested")}
    coordinates: dict[str, Coordinate | int | None] = {
        **coordinates_of(result),
        "bin_edges": ("bin_edges", "s", "time of flight at the edges of the bins"),
        "word": (["low", "high"], "1", "64 bits of a number of 128"),
        "run": len(result.photon_ranges),
        "limit": (["start", "stop"], "1", "of photon ids"),
    }
    with write_hdf5(path) as file:
        head = {"format": FORMAT, "format_version": FORMAT_VERSION, "read_me": TABLES["read_me"]}
        signed = result.signed_tallies
        names: dict[str, Any] = {} if signed is None else {signed.group: list(signed.names)}
        file.attrs.update({**head, **_attributes(result), **names})
        for name, array in arrays.items():
            dimensions = _DIMENSIONS[name][0]
            if "time" in dimensions:
                chunks = (*[1] * (array.ndim - len(chunk)), *chunk)
                write_packed(file, name, array, chunks=chunks, compression=compression)
            else:
                file.create_dataset(name, data=array, **(options if "y" in dimensions else {}))
        file.create_dataset("bin_edges", data=result.bin_edges)
        axes, described = _write_flux(file, result, options)
        file.create_dataset("config", data=result.scene.to_toml())
        for name in _RECORDS:
            file.create_dataset(name, data=json.dumps(dict(getattr(result, name))))
        name_dimensions(file, coordinates | axes, _DIMENSIONS | described)
    return Path(path)


def load_result(path: str | Path) -> Result:
    """Reads what `save_result` wrote.

    Raises `FileError`: no such file, not a spadwarp result, of a newer format version, damaged, or with arrays that are
    not those of its scene; says which.
    """
    with read_hdf5(path, FORMAT, version=FORMAT_VERSION) as file:
        head = _head(file)
        camera, counts = head.scene.camera, {"component": len(head.scene.components), "time": head.scene.gate.bins}

        def array(name: str) -> Any:
            return file.array(name, ARRAYS[name][0], shape_of(name, camera.height, camera.width, **counts))

        def moment(name: str) -> Any:
            return array(name) if head.batch_size else None

        tallies = array("tallies")
        if tallies.min() < 0:
            file.refuse("tallies", "are negative in some bins")
        signed: Any = None
        for group in ("derivatives", "channels"):
            if group in file:
                names = tuple(np.ravel(file.attribute(group)).tolist())
                if not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
                    file.refuse(group, "are not names")
                counts[DIMENSION_OF[group]] = len(names)
                units, moments = tuple(map(float, array(f"{group}/unit"))), moment(f"{group}/second_moment")
                signed = SignedTallies(group, names, array(f"{group}/tallies"), units, moments)
        kept = Reconstruction.__dataclass_fields__ if "reconstruction" in file else ()
        light = {name: array(f"reconstruction/{name}") for name in kept}
        maps = {name: array(f"truth/{name}") for name in Truth.__dataclass_fields__}
        for name, values in maps.items():
            if np.isinf(values).any():
                file.refuse(f"truth/{name}", "is infinite in some pixels")
        moments = file.integers("batch_moments", bits=256)
        components = head.scene.components
        if not moments.keys() <= moments_of(components, [0] * len(components), 1, 1).keys():
            file.refuse("batch_moments", "are not those of the components")
        made = file.table("provenance")
        parts = made.get("parts", [])
        if not isinstance(parts, list) or not all(isinstance(part, dict) for part in parts):
            file.refuse("provenance", "holds parts that are no tables")
        return Result(
            **vars(head),
            tallies=tallies,
            batches=file.integer("batches", default=0),
            half=moment("half") if "half" in file else None,
            half_photons=file.integer("half_photons", default=0),
            second_moment=moment("second_moment"),
            truth=Truth(**maps),
            reconstruction=Reconstruction(**light) if light else None,
            energy_balance=file.integers("energy_balance"),
            counters=file.integers("counters"),
            batch_moments=moments,
            signed_tallies=signed,
            flux_tallies=_read_flux(file, head) if head.scene.flux else None,
            timing=file.numbers("timing"),
            provenance=made,
        )


def _write_flux(file: Any, result: Result, options: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Writes the integers of the sections of flux and the sums of their squares; returns coordinates and descriptions
    for `name_dimensions`."""
    axes, described, held = dict[str, Any](), dict[str, Any](), result.flux_tallies
    for name, array in flux_arrays(result.scene).items():
        assert held is not None
        section = f"flux/{name.partition('/')[0]}"
        own = {f"{section}/{axis}": coordinate for axis, coordinate in array.dimensions.items()}
        axes |= own
        texts: dict[str, Any] = {
            f"flux/{name}": (held.tallies, (*own,), f"times unit over photons: {array.meaning} [{array.unit}]")
        }
        if held.second_moment is not None:
            text = "sum over batches of the squared tally"
            texts[f"flux/{name}_second_moment"] = held.second_moment, ("word", *own), text
        for place, (entries, dimensions, text) in texts.items():
            file.create_dataset(place, data=part_of(entries, array), **options).attrs["unit"] = array.value
            described[place] = dimensions, "1", text
    return axes, described


def _read_flux(file: Hdf5File, head: ResultHead) -> FluxTallies:
    """The sections' tallies of a file, one after another."""
    size = sum(section.size for section in head.scene.flux)
    tallies = np.zeros(size, np.int64)
    moments = np.zeros((2, size), np.uint64) if head.batch_size else None
    for name, array in flux_arrays(head.scene).items():
        part_of(tallies, array)[...] = file.array(f"flux/{name}", np.int64, array.shape)
        if moments is not None:
            held = file.array(f"flux/{name}_second_moment", np.uint64, (2, *array.shape))
            part_of(moments, array)[...] = held
    return FluxTallies(tallies, moments)


ResultLike = Result | str | os.PathLike[str]


def as_result(result: ResultLike, name: str = "result") -> Result:
    """A result as it is, or that of a file or of a run's directory.

    Raises `ArgumentError` for anything else, with the argument's name, and what `load_result` raises.
    """
    if isinstance(result, str | os.PathLike):
        return load_result(file_within(Path(result), ("result.h5",)))
    if not isinstance(result, Result):
        raise ArgumentError(f"{name} = {shown(result)} is neither a Result nor the path of one")
    return result


def read_head(path: str | Path) -> ResultHead:
    """Of the result in a file. Raises `FileError`."""
    with read_hdf5(path, FORMAT, version=FORMAT_VERSION) as file:
        return _head(file)


def _head(file: Hdf5File) -> ResultHead:
    ranges = tuple((int(start), int(stop)) for start, stop in file.array("photon_ranges", np.uint64, (None, 2)))
    if not ranges or any(start >= stop for start, stop in ranges) or len(joined(ranges)) > len(ranges):
        file.refuse("photon_ranges", "are not ranges of photon ids")
    start, stop = map(int, file.array("requested", np.uint64, (2,)))
    if not start <= ranges[0][0] < ranges[-1][1] <= stop:
        file.refuse("requested", f"from {start} to {stop} does not hold the photons that were traced")
    focus = file.attribute("camera_focus_distance")  # NaN stands for all depths
    focus = focus if isinstance(focus, float) and np.isnan(focus) else file.real("camera_focus_distance", "(0, inf]")
    return ResultHead(
        scene=Scene.from_toml(file.text("config"), source=file.text_attribute("source", None)),
        unit=file.real("unit", _UNITS),
        photons=file.integer("photons"),
        seed=file.integer("seed"),
        energy_balance_unit=file.real("energy_balance_unit", _UNITS),
        partial=file.flag("partial"),
        batch_size=file.integer("batch_size", default=0),
        photon_ranges=ranges,
        requested=(start, stop),
        file_hashes=tuple(file.text_attribute("file_hashes", "").split()),
        focus_distance=None if np.isnan(focus) else focus,
    )


def _attributes(result: Result) -> dict[str, Any]:
    """What readers of the file alone need, in SI units."""
    scene = result.scene
    medium, laser, camera, detector, gate = scene.medium, scene.laser, scene.camera, scene.detector, scene.gate
    own = ("unit", "photons", "energy_balance_unit", "partial", "batch_size", "batches", "half_photons")
    values = {
        **{name: getattr(result, name) for name in own},
        "seed": str(result.seed),
        "file_hashes": " ".join(result.file_hashes),
        "components": list(scene.components),
        "gate_start": gate.start,
        "bin_width": gate.bin_width,
        **water_of(scene),
        "molecular_share": medium.molecular_share,
        "phase_index": medium.phase_index,
        "laser_position": scene.beam.position,
        "laser_axis": scene.beam.axis,
        "laser_wavelength": laser.wavelength_nm * 1e-9,
        "laser_pulse_energy": laser.pulse_energy,
        "laser_repetition_rate": laser.repetition_rate,
        "laser_photons_per_pulse": laser.photons_per_pulse,
        "laser_pulse_fwhm": laser.pulse_fwhm_ps * 1e-12,
        "camera_pixel_tangent": camera.pixel_tangent,
        **camera_attributes(camera, result.focus_distance),
        "scan": scene.scan.mode,
        "camera_aperture_area": camera.aperture_area,
        "detector_pde": scene.detections_per_photon,
        "detector_jitter_fwhm": detector.jitter_fwhm_ps * 1e-12,
        "detector_irf": detector.irf,
    }
    return values if scene.source is None else {**values, "source": str(scene.source)}


# Results added up: tallies are integers, so that the order and the devices make no difference


def _physics(scene: Scene) -> Scene:
    """The scene without what does not change a photon's history."""
    transport = scene.transport.model_copy(update={"photons": 1, "seed": 0})
    return scene.model_copy(update={"transport": transport, "output": type(scene.output)()})


def difference(a: ResultHead, b: ResultHead) -> str:
    """What shows that two hold photons of different runs; empty where they are of one."""
    one, other = _physics(a.scene), _physics(b.scene)
    if one != other:
        sections = [name for name in type(one).model_fields if getattr(one, name) != getattr(other, name)]
        return f"the scene of the results differs in {', '.join(sections)}: only photons and output may differ"
    for path, now, before in zip(a.scene.files, a.file_hashes, b.file_hashes, strict=False):
        if now != before:
            return f"{path} is another file than it was: its content has changed between the runs"
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in ("seed", "unit")}
    pairs["presence of errors"] = a.batch_size > 0, b.batch_size > 0
    if isinstance(a, Result) and isinstance(b, Result):
        pairs["list of derivatives"] = tuple(a.derivatives), tuple(b.derivatives)
        pairs["channel"] = a.provenance.get("channel"), b.provenance.get("channel")
        if not same_targets(a.truth, b.truth):
            return TARGETS_DIFFER
    for name, (mine, its) in pairs.items():
        if mine != its:
            return f"the {name.replace('_', ' ')} of the results differs ({mine} and {its})"
    mine, its = a.focus_distance, b.focus_distance
    if mine != its and (mine is None or its is None or not np.isclose(mine, its, rtol=1e-4, atol=0.0)):
        return f"the lenses of the results differ: focus_distance is {mine} and {its} m"
    return ""


TARGETS_DIFFER = "the targets of the results differ, by their truth maps: was a mesh file changed?"


def same_targets(a: Truth, b: Truth) -> bool:
    """Whether two truth maps are of the same targets."""
    return np.allclose(a.range, b.range, rtol=1e-4, equal_nan=True)


def merge(results: Iterable[ResultLike]) -> Result:
    """Adds results of the same scene, seed and unit with disjoint photon ids; bit-identical to one run of all the ids.

    `results` are results or their paths.

    Standard errors are from the batches that the parts had. The ids may leave gaps, which `simulate(resume=)` fills.
    Each part's provenance is in `provenance["parts"]`, with its ids.

    Raises `ArgumentError`: no list of results; `ConfigError`: different scenes (photons and output aside), seeds or
    units, some with errors and some without, or ids that overlap.
    """
    if isinstance(results, str | os.PathLike | Result) or not isinstance(results, Iterable):
        raise ArgumentError(f"results = {shown(results)} is not a list of results or of their paths")
    parts = [as_result(item, "results: an item") for item in results]
    if not parts:
        raise ConfigError("merge: no results given")
    first = parts[0]
    for other in parts[1:]:
        if problem := difference(first, other):
            raise ConfigError(f"merge: {problem}")
    ranges = joined(ids for part in parts for ids in part.photon_ranges)
    provenance = list[dict[str, Any]]()  # of each part, with its photon ids
    for part in parts:
        made = dict(part.provenance)
        provenance += made.pop("parts", None) or [{**made, "photon_ranges": [list(ids) for ids in part.photon_ranges]}]
    head = {name: value for name, value in provenance[0].items() if name != "photon_ranges"}
    size = max(part.batch_size for part in parts)
    total = total_of(*(rebatched(part, size // part.batch_size if size else 1) for part in parts))
    return replace(
        first,
        **vars(total),
        reconstruction=None,
        batch_size=size,
        photons=sum(part.photons for part in parts),
        timing=added(*(part.timing for part in parts)),
        provenance=head if len(provenance) == 1 else {**head, "parts": provenance},
        partial=any(part.partial for part in parts),
        photon_ranges=ranges,
        requested=(min(part.requested[0] for part in parts), max(part.requested[1] for part in parts)),
    )


# Images


def save_truth_maps(result: Result, path: str | Path) -> Path:
    """Truth maps as EXR: Z (planar depth [m]), range [m], N.X, N.Y, N.Z (camera frame), and reflectance in R, G and B.

    NaN where nothing is hit. Raises `FileError`.
    """
    truth = result.truth
    channels = {"Z": truth.depth, "range": truth.range}
    channels |= {f"N.{axis}": truth.normal[..., index] for index, axis in enumerate("XYZ")}
    channels |= dict.fromkeys("RGB", truth.reflectance)
    return write_exr(path, channels, {"R G B": "reflectance", **exr_notes("truth", result.scene, result)})


def load_truth_maps(path: str | Path) -> Truth:
    """Reads what `save_truth_maps` wrote. Raises `FileError`, also for an EXR without its channels."""
    channels, _ = read_exr(path)
    needed = ("Z", "range", "N.X", "N.Y", "N.Z", "R")
    if missing := [name for name in needed if name not in channels]:
        raise FileError(f"{path}: not truth maps: no channel {', '.join(missing)} among {', '.join(channels)}")
    depth, distance, *normal, reflectance = (channels[name].astype(np.float32) for name in needed)
    return Truth(depth=depth, range=distance, normal=np.stack(normal, axis=-1), reflectance=reflectance)


def save_depth_exr(result: Result, depth: ArrayLike, path: str | Path) -> Path:
    """A depth frame of the result as EXR: Z (planar depth [m], NaN where nothing returned). Raises `FileError`."""
    return write_exr(path, {"Z": depth}, exr_notes("measured depth", result.scene, result))


def exr_notes(content: str, scene: Scene | None, result: Result | None = None) -> dict[str, Any]:
    """Metadata of an EXR image of depth."""
    notes: dict[str, Any] = {"content": content, "Z": "planar depth [m]", "frame": "+x right, +y down, +z forward"}
    if scene is not None:
        notes |= {"pixel_tangent": scene.camera.pixel_tangent, "group_index": scene.medium.group_index}
        notes["config"] = scene.to_toml()
    return notes if result is None else {**notes, "photons": result.photons, "seed": result.seed}


# Truth maps from the EXR files that a game engine or Blender writes

_HALF_MAX = 65504.0  # the largest float16, which stands for infinity in files of float16
_PRESETS = read_toml(Path(__file__).with_name("exr_presets.toml"))


def load_truth_exr(
    *,
    depth: str | Path,
    camera: Any,
    preset: Literal["unreal", "blender"] = "unreal",
    depth_channel: str | None = None,
    depth_scale: float | None = None,
    radial: bool = False,
    normal: str | Path | None = None,
    albedo: str | Path | float = 0.5,
    albedo_channel: str | None = None,
    axes: ArrayLike | None = None,
) -> Truth:
    """Truth maps from a program's EXR export, in the camera frame (+x right, +y down, +z forward) and in metres.

    Args:
        depth: File with the depth; float16 and float32 are read as they are.
        camera: The camera that the images were rendered with (`scene.camera`).
        preset: Which program's channels, units and axes hold.
        depth_channel: Name of the depth channel, or the last parts of it (`Depth.Z` finds `ViewLayer.Depth.Z`).
        depth_scale: Metres per unit of depth, > 0.
        radial: Whether depth is the distance from the camera instead of planar depth.
        normal: File with world normals; without, every surface faces the camera.
        albedo: File with the diffuse reflectance, or one number in [0, 1].
        albedo_channel: Its channel.
        axes: `[3, 3]`, the camera's right, down and forward as unit vectors of the program's world; the preset's are
            those of a camera without rotation.

    Returns Truth; NaN where the file has NaN, infinity, 0 or the sky's value. Raises `FileError`: a file that cannot be
    read, without the channel (the message names those it has), of another size than the camera's image, with negative
    depth or albedo outside [0, 1], or with nothing in view; `ArgumentError`: an argument out of range.
    """
    check_choice("preset", preset, [*_PRESETS])
    if camera.port is not None:
        raise ArgumentError("camera.port: rendered truth is of cameras that see along straight lines")
    how, shape, view = _PRESETS[preset], (camera.height, camera.width), pixel_directions(camera)
    scale = check_real("depth_scale", how["depth_scale"] if depth_scale is None else depth_scale, "[1e-9, 1e9]")

    stored = _channel(depth, (depth_channel,) if depth_channel else how["depth_channels"], shape)
    sky = min(how["sky"], _HALF_MAX) if stored.dtype == np.float16 else how["sky"]
    raw = stored.astype(np.float64)
    raw[~np.isfinite(raw) | (raw >= sky) | (raw == 0)] = np.nan
    hit = ~np.isnan(raw)
    if not hit.any():
        raise FileError(f"{depth}: no pixel has a depth: everything is sky, 0 or NaN")
    if (raw[hit] < 0).any():
        raise FileError(f"{depth}: depth {raw[hit].min():g} m is outside (0, inf) m")
    distance = raw * scale if radial else raw * scale / view[..., 2]

    if isinstance(albedo, (str, Path)):
        wanted = (albedo_channel,) if albedo_channel else how["albedo_channels"]
        reflectance = _channel(albedo, wanted, shape).astype(np.float64)
        wrong = hit & ~((reflectance >= 0) & (reflectance <= 1))
        if wrong.any():
            raise FileError(f"{albedo}: albedo {reflectance[wrong][0]:g} is outside [0, 1]")
    else:
        reflectance = np.full(shape, check_real("albedo", albedo, "[0, 1]"))

    normals = -view if normal is None else _normals(normal, how, axes, view, hit)
    return Truth(
        depth=(distance * view[..., 2]).astype(np.float32),
        range=distance.astype(np.float32),
        normal=np.where(hit[..., None], normals, np.nan).astype(np.float32),
        reflectance=np.where(hit, reflectance, np.nan).astype(np.float32),
    )


def _normals(
    path: str | Path, how: dict[str, Any], axes: ArrayLike | None, view: NDArray[np.float64], hit: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Unit normals in the camera frame, on the camera's side."""
    rows = np.asarray(how["axes"] if axes is None else axes, np.float64)
    if rows.shape != (3, 3) or not np.allclose(rows @ rows.T, np.eye(3), atol=1e-4):
        raise ArgumentError(f"axes = {rows.tolist()} are not three orthogonal unit vectors")
    components = [_channel(path, names, hit.shape) for names in zip(*how["normal_channels"], strict=True)]
    normals = np.stack(components, axis=-1).astype(np.float64) @ rows.T
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    if (missing := hit & ~(length[..., 0] > 0.1)).any():
        row, column = np.argwhere(missing)[0]
        raise FileError(f"{path}: no normal at pixel ({row}, {column}), which has a depth")
    if abs((typical := float(np.median(length[hit]))) - 1.0) > 0.05:
        raise FileError(f"{path}: normals of length {typical:.3g}, not 1; colours (n + 1)/2 have to become n first")
    with np.errstate(invalid="ignore", divide="ignore"):
        normals = normals / length
    return np.where(((normals * view).sum(axis=-1) > 0)[..., None], -normals, normals)


def _channel(path: str | Path, names: Sequence[str], shape: tuple[int, ...]) -> NDArray[Any]:
    """The first of the named channels, or the only one that ends in `.name`; float, `[H, W]`."""
    path = Path(path)
    other = path.with_suffix(path.suffix.swapcase())  # engines write `.EXR`
    channels, _ = read_exr(other if other.exists() and not path.exists() else path)
    for name in names:
        found = [key for key in channels if key == name] or [key for key in channels if key.endswith(f".{name}")]
        if len(found) > 1:
            raise FileError(f"{path}: channel {name!r} could be {' or '.join(found)}; name one of them in full")
        if found:
            values = channels[found[0]]
            if values.shape != shape:
                sizes = f"{values.shape[1]} x {values.shape[0]} pixels; the camera has {shape[1]} x {shape[0]}"
                raise FileError(f"{path}: {sizes}")
            return values
    raise FileError(f"{path}: no channel {' or '.join(map(repr, names))}; it has {', '.join(channels)}")
