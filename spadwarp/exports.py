"""Results and frames in the formats of other programs: NumPy, MATLAB, PicoQuant, EXR."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.config import SPEED_OF_LIGHT
from spadwarp.errors import FileError, SpadwarpError
from spadwarp.files import atomic_path, load_result, write_exr
from spadwarp.result import COMPONENTS, Result, pixel_directions
from spadwarp.tensors import on_host

if TYPE_CHECKING:
    from spadwarp.config import Scene
    from spadwarp.detector import Detection

__all__ = ["FORMATS", "export"]

FORMATS = (".npy", ".mat", ".ptu", ".exr")

_LARGEST_VARIABLE = 2**31 - 1  # bytes of one array in a MATLAB 5 file
_LARGEST_DTIME = 32768  # bins that a T3 record of PicoQuant can tell apart


def export(
    source: Result | Detection | str | Path,
    path: str | Path,
    *,
    frame: int | None = None,
    result: Result | None = None,
) -> list[Path]:
    """Writes a result or frames in another program's format, the one that the ending of `path` says.

    - `.npy`: a result's expected histogram `[H, W, T]` (fraction of the emitted photons); counts `[H, W, T]`, of many
      frames `[frames, H, W, T]`; frames of the analytic simulator `[H, W]` or `[frames, H, W]` (depth [m]).
    - `.mat`: counts of one frame as the simulated data that single-photon denoisers train on (Lindell et al. 2018):
      `spad` sparse `[W·H, T]`, whose row is y + H·x; `rates` `[H, W, T]`, the expected counts that `spad` was drawn
      from; `bin` `[H, W]`, the bin of the true time of flight counted from 1, 0 without one; `bin_size` [s]; `depth`
      [m], 0 where nothing is; `intensity` in [0, 1]; `SBR`; `mean_signal_photons` and `mean_background_photons` of a
      pixel. Also under the names that some readers know: `range_bins` for `bin`, `photons` for `mean_signal_photons`.
    - `.ptu`: counts as a T3 image of PicoQuant, one record a detection, the frames one after the other. Times are told
      from the window's start, which the comment of the file states, as behind a delayed sync.
    - `.exr`: images of one frame: depth `Z` [m], `intensity`, `truth.Z`; of a result its components as well, of counts
      `<method>.Z` for each estimator in the file.

    Args:
        source: A `Result`, a `Detection`, or the file of one (`result.h5`, `frames.h5`, `analytic.h5`).
        path: The file. Of many frames `.mat` and `.exr` hold one each: `name-00000.mat`, `name-00001.mat`, …
        frame: Only this one, from 0.
        result: What a `Detection` was drawn from; `.mat` needs its truth.

    Returns:
        The files that were written.

    Raises:
        ValueError: No such frame, or what the format holds is not in the source.
        FileError: A file cannot be read or written, or the package for its format is not installed.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise FileError(f"{path}: ending {path.suffix!r} is not one of {', '.join(FORMATS)}")
    try:
        with _opened(source, result) as exposures:
            if isinstance(exposures, Result):
                return [_write_result(exposures, path, ending, frame)]
            if frame is not None and not 0 <= frame < exposures.frames:
                raise ValueError(f"frame = {frame} is outside [0, {exposures.frames - 1}]")
            chosen = range(exposures.frames) if frame is None else range(frame, frame + 1)
            if ending == ".npy":
                return [_write_npy(exposures, path, chosen)]
            if ending == ".ptu":
                return [_write_ptu(exposures, path, chosen)]
            write = _write_mat if ending == ".mat" else _write_exr
            return [write(exposures, name, one) for one, name in zip(chosen, _numbered(path, chosen), strict=True)]
    except ImportError as error:
        raise FileError(f"{path}: writing it needs {error.name}: pip install 'spadwarp[formats]'") from error


# Sources


