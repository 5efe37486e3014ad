"""Denoising of depth frames by a network with trained weights, or by one of the baselines."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import on_host, real_array
from spadwarp.denoise.baselines import BASELINES, CLASSICAL, FROM_COUNTS, METHODS, median_filter
from spadwarp.denoise.frames import DepthFrames, checked_gate, depth_frames, depth_values
from spadwarp.denoise.histograms import CountFrames, count_frames, merged_bins, target_bins, without_defects
from spadwarp.denoise.network_files import Precision, fast_precision, require_torch, torch_device
from spadwarp.frames.backgrounds import BackgroundLaw, profile_of_depth
from spadwarp.frames.depth import arrival_time
from spadwarp.frames.response import FWHM_PER_SIGMA, InstrumentResponse
from spadwarp.values import ArgumentError, SpadwarpWarning, check_choice, check_real

__all__ = ["METHODS", "Estimate", "estimate", "second_return"]

_ROWS = 64  # whose counts are summed at once: little memory
_PIXELS_AT_ONCE = {"cpu": 1 << 16, "cuda": 1 << 23}  # a batch that fits into a CPU's cache is faster


class Estimate(NamedTuple):
    """The answer of denoising, float32, each of the frames' shape."""

    depth: NDArray[np.float32]
    """[m]; an answer for every pixel of PyramidNet, except in frames without any report (NaN)."""
    target_probability: NDArray[np.float32]
    """Probability that the pixel sees a target and not only water. For methods that do not estimate it: 1 where the
    pixel reported, else 0."""
    confidence: NDArray[np.float32]
    """Probability that the depth is right to 1 % of the gate that holds the target; NaN for methods that do not
    estimate it."""
    significance: NDArray[np.float32] | None = None
    """Of the counts of the pixel for "likelihood", of 7 × 7 pixels for the others, which use those around it; see
    `spadwarp.arrival_time`. None without counts."""

    def masked(self, probability: float) -> NDArray[np.float32]:
        """Depth, NaN where a target is less probable than `probability`; 0.5 makes as few errors as possible."""
        probability = check_real("mask", probability, "[0, 1]")
        return np.where(self.target_probability >= probability, self.depth, np.float32(np.nan))


