"""Frames of any source, one at a time, and all that there is in the formats of other programs: of lidars single photons
with position and truth, as a table or a LAS file, and waveforms of each shot, too."""

from __future__ import annotations

import os
import shutil
import struct
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic import AnalyticFile
from spadwarp.arrays import Floats, on_host
from spadwarp.dataset import SPLITS, FrameReader
from spadwarp.files.loader import load, locate
from spadwarp.frames import Frames, FramesFile, Receiver, SequenceFile, detect
from spadwarp.io.arrays import write_array, write_exr
from spadwarp.io.paths import atomic_path, write_file
from spadwarp.io.text import json_text, write_text
from spadwarp.result import Channel, Result, analyser_channel
from spadwarp.result.file import exr_notes
from spadwarp.scene import Scene, noise_rate, shots_of
from spadwarp.scene.camera import CALIBRATION_ENDINGS, save_calibration, to_world
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport import target_map, truth_maps
from spadwarp.values import ArgumentError, FileError, check_choice, check_integer, path_from_time, time_from_path

__all__ = ["FORMATS", "LIDAR_FORMATS", "PhotonCloud", "export", "export_sensor_fusion", "open_source", "photon_cloud"]
__all__ += ["sequence", "write_lidar"]

LIDAR_FORMATS = (".parquet", ".las", ".laz", ".wdp")
"""Endings of the files that `write_lidar` writes."""

FORMATS = (".npy", ".npz", ".png", ".mat", ".ptu", ".exr", ".zarr", *LIDAR_FORMATS, *CALIBRATION_ENDINGS)
"""Endings of the files that `export` writes."""

_DATASET_IMAGES = {"Z": "noisy", "truth.Z": "clean", "background": "label", "intensity": "intensity", "bound": "bound"}
_TRUTH_CHANNELS = {"Z": "depth", "range": "range", "reflectance": "reflectance"}
_LARGEST_VARIABLE = 2**31 - 1  # bytes of one array in a MATLAB 5 file
_LARGEST_DTIME = 32768  # bins of a T3 record of PicoQuant


@dataclass(frozen=True, eq=False, kw_only=True)
class SequenceFrame:
    """One frame of any source; without counts where there is depth alone."""

    images: dict[str, NDArray[Any]]  # name → `[H, W]`; `Z` is the depth [m] where the source has it
    counts: NDArray[Any] | None = None  # `[H, W, T]`
    expected: NDArray[np.float32] | None = None  # `[H, W, T]`, before pile-up, of all light and noise
    background: float | None = None  # its part that is not target, counts of a pixel over all bins, mean over pixels
    pulses: int = 0  # as of `Frames`, like the next three
    gate_start: float = 0.0
    bin_width: float = 0.0
    period: float | None = None
    scene: Scene | None = None  # what the camera looked at
    depth: NDArray[np.float32] | None = None  # true depth [m] `[H, W]`
    content: str = ""  # what the images are, in words

    @property
    def main(self) -> NDArray[Any]:
        """Counts, or depth where there are none."""
        return self.images["Z"] if self.counts is None else self.counts

    def bins_of(self, scene: Scene, depth: NDArray[np.float32]) -> NDArray[np.float64]:
        """Time of flight in bins from the start of the gate, with its fraction, of depth [m] that a scene's camera sees
        `[H, W]`; NaN where there is none."""
        lines = lines_of_sight(scene)
        path = lines.path_from_range(lines.range_from_depth(depth.astype(np.float64)))
        time = time_from_path(path, scene.medium.group_index) - self.gate_start
        return (time if self.period is None else np.mod(time, self.period)) / self.bin_width


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameSequence:
    """Frames of one source, read one at a time."""

    name: str  # what to call the source in an error
    count: int  # of the frames
    frame: Callable[[int], SequenceFrame]  # number of a frame, from 0 → the frame
    same_scene: Callable[[int], range] | None = None  # → numbers of all frames of its scene; None: frames have counts

    def at(self, number: int) -> SequenceFrame:
        """A frame; `ArgumentError` for a number that is not there."""
        if not 0 <= number < self.count:
            raise ArgumentError(f"frame = {number} is outside [0, {self.count}), the frames of {self.name}")
        return self.frame(number)

    def with_counts(self, number: int, ending: str) -> tuple[SequenceFrame, NDArray[Any]]:
        """A frame and its counts; `ArgumentError` if it has none, which files of `ending` are for."""
        frame = self.frame(number)
        if frame.counts is None:
            raise ArgumentError(f"{self.name}: frame {number} is depth without counts, which {ending} is for")
        return frame, frame.counts


