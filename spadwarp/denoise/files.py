"""Files: depth, stored or estimated from the histograms in them, its denoising, and training."""

from __future__ import annotations

import dataclasses
import json
import os
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.dataset import FrameReader, read_manifest
from spadwarp.dataset.shards import SceneFile
from spadwarp.denoise.baselines import BASELINES, FROM_COUNTS
from spadwarp.denoise.frames import MARGIN, checked_gate
from spadwarp.denoise.histograms import CountFrames, dim_pixels, target_bins, without_defects
from spadwarp.denoise.inference import (
    Estimate,
    detected,
    estimate_depth,
    estimate_histograms,
    second_return,
    target_threshold,
)
from spadwarp.denoise.network_files import Precision, require_torch, weights_metadata
from spadwarp.denoise.recipe import TrainingRecipe, load_training_recipe
from spadwarp.files import Held, gate_of, holds_own_file, is_own_file, load, locate, sequence, stored_depth
from spadwarp.frames.backgrounds import BackgroundLaw
from spadwarp.frames.depth import FARTHEST, Method, Quantity, depth_of, geometry, with_view
from spadwarp.frames.file import SequenceFile
from spadwarp.frames.measured import Histograms, read_histograms, stored_images
from spadwarp.io.arrays import read_exr, write_array, write_exr
from spadwarp.io.paths import existing_file
from spadwarp.result import Result
from spadwarp.scene.sections import file_of
from spadwarp.scene.sight import depth_from_time
from spadwarp.transport import PhotonRecords
from spadwarp.values import ArgumentError, FileError, SpadwarpWarning, check_real, percent, range_from_time
from spadwarp.viz import draw_denoised, draw_learning_curves

__all__ = ["denoise_file", "depth_files", "read_depth", "train"]

if TYPE_CHECKING:
    from spadwarp.denoise.synthetic_noise import CleanScenes
    from spadwarp.denoise.training import Trained


ENDINGS = (".h5", ".hdf5", ".exr", ".npy", ".npz", ".mat", ".ptu")

_JUDGED = 1 << 19  # pixels, of which is told whether a denoiser makes them worse
_EXR_CHANNELS = ("Z", "depth", "range", "A", "Depth.Z", "Depth.V")


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthReading:
    """Depth from a file; None for what the file does not give."""

    depth: NDArray[np.float32]  # [N, H, W] [m]; NaN where there is none
    quantity: Quantity = "depth"
    frames: bool  # whether the file held several
    gate: tuple[float, float] | None  # start and stop [m]
    profile: NDArray[np.float64] | None  # backscatter over the gate, [bins]
    source: str  # how the depth was obtained
    histograms: Histograms | None = None  # what it was estimated from: counts whose instrument response is known
    truth: NDArray[np.float32] | None = None  # true depth of the first frame, [H, W] [m]