@dataclass(frozen=True, kw_only=True)
class _Exposures:
    """Frames of counts, or of depth alone, wherever they lie.

    Attributes:
        place: What to call the source in an error.
        frames: How many.
        counts: Number of a frame → `[H, W, T]`; None where there are only images.
        images: Number of a frame → name → `[H, W]`.
        method: Estimator whose depth is the frame's, where there are several.
        most: Largest count of a pixel over all frames.
        shape: (H, W, T).
        expected, background: Per pulse and bin, `[H, W, T]` and `[H, W, 1 or T]`.
        depth: True depth [m] `[H, W]`.
    """

    place: str
    frames: int
    counts: Callable[[int], NDArray[Any]] | None
    images: Callable[[int], dict[str, NDArray[Any]]]
    method: str | None = None
    most: int = 0
    shape: tuple[int, int, int] = (0, 0, 0)
    expected: NDArray[np.float32] | None = None
    background: NDArray[np.float32] | None = None
    pulses: int = 0
    gate_start: float = 0.0
    bin_width: float = 0.0
    period: float | None = None
    scene: Scene | None = None
    depth: NDArray[np.float32] | None = None


@contextmanager
def _opened(source: Any, result: Result | None) -> Iterator[Result | _Exposures]:
    if isinstance(source, Result):
        yield source
    elif isinstance(source, (str, Path)):
        with _opened_file(Path(source)) as opened:
            yield opened
    elif hasattr(source, "counts"):
        yield _of_detection(source, result)
    else:
        raise ValueError(f"source is a {type(source).__name__}; a Result, a Detection or a file of one is needed")


def _of_detection(detection: Detection, result: Result | None) -> _Exposures:
    counts = on_host(detection.counts)
    counts = counts[None] if detection.summed else counts
    depth = None if result is None else result.truth.depth
    return _Exposures(
        place="Detection",
        frames=len(counts),
        counts=counts.__getitem__,
        images=lambda one: {"intensity": counts[one].sum(axis=-1)} | ({} if depth is None else {"truth.Z": depth}),
        most=int(counts.sum(axis=-1, dtype=np.int64).max()),
        shape=counts.shape[1:],
        expected=on_host(detection.expected),
        background=on_host(detection.background),
        pulses=detection.exposure,
        gate_start=detection.gate_start,
        bin_width=detection.bin_width,
        period=detection.period,
        scene=None if result is None else result.scene,
        depth=depth,
    )


@contextmanager
def _opened_file(path: Path) -> Iterator[Result | _Exposures]:
    import h5py

    if not path.is_file():
        raise FileError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
    if not h5py.is_hdf5(path):
        raise FileError(f"{path}: not an HDF5 file")
    readers = {"spadwarp frames": _of_frames, "spadwarp analytic": _of_analytic}
    with h5py.File(path, "r") as file:
        kind = file.attrs.get("format")
        if kind in readers:
            try:
                exposures = readers[kind](path, file)
            except (KeyError, ValueError, TypeError, OSError, RuntimeError, SpadwarpError) as error:
                raise FileError(f"{path}: damaged or not readable: {error}") from error
            yield exposures
            return
    yield load_result(path)


def _of_frames(path: Path, file: Any) -> _Exposures:
    about = file.attrs
    methods = list(file["depth"])

    def images(one: int) -> dict[str, NDArray[Any]]:
        depths = {f"{method}.Z": file[f"depth/{method}"][one] for method in methods}
        return {"intensity": file["intensity"][one], **depths, "truth.Z": file["truth/depth"][...]}

    return _Exposures(
        place=str(path),
        frames=int(about["frames"]),
        counts=lambda one: file["counts"][one],
        images=images,
        method=_best(methods) if methods else None,
        most=max(int(file["intensity"][one].max()) for one in range(int(about["frames"]))),
        shape=file["counts"].shape[1:],
        expected=file["expected"][...] if "expected" in file else None,
        background=file["background"][...],
        pulses=int(about["pulses"]),
        gate_start=float(about["gate_start"]),
        bin_width=float(about["bin_width"]),
        period=float(about["period"]) if np.isfinite(about["period"]) else None,
        scene=_scene(file),
        depth=file["truth/depth"][...],
    )