def open_source(source: Any, *, result: Result | None = None, split: str = "all") -> Result | FrameSequence:
    """A result or frames: in memory, in a file, or in a directory; see `load`.

    Args:
        source: A `Result`, `Frames`, what `load` returns, or a path.
        result: From which `Frames` were drawn.
        split: Of a dataset.

    Raises `ArgumentError`: a source of another type; `FileError`: not a file of ours, or damaged.
    """
    check_choice("split", split, (*SPLITS, "all"))
    if isinstance(source, Frames):
        return _of_frames(source, result)
    if isinstance(source, (str, os.PathLike)):
        place = locate(source)
        source = FrameReader(place, split) if place.is_dir() else load(place)
    return source if isinstance(source, Result) else sequence(source)


def sequence(held: Any) -> FrameSequence:
    """The frames of a `FramesFile`, a `SequenceFile`, an `AnalyticFile` or a `FrameReader`.

    Raises `ArgumentError` for others.
    """
    if isinstance(held, FramesFile | SequenceFile):
        return _of_stored(held)
    if isinstance(held, AnalyticFile):
        return _of_analytic(held)
    if isinstance(held, FrameReader):
        return _of_dataset(held)
    raise ArgumentError(f"source is a {type(held).__name__}; a Result, Frames or a file of one is needed")


def _of_frames(frames: Frames, result: Result | None) -> FrameSequence:
    counts, expected, background = map(on_host, (frames.counts, frames.expected, frames.background))
    counts = counts[None] if frames.summed else counts
    truth = None if result is None else result.truth.depth

    def frame(number: int) -> SequenceFrame:
        return SequenceFrame(
            images={"intensity": counts[number].sum(axis=-1)} | ({} if truth is None else {"truth.Z": truth}),
            counts=counts[number],
            expected=expected * np.float32(frames.exposure),
            background=_mean_background(background, expected.shape) * frames.exposure,
            pulses=frames.exposure,
            gate_start=frames.gate_start,
            bin_width=frames.bin_width,
            period=frames.period,
            scene=None if result is None else result.scene,
            depth=truth,
        )

    return FrameSequence(name="Frames", count=len(counts), frame=frame)


def _of_stored(file: FramesFile | SequenceFile) -> FrameSequence:
    best, pulses = file.best_method, np.float32(file.pulses)
    known = {name: getattr(file, name) for name in ("pulses", "gate_start", "bin_width", "period")}

    def facts(number: int) -> dict[str, Any]:
        content = [f"Z by {best}"] if best else []
        if isinstance(file, SequenceFile):
            return {
                "scene": file.scene(number),
                "depth": file.truth(number).depth,
                "expected": file.expected(number) * pulses,
                "background": file.background(number) * file.bins * file.pulses,
                "content": ", ".join([*content, f"{file.trajectory.times[number]:g} s"]),
            }
        return {
            "scene": file.scene,
            "depth": file.truth_depth,
            "expected": file.expected * pulses,
            "background": _mean_background(file.background, file.expected.shape) * file.pulses,
            "content": "".join(content),
        }

    def frame(number: int) -> SequenceFrame:
        depths = {f"{method}.Z": file.depth(method, number) for method in file.methods}
        of_scene = facts(number)
        images: dict[str, Any] = {"Z": depths[f"{best}.Z"]} if best else {}
        images |= {"intensity": file.intensity(number), **depths, "truth.Z": of_scene["depth"]}
        return SequenceFrame(images=images, counts=file.counts(number), **known, **of_scene)

    return FrameSequence(name=str(file.path), count=file.frames, frame=frame)


def _of_analytic(file: AnalyticFile) -> FrameSequence:
    truth = file.truth.depth

    def frame(number: int) -> SequenceFrame:
        images = {"Z": file.depth(number), "background": file.labels(number).astype(np.float32), "truth.Z": truth}
        return SequenceFrame(images=images, scene=file.scene, depth=truth, content="Z by the analytic simulator")

    return FrameSequence(name=str(file.path), count=file.frames, frame=frame, same_scene=lambda _: range(file.frames))


def _of_dataset(reader: FrameReader) -> FrameSequence:
    depth = reader.with_fields("noisy", "clean", "label", "intensity", "bound")
    histograms = reader.with_fields("counts", "expected")
    photons, pulses, backscatter = map(depth.scene_numbers, ("photons", "pulses", "backscatter"))

    def frame(number: int) -> SequenceFrame:
        item, scene = cast(dict[str, Any], depth[number]), depth.scene(number)
        row = int(item["scene"])
        common: dict[str, Any] = {
            "images": {name: item[field][0] for name, field in _DATASET_IMAGES.items()},
            "scene": scene,
            "depth": item["clean"][0],
            "content": f"sample {int(item['sample'])}",
        }
        if not photons[row]:
            return SequenceFrame(**common)
        cubes = histograms[number]
        noise = float(np.mean(noise_rate(scene))) * scene.gate.bins * scene.gate.bin_width
        return SequenceFrame(
            counts=np.moveaxis(cubes["counts"], 0, -1).astype(np.uint32),
            expected=np.ascontiguousarray(np.moveaxis(cubes["expected"], 0, -1)),
            background=(float(backscatter[row]) + noise) * int(pulses[row]),
            pulses=int(pulses[row]),
            gate_start=scene.gate.start,
            bin_width=scene.gate.bin_width,
            period=1.0 / scene.laser.repetition_rate if scene.detector.wrap else None,
            **common,
        )

    return FrameSequence(name=str(reader.path), count=len(depth), frame=frame, same_scene=depth.same_scene)