def read_depth(
    path: str | Path,
    *,
    as_depth: bool = False,
    channel: str | None = None,
    scale: float = 1.0,
    method: Method | None = None,
    background: ArrayLike | BackgroundLaw | None = None,
    gate: tuple[float, float] | None = None,
    gate_time: tuple[float, float] | None = None,
    device: str | None = None,
    **measured: Any,
) -> DepthReading:
    """Depth from a file.

    `.h5`: a result or frames of counts; of an analytic file, a shard or a dataset's folder the depth as it is. `.exr`:
    depth in `channel`. `.npy`, `.npz`, `.mat`, `.h5` of others: one frame `[H, W]` of depth, or histograms, see
    `spadwarp.frames.read_histograms`. `.ptu`: histograms. Histograms become depth by `spadwarp.frames.depth.depth_of`,
    in every pixel.

    Args:
        path: The file.
        as_depth: Three dimensions in `.npy`, `.npz`, `.mat` and `.h5` are frames `[N, H, W]` of depth, not a histogram.
        channel: Of an EXR; default: the first of Z, depth, range, A that it has. Of a result of polarised light: "I",
            "co" or "cross", see `spadwarp.result.analyser_channel`; default: "I", all light.
        scale: Metres per unit of stored depth; 0.01 for engines that write centimetres.
        method: Estimator for histograms; default: `"likelihood"` for counts, `"matched"` for rates, and `"centroid"`
            where the response is not known.
        background: Of counts whose response is known, as `spadwarp.denoise.estimate` takes it, replacing the file's;
            default: the file's, else "decay".
        gate: (start, stop) in depth [m]; of counts whose response is known, only the bins within it are used.
        gate_time: The same in time of flight [s], by the group index of the file or the one that is given.
        device: Warp device of the estimator.
        measured: What a file of measured histograms does not say, as `read_histograms` takes it, and `group_index` and
            `horizontal_fov_deg`, as `depth_of` does.

    Raises:
        FileError: No such file, not readable, or without depth.
        ArgumentError: An argument out of range, or missing for what the file holds.
    """
    place, gate = locate(path), None if gate is None else checked_gate(gate)
    if place.suffix.lower() not in ENDINGS and not place.is_dir():
        raise FileError(f"{existing_file(place)}: ending {place.suffix!r} is not one of {', '.join(ENDINGS)}")
    if not (np.isfinite(scale) and scale > 0):
        raise ArgumentError(f"scale = {scale} is outside (0, inf), metres per unit")
    truth: NDArray[np.float32] | None = None
    of_result: dict[str, Any] = {}
    if is_own_file(place):
        held = load(place)
        own, truth = stored_depth(held), _truth(held)
        of_result = {"channel": channel or "I"} if isinstance(held, Result) else {}
        if own is not None:
            frames = own.values.astype(np.float32)
            source = f"depth as it is{_remark(held)}"
            gate = gate_of(held, gate_time)
            return DepthReading(depth=frames, frames=True, gate=gate, profile=None, source=source, truth=truth)
    found = _stored_depth(place, channel, measured.get("dataset"), as_depth)
    if found is not None:
        stored, chosen = found
        if stored.dtype.kind not in "iuf":
            raise FileError(f"{place}: {stored.dtype} {stored.shape}; depth is real numbers")
        others = ["background"] * (background is not None)
        if given := [*(name.replace("_", " ") for name in measured if name not in ("dataset", "group_index")), *others]:
            raise ArgumentError(f"{place} holds depth: {', '.join(given)} are of histograms")
        depth = stored.astype(np.float32)
        below = np.count_nonzero(depth < 0)
        depth[~np.isfinite(depth) | (depth >= 65504.0) | (depth <= 0)] = np.nan  # 65504: the sky in float16
        frames = depth.reshape(-1, *depth.shape[-2:]) * np.float32(scale)
        if np.isfinite(frames).any() and (middle := float(np.nanmedian(frames))) > FARTHEST:
            text = f"{place}: depths of {middle:.4g} m; no light comes back so far through water: scale = {scale:g} m"
            warnings.warn(f"{text}, per unit of the file, or gate may be wrong", SpadwarpWarning, stacklevel=2)
        source = "depth as it is" + (f": {chosen}" if chosen else "")
        source += f"; {below} values below 0 count as not reported" if below else ""
        gate = _in_depth(gate_time, place, measured.get("group_index"))
        return DepthReading(depth=frames, frames=depth.ndim == 3, gate=gate, profile=None, source=source)
    view = [measured.pop(name, None) for name in ("group_index", "horizontal_fov_deg")]
    histograms = with_view(read_histograms(place, **measured, **of_result), *view)
    if histograms.scene is None and histograms.response is None:
        text = "the instrument response is not given (irf): with it, counts are denoised with their histograms"
        histograms = dataclasses.replace(histograms, notes=(*histograms.notes, text))
    index = histograms.group_index if histograms.scene is None else histograms.scene.medium.group_index
    gate = gate or _in_depth(gate_time, place, index)
    counted = histograms.values.dtype.kind in "iu" and histograms.response is not None
    if counted and histograms.bin_width is None:
        raise ArgumentError(f"{place}: bin width is missing (bin_width)")
    if counted:
        histograms = _with_background(histograms, background)
    elif background is not None:
        raise ArgumentError(f"{place}: background is of counts whose instrument response (irf) is known")
    if counted and gate is not None:
        histograms = _within(histograms, gate)
    read = _estimate_depth(histograms, counted, method, device)
    return dataclasses.replace(read, truth=truth, gate=read.gate if counted else gate or read.gate)