def _of_analytic(path: Path, file: Any) -> _Exposures:
    return _Exposures(
        place=str(path),
        frames=len(file["depth"]),
        counts=None,
        images=lambda one: {
            "Z": file["depth"][one],
            "background": file["labels"][one].astype(np.float32),
            "truth.Z": file["truth/depth"][...],
        },
        scene=_scene(file),
        depth=file["truth/depth"][...],
    )


def _scene(file: Any) -> Scene:
    import tomllib

    from spadwarp.config import Scene

    return Scene.from_dict(tomllib.loads(file["config"].asstr()[()]), source=file.attrs.get("source") or None)


def _best(methods: Sequence[str]) -> str:
    """The estimator that comes last in `METHODS`: the one that uses most of what is known."""
    from spadwarp.depth import METHODS

    return max(methods, key=lambda name: METHODS.index(name) if name in METHODS else -1)  # type: ignore[arg-type]


def _counts_of(exposures: _Exposures, ending: str) -> Callable[[int], NDArray[Any]]:
    if exposures.counts is None:
        raise ValueError(f"{exposures.place} holds depth and no counts, which {ending} is for")
    return exposures.counts


# Formats


def _numbered(path: Path, chosen: range) -> list[Path]:
    if len(chosen) == 1:
        return [path]
    return [path.with_name(f"{path.stem}-{one:05}{path.suffix}") for one in chosen]


def _write_result(result: Result, path: Path, ending: str, frame: int | None) -> Path:
    if frame is not None:
        raise ValueError(f"frame = {frame}: a result holds expected histograms, not frames")
    if ending == ".npy":
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.save(file, result.histogram)
        return path
    if ending == ".exr":
        scale = result.unit / result.photons
        channels: dict[str, Any] = {"Z": result.depth(), "intensity": result.intensity}
        for name, part in zip(COMPONENTS, result.tallies, strict=True):
            channels[name] = part.sum(axis=-1, dtype=np.float64) * scale
        truth = result.truth
        channels |= {"truth.Z": truth.depth, "truth.range": truth.range, "truth.reflectance": truth.reflectance}
        channels |= {f"truth.N.{axis}": truth.normal[..., index] for index, axis in enumerate("XYZ")}
        return write_exr(path, channels, _notes(result.scene, "expected depth (centroid), fractions of the light"))
    raise ValueError(
        f"a result holds expected histograms, and {ending} is for counts: draw frames first (`spadwarp detect`)"
    )


def _write_npy(exposures: _Exposures, path: Path, chosen: range) -> Path:
    frame = exposures.counts or (lambda one: exposures.images(one)["Z"])
    first = frame(chosen[0]) if chosen else None
    if first is None:
        raise ValueError(f"{exposures.place} holds no frames")
    with atomic_path(path) as temporary:
        shape = first.shape if len(chosen) == 1 else (len(chosen), *first.shape)
        array = np.lib.format.open_memmap(temporary, mode="w+", dtype=first.dtype, shape=shape)
        for place, one in enumerate(chosen):
            array[... if len(chosen) == 1 else place] = frame(one)
        array.flush()
        del array
    return path