def _mean_background(background: NDArray[np.float32], shape: tuple[int, ...]) -> float:
    """Expected background of a pixel per pulse over all bins, mean over pixels."""
    return float(np.broadcast_to(background, shape).mean(dtype=np.float64)) * shape[-1]


# Formats of other programs


def export(
    source: Result | Frames | str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    frames: int | slice | None = None,
    split: str = "all",
    result: Result | None = None,
    channel: Channel = "I",
    seed: int = 0,
) -> list[Path]:
    """Writes a result, frames or a dataset in another program's format, which the ending of `path` selects.

    `.npy`, `.npz`, `.png`, `.mat`, `.ptu`, `.exr`, `.zarr`, `.parquet`, `.las`, `.laz`, `.wdp`; the calibration of the
    camera as `.xml`, `.yml`, `.yaml`, `.json`. What they hold: docs/formats.md, "Other programs' formats".

    Args:
        source: A `Result`, `Frames`, the file of one (`result.h5`, `frames.h5`, `analytic.h5`), or the folder of a
            dataset.
        path: The file. Of many frames `.mat`, `.exr` and `.png` hold one each: `name-00000.mat`, `name-00001.mat`, …
        frames: Only this one, from 0, or these.
        split: Of a dataset: "train", "validation", "test" or "all".
        result: The result that the `Frames` were drawn from; `.mat` needs its truth.
        channel: Of a result: which light counts, see `spadwarp.result.analyser_channel`.
        seed: Of the photons of `.parquet`, `.las`, `.laz` and `.wdp`.

    Returns the files that were written. Raises `ArgumentError`: no such frame, or what the format holds is not in the
    source; `FileError`: a file cannot be read or written, or the package for its format is not installed.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise FileError(f"{path}: ending {path.suffix!r} is not one of {', '.join(FORMATS)}")
    source = Path(source) if isinstance(source, os.PathLike) else source
    opened = open_source(source, result=result, split=split)
    if ending in CALIBRATION_ENDINGS:
        return [_write_calibration(opened, path)]
    if isinstance(opened, Result):
        light = analyser_channel(opened, channel)
        if ending in LIDAR_FORMATS:
            return write_lidar(light, path, seed=seed)
        if ending == ".zarr":
            return [_write_zarr(light, path)]
        return [_write_result(light, path, ending, frames)]
    if ending in (".zarr", *LIDAR_FORMATS):
        raise ArgumentError(f"{ending} is for a result: it has what frames do not hold")
    if channel != "I":
        raise ArgumentError(f"channel = {channel!r}: only results have channels")
    chosen = _chosen(opened, frames)
    whole = {".npy": _write_npy, ".npz": _write_npz, ".ptu": _write_ptu}
    if ending in whole:
        return [whole[ending](opened, path, chosen)]
    write = {".mat": _write_mat, ".exr": _write_exr_frame, ".png": _write_png}[ending]
    numbered = {number: path.with_name(f"{path.stem}-{number:05}{path.suffix}") for number in chosen}
    return [write(opened, numbered[number] if len(chosen) > 1 else path, number) for number in chosen]


def export_sensor_fusion(
    source: Frames | str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    stem: str = "frames",
    factor: int = 8,
    frames: int | slice | None = None,
    split: str = "all",
    result: Result | None = None,
) -> list[Path]:
    """Writes frames beside a camera image of finer pixels, as the loader of Lindell, O'Toole and Wetzstein (2018) for
    sensor fusion reads them.

    - `intensity/STEM-00000.mat`: `intensity` `[factor · H, factor · W]`, 0 to 255: reflectance times the cosine of the
      angle of view, as a photo with a flash without scattering.
    - `spad/STEM-00000_p1.mat`: the variables of `export`, and `bin_hr` `[factor · H, factor · W]`, the bin of the
      true time of flight, counted from 1 at its centre and with its fraction, within [1, T]; 0 without a target.
    - `STEM.txt`: the list of the intensity files, which the loader takes.

    Args:
        source: Frames with counts, of scenes whose targets are meshes, as for `export`.
        folder: Where they are written.
        stem: Of the files' names.
        factor: Pixels of the camera image in a pixel, each way, in [1, 64].
        frames, split, result: As for `export`.

    Raises `ArgumentError`: no such frame, or no counts, or no scene of meshes; `FileError`: a file cannot be read or
    written.
    """
    opened, folder = open_source(source, result=result, split=split), Path(folder)
    if isinstance(opened, Result):
        raise ArgumentError("a result holds expected histograms: draw frames first (`spadwarp detect`)")
    factor = check_integer("factor", factor, "[1, 64]")
    listed: list[str] = []
    written: list[Path] = []
    images: dict[Scene, dict[str, Any]] = {}
    for number in _chosen(opened, frames):
        frame, _ = opened.with_counts(number, "sensor fusion")
        if frame.scene is None or not frame.scene.targets:
            raise ArgumentError(f"{opened.name}: frame {number} has no scene of meshes to take a finer image of")
        if frame.scene not in images:
            images = {frame.scene: _camera_image(frame, factor)}  # frames of one scene follow each other
        image = images[frame.scene]
        name = f"{stem}-{number:05}"
        written += [
            _save_mat(folder / "intensity" / f"{name}.mat", {"intensity": image["intensity"]}),
            _write_mat(opened, folder / "spad" / f"{name}_p1.mat", number, extra={"bin_hr": image["bin_hr"]}),
        ]
        listed.append(f"{os.path.abspath(written[-2])}\n")
    return [*written, write_text("".join(listed), folder / f"{stem}.txt")]


def _camera_image(frame: SequenceFrame, factor: int) -> dict[str, NDArray[Any]]:
    """Truth of a camera of the same place and view with `factor` times as many pixels each way."""
    assert frame.scene is not None and frame.counts is not None
    camera, tables, bins = frame.scene.camera, frame.scene.to_dict(), frame.counts.shape[-1]
    (fx, fy), (column, row) = camera.focal_pixels, camera.principal_point
    pose: dict[str, Any] = {"position": list(camera.position), "rotation_deg": list(camera.rotation_deg)}
    sides = {"width": factor * camera.width, "height": factor * camera.height}
    lens: dict[str, Any] = {"fx": factor * fx, "fy": factor * fy, "cx": factor * column - 0.5, "cy": factor * row - 0.5}
    lens |= {"distortion": list(camera.distortion), "pinhole": True, "aperture_diameter": 0.01}
    tables["camera"] = {**sides, **lens, **pose}
    tables.pop("scan", None)
    scene = Scene.from_dict(tables, source=frame.scene.source)
    truth = truth_maps(scene, device="cpu")
    position = frame.bins_of(scene, truth.depth)
    inside = (position >= 0) & (position < bins)
    cosine = -np.einsum("hwi,hwi->hw", truth.normal, lines_of_sight(scene).direction)
    light = np.nan_to_num(truth.reflectance * np.clip(cosine, 0.0, 1.0))
    return {
        "bin_hr": np.where(inside, np.clip(position + 0.5, 1.0, bins), 0.0),
        "intensity": (255.0 * light / max(float(light.max()), 1e-300)).astype(np.float32),
    }


def _write_calibration(opened: Result | FrameSequence, path: Path) -> Path:
    scene = opened.scene if isinstance(opened, Result) else opened.at(0).scene
    if scene is None:
        raise ArgumentError("result is missing: its scene has the camera")
    return save_calibration(scene.camera, path)


def _chosen(source: FrameSequence, frames: int | slice | None) -> range:
    every = range(source.count)
    if isinstance(frames, int):
        if frames not in every:
            raise ArgumentError(f"frames = {frames} is outside [0, {source.count - 1}]")
        return every[frames : frames + 1]
    chosen = every if frames is None else every[frames]
    if not chosen:
        ends = (None, None) if frames is None else (frames.start, frames.stop)
        text = ":".join("" if end is None else str(end) for end in ends)
        raise ArgumentError(f"{source.name} holds {source.count} frames, none of them in {text}")
    return chosen


def _write_result(result: Result, path: Path, ending: str, frames: Any) -> Path:
    if frames is not None:
        raise ArgumentError(f"frames = {frames}: a result holds expected histograms, not frames")
    if ending == ".npy":
        return write_array(path, result.histogram)
    if ending == ".npz":
        gate = result.scene.gate
        arrays = {"histogram": result.histogram, "true_depth": result.truth.depth}
        return _save_npz(path, arrays, _time_axis(gate.start, gate.bin_width, result.scene), gate.bins)
    if ending == ".png":
        return _save_png(path, result.depth())
    if ending == ".exr":
        channels: dict[str, Any] = {"Z": result.depth(), "intensity": result.intensity}
        for name, tallies in zip(result.scene.components, result.tallies, strict=True):
            channels[name] = tallies.sum(axis=-1, dtype=np.float64) * result.tally_value
        truth = result.truth
        channels |= {f"truth.{name}": getattr(truth, field) for name, field in _TRUTH_CHANNELS.items()}
        channels |= {f"truth.N.{axis}": truth.normal[..., index] for index, axis in enumerate("XYZ")}
        content = "expected depth (centroid), fractions of the light"
        return write_exr(path, channels, exr_notes(content, result.scene))
    raise ArgumentError(
        f"a result holds expected histograms, and {ending} is for counts: draw frames first (`spadwarp detect`)"
    )


# Writers


def _write_zarr(result: Result, path: Path) -> Path:
    import zarr  # noqa: F401, xarray's own error names no package

    if path.exists() and not (path / "zarr.json").is_file():
        raise FileError(f"{path} exists, and is not a Zarr store to replace")
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as made, warnings.catch_warnings():
        # Version 3 of the format does not yet have names as fixed-length text, says zarr.
        warnings.simplefilter("ignore")
        try:
            result.to_xarray().to_zarr(Path(made) / "store")
            if path.exists():
                shutil.rmtree(path)
            os.replace(Path(made) / "store", path)
        except OSError as error:
            raise FileError(f"{path}: cannot be written: {error}") from error
    return path


def _write_npy(frames: FrameSequence, path: Path, chosen: range) -> Path:
    """Counts `[H, W, T]`, or depth `[H, W]` where there are none; of several frames with these before."""
    first, several = frames.frame(chosen[0]).main, len(chosen) > 1
    with atomic_path(path) as temporary:
        shape = (len(chosen), *first.shape) if several else first.shape
        array = np.lib.format.open_memmap(temporary, mode="w+", dtype=first.dtype, shape=shape)
        for row, number in enumerate(chosen):
            array[row if several else ...] = frames.frame(number).main
        array.flush()
        del array
    return path


def _time_axis(start: float, width: float, scene: Scene | None) -> dict[str, float]:
    """What turns a bin into a time of flight, and that into a length, by the names of our own files."""
    water = {} if scene is None else {"group_index": scene.medium.group_index}
    return {"gate_start": start, "bin_width": width, **water}


def _save_npz(path: Path, arrays: dict[str, Any], axis: dict[str, Any], bins: int) -> Path:
    time = axis["gate_start"] + (np.arange(bins) + 0.5) * axis["bin_width"]
    return write_file(path, partial(np.savez_compressed, **arrays, **axis, time=time))


def _write_npz(frames: FrameSequence, path: Path, chosen: range) -> Path:
    """As `_write_npy`, with axes."""
    first, cubes = frames.frame(chosen[0]), [frames.frame(number).main for number in chosen]
    whole = cubes[0] if len(cubes) == 1 else np.stack(cubes)
    if first.counts is None:
        return write_file(path, partial(np.savez_compressed, depth=whole))
    arrays = {"counts": whole, "pulses": first.pulses} | ({} if first.depth is None else {"true_depth": first.depth})
    return _save_npz(path, arrays, _time_axis(first.gate_start, first.bin_width, first.scene), whole.shape[-1])


def _save_png(path: Path, depth: NDArray[Any]) -> Path:
    from PIL import Image

    millimetres = np.nan_to_num(np.rint(1e3 * np.asarray(depth, np.float64)))
    millimetres[(millimetres < 0) | (millimetres > 65535)] = 0
    return write_file(path, partial(Image.fromarray(millimetres.astype(np.uint16)).save, format="PNG"))


def _write_png(frames: FrameSequence, path: Path, number: int) -> Path:
    images = frames.frame(number).images
    if "Z" not in images:
        raise ArgumentError(f"{frames.name}: frame {number} has no depth, which .png is for")
    return _save_png(path, images["Z"])


def _write_mat(
    frames: FrameSequence, path: Path, number: int, *, extra: Mapping[str, NDArray[Any]] | None = None
) -> Path:
    """One frame as single-photon denoisers read it; `spadwarp.export` lists the variables. `extra`: further ones."""
    from scipy.sparse import csc_matrix

    frame, counts = frames.with_counts(number, ".mat")
    height, width, bins = counts.shape
    if frame.scene is None or frame.depth is None:
        raise ArgumentError("result is missing: .mat holds the truth of the scene that the counts were drawn from")
    if frame.expected is None or frame.background is None:
        raise ArgumentError(f"{frames.name} does not hold the expected counts of its frames: draw them anew")
    if 4 * counts.size > _LARGEST_VARIABLE:
        raise FileError(f"{path}: {height} x {width} x {bins} values are more than a MATLAB 5 file can hold")
    total = frame.expected.sum(axis=-1, dtype=np.float64)
    signal = np.clip(total - frame.background, 0.0, None)
    photons = max(float(total.mean()) - frame.background, 0.0)
    true_bins = np.floor(frame.bins_of(frame.scene, frame.depth)) + 1.0
    true_bins = np.where((true_bins >= 1) & (true_bins <= bins), true_bins, 0.0)
    variables = {
        # Pixels column by column, as MATLAB's reshape takes them.
        "spad": csc_matrix(counts.transpose(1, 0, 2).reshape(width * height, bins).astype(np.float64)),
        "rates": frame.expected,
        "bin": true_bins,
        "range_bins": true_bins,
        "bin_size": frame.bin_width,
        **_time_axis(frame.gate_start, frame.bin_width, frame.scene),
        "depth": np.nan_to_num(frame.depth),
        "intensity": (signal / max(float(signal.max()), 1e-300)).astype(np.float32),
        "SBR": photons / frame.background if frame.background > 0 else np.inf,
        "photons": photons,
        "mean_signal_photons": photons,
        "mean_background_photons": frame.background,
        "pulses": float(frame.pulses),
        **(extra or {}),
    }
    return _save_mat(path, variables)


def _save_mat(path: Path, variables: Mapping[str, Any]) -> Path:
    from scipy.io import savemat

    return write_file(path, lambda file: savemat(file, variables, do_compression=True))


def _write_ptu(frames: FrameSequence, path: Path, chosen: range) -> Path:
    """Counts as a T3 image of PicoQuant, one record a detection, the frames one after the other.

    With the tags that `phconvert` asks for, and the records of a MultiHarp, whose markers `tttrlib` knows, too.
    """
    import ptufile

    from spadwarp.values import __version__

    first, counts = frames.with_counts(chosen[0], ".ptu")
    height, width, bins = counts.shape
    if bins > _LARGEST_DTIME:
        raise FileError(f"{path}: {bins} bins are more than the {_LARGEST_DTIME} of a T3 record")
    most = max(int(frames.with_counts(number, ".ptu")[1].sum(axis=-1).max()) for number in chosen)
    sync = max(first.period or 0.0, bins * first.bin_width)
    # A pixel lasts long enough for its detections, one a sync.
    pixel_time = sync * max(most, 1)
    # Side of a pixel at the median depth of what it looks at [um]; 1 where that is not known.
    seen = np.nan if first.depth is None or np.isnan(first.depth).all() else float(np.nanmedian(first.depth))
    side = 1.0 if first.scene is None or np.isnan(seen) else 1e6 * seen * first.scene.camera.pixel_tangent
    comment = (
        f"Counts of a simulated SPAD array, {first.pulses} pulses a frame. "
        f"Bin 0 begins at {first.gate_start * 1e9:.6f} ns of flight"
        + ("." if first.scene is None else f", group index {first.scene.medium.group_index:.6f}.")
    )
    with (
        atomic_path(path) as temporary,
        ptufile.PtuWriter(
            temporary,
            (1, height, width, 1, bins),
            global_resolution=sync,
            tcspc_resolution=first.bin_width,
            pixel_time=pixel_time,
            pixel_resolution=side,
            record_type=ptufile.PtuRecordType.GenericT3,
            comment=comment,
            tags={
                "CreatorSW_Name": "spadwarp",
                "CreatorSW_Version": __version__,
                "HW_Type": "simulated SPAD array",
                "HW_Version": "1",
                "HW_SerialNo": "0",
                "MeasDesc_AcquisitionTime": max(1, round(1e3 * pixel_time * width * height * len(chosen))),  # [ms]
            },
        ) as file,
    ):
        for number in chosen:
            frame, counts = frames.with_counts(number, ".ptu")
            if (frame.gate_start, frame.bin_width) != (first.gate_start, first.bin_width):
                raise ArgumentError(f"frames {chosen[0]} and {number} have different gates: a .ptu file has one")
            file.write(np.ascontiguousarray(counts, np.uint32))
    return path


def _write_exr_frame(frames: FrameSequence, path: Path, number: int) -> Path:
    """The images of one frame."""
    frame, channels = frames.frame(number), {}
    for name, image in frame.images.items():  # EXR's integers have no sign, and few programs show them
        channels[name] = image.astype(np.float32) if image.dtype.kind in "iu" else image
    content = f"frame {number} of {frames.count}" + (f", {frame.content}" if frame.content else "")
    return write_exr(path, channels, exr_notes(content, frame.scene))


# What a lidar delivers

NOISE = "noise"

# Classes of ASPRS for bathymetry: 40 bottom or object, 41 water surface, 45 water column, 7 noise.
_CLASSES = {"surface": 41, "ballistic": 40, "forward_scattered": 40, "backscatter": 45, NOISE: 7}

_COORDINATE = 1e-4  # unit of coordinates in a LAS file [m]
_HEADER = 60  # bytes of the record that a file of waveforms begins with


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotonCloud:
    """Detections one by one, in the order of shot and time: arrays `[N]`."""

    shot: NDArray[np.int32]  # number of the shot, from 0; without a scan 0
    row: NDArray[np.int32]  # of the pixel that has it
    column: NDArray[np.int32]
    pulse: NDArray[np.int64]  # number of the pulse in the shot
    time: Floats  # when the pulse was emitted, from the first pulse of all on [s]
    time_of_flight: Floats  # middle of the bin [s]
    position: Floats  # on the line of sight of its pixel at that time of flight, in the world [m], `[N, 3]`
    component: NDArray[np.int8]  # index into `components`: where it is from
    components: tuple[str, ...]  # those of a result, and "noise": dark counts, ambient light, crosstalk
    target: NDArray[np.int32]  # the target on the line of sight, from 0; -1 for none
    true_range: NDArray[np.float32]  # of that target [m]; NaN for none

    def __len__(self) -> int:
        return len(self.shot)

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns of the table; `component` as text."""
        arrays = {name: array for name, array in vars(self).items() if name not in ("position", "components")}
        arrays |= dict(zip("xyz", self.position.T, strict=True))
        return arrays | {"component": np.array(self.components)[self.component]}