def _in_depth(times: tuple[float, float] | None, path: Path, index: float | None) -> tuple[float, float] | None:
    """A gate [m] of one in time of flight [s]."""
    if times is not None and index is None:
        raise ArgumentError(f"{path}: a gate in time of flight needs a group index (group_index), or give two lengths")
    return times and checked_gate((range_from_time(times[0], index or 1.0), range_from_time(times[1], index or 1.0)))


def _with_background(held: Histograms, given: ArrayLike | BackgroundLaw | None) -> Histograms:
    """Counts without defects, with the background that is given, or with that of the file, or with an estimate."""
    if given is None and held.background is not None and (held.background_per_bin is None or held.pulses):
        return held
    assert held.response is not None
    own = "decay" if held.background is None else held.background_per_bin
    known: Any = own if given is None else given
    used = without_defects(held.values, known, held.response.per_bin(float(held.bin_width or 0.0)))
    notes = [used.estimated.summary] if used.estimated is not None and known != "none" else []
    notes += [used.defects.summary] if used.defects is not None else []
    level_known = used.level_known and (given is not None or held.level_known)
    return dataclasses.replace(
        held, values=used.counts, background=used.background, level_known=level_known, notes=(*held.notes, *notes)
    )


def _remark(held: Held) -> str:
    """The order of a dataset's frames, and why histograms that a file holds beside its depth are not used."""
    if isinstance(held, FrameReader):
        unused = "; its histograms are not used, since a dataset does not keep their background"
        return "; frames in the reader's order: train, validation, test" + (unused if held.histogram_bins else "")
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


def _estimate_depth(histograms: Histograms, counted: bool, method: Method | None, device: str | None) -> DepthReading:
    method = method or ("likelihood" if counted else "matched")
    if method in ("matched", "likelihood") and histograms.response is None:
        method = "centroid"
    # Of counts whose response is unknown, only what is significant: the networks know no noise of open water as even.
    reduced = depth_of(histograms, method=method, min_significance=0.0 if counted else None, device=device)
    scene = histograms.scene
    index = scene.medium.group_index if scene is not None else float(histograms.group_index or 1.0)
    gate_stop = histograms.gate_start + histograms.values.shape[-1] * float(histograms.bin_width or 0.0)
    known = histograms.background_per_bin
    backscatter = None if known is None else known.reshape(-1, known.shape[-1]).sum(axis=0, dtype=np.float64)
    depth = reduced.values.astype(np.float32)
    depth[depth <= 0.0] = np.nan  # a peak of noise at the time of the pulse
    dim = [] if counted else dim_pixels(histograms)
    source = "; ".join([f"{reduced.quantity} by {method} from histograms", *histograms.notes, *dim])
    return DepthReading(
        depth=depth, quantity=reduced.quantity, frames=reduced.frames > 1,
        profile=backscatter if backscatter is not None and backscatter.sum() > 0 else None,
        gate=(range_from_time(histograms.gate_start, index), range_from_time(gate_stop, index)), source=source,
        histograms=histograms if counted else None,
    )  # fmt: skip


def depth_at(time: NDArray[np.float64], histograms: Histograms) -> NDArray[np.float64]:
    """Depth [m] at times of flight `[..., H, W]` [s]; range where the view is not known."""
    if histograms.scene is not None:
        return depth_from_time(time, scene=histograms.scene)
    index, lines = geometry(histograms)
    distance = range_from_time(time, index)
    return distance if lines is None else lines.depth_from_range(distance)


def _within(held: Histograms, gate: tuple[float, float]) -> Histograms:
    """Those bins alone whose depth lies in a gate [m] in some pixel."""
    bins, width = held.values.shape[-1], float(held.bin_width or 0.0)
    times = [np.full(held.values.shape[-3:-1], held.gate_start + width * edge) for edge in (0, bins)]
    near, far = (depth_at(time, held) for time in times)
    first = max(0, int(np.floor(np.min((gate[0] - near) / (far - near)) * bins + 1e-6)))
    stop = min(bins, int(np.ceil(np.max((gate[1] - near) / (far - near)) * bins - 1e-6)))
    if stop <= first:
        extent = f"{near.min():.4g} to {far.max():.4g} m"
        raise ArgumentError(f"gate = ({gate[0]:g}, {gate[1]:g}) m lies outside the histograms, {extent}")
    known = held.background if held.background_per_bin is None else held.background_per_bin[..., first:stop]
    return dataclasses.replace(
        held, values=held.values[..., first:stop], gate_start=held.gate_start + first * width, background=known
    )


