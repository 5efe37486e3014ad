"""Frames of any source, one at a time, and all that there is in the formats of other programs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic import AnalyticFile
from spadwarp.arrays import on_host
from spadwarp.dataset import FrameReader
from spadwarp.dataset.recipe import SPLITS
from spadwarp.errors import ArgumentError, FileError
from spadwarp.files.loader import load, locate
from spadwarp.frames import Frames, FramesFile, SequenceFile
from spadwarp.frames import export as writers
from spadwarp.frames.export import FrameSequence, SequenceFrame
from spadwarp.io.arrays import write_array, write_exr
from spadwarp.limits import check_choice
from spadwarp.result import Channel, analyser_channel
from spadwarp.result.result import COMPONENTS, Result
from spadwarp.scene import noise_rate
from spadwarp.scene.camera import CALIBRATION_ENDINGS, save_calibration

__all__ = ["FORMATS", "export", "export_sensor_fusion", "open_source", "sequence"]

FORMATS = (".npy", ".mat", ".ptu", ".exr", *CALIBRATION_ENDINGS)
"""Endings of the files that `export` writes."""

_DATASET_IMAGES = {"Z": "noisy", "truth.Z": "clean", "background": "label", "intensity": "intensity", "bound": "bound"}
_TRUTH_CHANNELS = {"Z": "depth", "range": "range", "reflectance": "reflectance"}


def open_source(source: Any, *, result: Result | None = None, split: str = "all") -> Result | FrameSequence:
    """A result or frames: in memory, in a file, or in a directory; see `load`.

    Args:
        source: A `Result`, `Frames`, what `load` returns, or a path.
        result: From which `Frames` were drawn.
        split: Of a dataset.

    Raises:
        ArgumentError: A source of another type.
        FileError: Not a file of ours, or damaged.
    """
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
        still = {"scene": file.scene, "depth": file.truth_depth, "content": "".join(content)}
        if file.expected is not None:
            still["expected"] = file.expected * pulses
        if file.expected is not None and file.background is not None:
            still["background"] = _mean_background(file.background, file.expected.shape) * file.pulses
        return still

    def frame(number: int) -> SequenceFrame:
        depths = {f"{method}.Z": file.depth(method, number) for method in file.methods}
        images, of_scene = {"Z": depths[f"{best}.Z"]} if best else {}, facts(number)
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
        item, scene = depth[number], depth.scene(number)
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
) -> list[Path]:
    """Writes a result, frames or a dataset in another program's format, which the ending of `path` selects.

    - `.npy`: a result's expected histogram `[H, W, T]` (fraction of the emitted photons); counts `[H, W, T]`, of many
      frames `[frames, H, W, T]`; where there is depth alone, as in datasets of the analytic simulator, depth `[H, W]`
      or `[frames, H, W]` [m].
    - `.mat`: counts of one frame as the simulated data that single-photon denoisers train on (Lindell et al. 2018):
      `spad` sparse `[W·H, T]`, whose row is y + H·x; `rates` `[H, W, T]`, the expected counts that `spad` was drawn
      from; `bin` `[H, W]`, the bin of the true time of flight counted from 1, 0 without one; `bin_size` [s]; `depth`
      [m], 0 without a target; `intensity` in [0, 1]; `SBR`; `mean_signal_photons` and `mean_background_photons` of a
      pixel. Also under the names that some readers know: `range_bins` for `bin`, `photons` for `mean_signal_photons`.
    - `.ptu`: counts as a T3 image of PicoQuant, one record a detection, the frames one after the other. Times start at
      the window's start, which the comment of the file states, as behind a delayed sync.
    - `.exr`: images of one frame: depth `Z` [m], `intensity`, `truth.Z` and what else the source has: components of a
      result, `<method>.Z` of each estimator, `background` where the pixel reports it, the bound of the depth.
    - `.xml`, `.yml`, `.yaml`, `.json`: the camera's calibration, as OpenCV's `cv::FileStorage` reads it.

    Args:
        source: A `Result`, `Frames`, the file of one (`result.h5`, `frames.h5`, `analytic.h5`), or the folder of a
            dataset.
        path: The file. Of many frames `.mat` and `.exr` hold one each: `name-00000.mat`, `name-00001.mat`, …
        frames: Only this one, from 0, or these.
        split: Of a dataset: "train", "validation", "test" or "all".
        result: The result that the `Frames` were drawn from; `.mat` needs its truth.
        channel: Of a result: which light counts, see `spadwarp.result.analyser_channel`.

    Returns:
        The files that were written.

    Raises:
        ArgumentError: No such frame, or what the format holds is not in the source.
        FileError: A file cannot be read or written, or the package for its format is not installed.
    """
    path = Path(path)
    check_choice("split", split, (*SPLITS, "all"))
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise FileError(f"{path}: ending {path.suffix!r} is not one of {', '.join(FORMATS)}")
    source = Path(source) if isinstance(source, os.PathLike) else source
    try:
        opened = open_source(source, result=result, split=split)
        if ending in CALIBRATION_ENDINGS:
            return [_write_calibration(opened, path)]
        if isinstance(opened, Result):
            return [_write_result(analyser_channel(opened, channel), path, ending, frames)]
        if channel != "I":
            raise ArgumentError(f"channel = {channel!r}: only results have channels")
        chosen = _chosen(opened, frames)
        if ending in (".npy", ".ptu"):
            return [(writers.write_npy if ending == ".npy" else writers.write_ptu)(opened, path, chosen)]
        write = writers.write_mat if ending == ".mat" else writers.write_exr_frame
        numbered = {number: path.with_name(f"{path.stem}-{number:05}{path.suffix}") for number in chosen}
        return [write(opened, numbered[number] if len(chosen) > 1 else path, number) for number in chosen]
    except ModuleNotFoundError as error:
        raise FileError(f"{path}: writing it needs {error.name}: pip install 'spadwarp[formats]'") from error


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

    Raises:
        ArgumentError: No such frame, or no counts, or no scene of meshes.
        FileError: A file cannot be read or written.
    """
    check_choice("split", split, (*SPLITS, "all"))
    opened = open_source(source, result=result, split=split)
    if isinstance(opened, Result):
        raise ArgumentError("a result holds expected histograms: draw frames first (`spadwarp detect`)")
    return writers.write_sensor_fusion(opened, Path(folder), stem, _chosen(opened, frames), factor)


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
    if ending == ".exr":
        channels: dict[str, Any] = {"Z": result.depth(), "intensity": result.intensity}
        for name, tallies in zip(COMPONENTS, result.tallies, strict=True):
            channels[name] = tallies.sum(axis=-1, dtype=np.float64) * result.tally_value
        truth = result.truth
        channels |= {f"truth.{name}": getattr(truth, field) for name, field in _TRUTH_CHANNELS.items()}
        channels |= {f"truth.N.{axis}": truth.normal[..., index] for index, axis in enumerate("XYZ")}
        content = "expected depth (centroid), fractions of the light"
        return write_exr(path, channels, writers.exr_metadata(result.scene, content))
    raise ArgumentError(
        f"a result holds expected histograms, and {ending} is for counts: draw frames first (`spadwarp detect`)"
    )
