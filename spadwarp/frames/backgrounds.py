"""Background of measured counts, estimated from the frame itself.

Ambient light and dark counts are constant over the gate; backscatter decays, as exp(−2 c z) / z² or by several laws at
once. All of these are sums of decaying exponentials with weights >= 0 (completely monotone functions, Bernstein 1929),
and of a constant. Walls end the water before them: the mean over pixels may fall by any course. Before a gate is open
it rises, by any course. The weights are those of the highest Poisson likelihood of the counts outside the returns of
targets. Returns are found where the counts of a block of pixels exceed the background within the time of the response;
whatever all blocks share at the same time and does not fit into a decay counts as a return, too.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.frames.response import FWHM_PER_SIGMA
from spadwarp.values import ArgumentError, check_choice, percent

__all__ = ["Background", "BackgroundLaw", "estimate_background"]

BackgroundLaw = Literal["decay", "flat", "none"]
"""What is assumed of a background that is not known: decays and a constant, a constant, or that there is none."""

_BLOCK = 4  # side of the blocks in which returns are looked for [pixels]
_RATES = np.concatenate([[0.0], np.geomspace(0.5, 200.0, 28)])  # of the decays [1 / gate]
_TOLERANCES = (0.5, 0.3, 0.2, 0.1)  # excess over the fit that is no return yet, as the fit gets better
_STEPS, _LAST_STEPS = 60, 1000  # of a fit, and of the last one; each begins with the one before
_FALSE = 4.0  # log of the reciprocal rate of returns by chance, beside that for the number of bins
_CLIPPED = 2.0  # deviations above a fit, beyond which a bin of the first one counts no more
_PARTS, _COUNTS_OF_PART = 16, 10.0  # parts of the gate that a block's scale is the median of, and their least counts
_DIFFERENT = 5.0  # standard errors of their variance beyond that of chance, from which on scales differ
_DECAYS = 12.0  # twice the log-likelihood that decays gain where they are there; one in 400 frames does by chance
_OPEN = 0.9  # part of the expected background from which on a gate counts as open
_WIDER = (1, 4)  # windows of the search for returns, in widths of the response


class Background(NamedTuple):
    """Background counts of a pixel in each bin, and how well they are known."""

    per_bin: NDArray[np.float32]  # mean over the pixels, `[T]`
    scale: NDArray[np.float32] | None  # of each pixel, mean about 1, `[H, W]`; None where they differ by chance alone
    relative_error: float  # standard error of its sum over the gate, relative; of the fit alone
    interpolated: float  # part of the bins in which returns leave less than a tenth of the pixels
    decays: bool
    falls: bool  # by a course that is no sum of decays, as walls end the water

    @property
    def counts(self) -> NDArray[np.float32]:
        """Background of every pixel, `[T]` or `[H, W, T]`."""
        return self.per_bin if self.scale is None else self.scale[..., None] * self.per_bin

    @property
    def summary(self) -> str:
        """One sentence for the user."""
        law = "a falling course" if self.falls else "decays and a constant" if self.decays else "a constant"
        text = f"background estimated from the frame: {law}, {self.per_bin.sum():.3g} counts in a pixel"
        text += f" ± {percent(self.relative_error)} %"
        if self.scale is not None:
            text += f", {self.scale.min():.2g} to {self.scale.max():.2g} times that in blocks of 4 x 4"
        return text + (f", {percent(self.interpolated)} % of the bins interpolated" if self.interpolated else "")


def estimate_background(counts: ArrayLike, response: ArrayLike | float, *, law: str = "decay") -> Background:
    """Background of counts `[H, W, T]` or `[N, H, W, T]`: one course over time for all pixels and frames.

    Of one frame, blocks of 4 × 4 pixels have scales of their own where these differ by more than chance: ambient light
    follows the reflectance, backscatter the beam.

    Args:
        counts: Whole numbers or rates >= 0.
        response: Instrument response per bin, centred on its time zero, `[2 r + 1]`; or the FWHM of a return [bins].
        law: One of `BackgroundLaw`. "decay": decays and a constant, or the constant alone where decays do not make the
            counts clearly more likely; "flat": a constant; "none": nothing.

    Raises `ArgumentError`.
    """
    check_choice("background", law, get_args(BackgroundLaw))
    cube = np.asarray(counts)
    if cube.ndim not in (3, 4) or cube.size == 0:
        raise ArgumentError(f"counts have shape {cube.shape}; [H, W, T] or [N, H, W, T] is needed")
    bins = cube.shape[-1]
    if law == "none":
        return Background(np.zeros(bins, np.float32), None, 0.0, 0.0, False, False)
    blocks, pixels = _blocks(cube.reshape(-1, *cube.shape[-3:]))
    given = blocks, pixels, return_width(response), _RATES[:1] if law == "flat" else _RATES, cube.shape
    found, opens = _course(*given, law == "decay")
    # Few early counts mean that a gate opens, or that returns follow: what leaves the smaller error counts.
    return min(found, _course(*given, False)[0], key=lambda one: one.relative_error) if opens else found


def _course(
    blocks: NDArray[np.float64],
    pixels: NDArray[np.float64],
    width: int,
    rates: NDArray[np.float64],
    shape: tuple[int, ...] | None,
    may_open: bool,
) -> tuple[Background, bool]:
    """The background of blocks of counts of this shape, and whether the gate opens, within its first half, if it may.

    `width`: of a return [bins].
    """
    from scipy.ndimage import uniform_filter1d

    total, begin = blocks.sum(axis=0), 0
    if may_open:
        begin = int(uniform_filter1d(total, width).argmax())  # a gate that opens has its most counts when it is open
        begin = begin if begin < total.size // 2 else 0
    exposure = np.where(np.arange(total.size) < begin, 0.0, pixels.sum())
    level, weight = _first_fit(total * (exposure > 0), exposure, rates)
    level[:begin] = level[begin]
    free = np.ones(blocks.shape, bool)
    opening = _opening(total, pixels.sum() * level) if begin else np.ones(total.size)
    for tolerance in _TOLERANCES:
        scale = _scales(blocks, pixels, level * opening, free)
        scaled = pixels * scale
        free = ~_returns(blocks, (1.0 + tolerance) * scaled[:, None] * level * opening, width)
        seen, exposure = (blocks * free).sum(axis=0), scaled @ free
        if may_open:
            opening = _opening(seen, exposure * level)
        whole = opening == 1.0
        level, weight, gain = _fit(seen * whole, exposure * whole, rates, weight)
        level = np.where(whole, level, level[whole.argmax()])  # before the gate is open, no decay can be seen
    level, _, gain = _fit(seen * whole, exposure * whole, rates, weight, _LAST_STEPS)
    decays, falling = gain > _DECAYS, None
    if not decays:
        level, *_ = _fit(seen * whole, exposure * whole, _RATES[:1])
    elif shape is not None:  # of counts: depths alone are too few for it
        falling = _falling(seen * whole, exposure * whole, level, pixels.sum())
    if falling is not None:
        free = ~_returns(blocks, (1.0 + tolerance) * scaled[:, None] * falling * opening, width)
        seen, exposure = (blocks * free).sum(axis=0), scaled @ free
        falling = _falling(seen * whole, exposure * whole, level, pixels.sum())
        level = level if falling is None else falling
    level = np.where(whole, level, level[whole.argmax()])
    if not whole.all():
        level = np.maximum(level * _opening(seen, exposure * level), 1e-9)
    expected = exposure * level
    used = expected > 0
    misfit = float(((seen - expected)[used] ** 2 / expected[used]).sum()) / max(1, used.sum() - 2)
    error = float(np.sqrt(max(1.0, misfit) / max(seen.sum(), 1.0)))
    hidden = float(np.mean(exposure < 0.1 * pixels.sum()))
    image = None
    if shape is not None and np.prod(shape[:-3]) == 1 and np.ptp(scale) > 0:
        rows, columns = (-(-side // _BLOCK) for side in shape[-3:-1])
        image = np.kron(scale.reshape(rows, columns), np.ones((_BLOCK, _BLOCK))).astype(np.float32)
        image = image[: shape[-3], : shape[-2]]
    found = Background(level.astype(np.float32), image, error, hidden, bool(decays), falling is not None)
    return found, not whole.all()


def _opening(seen: NDArray[np.float64], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Part of the expected background that a gate lets through while it opens, `[T]`: rising, then 1.

    Isotonic regression of the counts over those expected; 1 everywhere where chance explains that the first are few, or
    where this takes half of the gate.
    """
    from scipy.optimize import isotonic_regression

    known = np.maximum(expected, 1e-9)
    part = isotonic_regression(seen / known, weights=known).x
    part = np.where(part < _OPEN, part, 1.0)
    there = part < 1.0
    few, usual = seen[there], known[there]
    deviance = float((few * np.log(np.maximum(few, 1e-9) / usual) - few + usual).sum())
    opens = deviance > np.log(seen.size) + _FALSE and known[there].sum() < 0.5 * known.sum() and there.mean() < 0.5
    return part if opens else np.ones(seen.size)