# Denoising: depth or histograms in, denoised depth out.


@dataclass(frozen=True, eq=False, kw_only=True)
class Denoised:
    """Output of `denoise_file`."""

    depth: NDArray[np.float32]  # [N, H, W] [m]
    target_probability: NDArray[np.float32]  # that a pixel sees a target
    threshold: float  # of this probability, from which on it counts as one
    confidence: NDArray[np.float32]  # probability that its depth is right
    gate: tuple[float, float]  # [m]
    files: tuple[Path, ...]
    notes: tuple[str, ...]  # for the user


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
    min_significance: float | None = None,
    **reading: Any,
) -> Denoised:
    """Denoises the depth in a file.

    Writes to `out`: `NAME.npy`, `NAME_target.npy`, `NAME_confidence.npy` (depth and the two probabilities of all
    frames), `NAME.exr` (all three of the first), and `NAME.png`, in which open water is left out. From counts also
    `NAME_second.npy`, the depth of a second return in the same pixel, NaN where there is none. In bright scenes this
    may be light that the water scattered into the pixel from another part of the target. `NAME_significance.npy`: that
    of the counts.

    Args:
        path: A result or frames of spadwarp, depth as EXR, NumPy or MATLAB, or measured histograms.
        out: The folder.
        model, weights, device, precision: See `spadwarp.denoise.estimate`.
        mask: Pixels that see a target with less than this probability become NaN; default: every pixel has a depth.
        min_significance: Of counts, pixels below it become NaN, see `Estimate`; default: that of the scene's detector,
            4 of measured histograms.
        gate: (start, stop) in depth [m]; of counts only the bins within it are used. Default: the file's, else all.
        profile: Backscatter over the gate `[bins]`; default: the file's, else as `estimate` does.
        reading: The other arguments of `read_depth`.

    Raises:
        FileError: A file cannot be read or written.
        ArgumentError: An argument out of range or missing.
    """
    folder, name = Path(out), Path(path).stem
    if folder.resolve() == Path(path).resolve().parent:
        raise ArgumentError(f"out = {folder} is the folder of {path}; another is needed: nothing is overwritten")
    mask = None if mask is None else check_real("mask", mask, "[0, 1]")
    if model not in BASELINES:
        require_torch()  # before the work begins
    read = read_depth(path, gate=gate, **reading)
    notes, gate = [read.source], gate or read.gate
    valid = read.depth[np.isfinite(read.depth) & (read.depth > 0)]
    if gate is None:
        if valid.size == 0:
            raise FileError(f"{path}: no pixel has a depth")
        low, high = float(valid.min()), float(valid.max())
        gate = (low, high if high > low else 1.001 * low)
        notes.append(f"gate {gate[0]:.4g} to {gate[1]:.4g} m, from the nearest to the farthest depth of the file")
    elif valid.size and gate[0] < gate[1]:  # a file without any depth stays empty
        slack = MARGIN * (gate[1] - gate[0])
        if not ((valid >= gate[0] - slack) & (valid <= gate[1] + slack)).any():
            extent = f"{valid.min():.4g} to {valid.max():.4g} m"
            raise ArgumentError(f"gate = ({gate[0]:g}, {gate[1]:g}) m holds none of the depths of the file, {extent}")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        second, held, profile = None, read.histograms, read.profile if profile is None else profile
        options: dict[str, Any] = {"model": model, "weights": weights, "device": device}
        uses_counts = held is not None and model in ("pyramid", *FROM_COUNTS)
        if uses_counts and (weights is None or weights_metadata(model, weights)["model"] == "histograms"):
            options["model"] = model = "histograms" if model == "pyramid" else model
            notes.append("denoised with its histograms")
            found, second = _from_counts(read, precision=precision, **options)
        else:
            found = estimate_depth(read.depth, gate=gate, profile=profile, precision=precision, **options)
        if held is not None:
            if min_significance is None:
                min_significance = 4.0 if held.scene is None else held.scene.detector.min_significance
            found = detected(found, _count_frames(held), model=model, min_significance=min_significance)
        depth = found.depth if mask is None else found.masked(mask)
    notes += [str(warning.message) for warning in caught]
    if empty := np.count_nonzero(np.isnan(depth).all(axis=(1, 2))):
        notes.append(f"{empty} of {len(depth)} frames are empty: nothing was reported, or no target is seen")
    if second is not None:
        some = f"{percent(np.isfinite(second).mean())} % of {second.size} pixels have"
        notes.append(f"{some} a second return, of a surface or of light scattered into them")
    threshold = target_threshold(model) if mask is None else mask
    shown = found.masked(threshold)[0]
    files = _write(folder, name, read, Estimate(depth, *found[1:]), second, model)
    notes += _worse(read.depth, depth, model, gate)
    target = found.target_probability >= threshold
    if target.any() and (sure := float(np.median(found.confidence[target]))) < 0.5:
        notes.append(f"unsure: half of the targets' depths have a confidence below {sure:.2f} ({name}_confidence.npy)")
    if model == "usdn" and weights is None:
        notes.append("usdn, for comparison: its depths are off by 1 to 3 cm even without noise; pyramid is better")
    style: dict[str, Any] = {"quantity": read.quantity, "title": f"{Path(path).name}: {model}"}
    files.append(draw_denoised(read.depth[0], shown, folder / f"{name}.png", gate=gate, truth=read.truth, **style))
    return Denoised(
        depth=depth, target_probability=found.target_probability, threshold=threshold, confidence=found.confidence,
        gate=gate, files=tuple(files), notes=tuple(notes),
    )  # fmt: skip