def photon_cloud(result: Result, *, seed: int = 0, device: str | None = None) -> PhotonCloud:
    """The detections of one frame of a result's detector, each with its position and the component it is from.

    Detections are those of `spadwarp.detect` with dead time, pile-up, jitter and noise. A detector does not tell
    photons apart, so that one at a time is of each component with the share that this has of the expected detections
    there; what afterpulses follow gives them its share. Where the detector's time wraps, positions are those of the
    first period.

    Raises what `detect` and `shots_of` raise.
    """
    frames = detect(result, seed=seed, tags=True, device=device)
    assert frames.tags is not None
    _, row, column, pulse, tag_bin = frames.tags
    scene, at = result.scene, (row, column)
    middle = frames.gate_start + 0.5 * (frames.edges[:-1] + frames.edges[1:])
    flight = middle[tag_bin]
    shot = _shot_numbers(result)[at]
    emitted = (shot * float(frames.pulses) + pulse) / scene.laser.repetition_rate
    return PhotonCloud(
        shot=shot,
        row=row.astype(np.int32),
        column=column.astype(np.int32),
        pulse=pulse.astype(np.int64),
        time=np.asarray(emitted, np.float64),
        time_of_flight=flight,
        position=_positions(result, at, flight),
        component=_components(result, frames, (*at, tag_bin), seed),
        components=(*scene.components, NOISE),
        target=target_map(scene, device=device)[at],
        true_range=result.truth.range[at],
    )


