"""Files in, denoised depth out: what `spadwarp denoise` does with a path."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.frames import POOLED, depth_frames
from spadwarp.denoise.inference import clues_of, denoise_frames, weights_card
from spadwarp.errors import ArgumentError, FileError
from spadwarp.frames.arrival_time import Method
from spadwarp.frames.depth import depth_of
from spadwarp.frames.measured import Histograms, read_histograms
from spadwarp.io.atomic import atomic_path
from spadwarp.io.exr import read_exr, write_exr
from spadwarp.units import range_from_time

__all__ = ["ENDINGS", "Denoised", "DepthReading", "denoise_file", "depth_files", "read_depth"]

ENDINGS = (".h5", ".exr", ".npy", ".mat", ".ptu")

_EXR_CHANNELS = ("Z", "depth", "range", "A", "Depth.Z", "Depth.V")


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthReading:
    """Depth from a file.

    Attributes:
        depth: float32 `[N, H, W]` [m]; NaN where there is none.
        frames: Whether the file held several frames.
        gate: (start, stop) [m], as far as the file tells.
        profile: Backscatter over the gate, `[bins]`, as far as the file tells.
        source: How it came about, in words.
        histograms: What the depth was estimated from, if that are counts of which the instrument response is known.
    """

    depth: NDArray[np.float32]
    frames: bool
    gate: tuple[float, float] | None
    profile: NDArray[np.float64] | None
    source: str
    histograms: Histograms | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Denoised:
    """What `denoise_file` wrote: the depth `[N, H, W]` [m], gate [m], files and notes in words."""

    depth: NDArray[np.float32]
    gate: tuple[float, float]
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def depth_files(path: str | Path) -> list[Path]:
    """The file, or the files of a folder that may hold depth or histograms. Raises `FileError` if there are none."""
    place = Path(path)
    if not place.is_dir():
        return [place]
    found = sorted(one for one in place.iterdir() if one.is_file() and one.suffix.lower() in ENDINGS)
    if not found:
        raise FileError(f"{place}: no file that ends in {', '.join(ENDINGS)}")
    return found


def denoise_file(
    path: str | Path,
    out: str | Path,
    *,
    model: str = "pyramid",
    gate: tuple[float, float] | None = None,
    profile: NDArray[np.float64] | None = None,
    weights: str | Path | None = None,
    device: str | None = None,
    **reading: Any,
) -> Denoised:
    """Denoises what a file holds; writes `NAME.npy` (all frames), `NAME.exr` and `NAME.png` (the first) to `out`.

    Args:
        path: A result or frames of spadwarp, depth as EXR, NumPy or MATLAB, or measured histograms.
        out: The folder.
        model, weights, device: See `denoise`.
        gate: (start, stop) in depth [m]; default: the file's, else from the nearest to the farthest depth in it.
        profile: Backscatter over the gate `[bins]`; default: the file's, else flat.
        reading: Arguments of `read_depth`.

    Raises:
        FileError: Cannot be read, or written.
        ArgumentError: An argument out of range or missing.
    """
    folder, name = Path(out), Path(path).stem
    if folder.resolve() == Path(path).resolve().parent:
        raise ArgumentError(
            f"out = {folder} is the folder of {path}; another is needed, so that nothing is overwritten"
        )
    read = read_depth(path, **reading)
    notes = [read.source]
    gate = gate or read.gate
    if gate is None:
        there = read.depth[np.isfinite(read.depth) & (read.depth > 0)]
        if there.size == 0:
            raise FileError(f"{path}: no pixel has a depth")
        low, high = float(there.min()), float(there.max())
        gate = (low, high if high > low else 1.001 * low)
        notes.append(f"gate {gate[0]:.4g} to {gate[1]:.4g} m, from the nearest to the farthest depth of the file")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        clues = None
        counts = read.histograms if model in ("pyramid", "histograms") else None
        if counts is not None and (weights is None or weights_card(model, weights).get("model") == "histograms"):
            model = "histograms"
            notes.append("denoised with its histograms")
            clues = _clues(counts, group_index=reading.get("group_index"), device=device)
        frames = depth_frames(read.depth, gate=gate, profile=read.profile if profile is None else profile, clues=clues)
        found, seen = denoise_frames(frames, model=model, weights=weights, device=device)
        depth = np.where(seen, found, np.float32(np.nan))
    notes += [str(one.message) for one in caught]
    empty = np.count_nonzero(np.isnan(depth).all(axis=(1, 2)))
    if empty:
        notes.append(f"{empty} of {len(depth)} frames stay empty: nothing was reported, or no target is seen")
    with atomic_path(folder / f"{name}.npy") as temporary, temporary.open("wb") as file:
        np.save(file, depth if read.frames else depth[0])
    about = {"content": "denoised depth", "method": model, "frame": "+x right, +y down, +z forward"}
    files = (
        folder / f"{name}.npy",
        write_exr(folder / f"{name}.exr", {"Z": np.ascontiguousarray(depth[0])}, about),
        _draw(read.depth[0], depth[0], folder / f"{name}.png", gate=gate, title=f"{Path(path).name}: {model}"),
    )
    return Denoised(depth=depth, gate=gate, files=files, notes=tuple(notes))


def read_depth(
    path: str | Path,
    *,
    as_depth: bool = False,
    channel: str | None = None,
    scale: float = 1.0,
    variable: str | None = None,
    method: Method | None = None,
    bin_width_ps: float | None = None,
    gate_start_ns: float | None = None,
    group_index: float | None = None,
    irf_fwhm_ps: float | None = None,
    device: str | None = None,
) -> DepthReading:
    """Depth from a file.

    `.h5`: a result, or frames of counts. `.exr`: depth in `channel`. `.npy`, `.mat`: one frame `[H, W]` of depth, or
    histograms `[H, W, T]`, `[N, H, W, T]`. `.ptu`: histograms. These become depth by `spadwarp.frames.depth.depth_of`.

    Args:
        path: The file.
        as_depth: Three dimensions in `.npy` and `.mat` are frames `[N, H, W]` of depth, not a histogram.
        channel: Of an EXR; default: the first of Z, depth, range, A that it has.
        scale: Metres per unit of stored depth; 0.01 for engines that write centimetres.
        variable: Array of a `.mat`.
        method: Estimator for histograms; default: `"likelihood"` for counts, `"matched"` for rates, and `"centroid"`
            where the response is not known.
        bin_width_ps, gate_start_ns, group_index, irf_fwhm_ps: Of measured histograms, see `depth_of`.
        device: Warp device of the estimator.

    Raises:
        FileError: No such file, not readable, or without depth.
        ArgumentError: An argument out of range, or missing for what the file holds.
    """
    place = Path(path)
    if not place.is_file():
        raise FileError(f"{place}: {'is not a file' if place.exists() else 'no such file'}")
    ending = place.suffix.lower()
    if ending not in ENDINGS:
        raise FileError(f"{place}: ending {place.suffix!r} is not one of {', '.join(ENDINGS)}")
    if not (np.isfinite(scale) and scale > 0):
        raise ArgumentError(f"scale = {scale} is outside (0, inf)")
    stored: NDArray[Any] | None = None
    if ending == ".exr":
        stored = _exr_depth(place, channel)
    elif ending in (".npy", ".mat"):
        array = _array(place, variable)
        stored = array if array.ndim == 2 or (as_depth and array.ndim == 3) else None
    if stored is not None:
        if stored.dtype.kind not in "iuf":
            raise FileError(f"{place}: {stored.dtype} {stored.shape}; depth is real numbers")
        depth = stored.astype(np.float32)
        below = np.count_nonzero(depth < 0)
        depth[~np.isfinite(depth) | (depth >= 65504.0) | (depth <= 0)] = np.nan  # 65504: the sky in float16
        frames = depth.reshape(-1, *depth.shape[-2:]) * np.float32(scale)
        source = "depth as it is" + (f"; {below} values below 0 count as not reported" if below else "")
        return DepthReading(depth=frames, frames=depth.ndim == 3, gate=None, profile=None, source=source)
    histograms = read_histograms(place, variable=variable)
    changes: dict[str, Any] = {}
    if histograms.scene is None:
        if bin_width_ps is not None:
            changes["bin_width"] = 1e-12 * bin_width_ps
        if gate_start_ns is not None:
            changes["gate_start"] = 1e-9 * gate_start_ns
        if irf_fwhm_ps is not None:
            from spadwarp.frames.response import instrument_response

            changes["irf"] = changes["response"] = instrument_response(pulse_fwhm=0.0, jitter_fwhm=1e-12 * irf_fwhm_ps)
        histograms = dataclasses.replace(histograms, **changes)
    counted = histograms.values.dtype.kind in "iu" and histograms.response is not None
    if counted and histograms.background is None:
        # Flat, at the median bin of all pixels and frames together: that of sparse counts would be 0.
        bins = histograms.values.shape[-1]
        total = histograms.values.reshape(-1, bins).sum(axis=0, dtype=np.float64)
        level = np.median(total) * bins / histograms.values.size
        histograms = dataclasses.replace(histograms, background=np.full(bins, level, np.float32))
    if method is None:
        method = "likelihood" if counted else "matched"
    if method in ("matched", "likelihood") and histograms.response is None:
        method = "centroid"
    reduced = depth_of(histograms, method=method, group_index=group_index, device=device)
    scene = histograms.scene
    index = scene.medium.group_index if scene is not None else float(group_index or 1.0)
    gate_stop = histograms.gate_start + histograms.values.shape[-1] * float(histograms.bin_width or 0.0)
    return DepthReading(
        depth=reduced.values.astype(np.float32),
        frames=reduced.frames > 1,
        gate=(range_from_time(histograms.gate_start, index), range_from_time(gate_stop, index)),
        profile=_profile(histograms),
        source=f"{reduced.quantity} by {method} from histograms",
        histograms=histograms if counted else None,
    )


def _clues(histograms: Histograms, *, group_index: float | None, device: str | None) -> NDArray[np.float32]:
    """What counts tell beyond each pixel's depth, `[N, CLUES, H, W]`, pooled depths in metres."""
    from spadwarp.scene.geometry import depth_from_time

    bins, width = histograms.values.shape[-1], float(histograms.bin_width or 0.0)
    counts = histograms.values.reshape(-1, *histograms.values.shape[-3:])
    known = np.asarray(histograms.background, np.float32)
    background = np.broadcast_to(known, counts.shape[1:] if known.ndim == 3 else (bins,))
    assert histograms.response is not None
    clues = clues_of(counts, background=background, response=histograms.response.per_bin(width), device=device)
    scene = histograms.scene
    for channel in range(POOLED):
        time = histograms.gate_start + clues[:, channel].astype(np.float64) * (bins * width)
        if scene is not None:
            clues[:, channel] = depth_from_time(time, scene=scene)
        else:
            clues[:, channel] = range_from_time(time, float(group_index or 1.0))
    return clues