def _worse(depth: NDArray[np.float32], found: NDArray[np.float32], model: str, gate: tuple[float, float]) -> list[str]:
    """A note where depths move by more than the noise of the input: half of them, and the hundredth that moves most.

    On surfaces of the input alone, where of 5 × 5 pixels half of the depths, five or more, are within a hundredth of
    the gate from their median. From it a pixel's noise is measured, also of one that reported backscatter.
    """
    depth, found = (one[: max(1, _JUDGED // depth[0].size)] for one in (depth, found))
    padded = np.pad(depth, ((0, 0), (2, 2), (2, 2)), constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), (1, 2)).reshape(*depth.shape, 25)
    ascending = np.sort(around, axis=-1)  # NaN last
    reported = np.isfinite(ascending).sum(axis=-1, keepdims=True)
    middle = np.take_along_axis(ascending, np.maximum(reported - 1, 0) // 2, axis=-1)
    agreeing = (np.abs(ascending - middle) < 0.01 * (gate[1] - gate[0])).sum(axis=-1, keepdims=True)
    pair = np.abs([depth - middle[..., 0], found - depth])
    surface = (agreeing >= np.maximum(5, 0.5 * reported))[..., 0] & np.isfinite(pair).all(axis=0)
    noise, moved = np.quantile(pair[:, surface], (0.5, 0.99), axis=1).T if surface.any() else np.zeros((2, 2))
    if not ((moved > 1.8 * noise).all() and moved[0] > 1e-4):
        return []
    usual = 1e3 * noise[0] / 0.6745  # standard deviation
    text = f"worse: the input's noise is {usual:.2g} mm, but half of the pixels moved by {1e3 * moved[0]:.2g} mm"
    return [text if model in ("pyramid", "histograms") else f"{text}; model pyramid is more accurate"]


def _write(
    folder: Path, name: str, read: DepthReading, found: Estimate, second: NDArray[np.float32] | None, method: str
) -> list[Path]:
    """Writes the arrays and the EXR of `denoise_file`; their paths."""
    arrays: dict[str, Any] = {"": found.depth, "_target": found.target_probability, "_confidence": found.confidence}
    arrays |= {"_significance": found.significance, "_second": second}
    written = []
    for ending, values in arrays.items():
        if values is not None:
            written.append(write_array(folder / f"{name}{ending}.npy", values if read.frames else values[0]))
    metadata = {"content": "denoised depth", "method": method, "frame": "+x right, +y down, +z forward"}
    channels = {"Z" if read.quantity == "depth" else "range": found.depth, "confidence": found.confidence}
    channels["target_probability"] = found.target_probability
    first = {channel: np.ascontiguousarray(values[0]) for channel, values in channels.items()}
    return [*written, write_exr(folder / f"{name}.exr", first, metadata)]


def _count_frames(held: Histograms) -> CountFrames:
    """Counts whose response and background are known."""
    assert held.response is not None and held.background is not None
    response = held.response.per_bin(float(held.bin_width or 0.0)).astype(np.float32)
    return CountFrames(held.values, held.background, response, held.level_known)


def _from_counts(read: DepthReading, **options: Any) -> tuple[Estimate, NDArray[np.float32]]:
    """The estimate of a method that uses counts, in the bins that hold the target; and second returns [m]."""
    held = read.histograms
    assert held is not None and read.gate is not None
    frames, width = _count_frames(held), float(held.bin_width or 0.0)
    bins = target_bins(frames)
    start, extent = held.gate_start + bins.start * width, (bins.stop - bins.start) * width

    def to_depth(place: NDArray[np.float32]) -> NDArray[np.float64]:
        return depth_at(start + place.astype(np.float64) * extent, held)

    in_depth = (read.gate[1] - read.gate[0]) / held.values.shape[-1]
    found = estimate_histograms(read.depth, frames, bins=bins, bin_width=in_depth, to_depth=to_depth, **options)
    near, far = (to_depth(np.full_like(found.depth, place)) for place in (0.0, 1.0))
    counts, level, response = frames.part(bins)[:3]
    place = ((found.depth - near) / (far - near)).reshape(counts.shape[:-1])  # depth is linear in the place
    second = second_return(place, counts, background=level, response=response, device=options["device"])
    return found, to_depth(second.reshape(found.depth.shape)).astype(np.float32)


# Training: a recipe and a dataset in, weights, log and learning curves out.


def train(
    recipe: TrainingRecipe | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    notify: Callable[[str], None] | None = None,
) -> Trained:
    """Trains a denoiser, or resumes an interrupted training.

    Writes `MODEL.safetensors`, `log.jsonl`, `curves.png` and `checkpoint.pt` to the folder `out`. Ctrl-C or SIGTERM
    keep a checkpoint of the last step and raise KeyboardInterrupt.

    Args:
        recipe: From `spadwarp.denoise.load_training_recipe`, or the recipe's path.
        out: The run's folder; new, or with an interrupted run of the same recipe.
        device: torch device; default: the first GPU, else the CPU.
        progress: Called with ("steps", done, total) after every step.
        notify: Called with how long the training will take, once the first steps show it.

    Raises:
        ConfigError: A recipe that cannot be used, or a run of another recipe in the folder.
        FileError: The dataset cannot be read, or a file cannot be read or written.
        SpadwarpError: A package of the extra `denoise` is missing.
    """
    require_torch()
    from spadwarp.denoise.training import fit

    if not isinstance(recipe, TrainingRecipe):
        recipe = load_training_recipe(recipe)
    training = validation = None
    if recipe.data is not None:
        with file_of("data"):
            training, validation = (read_scenes(recipe.data, split) for split in ("train", "validation"))
    trained = fit(recipe, training, validation, Path(out), device=device, progress=progress, notify=notify)
    if trained.log.is_file() and trained.log.stat().st_size:
        log = [json.loads(line) for line in trained.log.read_text().splitlines()]
        draw_learning_curves(log, Path(out) / "curves.png", title=f"{recipe.model}, seed {recipe.seed}")
    return trained


def read_scenes(folder: str | os.PathLike[str], split: str) -> CleanScenes:
    """The clean scenes of a split of a dataset. Raises `FileError`."""
    import torch

    from spadwarp.denoise.synthetic_noise import CleanScenes

    parts: list[list[Any]] = []
    manifest = read_manifest(folder)
    for name in manifest["splits"][split]["shards"]:
        scenes = SceneFile(Path(folder), name, (manifest["height"], manifest["width"]))
        with closing(scenes.file):
            columns = [scenes.array(column) for column in ("depth", "bound", "backscatter_profile")]
            parts.append([*columns[:2], scenes.gate(), columns[2]])
    if not parts:
        more = "" if split == "train" else f"; name a target in targets.{split} of its recipe"
        raise FileError(f"{folder}: the dataset has no scenes for {split}{more}")
    depth, bound, gate, profile = (np.concatenate(arrays).astype(np.float32) for arrays in zip(*parts, strict=True))
    profile /= np.maximum(profile.mean(axis=1, keepdims=True), 1e-12)
    return CleanScenes(*map(torch.from_numpy, (depth, bound, gate, profile)))