def _shot_numbers(result: Result) -> NDArray[np.int32]:
    """The shot in which each pixel sees, `[H, W]`."""
    scene, (height, width) = result.scene, result.truth.depth.shape
    number = np.arange(height * width) // (height * width // scene.scan_positions)
    return number.reshape(height, width).astype(np.int32)


def _positions(result: Result, at: tuple[Any, Any], flight: Floats) -> Floats:
    """Points of the world [m] on the lines of sight of pixels at times of flight, or where these lines begin."""
    scene = result.scene
    lines = lines_of_sight(scene)[at]
    ranges = lines.range_from_path(path_from_time(flight, scene.medium.group_index))
    points = lines.points(np.where(np.isnan(ranges), lines.lead, ranges))
    if scene.scan.mode != "trajectory":
        return to_world(scene.camera, points)
    shots, number = shots_of(scene), _shot_numbers(result)[at]
    return np.einsum("nij,nj->ni", shots.rotation[number], points) + shots.position[number]


def _components(result: Result, frames: Frames, at: tuple[Any, Any, Any], seed: int) -> NDArray[np.int8]:
    """Drawn for detections in voxels, by what each component and the noise are expected to bring there."""
    import warp as wp

    scene = result.scene
    scale, gate = scene.detectable_photons_per_pulse, scene.gate
    axis, shape = (gate.start, gate.bin_width), result.truth.depth.shape
    choices: dict[str, Any] = {"shape": (*shape, gate.bins), "axis": axis, "device": wp.get_device("cpu")}
    receiver = Receiver.of(scene.detector, scene.laser, irf=frames.irf, **choices)
    dark = wp.zeros(shape[0] * shape[1], dtype=wp.float32, device="cpu")
    left = np.random.Generator(np.random.Philox(key=[seed, 0x70686F74])).random(len(at[0])) * frames.expected[at]
    noise = len(scene.components)
    component = np.full(len(left), noise, np.int8)
    for number, name in enumerate(scene.components):
        light = (result.expected(name) * scale).astype(np.float32).reshape(-1, gate.bins)
        rows: Any = wp.array(light, device="cpu")
        share = receiver.light(rows, dark).numpy().reshape(*shape, -1)[at]
        component[(component == noise) & (left < share)] = number
        left = left - share
    return component