def _falling(
    seen: NDArray[np.float64], exposure: NDArray[np.float64], level: NDArray[np.float64], pixels: float
) -> NDArray[np.float64] | None:
    """A falling course of any form, `[T]`, where walls end the water: isotonic regression, linear where returns are.

    None unless in some bins less than half of `level`, a sum of decays, is clearly more likely.
    """
    from scipy.optimize import isotonic_regression

    free = np.flatnonzero(exposure > 0.1 * pixels)
    if len(free) < 2:
        return None
    part = seen[free] / exposure[free]
    found = np.maximum(isotonic_regression(part, weights=exposure[free], increasing=False).x, 1e-9)
    less = found < 0.5 * level[free]
    gain = seen[free] * np.log(found / level[free]) - (found - level[free]) * exposure[free]
    if gain[less].sum() < len(np.unique(found[less])) * np.log(len(free)) + _FALSE:
        return None
    return np.interp(np.arange(level.size), free, found)


def _blocks(frames: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Counts of blocks of pixels `[blocks, T]`, and how many pixels each has."""
    sizes = np.outer(*(np.minimum(_BLOCK, side - np.arange(0, side, _BLOCK)) for side in frames.shape[1:3]))
    sums = np.zeros((len(frames), *sizes.shape, frames.shape[-1]))
    for row, column in np.ndindex(_BLOCK, _BLOCK):  # many times faster than reduceat
        some = frames[:, row::_BLOCK, column::_BLOCK]
        sums[:, : some.shape[1], : some.shape[2]] += some
    return sums.reshape(-1, frames.shape[-1]), np.tile(sizes.ravel(), len(frames)).astype(np.float64)


def return_width(response: ArrayLike | float) -> int:
    """Bins that hold nearly all of a return: ± 2 deviations of the response, per bin or by its FWHM [bins]."""
    taps = np.asarray(response, np.float64)
    if not taps.ndim:
        return 2 * int(np.ceil(2.0 * float(taps) / FWHM_PER_SIGMA)) + 1
    place = np.arange(taps.size) - taps.size // 2
    total = taps.sum()
    mean = (taps * place).sum() / total
    return 2 * int(np.ceil(2.0 * np.sqrt(max(0.0, (taps * (place - mean) ** 2).sum() / total)))) + 1


def _first_fit(
    total: NDArray[np.float64], exposure: NDArray[np.float64], rates: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A fit to the counts of all pixels, in which what rises above it counts no more, `[T]`, and its weights."""
    seen, weight = total, None
    for _ in range(12):
        level, weight, _ = _fit(seen, exposure, rates, weight)
        most = level * exposure + _CLIPPED * np.sqrt(level * exposure)
        seen = np.minimum(total, most)
    assert weight is not None
    return level, weight


def _fit(
    seen: NDArray[np.float64],
    exposure: NDArray[np.float64],
    rates: NDArray[np.float64],
    weight: NDArray[np.float64] | None = None,
    steps: int = _STEPS,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Sum of decays with the highest likelihood `[T]`, weights, and twice the log-likelihood gained over a constant.

    By expectation maximisation from `weight`: counts are shared among the decays as these are expected there.
    """
    place = (np.arange(seen.size) + 0.5) / seen.size
    laws = np.exp(-rates[:, None] * place)
    reach = np.maximum(laws @ exposure, 1e-300)
    if not (seen.sum() > 0 and exposure.sum() > 0):
        return np.full(seen.size, 1e-9), np.zeros(len(laws)), 0.0
    constant = seen.sum() / exposure.sum()
    share = seen.sum() / reach / len(laws)
    weight = share if weight is None or not weight.any() else weight + 1e-6 * share  # none is lost for good
    for _ in range(steps if len(laws) > 1 else 1):
        weight = weight * (laws @ (seen / np.maximum(weight @ laws, 1e-300))) / reach
    level = np.maximum(weight @ laws, 1e-9)
    gain = float((seen * np.log(level / constant)).sum() - ((level - constant) * exposure).sum())
    return level, weight, 2.0 * gain


def _scales(
    blocks: NDArray[np.float64], pixels: NDArray[np.float64], level: NDArray[np.float64], free: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Background of each block over that of all, `[blocks]`, mean 1: ambient light follows the reflectance.

    The median over parts of the gate that have as much background each, of which a return takes one or two; shrunk to 1
    as far as they may differ by chance; 1 where they do not differ clearly.
    """
    total = float(level.sum() * pixels.mean())
    parts = int(min(_PARTS, total / _COUNTS_OF_PART))
    if parts < 5:
        return np.ones(len(blocks))
    start = np.searchsorted(level.cumsum() / level.sum(), np.arange(parts) / parts)
    start = np.unique(start)
    expected = np.add.reduceat(np.where(free, level, 0.0), start, axis=1) * pixels[:, None]
    seen = np.add.reduceat(np.where(free, blocks, 0.0), start, axis=1)
    ratio = np.where(expected > 0.3 * _COUNTS_OF_PART, seen / np.maximum(expected, 1e-9), np.nan)
    some = np.isfinite(ratio).any(axis=1)
    scale = np.ones(len(blocks))
    scale[some] = np.nanmedian(ratio[some], axis=1)
    chance = 0.5 * np.pi / np.maximum(expected.sum(axis=1), _COUNTS_OF_PART)  # variance of a median
    scale /= max(np.average(scale, weights=pixels), 1e-9)
    real = float(scale.var() - chance.mean())
    if real < _DIFFERENT * chance.mean() * np.sqrt(2.0 / len(scale)):
        return np.ones(len(blocks))
    scale = np.maximum(1.0 + (scale - 1.0) * real / (real + chance), 0.02)
    return scale / np.average(scale, weights=pixels)


def _returns(
    blocks: NDArray[np.float64], expected: NDArray[np.float64], width: int, wider: tuple[int, ...] = _WIDER
) -> NDArray[np.bool_]:
    """Bins of blocks `[blocks, T]` that may hold light of a target.

    Where a window of the width of the response, or of some times as much, has an excess over the background that chance
    does not explain: log-likelihood ratio of Poisson counts.
    """
    from scipy.ndimage import maximum_filter1d, uniform_filter1d

    found = np.zeros(blocks.shape, bool)
    bins = blocks.shape[1]
    for times in wider:
        side = min(width * times, bins) | 1
        rest = np.where(found, expected, blocks)  # without what a narrower window found
        counts, level = (side * uniform_filter1d(one, side, axis=1, mode="constant") for one in (rest, expected))
        level = np.maximum(level, 1e-9)  # sums that run along the bins can end a little below 0
        ratio = counts * np.log(np.maximum(counts, 1e-9) / level) - (counts - level)
        excess = (counts > level) & (ratio > np.log(bins) + _FALSE)
        found |= maximum_filter1d(excess, side + (width - 1) * (times == 1), axis=1, mode="constant")
    return found


_PROFILE_BINS, _PROFILE_BLOCKS = 64, 1024  # over the gate; evenly chosen of all frames, so many tell the profile


def profile_of_depth(depth: NDArray[np.float32], gate: tuple[float, float]) -> NDArray[np.float64] | None:
    """Backscatter over the gate, `[bins]`, by which the depths `[N, H, W]` [m] beside those of targets decay.

    None where they do not clearly decay. Depths are counts of one photon in a pixel; a return is a bin in which depths
    of a block of pixels agree.
    """
    if depth.ndim < 2 or depth.size == 0:
        return None
    some = depth.reshape(-1, *depth.shape[-2:])
    rows, columns = (-(-side // _BLOCK) for side in some.shape[1:])
    some = some[:: max(1, len(some) * rows * columns // _PROFILE_BLOCKS // 4)]
    with np.errstate(invalid="ignore"):
        place = np.floor((some - gate[0]) / (gate[1] - gate[0]) * _PROFILE_BINS)
        reported = (some > 0) & (place >= 0) & (place < _PROFILE_BINS)
    frame, row, column = np.nonzero(reported)
    block = (frame * rows + row // _BLOCK) * columns + column // _BLOCK
    count = len(some) * rows * columns
    index = block * _PROFILE_BINS + place[reported].astype(np.int64)
    blocks = np.bincount(index, minlength=count * _PROFILE_BINS).reshape(count, -1).astype(np.float64)
    pixels = _blocks(np.ones((*some.shape, 1)))[0][:, 0]
    chosen = slice(None, None, -(-count // _PROFILE_BLOCKS))
    found, _ = _course(blocks[chosen], pixels[chosen], 1, _RATES, None, True)
    return found.per_bin.astype(np.float64) if found.decays else None


# The bins that hold the targets: a network is more accurate in a gate that is not much wider than that.

_KEPT = 0.7  # a gate is narrowed only to less than this part of its width
_DEVIATIONS = 5.0  # of the counts of all pixels together, from which on they hold a return


def bins_of_target(
    counts: NDArray[Any], background: NDArray[np.float32], response: NDArray[np.float32]
) -> tuple[int, int]:
    """(first, stop) of the bins that hold all returns, with a margin; (0, T) where there are none, or little is gained.

    Returns are where two blocks of pixels beside each other have an excess at the same time, where all pixels together
    have one, and where a pixel alone has one that chance gives in no pixel of the frame. So no surface that reaches
    over two blocks and can be told from the background is left out, and no pixel with a clear return of its own gets a
    depth from elsewhere. Arguments are those of `spadwarp.denoise.estimate`.
    """
    from scipy.ndimage import maximum_filter, uniform_filter1d

    frames = counts.reshape(-1, *counts.shape[-3:])
    bins = frames.shape[-1]
    each = background if background.ndim == 3 else background[None, None]
    mean = each.reshape(-1, bins).mean(axis=0, dtype=np.float64)
    blocks, pixels = _blocks(frames)
    scale = _scales(blocks, pixels, mean, np.ones(blocks.shape, bool))[:, None]
    if background.ndim == 3:
        expected = np.tile(_blocks(each[None])[0], (len(frames), 1))
    else:
        expected = scale * pixels[:, None] * mean
    width = return_width(np.asarray(response, np.float64))
    tolerated = (1.0 + _TOLERANCES[-1]) * expected
    shape = (len(frames), *(-(-side // _BLOCK) for side in frames.shape[1:3]), bins)
    alone = _returns(blocks, tolerated, width, (1,)).reshape(shape)
    around = np.ones((1, 3, 3, 1), bool)
    around[0, 1, 1] = False
    kept = (alone & maximum_filter(alone, footprint=around, mode="constant")).any(axis=(0, 1, 2))
    total, level = blocks.sum(axis=0), expected.sum(axis=0)
    side = max(width, bins // 64) | 1
    above = uniform_filter1d(total - level, side, mode="constant")
    together = above > _DEVIATIONS * np.sqrt(uniform_filter1d(np.maximum(level, 1.0), side, mode="constant") / side)
    if not together.any():  # too few counts to tell which blocks see all of the target
        return 0, bins
    kept |= together | _clear_returns(frames, mean * max(1.0, float(scale.max())), width)
    found = np.flatnonzero(kept)
    first, stop = int(found[0]), int(found[-1]) + 1
    outside = float((total - level)[:first].sum() + (total - level)[stop:].sum())
    if outside > 0.02 * (total - level)[first:stop].sum() + 3.0 * np.sqrt(level.sum()):
        return 0, bins  # light spread too thin to be found, or a background that is not right
    margin = width + (stop - first) // 8
    first, stop = max(0, first - margin), min(bins, stop + margin)
    return (first, stop) if stop - first < _KEPT * bins else (0, bins)


def _clear_returns(frames: NDArray[Any], level: NDArray[np.float64], width: int) -> NDArray[np.bool_]:
    """Bins `[T]` in which a pixel alone has more counts within a return's width than chance gives in any pixel."""
    from scipy.ndimage import uniform_filter1d
    from scipy.special import pdtrc

    expected = width * uniform_filter1d(level, width, mode="constant")
    most, rare = np.zeros(level.size), 0.01 / frames.size
    for row in frames.reshape(-1, *frames.shape[2:]):
        sums = uniform_filter1d(row.astype(np.float32), width, axis=-1, mode="constant").max(axis=0)
        most = np.maximum(most, width * sums)
    return np.asarray(pdtrc(np.rint(most) - 1.0, expected) < rare)
