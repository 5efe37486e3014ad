"""Depth of a file: stored, or estimated from the histograms in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset import FrameReader
from spadwarp.denoise.frames import checked_gate
from spadwarp.denoise.histogram_inputs import dim_pixels
from spadwarp.files import Held, gate_of, is_own_file, load, locate, sequence, stored_depth
from spadwarp.frames.depth import Method, depth_of
from spadwarp.frames.file import SequenceFile
from spadwarp.frames.measured import Histograms, read_histograms, stored_images
from spadwarp.io.arrays import read_exr
from spadwarp.io.paths import existing_file
from spadwarp.result import Result
from spadwarp.scene.sight import depth_from_time
from spadwarp.transport import PhotonRecords
from spadwarp.values import ArgumentError, FileError, range_from_time

__all__ = ["ENDINGS", "DepthReading", "backscatter_profile", "depth_at", "read_depth"]

ENDINGS = (".h5", ".hdf5", ".exr", ".npy", ".mat", ".ptu")

_EXR_CHANNELS = ("Z", "depth", "range", "A", "Depth.Z", "Depth.V")


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthReading:
    """Depth from a file.

    Attributes:
        depth: float32 `[N, H, W]` [m]; NaN where there is none.
        frames: Whether the file held several frames.
        gate: (start, stop) [m]; None where the file does not give it.
        profile: Backscatter over the gate, `[bins]`; None where the file does not give it.
        source: How the depth was obtained, as text.
        histograms: What the depth was estimated from, if these are counts whose instrument response is known.
        truth: True depth of the first frame, `[H, W]` [m]; None where the file does not give it.
    """

    depth: NDArray[np.float32]
    frames: bool
    gate: tuple[float, float] | None
    profile: NDArray[np.float64] | None
    source: str
    histograms: Histograms | None = None
    truth: NDArray[np.float32] | None = None


def read_depth(
    path: str | Path,
    *,
    as_depth: bool = False,
    channel: str | None = None,
    scale: float = 1.0,
    method: Method | None = None,
    gate: tuple[float, float] | None = None,
    group_index: float | None = None,
    device: str | None = None,
    **measured: Any,
) -> DepthReading:
    """Depth from a file.

    `.h5`: a result or frames of counts; of an analytic file, a shard or a dataset's folder the depth as it is. `.exr`:
    depth in `channel`. `.npy`, `.mat`, `.h5` of others: one frame `[H, W]` of depth, or histograms, see
    `spadwarp.frames.read_histograms`. `.ptu`: histograms. Histograms become depth by `spadwarp.frames.depth.depth_of`.

    Args:
        path: The file.
        as_depth: Three dimensions in `.npy`, `.mat` and `.h5` are frames `[N, H, W]` of depth, not a histogram.
        channel: Of an EXR; default: the first of Z, depth, range, A that it has. Of a result of polarised light: "I",
            "co" or "cross", see `spadwarp.result.analyser_channel`; default: "I", all light.
        scale: Metres per unit of stored depth; 0.01 for engines that write centimetres.
        method: Estimator for histograms; default: `"likelihood"` for counts, `"matched"` for rates, and `"centroid"`
            where the response is not known.
        gate: (start, stop) in depth [m]; of counts whose response is known, only the bins within it are used.
        group_index: Of measured histograms, see `depth_of`.
        device: Warp device of the estimator.
        measured: What a file of measured histograms does not say, as `read_histograms` takes it.

    Raises:
        FileError: No such file, not readable, or without depth.
        ArgumentError: An argument out of range, or missing for what the file holds.
    """
    if gate is not None:
        gate = checked_gate(gate)
    place = locate(path)
    if place.suffix.lower() not in ENDINGS and not place.is_dir():
        raise FileError(f"{existing_file(place)}: ending {place.suffix!r} is not one of {', '.join(ENDINGS)}")
    if not (np.isfinite(scale) and scale > 0):
        raise ArgumentError(f"scale = {scale} is outside (0, inf)")
    truth: NDArray[np.float32] | None = None
    of_result: dict[str, Any] = {}
    if is_own_file(place):
        held = load(place)
        own, truth = stored_depth(held), _truth(held)
        of_result = {"channel": channel or "I"} if isinstance(held, Result) else {}
        if own is not None:
            frames = own.values.astype(np.float32)
            source = f"depth as it is{_unused(held)}"
            return DepthReading(depth=frames, frames=True, gate=gate_of(held), profile=None, source=source, truth=truth)
    found = _stored_depth(place, channel, measured.get("dataset"), as_depth)
    if found is not None:
        stored, chosen = found
        if stored.dtype.kind not in "iuf":
            raise FileError(f"{place}: {stored.dtype} {stored.shape}; depth is real numbers")
        if given := [name.replace("_", " ") for name in measured if name != "dataset"]:
            raise ArgumentError(f"{place} holds depth: {', '.join(given)} are of histograms")
        depth = stored.astype(np.float32)
        below = np.count_nonzero(depth < 0)
        depth[~np.isfinite(depth) | (depth >= 65504.0) | (depth <= 0)] = np.nan  # 65504: the sky in float16
        frames = depth.reshape(-1, *depth.shape[-2:]) * np.float32(scale)
        source = "depth as it is" + (f": {chosen}" if chosen else "")
        source += f"; {below} values below 0 count as not reported" if below else ""
        return DepthReading(depth=frames, frames=depth.ndim == 3, gate=None, profile=None, source=source)
    histograms = read_histograms(place, **measured, **of_result)
    counted = histograms.values.dtype.kind in "iu" and histograms.response is not None
    if counted:
        histograms = _with_background(histograms)
        if gate is not None:
            histograms = _within(histograms, gate, float(group_index or 1.0))
    return dataclasses.replace(_estimate_depth(histograms, counted, method, group_index, device), truth=truth)


def _unused(held: Held) -> str:
    """Why histograms that a file holds beside its depth are not used; "" where there are none."""
    if isinstance(held, FrameReader) and held.histogram_bins:
        return "; its histograms are not used, since a dataset does not keep their background"
    if isinstance(held, SequenceFile):
        return "; its histograms are not used, since each frame is of another scene"
    return ""


def _truth(held: Held) -> NDArray[np.float32] | None:
    """True depth of the first frame, where one of our files has it."""
    if isinstance(held, Result):
        return held.truth.depth
    if isinstance(held, PhotonRecords):
        return None
    depth = sequence(held).at(0).depth
    return None if depth is None else depth.astype(np.float32)


def _stored_depth(
    path: Path, channel: str | None, dataset: str | None, as_depth: bool
) -> tuple[NDArray[Any], str] | None:
    """Depth `[H, W]` or `[N, H, W]` as the file has it, and a text if it is one of several; None for histograms."""
    ending = path.suffix.lower()
    if ending == ".exr":
        channels, _ = read_exr(path)
        wanted: Sequence[str] = _EXR_CHANNELS if channel is None else (channel,)
        found = next((channels[name] for name in wanted if name in channels), None)
        if found is None:
            raise FileError(f"{path}: no channel {' or '.join(map(repr, wanted))}; it has {', '.join(channels)}")
        return found, ""
    return stored_images(path, dataset, several=as_depth)


def _with_background(histograms: Histograms) -> Histograms:
    """Counts with their background; where it is not known, a flat one."""
    if histograms.background is not None:
        return histograms
    bins = histograms.values.shape[-1]
    # At the median bin of all pixels and frames together: that of sparse counts would be 0.
    total = histograms.values.reshape(-1, bins).sum(axis=0, dtype=np.float64)
    level = np.median(total) * bins / histograms.values.size
    return dataclasses.replace(histograms, background=np.full(bins, level, np.float32))


def _estimate_depth(
    histograms: Histograms, counted: bool, method: Method | None, group_index: float | None, device: str | None
) -> DepthReading:
    method = method or ("likelihood" if counted else "matched")
    if method in ("matched", "likelihood") and histograms.response is None:
        method = "centroid"
    reduced = depth_of(histograms, method=method, group_index=group_index, device=device)
    scene = histograms.scene
    index = scene.medium.group_index if scene is not None else float(group_index or 1.0)
    gate_stop = histograms.gate_start + histograms.values.shape[-1] * float(histograms.bin_width or 0.0)
    depth = reduced.values.astype(np.float32)
    depth[depth <= 0.0] = np.nan  # a peak of noise at the time of the pulse
    dim = [] if counted else dim_pixels(histograms)
    return DepthReading(
        depth=depth,
        frames=reduced.frames > 1,
        gate=(range_from_time(histograms.gate_start, index), range_from_time(gate_stop, index)),
        profile=backscatter_profile(histograms),
        source="; ".join([f"{reduced.quantity} by {method} from histograms", *histograms.notes, *dim]),
        histograms=histograms if counted else None,
    )


def depth_at(time: NDArray[np.float64], histograms: Histograms, group_index: float) -> NDArray[np.float64]:
    """Depth [m] at times of flight `[..., H, W]` [s]; range where the camera is not known."""
    if histograms.scene is None:
        return range_from_time(time, group_index)
    return depth_from_time(time, scene=histograms.scene)


def _within(held: Histograms, gate: tuple[float, float], group_index: float) -> Histograms:
    """Those bins alone whose depth lies in a gate [m] in some pixel."""
    bins, width = held.values.shape[-1], float(held.bin_width or 0.0)
    times = [np.full(held.values.shape[-3:-1], held.gate_start + width * edge) for edge in (0, bins)]
    near, far = (depth_at(time, held, group_index) for time in times)
    first = max(0, int(np.floor(np.min((gate[0] - near) / (far - near)) * bins + 1e-6)))
    stop = min(bins, int(np.ceil(np.max((gate[1] - near) / (far - near)) * bins - 1e-6)))
    if stop <= first:
        extent = f"{near.min():.4g} to {far.max():.4g} m"
        raise ArgumentError(f"gate = ({gate[0]:g}, {gate[1]:g}) m lies outside the histograms, {extent}")
    known = held.background if held.background_per_bin is None else held.background_per_bin[..., first:stop]
    return dataclasses.replace(
        held, values=held.values[..., first:stop], gate_start=held.gate_start + first * width, background=known
    )


def backscatter_profile(histograms: Histograms) -> NDArray[np.float64] | None:
    """Backscatter of all pixels together over the bins; None where the file does not give it."""
    background = histograms.background_per_bin
    if background is None:
        return None
    total = np.asarray(background, np.float64).reshape(-1, background.shape[-1]).sum(axis=0)
    return total if total.sum() > 0 else None