def _profile(histograms: Histograms) -> NDArray[np.float64] | None:
    """Backscatter of all pixels together over the bins; None where the file does not know it."""
    background = histograms.background
    if background is None or np.ndim(background) == 0 or np.shape(background)[-1] != histograms.values.shape[-1]:
        return None
    total = np.asarray(background, np.float64).reshape(-1, histograms.values.shape[-1]).sum(axis=0)
    return total if total.sum() > 0 else None


def _exr_depth(path: Path, channel: str | None) -> NDArray[Any]:
    channels, _ = read_exr(path)
    wanted: Sequence[str] = _EXR_CHANNELS if channel is None else (channel,)
    for name in wanted:
        if name in channels:
            return channels[name]
    raise FileError(f"{path}: no channel {' or '.join(map(repr, wanted))}; it has {', '.join(channels)}")


def _array(path: Path, variable: str | None) -> NDArray[Any]:
    """The array of a `.npy`, or of a `.mat` if it is depth; shape alone tells depth and histograms apart."""
    try:
        if path.suffix.lower() == ".npy":
            with path.open("rb") as file:
                if file.read(6) != b"\x93NUMPY":
                    raise ValueError("it does not begin as NumPy's files do")
            return np.load(path, allow_pickle=False)
        from scipy.io import loadmat

        arrays = {
            name: one
            for name, one in loadmat(path, spmatrix=False).items()
            if isinstance(one, np.ndarray) and one.ndim >= 2
        }
    except NotImplementedError:  # MATLAB 7.3 is HDF5
        import h5py

        with h5py.File(path, "r") as file:
            arrays = {name: one[...].T for name, one in file.items() if isinstance(one, h5py.Dataset) and one.ndim >= 2}
    except Exception as error:  # what a reader raises depends on the format
        raise FileError(f"{path}: damaged or not readable: {error}") from error
    arrays = {name: one for name, one in arrays.items() if one.dtype.kind in "iuf" and one.size > 1}
    if variable is not None and variable not in arrays:
        raise FileError(f"{path}: no array {variable!r}; it holds {', '.join(arrays) or 'nothing'}")
    if not arrays:
        raise FileError(f"{path}: no array of numbers with two dimensions or more")
    return arrays[variable] if variable is not None else max(arrays.values(), key=np.size)


def _draw(
    noisy: NDArray[np.float32], denoised: NDArray[np.float32], path: Path, *, gate: tuple[float, float], title: str
) -> Path:
    from spadwarp.viz.result import image_panels, show_image, shown_limits

    figure, images, bars = image_panels(noisy.shape, 2)
    low, high = shown_limits(denoised if np.isfinite(denoised).any() else noisy, beyond=1.0)
    low, high = max(low, gate[0] - 1.0), min(high, gate[1] + 1.0)
    for image, bar, values, name in zip(images, bars, (noisy, denoised), ("Input", "Denoised"), strict=True):
        show_image(image, bar, values, title=name, label="depth z [m]", colours="viridis_r", low=low, high=high)
    figure.suptitle(title, fontsize=9, color="0.25")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format="png")
    return path