def write_lidar(result: Result, path: Path, *, seed: int = 0) -> list[Path]:
    """Writes what a lidar delivers of one frame of a result; the ending of `path` selects it, see `spadwarp.export`.

    Returns the files. Raises `ArgumentError`: no detection, or bins that a file of waveforms cannot have.
    """
    ending = path.suffix.lower()
    if ending == ".wdp":
        return _write_waveforms(result, path, seed)
    cloud = photon_cloud(result, seed=seed)
    if not len(cloud):
        raise ArgumentError("no photon was detected: more pulses (detector.pulses_per_frame), or a brighter laser")
    if ending == ".parquet":
        import pyarrow
        import pyarrow.parquet

        axis = _time_axis(result.scene.gate.start, result.scene.gate.bin_width, result.scene)
        table = pyarrow.table(cloud.columns(), metadata={name: str(value) for name, value in axis.items()})
        return [write_file(path, partial(pyarrow.parquet.write_table, table))]
    return [_write_las(cloud, path, result.scene)]


def _las_header(point_format: int, points: Floats, scene: Scene) -> Any:
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales, header.offsets = np.full(3, _COORDINATE), np.floor(points.min(axis=0))
    header.global_encoding.wkt = True
    header.generating_software = "spadwarp"
    axis = json_text(_time_axis(scene.gate.start, scene.gate.bin_width, scene)).encode()
    header.vlrs.append(laspy.VLR("LASF_Spec", 3, "time of flight, SI units", axis))  # 3: text
    return header