def _write_mat(exposures: _Exposures, path: Path, one: int) -> Path:
    from scipy.io import savemat
    from scipy.sparse import csc_matrix

    counts = _counts_of(exposures, ".mat")(one)
    height, width, bins = counts.shape
    if exposures.scene is None or exposures.depth is None:
        raise ValueError("result is missing: .mat holds the truth of the scene that the counts were drawn from")
    if exposures.expected is None or exposures.background is None:
        raise ValueError(f"{exposures.place} does not tell what its counts were drawn from: draw them anew")
    if 4 * counts.size > _LARGEST_VARIABLE:
        raise FileError(f"{path}: {height} x {width} x {bins} values are more than a MATLAB 5 file can hold")
    rates = exposures.expected * np.float32(exposures.pulses)
    background = np.broadcast_to(exposures.background * np.float32(exposures.pulses), rates.shape)
    signal = np.clip(rates.sum(axis=-1, dtype=np.float64) - background.sum(axis=-1, dtype=np.float64), 0.0, None)
    noise = float(background.mean(dtype=np.float64)) * bins
    bin = _true_bins(exposures, exposures.scene, exposures.depth)
    photons = float(signal.mean())
    variables = {
        # Pixels column by column, as MATLAB's reshape takes them.
        "spad": csc_matrix(counts.transpose(1, 0, 2).reshape(width * height, bins).astype(np.float64)),
        "rates": rates,
        "bin": bin,
        "range_bins": bin,
        "bin_size": exposures.bin_width,
        "gate_start": exposures.gate_start,
        "depth": np.nan_to_num(exposures.depth),
        "intensity": (signal / max(float(signal.max()), 1e-300)).astype(np.float32),
        "SBR": photons / noise if noise > 0 else np.inf,
        "photons": photons,
        "mean_signal_photons": photons,
        "mean_background_photons": noise,
        "pulses": float(exposures.pulses),
    }
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        savemat(file, variables, do_compression=True)
    return path


def _true_bins(exposures: _Exposures, scene: Scene, depth: NDArray[Any]) -> NDArray[np.float64]:
    """Bin of the true time of flight `[H, W]`, counted from 1; 0 where there is no target in the window."""
    view = pixel_directions(scene.camera)
    distance = depth.astype(np.float64) / view[..., 2]
    path = np.linalg.norm(distance[..., None] * view - np.asarray(scene.laser.position), axis=-1) + distance
    time = path * (scene.medium.group_index / SPEED_OF_LIGHT) - exposures.gate_start
    if exposures.period is not None:
        time = np.mod(time, exposures.period)
    found = np.floor(time / exposures.bin_width) + 1.0
    return np.where((found >= 1) & (found <= exposures.shape[2]), found, 0.0)


def _write_ptu(exposures: _Exposures, path: Path, chosen: range) -> Path:
    import ptufile

    counts = _counts_of(exposures, ".ptu")
    height, width, bins = exposures.shape
    if bins > _LARGEST_DTIME:
        raise FileError(f"{path}: {bins} bins are more than the {_LARGEST_DTIME} of a T3 record")
    sync = max(exposures.period or 0.0, bins * exposures.bin_width)
    about = (
        f"Counts of a simulated SPAD array, {exposures.pulses} pulses a frame. "
        f"Bin 0 begins at {exposures.gate_start * 1e9:.6f} ns of flight."
    )
    with (
        atomic_path(path) as temporary,
        ptufile.PtuWriter(
            temporary,
            (1, height, width, 1, bins),
            global_resolution=sync,
            tcspc_resolution=exposures.bin_width,
            # A pixel lasts long enough for its detections, one a sync.
            pixel_time=sync * max(exposures.most, 1),
            comment=about,
            tags={"CreatorSW_Name": "spadwarp"},
        ) as file,
    ):
        for one in chosen:
            file.write(counts(one).astype(np.uint32))
    return path


def _write_exr(exposures: _Exposures, path: Path, one: int) -> Path:
    images = exposures.images(one)
    about = f"frame {one} of {exposures.frames}"
    if exposures.method is not None:
        images["Z"] = images[f"{exposures.method}.Z"]
        about += f", Z by {exposures.method}"
    # EXR's integers have no sign, and few programs show them.
    channels = {name: image.astype(np.float32) if image.dtype.kind in "iu" else image for name, image in images.items()}
    return write_exr(path, channels, _notes(exposures.scene, about))


def _notes(scene: Scene | None, content: str) -> dict[str, str | int | float]:
    notes: dict[str, str | int | float] = {"content": content, "Z": "planar depth [m]"}
    if scene is not None:
        notes |= {"pixel_tangent": scene.camera.pixel_tangent, "config": scene.to_toml()}
    return notes