def estimate(
    depth: ArrayLike,
    *,
    gate: tuple[float, float],
    model: str = "pyramid",
    profile: ArrayLike | None = None,
    counts: ArrayLike | None = None,
    background: ArrayLike | BackgroundLaw = "decay",
    response: ArrayLike | None = None,
    min_significance: float = 4.0,
    weights: str | Path | None = None,
    device: str | None = None,
    precision: Precision | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Estimate:
    """Denoises depth frames: depth, and the probabilities that a pixel sees a target and that its depth is right.

    Args:
        depth: `[H, W]` or `[N, H, W]` [m], planar depth or range; NaN and 0 mean that nothing was reported.
        gate: (start, stop) of the camera's gate, in depth or range as `depth` is [m]. Distances need not be those of
            the training: networks see depth over the gate, or over the part of it that holds the target.
        model: "pyramid", "dncnn" or "usdn"; or a baseline: "median", "gating", "bm3d". With counts, "pyramid" means
            "histograms", the network that uses them; "likelihood", "pooled", "semi-global",
            "total-variation" and "belief-propagation" are classical estimates from counts.
        profile: The water's backscatter over the gate in equal bins, `[bins]`, in any unit; default: estimated
            from depths that clearly decay beside those of targets, else flat. PyramidNet and gating use it.
        counts: Histograms that `depth` was estimated from, over the gate in equal bins, `[H, W, T]` or `[N, H, W, T]`.
            PyramidNet uses them, with `response`: where photons are few, neighbouring pixels together show more than
            each alone.
        background: Expected background counts, a number, the same for all pixels `[T]`, or of each pixel `[H, W, T]`;
            or the law by which `spadwarp.frames.estimate_background` estimates them: "decay", "flat" or "none".
        response: Instrument response per bin centred on its time zero, `[2 r + 1]`, as
            `spadwarp.frames.InstrumentResponse.per_bin` gives it.
        min_significance: Of counts, pixels below this significance have no depth; 0: every pixel has one.
        weights: File of `spadwarp train`; default: the weights of the package.
        device: torch device of the network; default: the first GPU, else the CPU.
        precision: Of the layers of PyramidNet and of the network for histograms, "float16", "bfloat16" or "float32".
            Default: bfloat16 on a CPU with AMX, where layers take half the time and depths change by less than 0.1 mm
            in the median; float16 of PyramidNet on a GPU; else float32, which gives the same depth on every processor,
            to rounding.
        progress: Called with ("frames", done, total).

    Raises:
        ArgumentError: An argument out of range.
        SpadwarpError: A package of the extra `denoise` is missing; a device that does not exist; weights that cannot be
            read.
    """
    if model == "pyramid" and counts is not None:
        model = "histograms"
    check_choice("model", model, METHODS)
    gate, depth = checked_gate(gate), depth_values(depth)
    if precision is not None:
        check_choice("precision", precision, get_args(Precision))
    options: dict[str, Any] = {"model": model, "weights": weights, "device": device, "precision": precision}
    if model not in FROM_COUNTS:
        found = estimate_depth(depth, gate=gate, profile=profile, progress=progress, **options)
    else:
        if counts is None or response is None:
            raise ArgumentError(f"model = {model!r} needs counts and response, of which some are missing")
        frames = without_defects(counts, background, response)
        if depth.shape != frames.counts.shape[:-1]:
            raise ArgumentError(f"depth has shape {depth.shape}; {frames.counts.shape[:-1]} is needed, that of counts")
        if model in CLASSICAL and weights is not None:
            raise ArgumentError(f"weights are for a network, not for {model!r}")
        if frames.defects is not None:
            warnings.warn(frames.defects.summary, SpadwarpWarning, stacklevel=2)
            hidden = frames.defects.hide(depth, gate, frames.response.size)
            depth = np.where(hidden, np.float32(np.nan), depth)
        bins, width = target_bins(frames), (gate[1] - gate[0]) / frames.counts.shape[-1]
        start, stop = gate[0] + bins.start * width, gate[0] + bins.stop * width
        options["to_depth"] = lambda place: start + (stop - start) * place
        found = estimate_histograms(depth, frames, bins=bins, bin_width=width, **options)
        found = detected(found, frames, model=model, min_significance=min_significance)
    shaped: Any = (None if values is None else values.reshape(np.shape(depth)) for values in found)
    return Estimate(*shaped)


def detected(found: Estimate, given: CountFrames, *, model: str, min_significance: float) -> Estimate:
    """`found` with the significance of the counts, and neither depth nor target below the least; of rates as it is."""
    least, counts = check_real("min_significance", min_significance, "[0, 1000]"), given.counts
    if given.are_rates:
        return found
    side = 1 if model == "likelihood" else 7

    def summed(cube: NDArray[Any]) -> NDArray[Any]:  # over the pixels of a window that are in the frame
        for axis in (0, 1):
            total = cube.copy()
            ahead, sums = np.moveaxis(cube, axis, 0), np.moveaxis(total, axis, 0)
            for step in range(1, min(side // 2, len(sums) - 1) + 1):
                sums[step:] += ahead[:-step]
                sums[:-step] += ahead[step:]
            cube = total
        return cube

    frames = counts.reshape(-1, *counts.shape[-3:])
    known, height = np.asarray(given.background, np.float64), frames.shape[1]
    significance = np.empty(frames.shape[:-1], np.float32)
    options: dict[str, Any] = {"level_known": given.level_known, "device": "cpu"}
    half = np.flatnonzero(given.response >= 0.5 * np.max(given.response))
    width = (half[-1] - half[0] + 1) * (1.0 - 1e-9)  # bins, and not one more by rounding
    options["irf"] = InstrumentResponse(sigma=width * 1e-12 / FWHM_PER_SIGMA)
    for top in range(0, height, _ROWS):
        first, stop = max(0, top - side // 2), top + _ROWS + side // 2
        inner = slice(top - first, top - first + _ROWS)
        if known.ndim == 1:
            level = known * summed(np.ones((*frames[0, first:stop].shape[:2], 1)))
        else:
            level = summed(known[first:stop])
        options["background"] = np.maximum(level[inner], 0.0)
        for cube, image in zip(frames, significance, strict=True):
            some, out = summed(cube[first:stop].astype(np.int64))[inner], image[top : top + _ROWS]
            arrival_time(some, gate_start=0.0, bin_width=1e-12, significance=out, **options)
    significance = significance.reshape(found.depth.shape)
    depth = np.where(significance >= least, found.depth, np.float32(np.nan))
    probability = np.where(significance >= least, found.target_probability, np.float32(0.0))
    return found._replace(depth=depth, target_probability=probability, significance=significance)


_COARSE = 0.76  # part of the light in one bin, from which on the FWHM of a Gaussian response is less than a bin


def estimate_histograms(
    depth: NDArray[Any],
    frames: CountFrames,
    *,
    bins: slice,
    bin_width: float,
    model: str,
    to_depth: Callable[[NDArray[np.float32]], NDArray[Any]],
    weights: str | Path | None,
    device: str | None,
    precision: Precision | None = None,
) -> Estimate:
    """`estimate` for the methods that use counts, in the bins that hold the target; `bin_width` is in depth [m]."""
    require_torch()
    from spadwarp.denoise.classical import classical_depth

    frames = frames.part(bins)
    if model in CLASSICAL:
        place = classical_depth(frames, method=model, device=device)  # type: ignore[arg-type]
        found = np.stack([place, np.ones_like(place), np.full_like(place, np.nan)])
    else:
        found = _empty_where(depth, _by_network(frames, weights, torch_device(device), precision))
    found[0] = to_depth(found[0])
    found = found.reshape(3, *depth.shape)
    response = frames.response
    if np.max(response) >= _COARSE * np.sum(response):  # histograms tell no place within a bin; the pixel's light does
        found[0] = np.where(np.abs(depth - found[0]) < bin_width, depth, found[0])
    return Estimate(*found)


def _empty_where(depth: NDArray[Any], found: NDArray[np.float32]) -> NDArray[np.float32]:
    """The arrays of an `Estimate`, `[3, N, H, W]`, without depth and target in frames without any report."""
    empty = ~((depth > 0) & np.isfinite(depth)).reshape(found.shape[1:]).any(axis=(1, 2))
    found[0, empty], found[1, empty] = np.nan, 0.0
    return found


_MARGIN = 32  # pixels around a part of a large frame that are seen, too
_AT_ONCE = 6 << 20  # bins of all pixels that are computed at once: in float32 less than the 32 MiB that malloc keeps
_LEAST_PART = 96  # pixels of a side: smaller parts would see more of others than of their own


def _parts(length: int, most: int) -> list[tuple[slice, slice, slice]]:
    """A side in equal parts of at most so many pixels: what is answered, what is seen for it, and where in this."""
    count = -(-length // most)
    step = -(-length // (16 * count)) * 16  # whole strides of the network
    parts = [(first, max(0, first - _MARGIN), first + step) for first in range(0, length, step)]
    return [(slice(one, stop), slice(low, stop + _MARGIN), slice(one - low, stop - low)) for one, low, stop in parts]


def _by_network(
    given: CountFrames, weights: str | Path | None, place: Any, precision: Precision | None
) -> NDArray[np.float32]:
    """Depth over the gate, target probability and confidence, `[3, N, H, W]`."""
    torch = require_torch()
    from spadwarp.denoise.histogram_network import answer, halved, rebinned
    from spadwarp.denoise.networks import load_network

    frames, level = given.counts.reshape(-1, *given.counts.shape[-3:]), given.background
    height, width, bins = frames.shape[1:]
    found = np.empty((3, *frames.shape[:3]), np.float32)
    network, merged = load_network("histograms", weights, str(place)), merged_bins(bins, given.response)
    kind = precision or (fast_precision("cpu") if place.type == "cpu" else "float32")
    layers = torch.autocast(place.type, dtype=getattr(torch, kind), enabled=kind != "float32")
    most = max(_LEAST_PART, math.isqrt(int(_AT_ONCE * merged / bins)) - 2 * _MARGIN)
    with torch.inference_mode():
        parts = product(_parts(height, most), _parts(width, most))
        for (rows, seen_rows, inner_rows), (columns, seen_columns, inner_columns) in parts:
            seen = np.s_[..., seen_rows, seen_columns, :]
            part = given._replace(counts=frames[seen], background=level[seen] if level.ndim == 3 else level)
            for image, (cube, known, taps) in zip(found.swapaxes(0, 1), part.tensors(str(place)), strict=True):
                if merged > 1:
                    cube, known, taps = rebinned(cube, known, taps, int(merged))
                elif merged < 1:
                    cube, known, taps = halved(cube, known, taps)
                with layers:
                    probability, target = network(cube, known, taps)
                depth, confidence = answer(probability)
                depth *= merged * cube.shape[-1] / bins  # the last of merged bins may reach beyond the gate
                answers = torch.cat([depth, target.sigmoid(), confidence])
                image[:, rows, columns] = answers[:, inner_rows, inner_columns].cpu().numpy()
    return found


def target_threshold(model: str) -> float:
    """The probability from which on a pixel counts as one that sees a target, by the name of the method."""
    # With 0.08 PyramidNet misses 0.6 % of the target in drawn scenes in open water that no training saw, 2.7 % with the
    # noise of the training; its probabilities are too low on thin structures.
    return 0.08 if model == "pyramid" else 0.5


def estimate_depth(
    depth: NDArray[np.float32], *, gate: tuple[float, float], model: str, profile: ArrayLike | None, **options: Any
) -> Estimate:
    """`estimate` for the methods that use depth alone; `options`: of `estimate_frames`."""
    if profile is None and model in ("pyramid", "gating"):
        profile = profile_of_depth(depth, gate)
    return estimate_frames(depth_frames(depth, gate=gate, profile=profile), model=model, **options)


def estimate_frames(
    frames: DepthFrames,
    *,
    model: str,
    window: int = 5,
    weights: str | Path | None = None,
    device: str | None = None,
    precision: Precision | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Estimate:
    """`estimate` for frames `[N, H, W]`.

    `model` may also be "input", the frames as they are; `window`: side of the median, odd [pixels]. Networks without an
    answer of their own for a pixel give it the gate's end.
    """
    if model != "input":
        check_choice("model", model, METHODS)
    if precision is not None:
        check_choice("precision", precision, get_args(Precision))
    if model in FROM_COUNTS:
        raise ArgumentError(f"model = {model!r} needs counts with their background and response; they are missing")
    if model in BASELINES:
        if weights is not None:
            raise ArgumentError(f"weights are for a network, not for {model!r}")
        filtered = median_filter(frames, window=window) if model == "median" else BASELINES[model](frames)
        arrays = np.stack([filtered, ~np.isnan(frames.depth), np.full_like(filtered, np.nan)]).astype(np.float32)
        return Estimate(*_empty_where(frames.depth, arrays))
    torch = require_torch()
    from spadwarp.denoise.networks import corrected_target, load_network, narrowed_input

    place = torch_device(device)
    kind = "float32" if model != "pyramid" else precision or fast_precision(str(place))
    network = load_network(model, weights, str(place), kind)
    inputs = None if model == "pyramid" else frames.filled()[:, None]
    begin, extent = frames.gate[0], frames.gate[1] - frames.gate[0]
    part = max(1, _PIXELS_AT_ONCE[place.type] // frames.depth[0].size)
    answers, finite = torch.empty(3, *frames.depth.shape), True
    for first in range(0, len(frames.depth), part):
        some = slice(first, first + part)
        with torch.inference_mode():
            depth = torch.from_numpy(frames.depth[some]).to(place)
            reported = ~torch.isnan(depth)
            if inputs is None:
                density = torch.from_numpy(frames.density[some]).to(place)
                given, start, width, share = narrowed_input((depth - begin) / extent, density)
            else:
                given = torch.from_numpy(inputs[some]).to(place)
            output = network(given).float()
            finite &= bool(output.isfinite().all())
            found = output[:, 0].clamp_(0.0, 1.0)
            if inputs is None:
                found.mul_(width[:, None, None]).add_(start[:, None, None])
                output[:, 1] = corrected_target(output[:, 1], depth, given[:, 1], share)
            found.mul_(extent).add_(begin)
            probability, confidence = reported.float(), torch.full_like(found, torch.nan)
            if output.shape[1] > 1:
                probability, confidence = output[:, 1:3].sigmoid_().unbind(dim=1)
            answers[:, some] = torch.stack([found, probability, confidence])
        if progress is not None:
            progress("frames", min(first + part, len(frames.depth)), len(frames.depth))
    if not finite:  # values beyond the range of float16, or weights that are not finite
        if kind == "float32" or precision is not None:
            raise ArgumentError(f"precision = {kind!r}: the network {model!r} gave values that are not finite")
        return estimate_frames(frames, model=model, weights=weights, device=device, precision="float32")
    return Estimate(*_empty_where(frames.depth, answers.numpy()))


_BY_CHANCE = 6.0  # log of the false second returns that are accepted, one in e^6 pixels


def second_return(
    depth: ArrayLike,
    counts: ArrayLike,
    *,
    background: ArrayLike,
    response: ArrayLike,
    side: Literal[1, 3, 5, 7, 9] = 3,
    device: str | None = None,
) -> NDArray[np.float32]:
    """Depth over the gate of a second return `[N, H, W]`; NaN where there is no significant one.

    The first return is taken off each histogram: as many counts as lie in it, in the shape of the response, and what
    comes later of it in the mean of all pixels, never more than earlier. In what remains, beyond the response, the
    counts of `side` × `side` pixels within the response's width have to exceed the background by more than happens by
    chance in one of 400 pixels (Poisson likelihood ratio). Light that the water scatters into a pixel from a brighter
    part of the target is such an excess, too: with hundreds of detections a pixel most pixels have a second return.

    Args:
        depth: First return over the gate, 0 at its start and 1 at its end, `[H, W]` or `[N, H, W]`.
        counts, background, response, device: See `estimate`, as for errors.
        side: Of the window over which histograms are pooled; 1 for each pixel alone.
    """
    torch = require_torch()
    from spadwarp.denoise.classical import deviation, highest, pooled, toeplitz

    first, cubes = real_array("depth", depth), np.asarray(on_host(counts))
    if first.shape != cubes.shape[:-1]:
        raise ArgumentError(f"depth has shape {first.shape}; {cubes.shape[:-1]} is needed")
    frames = first.reshape(-1, *first.shape[-2:])
    found = []
    with torch.inference_mode():
        tensors = count_frames(cubes, background, response).tensors(device)
        for place, (cube, level, taps) in zip(frames, tensors, strict=True):
            bins = cube.shape[-1]
            at = (torch.from_numpy(np.nan_to_num(place)).to(cube.device)[None] * bins).long().clamp(0, bins - 1)
            width = float(deviation(taps, 0.1))
            shape = toeplitz(taps, bins)[0].t()[at]  # of the first return in each pixel
            delay = torch.arange(bins, device=cube.device) - at[..., None]
            near = delay.abs() <= 3.0 * width + 1.0
            above, late = cube - level, ~near & (delay > 0)
            signal = (above * near).sum(dim=-1, keepdim=True).clamp_min(0.0)
            reach = 2 * round(1.5 * width) + 1
            known = level + torch.where(late, signal * _late_light(above, signal, delay, late, reach), 0.0)
            rest = torch.where(near, known, cube - signal * shape).clamp_min(0.0)
            image = pooled(torch.cat([rest, known]), side) * side**2
            sums = torch.nn.functional.avg_pool1d(image.flatten(0, 2)[:, None], reach, 1, reach // 2)
            found_counts, expected = (sums.view_as(image) * reach).split(1)
            excess = torch.xlogy(found_counts, found_counts / expected) - (found_counts - expected)
            score = torch.where(near | (found_counts <= expected), 0.0, excess)
            significant = score.amax(dim=-1) > math.log(bins) + _BY_CHANCE
            found.append(torch.where(significant, highest(score), math.nan)[0].cpu().numpy())
    return np.stack(found).astype(np.float32)


def _late_light(above: Any, signal: Any, delay: Any, late: Any, reach: int) -> Any:
    """Part of a first return that comes so many bins later in the mean of the frame, never more than earlier.

    `[1, H, W, T]`. So a second surface behind all of the frame is none of it. `reach`: odd, bins of the mean.
    """
    torch = require_torch()
    bins = above.shape[-1]
    sums = torch.zeros(2, bins, dtype=torch.float64, device=above.device)
    for row in range(above.shape[1]):  # little memory
        chosen = late[:, row]
        for total, part in zip(sums, (above[:, row], signal[:, row].expand_as(above[:, row])), strict=True):
            total.index_add_(0, delay[:, row][chosen], part[chosen].double())
    excess, weight = torch.nn.functional.avg_pool1d(sums, reach, 1, reach // 2)
    falling = torch.where(weight > 0, excess / weight, torch.inf).cummin(dim=0).values.clamp_min(0.0)
    return torch.where(falling.isfinite(), falling, 0.0).to(above)[delay.clamp(0, bins - 1)]