def _write_las(cloud: PhotonCloud, path: Path, scene: Scene) -> Path:
    """A point for each photon, format 6."""
    import laspy

    header = _las_header(6, cloud.position, scene)
    extra = {name: getattr(cloud, name) for name in ("shot", "pulse", "time_of_flight", "component", "target")}
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=array.dtype) for name, array in extra.items()])
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.position.T
    las.gps_time = cloud.time
    las.classification = np.array([_CLASSES[name] for name in cloud.components], np.uint8)[cloud.component]
    las.return_number, las.number_of_returns = _returns(cloud)
    for name, array in extra.items():
        las[name] = array
    return write_file(path, lambda file: las.write(file, do_compress=path.suffix.lower() == ".laz"))


def _returns(cloud: PhotonCloud) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Number of each photon among those of its pixel and pulse, from 1, and how many there are; 15 at most."""
    of_pulse = np.stack([cloud.row, cloud.column, cloud.pulse])
    first = np.append(True, (np.diff(of_pulse, axis=1) != 0).any(axis=0))
    begin = np.flatnonzero(first)
    count = np.diff(np.append(begin, len(cloud)))
    number = np.arange(len(cloud)) - np.repeat(begin, count) + 1
    return np.minimum(number, 15).astype(np.uint8), np.minimum(np.repeat(count, count), 15).astype(np.uint8)


def _write_waveforms(result: Result, path: Path, seed: int) -> list[Path]:
    """A point, format 9, at the fullest bin of each pixel that has counts, and beside it the counts of all its bins."""
    import laspy

    scene, frames = result.scene, detect(result, seed=seed, tags=True)  # the same as of the photons
    spacing = 1e12 * frames.bin_width
    if abs(spacing - round(spacing)) > 1e-6 * spacing:
        text = f"gate.bin_width_ps = {spacing:.6g}: samples of a LAS file are whole picoseconds apart"
        raise ArgumentError(text)
    counts = frames.counts[0]
    at: tuple[Any, Any] = np.nonzero(counts.any(axis=2))  # type: ignore[assignment]
    if not len(at[0]):
        raise ArgumentError("no photon was detected: more pulses (detector.pulses_per_frame), or a brighter laser")
    samples = counts[at].astype("<u4" if counts.max() > 0xFFFF else "<u2")
    peak = samples.argmax(axis=1)
    flight = frames.gate_start + (peak + 0.5) * frames.bin_width
    points = _positions(result, at, flight)
    header = _las_header(9, points, scene)
    header.global_encoding.waveform_data_packets_external = True
    descriptor = laspy.vlrs.known.WaveformPacketVlr(100, "counts of time bins")
    fields = (8 * samples.itemsize, 0, samples.shape[1], round(spacing), 1.0, 0.0)
    descriptor.parse_record_data(struct.pack("<BBIIdd", *fields))
    header.vlrs.append(descriptor)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    shot, size = _shot_numbers(result)[at], samples.shape[1] * samples.itemsize
    las.gps_time = shot * (frames.pulses / scene.laser.repetition_rate)
    las.intensity = np.minimum(samples.max(axis=1), 0xFFFF)
    las.return_number = las.number_of_returns = np.ones(len(shot), np.uint8)
    las.wavepacket_index = np.ones(len(shot), np.uint8)
    las.wavepacket_offset = _HEADER + size * np.arange(len(shot), dtype=np.uint64)
    las.wavepacket_size = np.full(len(shot), size, np.uint32)
    las.return_point_wave_location = (peak + 0.5) * spacing
    # Along the line of sight, as fast as the light of the last two bins there and back.
    end: Floats = np.full(len(peak), frames.gate_start + frames.edges[-1])
    step = _positions(result, at, end) - _positions(result, at, end - frames.bin_width)
    las.x_t, las.y_t, las.z_t = (step / spacing).T
    head = struct.pack("<H16sHQ32s", 0, b"LASF_Spec", 65535, samples.nbytes, b"waveform data packets")
    write_file(path, lambda file: file.write(head + samples.tobytes()))
    return [write_file(path.with_suffix(".las"), partial(las.write, do_compress=False)), path]
