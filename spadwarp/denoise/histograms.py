"""Counts as the network for histograms and the classical estimates take them: checked, and without defects.

Defects are pixels, rows, columns and bins that count what is not light. A defect differs from what any scene can give,
in Poisson counts n of one pixel, row, column or bin:

- *stuck* at a time: light of a return spreads over the instrument response h, so that of any scene the expected counts
  of a bin are at most max h_k / (h_{k−1} + h_{k+1}) times those of its two neighbours; given their sum, n is binomial;
- *dead*: n is below the background, which reaches every pixel;
- *hot*: n is above the background, without a return.

Tests are exact and together have a false-alarm level of `FALSE_ALARMS` in a frame, for each kind. They allow for a
response half as wide as given, and for a background of half and of twice that given.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import on_host, real_array
from spadwarp.denoise.frames import nearest
from spadwarp.denoise.network_files import require_torch, torch_device
from spadwarp.frames.backgrounds import Background, BackgroundLaw, bins_of_target, estimate_background, return_width
from spadwarp.frames.measured import Histograms
from spadwarp.values import ArgumentError, percent


class CountFrames(NamedTuple):
    """Counts with what is known of them."""

    counts: NDArray[Any]  # [H, W, T] or [N, H, W, T]
    background: NDArray[np.float32]  # expected counts of each bin, [T] or [H, W, T]; [H, W, 1] if of all the same
    response: NDArray[np.float32]  # per bin, [2 r + 1]
    level_known: bool = True  # whether the background is known apart from these counts
    estimated: Background | None = None  # None where the background was given
    defects: Defects | None = None  # None without any

    @property
    def are_rates(self) -> bool:
        """Whether some counts are no whole numbers."""
        return self.counts.dtype.kind not in "biu" and not np.array_equal(self.counts, np.rint(self.counts))

    def part(self, bins: slice) -> CountFrames:
        """The same in some bins, of which each has its background."""
        shape = self.counts.shape[-3:] if self.background.ndim == 3 else self.counts.shape[-1:]
        level = np.broadcast_to(self.background, shape)
        return self._replace(counts=self.counts[..., bins], background=level[..., bins])

    def tensors(self, device: str | None) -> Iterator[tuple[Any, Any, Any]]:
        """Counts `[1, H, W, T]`, background and response of each frame as the network takes them."""
        torch = require_torch()
        place, (cubes, levels, taps) = torch_device(device), self[:3]
        tap = torch.from_numpy((taps / taps.sum())[None]).to(place)
        level = torch.tensor(levels if levels.ndim == 3 else levels[None, None])[None].to(place)
        level = level.clamp_min(1e-6 * float(level.mean()) + 1e-9)
        for cube in cubes.reshape(-1, *cubes.shape[-3:]):
            yield torch.from_numpy(cube.astype(np.float32)[None]).to(place), level, tap


def count_frames(counts: ArrayLike, background: ArrayLike | BackgroundLaw, response: ArrayLike) -> CountFrames:
    """Counts, background and response, checked; the background by a law is estimated. Raises `ArgumentError`."""
    if isinstance(background, str):
        given = count_frames(counts, np.zeros(np.shape(counts)[-1]), response)
        found = estimate_background(given.counts, given.response, law=background)
        return given._replace(background=found.counts, level_known=False, estimated=found)
    cubes = np.asarray(on_host(counts))
    if cubes.ndim not in (3, 4) or cubes.dtype.kind not in "biuf" or cubes.size == 0:
        raise ArgumentError(f"counts are {cubes.dtype} {cubes.shape}; numbers [H, W, T] or [N, H, W, T] are needed")
    low, high = cubes.min(), cubes.max()
    if not (low >= 0 and high < np.inf):
        raise ArgumentError(f"counts = {low} … {high} are outside [0, inf)")
    taps = real_array("response", response)
    if taps.ndim != 1 or taps.size % 2 == 0 or not (np.isfinite(taps).all() and taps.sum() > 0):
        raise ArgumentError(f"response has shape {taps.shape}; an odd number of values centred on time zero is needed")
    one, each = cubes.shape[-1:], cubes.shape[-3:]
    levels = real_array("background", background, shapes=((), one, each), within="[0, inf)")
    return CountFrames(cubes, levels if levels.ndim else np.broadcast_to(levels, one), taps)


def without_defects(counts: ArrayLike, background: ArrayLike | BackgroundLaw, response: ArrayLike) -> CountFrames:
    """Checked counts, of which those of defects are left out, also of the background. Raises `ArgumentError`.

    Rates have no defects.
    """
    given = count_frames(counts, background, response)
    if given.are_rates or not (defects := find_defects(*given[:3])).summary:
        return given
    cubes = repaired(given.counts, defects)
    if isinstance(background, str):
        given = count_frames(cubes, background, response)
    return given._replace(counts=cubes, defects=defects)


_LEAST_BINS, _MOST_BINS = 64, 512  # of the network
_NARROWEST, _WIDEST = 1.0, 5.0  # deviation of a response [bins]; few in the training are wider


def merged_bins(bins: int, response: NDArray[Any]) -> float:
    """How many of so many bins the network sees as one: several where there are too many, or the response has far more.

    0.5, each as two halves, where most of a return may fall into one: a bin is then too coarse for depths.
    """
    place = np.arange(response.size) - response.size // 2
    deviation = float(np.sqrt(np.maximum((response * place**2).sum() / response.sum(), 0.0)))
    if deviation < _NARROWEST and 2 * bins <= _MOST_BINS:
        return 0.5
    return max(-(-bins // _MOST_BINS), min(int(np.ceil(deviation / _WIDEST)), bins // _LEAST_BINS), 1)


def target_bins(frames: CountFrames) -> slice:
    """The bins of the part of the gate that holds the target.

    At least `_LEAST_BINS` bins of the network, if the gate has so many: it knows no histograms with less.
    """
    counts, background, response = frames.part(slice(None))[:3]
    (first, stop), bins = bins_of_target(counts, background, response), counts.shape[-1]
    fewest = int(_LEAST_BINS * merged_bins(bins, response))
    first = max(0, min(first - max(0, fewest - (stop - first)) // 2, bins - fewest))
    return slice(first, min(bins, max(stop, first + fewest)))


def dim_pixels(histograms: Histograms) -> list[str]:
    """A note where pixels of expected histograms receive little light, but more than backscatter; none below 1 %.

    Expected light has no threshold: a pixel beside a target has the depth of the little light that water scattered into
    it, as smooth as that of the target, where a camera would report nothing.
    """
    values, known = histograms.values, histograms.background_per_bin
    background = np.zeros(()) if known is None else known.sum(axis=-1, dtype=np.float64)
    signal = values.sum(axis=-1, dtype=np.float64) - background
    dim = float(((signal < 0.05 * np.quantile(signal, 0.9)) & (signal > background)).mean())
    if dim < 0.01:
        return []
    return [
        f"{percent(dim)} % of the pixels receive less than 5 % of the light of the bright ones: a depth there may be "
        "that of light scattered from beside, and count as a target; spadwarp detect draws the counts of a camera"
    ]


# Defects of a camera.

FALSE_ALARMS = 1e-3
"""Probability that a frame without defects has one, of each kind of test."""

_WRONG = 2.0  # factor by which the width of the response and the background may be wrong
_NO_RETURN = 0.01  # probability that chance gives a hot pixel its highest window
_MOST = 0.2  # part of the pixels or bins: more are no defects, but another response or background
_AROUND = 5  # side of the window whose median is usual
_AT_ONCE = 1 << 20  # bins of all pixels that are tested at once: little memory
_FEWEST = 4  # counts of a stuck bin: fewer are no proof


class Defects(NamedTuple):
    """Which pixels `[H, W]` and bins `[T]` do not count light; rows and columns among the pixels."""

    pixels: NDArray[np.bool_]
    bins: NDArray[np.bool_]
    lines: int  # rows and columns of pixels

    @property
    def summary(self) -> str:
        """One sentence for the user; "" without defects."""
        kinds = ("pixels", self.pixels), ("bins", self.bins)
        parts = " and ".join(f"{wrong.sum()} of {wrong.size} {kind}" for kind, wrong in kinds if wrong.any())
        whole = f" (whole rows or columns: {self.lines})" if self.lines else ""
        return parts and f"{parts} are stuck, hot or dead and left out{whole}"

    def hide(self, depth: NDArray[Any], gate: tuple[float, float], reach: int) -> NDArray[np.bool_]:
        """Which depths `[..., H, W]` [m] are of such a pixel, or less than `reach` / 2 bins from such a bin."""
        from scipy.ndimage import binary_dilation

        hidden = np.broadcast_to(self.pixels, depth.shape)
        if self.bins.any():
            near = binary_dilation(self.bins, iterations=max(1, reach // 2))
            place = (np.nan_to_num(depth) - gate[0]) / (gate[1] - gate[0]) * self.bins.size
            hidden = hidden | near[np.clip(place.astype(np.int64), 0, self.bins.size - 1)]
        return hidden


def find_defects(counts: NDArray[Any], background: NDArray[Any], response: NDArray[Any]) -> Defects:
    """Defects of counts `[H, W, T]` or `[N, H, W, T]`, of all frames together.

    `background`: expected counts of a frame, `[T]` or `[H, W, T]`; `response`: per bin, centred on its time zero.
    """
    from scipy.ndimage import median_filter

    frames = counts.reshape(-1, *counts.shape[-3:])
    cube = frames[0] if len(frames) == 1 else frames.sum(axis=0, dtype=np.int64)
    height, width, bins = cube.shape
    none = Defects(np.zeros((height, width), bool), np.zeros(bins, bool), 0)
    level = len(frames) * np.asarray(background, np.float64)
    taps = np.asarray(response, np.float64)
    most, window = _steepest(taps), return_width(taps)
    pixels, lines = _wrong_pixels(cube, level, most, window)
    if wrong_everywhere := bool(pixels.mean() > _MOST):  # by a bin, perhaps
        pixels, lines = none.pixels, 0
    total = cube.sum(axis=(0, 1), dtype=np.int64) - cube[pixels].sum(axis=0, dtype=np.int64)
    usual = (~pixels).sum() * level if level.ndim == 1 else level[~pixels].sum(axis=0)
    around = median_filter(total, _AROUND, mode="mirror")  # the background may be wrong at a bin
    wrong_bins = _stuck(total, most) | _dead(total, np.minimum(usual, around), bins)
    if wrong_bins.mean() > _MOST:
        return none
    if wrong_everywhere and wrong_bins.any():
        pixels, lines = _wrong_pixels(cube[..., ~wrong_bins], level[..., ~wrong_bins], most, window)
    if pixels.mean() > _MOST:
        pixels, lines = none.pixels, 0
    return Defects(pixels, wrong_bins, lines)


def _wrong_pixels(
    cube: NDArray[Any], level: NDArray[np.float64], most: float, width: int
) -> tuple[NDArray[np.bool_], int]:
    """Pixels `[H, W]` that are stuck, dead or hot, alone or as rows and columns, and how many of these."""
    each = np.broadcast_to(level.sum(axis=-1), cube.shape[:2])
    shape = level if level.ndim == 1 else level.mean(axis=(0, 1))
    pixels = np.zeros(cube.shape[:2], bool)
    if min(pixels.shape) > _AROUND:
        pixels = _wrong(cube, each, shape, most, width)
    sums = [cube.sum(axis=axis, dtype=np.int64) for axis in (0, 1)]

    def wrong_lines(axis: int) -> NDArray[np.bool_]:
        """Of the lines along an axis, without the pixels that are known to be wrong."""
        if pixels.shape[1 - axis] <= _AROUND:
            return np.zeros(pixels.shape[1 - axis], bool)
        counts, place = sums[axis].copy(), np.nonzero(pixels)[1 - axis]
        line, first = np.unique(np.sort(place), return_index=True)
        if line.size:
            known = cube[pixels][np.argsort(place, kind="stable")]
            counts[line] -= np.add.reduceat(known, first, axis=0, dtype=np.int64)
        return _wrong(counts, (each * ~pixels).sum(axis=axis), shape, most, width)

    lines = 0
    first = min((0, 1), key=lambda axis: wrong_lines(axis).mean() or 1.0)  # a wrong column shows in each row's sum
    for axis in (first, 1 - first):
        wrong = wrong_lines(axis)
        lines += int(wrong.sum())
        pixels = pixels | np.expand_dims(wrong, axis)
    return pixels, lines


def repaired(counts: NDArray[Any], found: Defects) -> NDArray[Any]:
    """The counts with those of the nearest good pixel and bin in place of each defect: none of its own are used."""
    if found.bins.any():
        counts = counts[..., nearest(found.bins)[0]]
    if found.pixels.any():
        rows, columns = nearest(found.pixels)
        counts = counts[..., rows, columns, :]
    return counts


def _wrong(
    counts: NDArray[Any], expected: NDArray[np.float64], shape: NDArray[np.float64], most: float, width: int
) -> NDArray[np.bool_]:
    """Which histograms `[..., T]` are stuck, dead or hot; `expected`: background of each, over bins of this `shape`."""
    from scipy.ndimage import median_filter

    total = counts.sum(axis=-1, dtype=np.int64)
    around = median_filter(total, _AROUND, mode="mirror").astype(np.float64)  # which a defect leaves as it is
    wrong = _dead(total, np.minimum(expected, around), total.size)
    bright = _above(total, _WRONG * expected, total.size)
    shape = shape / max(shape.sum(), 1e-12)
    parts = -(-counts.size // _AT_ONCE)
    given = (np.array_split(one, parts) for one in (wrong, counts, expected, bright))
    for part, some, level, chosen in zip(*given, strict=True):
        part |= _stuck(some, most, total.size).any(axis=-1)
        part[chosen] |= _hot(some[chosen], level[chosen, None] * shape, total.size, width)
    return wrong


def _dead(counts: NDArray[Any], expected: NDArray[np.float64], tests: int) -> NDArray[np.bool_]:
    from scipy.special import pdtr

    return np.asarray(pdtr(counts, expected / _WRONG) < FALSE_ALARMS / tests)


def _above(counts: NDArray[Any], expected: NDArray[np.float64], tests: int) -> NDArray[np.bool_]:
    from scipy.special import pdtrc

    return np.asarray((counts > 0) & (pdtrc(counts - 1.0, np.maximum(expected, 1e-9)) < FALSE_ALARMS / tests))


def _hot(counts: NDArray[Any], level: NDArray[np.float64], tests: int, width: int) -> NDArray[np.bool_]:
    """Which histograms `[n, T]` are above the background level everywhere, without a return.

    That is, beside the window with the most counts, and in no window by more than chance gives there.
    """
    from scipy.ndimage import uniform_filter1d
    from scipy.special import pdtrc

    side = min(width, counts.shape[-1])
    inside, known = (side * uniform_filter1d(one.astype(float), side, mode="constant") for one in (counts, level))
    best = inside.argmax(axis=-1)[:, None]
    rest, usual = (
        np.maximum(one.sum(axis=-1) - np.take_along_axis(part, best, -1)[:, 0], 0.0)
        for one, part in ((counts, inside), (level, known))
    )
    found = _above(np.rint(rest), _WRONG * usual, tests)
    excess = (rest - usual)[found, None] * (side / max(1, counts.shape[-1] - side))
    chance = pdtrc(np.maximum(np.rint(inside[found]), 1.0) - 1.0, known[found] + excess)
    found[found] = chance.min(axis=-1) * counts.shape[-1] > _NO_RETURN
    return found


def _stuck(counts: NDArray[Any], most: float, tests: int = 1) -> NDArray[np.bool_]:
    """Bins of histograms `[..., T]` that have more than `most` times the counts of both neighbours."""
    from scipy.special import betainc

    found = np.zeros(counts.shape, bool)
    if counts.shape[-1] < 3:
        return found
    place = np.nonzero(counts >= _FEWEST)
    own = counts[place].astype(np.float64)
    last = counts.shape[-1] - 1
    beside = [(*place[:-1], np.abs(place[-1] - 1)), (*place[:-1], last - np.abs(last - place[-1] - 1))]
    both = own + sum(counts[one].astype(np.float64) for one in beside)
    level = FALSE_ALARMS / (tests * counts.shape[-1])
    found[place] = (own > most * (both - own)) & (betainc(own, both - own + 1.0, most / (1.0 + most)) < level)
    return found


def _steepest(response: NDArray[np.float64]) -> float:
    """The most counts of a bin over those of both neighbours that light can give."""
    edges = np.concatenate([[0.0], np.maximum(response, 0.0).cumsum()])
    place = np.arange(edges.size) - 0.5 * edges.size + 0.5
    most = 1.0  # of a background that begins within the gate
    for phase in np.linspace(-0.5, 0.5, 5):
        ends = np.arange(-response.size // 2 - 1, response.size // 2 + 3) + phase - 0.5
        taps = np.diff(np.interp(1.2 * _WRONG * ends, place, edges))  # 1.2: sums over bins are wider than the response
        beside = taps[:-2] + taps[2:]
        some = taps[1:-1] > 1e-3 * taps.max()
        most = max(most, float((taps[1:-1][some] / np.maximum(beside[some], 1e-12)).max()))
    return most
