"""Results, frames and datasets in the formats of other programs: NumPy, MATLAB, PicoQuant, EXR."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, FileError
from spadwarp.io.atomic import atomic_path
from spadwarp.io.exr import write_exr
from spadwarp.result.result import COMPONENTS, Result
from spadwarp.run.exposures import Exposure, Exposures, opened

if TYPE_CHECKING:
    from spadwarp.frames.frames import Frames
    from spadwarp.scene import Scene

__all__ = ["FORMATS", "export"]

FORMATS = (".npy", ".mat", ".ptu", ".exr")

_LARGEST_VARIABLE = 2**31 - 1  # bytes of one array in a MATLAB 5 file
_LARGEST_DTIME = 32768  # bins that a T3 record of PicoQuant can tell apart


def export(
    source: Result | Frames | str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    frames: int | slice | None = None,
    split: str = "all",
    result: Result | None = None,
) -> list[Path]:
    """Writes a result, frames or a dataset in another program's format, the one that the ending of `path` says.

    - `.npy`: a result's expected histogram `[H, W, T]` (fraction of the emitted photons); counts `[H, W, T]`, of many
      frames `[frames, H, W, T]`; where there is depth alone, as in datasets of the analytic simulator, depth `[H, W]`
      or `[frames, H, W]` [m].
    - `.mat`: counts of one frame as the simulated data that single-photon denoisers train on (Lindell et al. 2018):
      `spad` sparse `[W·H, T]`, whose row is y + H·x; `rates` `[H, W, T]`, the expected counts that `spad` was drawn
      from; `bin` `[H, W]`, the bin of the true time of flight counted from 1, 0 without one; `bin_size` [s]; `depth`
      [m], 0 where nothing is; `intensity` in [0, 1]; `SBR`; `mean_signal_photons` and `mean_background_photons` of a
      pixel. Also under the names that some readers know: `range_bins` for `bin`, `photons` for `mean_signal_photons`.
    - `.ptu`: counts as a T3 image of PicoQuant, one record a detection, the frames one after the other. Times are told
      from the window's start, which the comment of the file states, as behind a delayed sync.
    - `.exr`: images of one frame: depth `Z` [m], `intensity`, `truth.Z` and what else the source has: components of a
      result, `<method>.Z` of each estimator, `background` where the pixel reports it, the bound of the depth.

    Args:
        source: A `Result`, `Frames`, the file of one (`result.h5`, `frames.h5`, `analytic.h5`), or the folder of a
            dataset.
        path: The file. Of many frames `.mat` and `.exr` hold one each: `name-00000.mat`, `name-00001.mat`, …
        frames: Only this one, from 0, or these.
        split: Of a dataset: "train", "validation", "test" or "all".
        result: What the `Frames` were drawn from; `.mat` needs its truth.

    Returns:
        The files that were written.

    Raises:
        ArgumentError: No such frame, or what the format holds is not in the source.
        FileError: A file cannot be read or written, or the package for its format is not installed.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise FileError(f"{path}: ending {path.suffix!r} is not one of {', '.join(FORMATS)}")
    source = Path(source) if isinstance(source, os.PathLike) else source
    try:
        with opened(source, result=result, split=split) as exposures:
            if isinstance(exposures, Result):
                return [_write_result(exposures, path, ending, frames)]
            chosen = _chosen(exposures, frames)
            if ending == ".npy":
                return [_write_npy(exposures, path, chosen)]
            if ending == ".ptu":
                return [_write_ptu(exposures, path, chosen)]
            write = _write_mat if ending == ".mat" else _write_exr
            return [write(exposures, name, one) for one, name in zip(chosen, _numbered(path, chosen), strict=True)]
    except ImportError as error:
        raise FileError(f"{path}: writing it needs {error.name}: pip install 'spadwarp[formats]'") from error


def _chosen(exposures: Exposures, frames: int | slice | None) -> range:
    every = range(exposures.count)
    if isinstance(frames, int):
        if frames not in every:
            raise ArgumentError(f"frames = {frames} is outside [0, {exposures.count - 1}]")
        return every[frames : frames + 1]
    chosen = every if frames is None else every[frames]
    if not chosen:
        ends = (None, None) if frames is None else (frames.start, frames.stop)
        asked = ":".join("" if end is None else str(end) for end in ends)
        raise ArgumentError(f"{exposures.place} holds {exposures.count} frames, none of them in {asked}")
    return chosen


def _numbered(path: Path, chosen: range) -> list[Path]:
    if len(chosen) == 1:
        return [path]
    return [path.with_name(f"{path.stem}-{one:05}{path.suffix}") for one in chosen]


def _counts_of(exposures: Exposures, number: int, ending: str) -> tuple[Exposure, NDArray[Any]]:
    frame = exposures.frame(number)
    if frame.counts is None:
        raise ArgumentError(f"{exposures.place}: frame {number} is depth without counts, which {ending} is for")
    return frame, frame.counts


# Formats


