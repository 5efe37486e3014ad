"""Denoising of files: depth or histograms in, denoised depth out."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.baselines import CLASSICAL, classical_depth
from spadwarp.denoise.frames import MARGIN, depth_frames
from spadwarp.denoise.histogram_inputs import features_of_histograms, target_bins
from spadwarp.denoise.inference import Estimate, estimate_frames, target_threshold
from spadwarp.denoise.network_files import Precision, weights_metadata
from spadwarp.denoise.reading import ENDINGS, DepthReading, backscatter_profile, depth_at, read_depth
from spadwarp.denoise.second_return import second_return
from spadwarp.files import holds_own_file, locate
from spadwarp.frames.measured import Histograms
from spadwarp.io.arrays import write_exr
from spadwarp.io.paths import atomic_path
from spadwarp.values import ArgumentError, FileError, check_real, percent
from spadwarp.viz import draw_denoised

__all__ = ["Denoised", "denoise_file", "depth_files"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Denoised:
    """Output of `denoise_file`: depth `[N, H, W]` [m], probability that a pixel sees a target and from which one on it
    counts as such, probability that its depth is right, gate [m], paths of the files, and notes for the user."""

    depth: NDArray[np.float32]
    target_probability: NDArray[np.float32]
    threshold: float
    confidence: NDArray[np.float32]
    gate: tuple[float, float]
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def depth_files(path: str | Path) -> list[Path]:
    """The file, or the files of a folder that may hold depth or histograms. Raises `FileError` if there are none."""
    place = Path(path)
    if not place.is_dir() or holds_own_file(place):
        return [locate(place)]
    found = sorted(file for file in place.iterdir() if file.is_file() and file.suffix.lower() in ENDINGS)
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
    precision: Precision | None = None,
    mask: float | None = None,
    **reading: Any,
) -> Denoised:
    """Denoises the depth in a file.

    Writes to `out`: `NAME.npy`, `NAME_target.npy`, `NAME_confidence.npy` (depth and the two probabilities of all
    frames), `NAME.exr` (all three of the first), and `NAME.png`, in which open water is left out. From counts also
    `NAME_second.npy`, the depth of a second return in the same pixel, NaN where there is none. In bright scenes this
    may be light that the water scattered into the pixel from another part of the target.

    Args:
        path: A result or frames of spadwarp, depth as EXR, NumPy or MATLAB, or measured histograms.
        out: The folder.
        model, weights, device, precision: See `spadwarp.denoise.estimate`.
        mask: Pixels that see a target with less than this probability become NaN; default: every pixel has a depth.
        gate: (start, stop) in depth [m]; of counts only the bins within it are used. Default: the file's, else all.
        profile: Backscatter over the gate `[bins]`; default: the file's, else flat.
        reading: The other arguments of `read_depth`.

    Raises:
        FileError: A file cannot be read or written.
        ArgumentError: An argument out of range or missing.
    """
    folder, name = Path(out), Path(path).stem
    if folder.resolve() == Path(path).resolve().parent:
        raise ArgumentError(f"out = {folder} is the folder of {path}; another is needed: nothing is overwritten")
    mask = None if mask is None else check_real("mask", mask, "[0, 1]")
    read = read_depth(path, gate=gate, **reading)
    notes, gate = [read.source], gate or read.gate
    if gate is None:
        valid = read.depth[np.isfinite(read.depth) & (read.depth > 0)]
        if valid.size == 0:
            raise FileError(f"{path}: no pixel has a depth")
        low, high = float(valid.min()), float(valid.max())
        gate = (low, high if high > low else 1.001 * low)
        notes.append(f"gate {gate[0]:.4g} to {gate[1]:.4g} m, from the nearest to the farthest depth of the file")
    else:
        _check_gate(gate, read.depth)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        counts = read.histograms if model in ("pyramid", "histograms", *CLASSICAL) else None
        counting = counts is not None and (weights is None or weights_metadata(model, weights)["model"] == "histograms")
        if counts is not None and counting:
            model = "histograms" if model == "pyramid" else model
            notes.append("denoised with its histograms")
            found, second = _from_counts(
                read, counts, profile, model, weights, float(reading.get("group_index") or 1.0), device
            )
        else:
            second = None
            frames = depth_frames(read.depth, gate=gate, profile=read.profile if profile is None else profile)
            found = estimate_frames(frames, model=model, weights=weights, device=device, precision=precision)
        depth = found.depth if mask is None else found.masked(mask)
    notes += [str(warning.message) for warning in caught]
    if empty := np.count_nonzero(np.isnan(depth).all(axis=(1, 2))):
        notes.append(f"{empty} of {len(depth)} frames are empty: nothing was reported, or no target is seen")
    if second is not None:
        share = percent(np.isfinite(second).mean())
        notes.append(f"{share} % of the pixels have a second return, of a surface or of light scattered into them")
    threshold = target_threshold(model) if mask is None else mask
    shown = found.masked(threshold)[0]
    files = _write(folder, name, read, Estimate(depth, *found[1:]), second, model)
    title = f"{Path(path).name}: {model}"
    files.append(draw_denoised(read.depth[0], shown, folder / f"{name}.png", gate=gate, title=title, truth=read.truth))
    return Denoised(
        depth=depth, target_probability=found.target_probability, threshold=threshold, confidence=found.confidence,
        gate=gate, files=tuple(files), notes=tuple(notes),
    )  # fmt: skip


def _check_gate(gate: tuple[float, float], depth: NDArray[np.float32]) -> None:
    """Refuses a gate that no depth of the file lies in or near; a file without any depth stays empty."""
    slack = MARGIN * (gate[1] - gate[0])
    valid = depth[np.isfinite(depth) & (depth > 0)]
    if valid.size and gate[0] < gate[1] and not ((valid >= gate[0] - slack) & (valid <= gate[1] + slack)).any():
        extent = f"{valid.min():.4g} to {valid.max():.4g} m"
        raise ArgumentError(f"gate = ({gate[0]:g}, {gate[1]:g}) m holds none of the depths of the file, {extent}")


def _write(
    folder: Path, name: str, read: DepthReading, found: Estimate, second: NDArray[np.float32] | None, method: str
) -> list[Path]:
    """Writes the arrays and the EXR of `denoise_file`; their paths."""
    arrays = {"": found.depth, "_target": found.target_probability, "_confidence": found.confidence}
    if second is not None:
        arrays["_second"] = second
    for ending, values in arrays.items():
        with atomic_path(folder / f"{name}{ending}.npy") as temporary, temporary.open("wb") as file:
            np.save(file, values if read.frames else values[0])
    metadata = {"content": "denoised depth", "method": method, "frame": "+x right, +y down, +z forward"}
    channels = {"Z": found.depth, "target_probability": found.target_probability, "confidence": found.confidence}
    first = {channel: np.ascontiguousarray(values[0]) for channel, values in channels.items()}
    return [*(folder / f"{name}{ending}.npy" for ending in arrays), write_exr(folder / f"{name}.exr", first, metadata)]


def _from_counts(
    read: DepthReading,
    histograms: Histograms,
    profile: NDArray[np.float64] | None,
    model: str,
    weights: str | Path | None,
    group_index: float,
    device: str | None,
) -> tuple[Estimate, NDArray[np.float32]]:
    """The estimate of a method that uses counts, in the bins that hold the target; and second returns [m]."""
    width = float(histograms.bin_width or 0.0)
    known = np.asarray(histograms.background, np.float32)
    shape = histograms.values.shape
    known = np.broadcast_to(known, shape[-3:] if known.ndim == 3 else shape[-1:])
    assert histograms.response is not None and read.gate is not None
    response = histograms.response.per_bin(width)
    first, stop, part = target_bins(histograms.values, known, response, read.gate)
    values, start = histograms.values[..., first:stop], histograms.gate_start + first * width

    def to_depth(place: NDArray[np.float32]) -> NDArray[np.float64]:
        time = start + place.astype(np.float64) * (values.shape[-1] * width)
        return depth_at(time, histograms, group_index)

    given: dict[str, Any] = {
        "counts": values, "background": known[..., first:stop], "response": response, "device": device,
    }  # fmt: skip
    if model in CLASSICAL:
        place = classical_depth(method=model, **given)  # type: ignore[arg-type]
        depth = to_depth(place).astype(np.float32).reshape(read.depth.shape)
        found = Estimate(depth, np.ones_like(depth), np.full_like(depth, np.nan))
        return found, _second(found.depth, to_depth, given)
    features = features_of_histograms(**given, total=histograms.values.sum(axis=-1), to_depth=to_depth)
    if profile is None or values.shape[-1] < shape[-1]:
        profile = backscatter_profile(dataclasses.replace(histograms, values=values, background=known[..., first:stop]))
    with warnings.catch_warnings():
        if values.shape[-1] < shape[-1]:
            warnings.simplefilter("ignore")  # depths outside this part are false peaks
        frames = depth_frames(read.depth, gate=part, profile=profile, features=features)
    found = estimate_frames(frames, model=model, weights=weights, device=device)
    return found, _second(found.depth, to_depth, given)


def _second(
    depth: NDArray[np.float32], to_depth: Callable[[NDArray[np.float32]], NDArray[Any]], given: dict[str, Any]
) -> NDArray[np.float32]:
    """Depth of second returns [m]; depth is linear in the place over the gate."""
    start, stop = (to_depth(np.full_like(depth, place)) for place in (0.0, 1.0))
    place = ((depth - start) / (stop - start)).reshape(given["counts"].shape[:-1])
    return to_depth(second_return(place, **given).reshape(depth.shape)).astype(np.float32)
