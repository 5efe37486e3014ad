"""Results, frames and datasets in the formats of other programs: NumPy, MATLAB, PicoQuant, EXR, OpenCV."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from spadwarp.dataset.recipe import SPLITS
from spadwarp.errors import ArgumentError, FileError
from spadwarp.files import open_source
from spadwarp.frames.export import FrameSequence, exr_metadata, write_exr_frame, write_mat, write_npy, write_ptu
from spadwarp.frames.frames import Frames
from spadwarp.io.atomic import atomic_path
from spadwarp.io.exr import write_exr
from spadwarp.limits import check_choice
from spadwarp.result import Channel, analyser_channel
from spadwarp.result.result import COMPONENTS, Result
from spadwarp.run.sensor_fusion import write_sensor_fusion
from spadwarp.scene.calibration import CALIBRATION_ENDINGS, save_calibration

__all__ = ["FORMATS", "export", "export_sensor_fusion"]

FORMATS = (".npy", ".mat", ".ptu", ".exr", *CALIBRATION_ENDINGS)


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
        with open_source(source, result=result, split=split) as opened:
            if ending in CALIBRATION_ENDINGS:
                return [_write_calibration(opened, path)]
            if isinstance(opened, Result):
                return [_write_result(analyser_channel(opened, channel), path, ending, frames)]
            if channel != "I":
                raise ArgumentError(f"channel = {channel!r}: only results have channels")
            chosen = _chosen(opened, frames)
            if ending in (".npy", ".ptu"):
                return [(write_npy if ending == ".npy" else write_ptu)(opened, path, chosen)]
            write = write_mat if ending == ".mat" else write_exr_frame
            return [write(opened, name, number) for number, name in zip(chosen, _numbered(path, chosen), strict=True)]
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
    """Writes frames beside a camera image of finer pixels, in the layout that networks for sensor fusion read.

    The layout is that of Lindell, O'Toole and Wetzstein (2018): see `write_sensor_fusion` for files and variables.

    Args:
        source: Frames with counts, as for `export`.
        folder: For the folders `intensity`, `spad` and the list of the files.
        stem: Of the files' names.
        factor: Pixels of the camera image in a pixel, each way, in [1, 64].
        frames, split, result: As for `export`.

    Raises:
        ArgumentError: No such frame, or no counts, or no scene of meshes.
        FileError: A file cannot be read or written.
    """
    check_choice("split", split, (*SPLITS, "all"))
    with open_source(source, result=result, split=split) as opened:
        if isinstance(opened, Result):
            raise ArgumentError("a result holds expected histograms: draw frames first (`spadwarp detect`)")
        return write_sensor_fusion(opened, Path(folder), stem, _chosen(opened, frames), factor)


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
        asked = ":".join("" if end is None else str(end) for end in ends)
        raise ArgumentError(f"{source.name} holds {source.count} frames, none of them in {asked}")
    return chosen


def _numbered(path: Path, chosen: range) -> list[Path]:
    if len(chosen) == 1:
        return [path]
    return [path.with_name(f"{path.stem}-{number:05}{path.suffix}") for number in chosen]


def _write_result(result: Result, path: Path, ending: str, frames: Any) -> Path:
    if frames is not None:
        raise ArgumentError(f"frames = {frames}: a result holds expected histograms, not frames")
    if ending == ".npy":
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.save(file, result.histogram)
        return path
    if ending == ".exr":
        channels: dict[str, Any] = {"Z": result.depth(), "intensity": result.intensity}
        for name, tallies in zip(COMPONENTS, result.tallies, strict=True):
            channels[name] = tallies.sum(axis=-1, dtype=np.float64) * result.tally_value
        truth = result.truth
        channels |= {f"truth.{name}": getattr(truth, field) for name, field in _TRUTH_CHANNELS.items()}
        channels |= {f"truth.N.{axis}": truth.normal[..., index] for index, axis in enumerate("XYZ")}
        content = "expected depth (centroid), fractions of the light"
        return write_exr(path, channels, exr_metadata(result.scene, content))
    raise ArgumentError(
        f"a result holds expected histograms, and {ending} is for counts: draw frames first (`spadwarp detect`)"
    )


_TRUTH_CHANNELS = {"Z": "depth", "range": "range", "reflectance": "reflectance"}