def _write_result(result: Result, path: Path, ending: str, frames: Any) -> Path:
    if frames is not None:
        raise ArgumentError(f"frames = {frames}: a result holds expected histograms, not frames")
    if ending == ".npy":
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.save(file, result.histogram)
        return path
    if ending == ".exr":
        scale = result.tally_value
        channels: dict[str, Any] = {"Z": result.depth(), "intensity": result.intensity}
        for name, part in zip(COMPONENTS, result.tallies, strict=True):
            channels[name] = part.sum(axis=-1, dtype=np.float64) * scale
        truth = result.truth
        channels |= {"truth.Z": truth.depth, "truth.range": truth.range, "truth.reflectance": truth.reflectance}
        channels |= {f"truth.N.{axis}": truth.normal[..., index] for index, axis in enumerate("XYZ")}
        return write_exr(path, channels, _notes(result.scene, "expected depth (centroid), fractions of the light"))
    raise ArgumentError(
        f"a result holds expected histograms, and {ending} is for counts: draw frames first (`spadwarp detect`)"
    )


def _write_npy(exposures: Exposures, path: Path, chosen: range) -> Path:
    def array_of(number: int) -> NDArray[Any]:
        frame = exposures.frame(number)
        return frame.images["Z"] if frame.counts is None else frame.counts

    first = array_of(chosen[0])
    with atomic_path(path) as temporary:
        shape = first.shape if len(chosen) == 1 else (len(chosen), *first.shape)
        array = np.lib.format.open_memmap(temporary, mode="w+", dtype=first.dtype, shape=shape)
        for place, number in enumerate(chosen):
            array[... if len(chosen) == 1 else place] = array_of(number)
        array.flush()
        del array
    return path


def _write_mat(exposures: Exposures, path: Path, number: int) -> Path:
    from scipy.io import savemat
    from scipy.sparse import csc_matrix

    frame, counts = _counts_of(exposures, number, ".mat")
    height, width, bins = counts.shape
    if frame.scene is None or frame.depth is None:
        raise ArgumentError("result is missing: .mat holds the truth of the scene that the counts were drawn from")
    if frame.expected is None or frame.background is None:
        raise ArgumentError(f"{exposures.place} does not tell what its counts were drawn from: draw them anew")
    if 4 * counts.size > _LARGEST_VARIABLE:
        raise FileError(f"{path}: {height} x {width} x {bins} values are more than a MATLAB 5 file can hold")
    total = frame.expected.sum(axis=-1, dtype=np.float64)
    signal = np.clip(total - frame.background, 0.0, None)
    photons = max(float(total.mean()) - frame.background, 0.0)
    bin = frame.true_bins()
    variables = {
        # Pixels column by column, as MATLAB's reshape takes them.
        "spad": csc_matrix(counts.transpose(1, 0, 2).reshape(width * height, bins).astype(np.float64)),
        "rates": frame.expected,
        "bin": bin,
        "range_bins": bin,
        "bin_size": frame.bin_width,
        "gate_start": frame.gate_start,
        "depth": np.nan_to_num(frame.depth),
        "intensity": (signal / max(float(signal.max()), 1e-300)).astype(np.float32),
        "SBR": photons / frame.background if frame.background > 0 else np.inf,
        "photons": photons,
        "mean_signal_photons": photons,
        "mean_background_photons": frame.background,
        "pulses": float(frame.pulses),
    }
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        savemat(file, variables, do_compression=True)
    return path


def _write_ptu(exposures: Exposures, path: Path, chosen: range) -> Path:
    import ptufile

    frame, counts = _counts_of(exposures, chosen[0], ".ptu")
    height, width, bins = counts.shape
    if bins > _LARGEST_DTIME:
        raise FileError(f"{path}: {bins} bins are more than the {_LARGEST_DTIME} of a T3 record")
    most = exposures.most
    if most is None:
        most = max(int(_counts_of(exposures, one, ".ptu")[1].sum(axis=-1).max()) for one in chosen)
    sync = max(frame.period or 0.0, bins * frame.bin_width)
    about = (
        f"Counts of a simulated SPAD array, {frame.pulses} pulses a frame. "
        f"Bin 0 begins at {frame.gate_start * 1e9:.6f} ns of flight."
    )
    with (
        atomic_path(path) as temporary,
        ptufile.PtuWriter(
            temporary,
            (1, height, width, 1, bins),
            global_resolution=sync,
            tcspc_resolution=frame.bin_width,
            # A pixel lasts long enough for its detections, one a sync.
            pixel_time=sync * max(most, 1),
            comment=about,
            tags={"CreatorSW_Name": "spadwarp"},
        ) as file,
    ):
        for number in chosen:
            one, counts = _counts_of(exposures, number, ".ptu")
            if (one.gate_start, one.bin_width) != (frame.gate_start, frame.bin_width):
                raise ArgumentError(f"frames {chosen[0]} and {number} have different gates: a .ptu file has one")
            file.write(np.ascontiguousarray(counts, np.uint32))
    return path


def _write_exr(exposures: Exposures, path: Path, number: int) -> Path:
    frame = exposures.frame(number)
    # EXR's integers have no sign, and few programs show them.
    channels = {name: one.astype(np.float32) if one.dtype.kind in "iu" else one for name, one in frame.images.items()}
    about = f"frame {number} of {exposures.count}" + (f", {frame.about}" if frame.about else "")
    return write_exr(path, channels, _notes(frame.scene, about))


def _notes(scene: Scene | None, content: str) -> dict[str, str | int | float]:
    notes: dict[str, str | int | float] = {"content": content, "Z": "planar depth [m]"}
    if scene is not None:
        notes |= {"pixel_tangent": scene.camera.pixel_tangent, "config": scene.to_toml()}
    return notes
