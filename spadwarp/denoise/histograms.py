"""Counts as the network for histograms and the classical estimates take them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import on_host, real_array
from spadwarp.denoise.defects import Defects, find_defects, repaired
from spadwarp.denoise.network_files import require_torch, torch_device
from spadwarp.frames.backgrounds import Background, BackgroundLaw, bins_of_target, estimate_background
from spadwarp.frames.measured import Histograms
from spadwarp.values import ArgumentError, percent

__all__ = ["second_return"]


def histogram_tensors(
    counts: ArrayLike, background: ArrayLike, response: ArrayLike, device: str | None
) -> Iterator[tuple[Any, Any, Any]]:
    """Counts `[1, H, W, T]`, background and response of each frame as the network takes them."""
    torch = require_torch()
    cubes, levels, taps = checked_histograms(counts, background, response)
    place = torch_device(device)
    tap = torch.from_numpy((taps / taps.sum())[None]).to(place)
    level = torch.from_numpy(levels if levels.ndim == 3 else levels[None, None])[None].to(place)
    level = level.clamp_min(1e-6 * float(level.mean()) + 1e-9)
    for cube in cubes.reshape(-1, *cubes.shape[-3:]):
        yield torch.from_numpy(cube.astype(np.float32)[None]).to(place), level, tap


def checked_histograms(
    counts: ArrayLike, background: ArrayLike, response: ArrayLike
) -> tuple[NDArray[Any], NDArray[np.float32], NDArray[np.float32]]:
    """Counts, background and response as arrays. Raises `ArgumentError`."""
    cubes = np.asarray(on_host(counts))
    if cubes.ndim not in (3, 4) or cubes.dtype.kind not in "biuf" or cubes.size == 0:
        raise ArgumentError(f"counts are {cubes.dtype} {cubes.shape}; numbers [H, W, T] or [N, H, W, T] are needed")
    low, high = cubes.min(), cubes.max()
    if not (low >= 0 and high < np.inf):
        raise ArgumentError(f"counts = {low} … {high} are outside [0, inf)")
    taps = real_array("response", response)
    if taps.ndim != 1 or taps.size % 2 == 0 or not (np.isfinite(taps).all() and taps.sum() > 0):
        raise ArgumentError(f"response has shape {taps.shape}; an odd number of values centred on time zero is needed")
    levels, one, each = real_array("background", background), cubes.shape[-1:], cubes.shape[-3:]
    levels = levels if levels.ndim else np.broadcast_to(levels, one)
    if levels.shape not in (one, each) or not (np.isfinite(levels).all() and (levels >= 0).all()):
        raise ArgumentError(f"background has shape {levels.shape}; (), {one} or {each} is needed, of numbers >= 0")
    return cubes, levels, taps


class Usable(NamedTuple):
    """Counts without defects, and what is known of them."""

    counts: NDArray[Any]  # [H, W, T] or [N, H, W, T]
    background: NDArray[np.float32]  # [T] or [H, W, T]
    response: NDArray[np.float32]
    defects: Defects | None  # None without any
    estimated: Background | None  # None where the background was given


def without_defects(counts: ArrayLike, background: ArrayLike | BackgroundLaw, response: ArrayLike) -> Usable:
    """Checked counts, of which those of defects are left out, also of the background. Raises `ArgumentError`.

    Rates have no defects.
    """
    law = background if isinstance(background, str) else None
    cubes, levels, taps = checked_histograms(counts, np.zeros(np.shape(counts)[-1]) if law else background, response)
    estimated = None if law is None else estimate_background(cubes, taps, law=law)
    levels = levels if estimated is None else estimated.counts
    if cubes.dtype.kind not in "biu" and not np.array_equal(cubes, np.rint(cubes)):
        return Usable(cubes, levels, taps, None, estimated)
    found = find_defects(cubes, levels, taps)
    if not found.summary:
        return Usable(cubes, levels, taps, None, estimated)
    cubes = repaired(cubes, found)
    if law is not None:
        estimated = estimate_background(cubes, taps, law=law)
        levels = estimated.counts
    return Usable(cubes, levels, taps, found, estimated)


_FEWEST, _MOST = 64, 512  # bins of the network
_WIDEST = 5.0  # deviation of a response [bins]; few in the training are wider


def merged_bins(bins: int, response: NDArray[Any]) -> int:
    """How many of so many bins the network sees as one: where there are too many, or far more than the response has."""
    place = np.arange(response.size) - response.size // 2
    deviation = float(np.sqrt(np.maximum((response * place**2).sum() / response.sum(), 0.0)))
    return max(-(-bins // _MOST), min(int(np.ceil(deviation / _WIDEST)), bins // _FEWEST), 1)


def target_bins(
    counts: NDArray[Any], background: NDArray[Any], response: NDArray[Any], gate: tuple[float, float]
) -> tuple[int, int, tuple[float, float]]:
    """First and last bin of the part of the gate that holds the target, and that part in depth [m].

    Of at least `_FEWEST` bins of the network, if the gate has so many: it knows no histograms with less.
    """
    cubes, levels, taps = checked_histograms(counts, background, response)
    first, stop = bins_of_target(cubes, levels, taps)
    bins = cubes.shape[-1]
    fewest = _FEWEST * merged_bins(bins, taps)
    first = max(0, min(first - max(0, fewest - (stop - first)) // 2, bins - fewest))
    stop = min(bins, max(stop, first + fewest))
    width = (gate[1] - gate[0]) / bins
    return first, stop, (gate[0] + first * width, gate[0] + stop * width)


def dim_pixels(histograms: Histograms) -> list[str]:
    """A note where pixels of expected histograms receive little light, but more than backscatter; none below 1 %.

    Expected light has no threshold: a pixel beside a target has the depth of the little light that water scattered into
    it, as smooth as that of the target, where a camera would report nothing.
    """
    values, known = histograms.values, histograms.background_per_bin
    signal, background = values.sum(axis=-1, dtype=np.float64), np.zeros(())
    if known is not None:
        background = known.sum(axis=-1, dtype=np.float64)
        signal = signal - background
    dim = float(((signal < 0.05 * np.quantile(signal, 0.9)) & (signal > background)).mean())
    if dim < 0.01:
        return []
    return [
        f"{percent(dim)} % of the pixels receive less than 5 % of the light of the bright ones: a depth there may be "
        "that of light scattered from beside, and count as a target; spadwarp detect draws the counts of a camera"
    ]


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

    The first return is taken off each histogram: as many counts as lie in it, in the shape of the response. In what
    remains, beyond the response, the counts of `side` × `side` pixels within the response's width have to exceed the
    background by more than happens by chance in one of 400 pixels (Poisson likelihood ratio). Light that the water
    scatters into a pixel from a brighter part of the target is such an excess, too: with hundreds of detections a pixel
    most pixels have a second return.

    Args:
        depth: First return over the gate, 0 at its start and 1 at its end, `[H, W]` or `[N, H, W]`.
        counts, background, response, device: See `spadwarp.denoise.estimate`, as for errors.
        side: Of the window over which histograms are pooled; 1 for each pixel alone.
    """
    torch = require_torch()
    from spadwarp.denoise.classical import highest, pooled
    from spadwarp.denoise.histogram_network import toeplitz

    first, cubes = real_array("depth", depth), np.asarray(on_host(counts))
    if first.shape != cubes.shape[:-1]:
        raise ArgumentError(f"depth has shape {first.shape}; {cubes.shape[:-1]} is needed")
    frames = first.reshape(-1, *first.shape[-2:])
    found = []
    with torch.inference_mode():
        tensors = histogram_tensors(cubes, background, response, device)
        for place, (cube, level, taps) in zip(frames, tensors, strict=True):
            bins = cube.shape[-1]
            at = (torch.from_numpy(np.nan_to_num(place)).to(cube.device)[None] * bins).long().clamp(0, bins - 1)
            apart = torch.arange(taps.shape[1], device=cube.device) - taps.shape[1] // 2
            width = float((taps[0] * apart.square()).sum().clamp_min(0.1).sqrt())
            shape = toeplitz(taps, bins)[0].t()[at]  # of the first return in each pixel
            near = (torch.arange(bins, device=cube.device) - at[..., None]).abs() <= 3.0 * width + 1.0
            signal = ((cube - level) * near).sum(dim=-1, keepdim=True).clamp_min(0.0)
            rest = torch.where(near, level.expand_as(cube), cube - signal * shape).clamp_min(0.0)
            reach = 2 * round(1.5 * width) + 1
            image = torch.cat([rest, level.expand_as(cube)])
            image = pooled(image, side) * side**2
            sums = torch.nn.functional.avg_pool1d(image.flatten(0, 2)[:, None], reach, 1, reach // 2)
            found_counts, expected = (sums.view_as(image) * reach).split(1)
            excess = torch.xlogy(found_counts, found_counts / expected) - (found_counts - expected)
            score = torch.where(near | (found_counts <= expected), 0.0, excess)
            significant = score.amax(dim=-1) > math.log(bins) + _BY_CHANCE
            found.append(torch.where(significant, highest(score), math.nan)[0].cpu().numpy())
    return np.stack(found).astype(np.float32)
