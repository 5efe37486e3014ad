"""Whether a pixel has detected anything: the significance of the best window of its counts over the background.

A window is two halves of some bins, and shares one with the next window. Of background alone its count n is Poisson
about the expectation B; binomial of the pulses that have not counted yet, where a pulse counts once at most; binomial
of the pixel's counts, where only the shape of the background is known. The best window has the largest deviance,
n ln(n/B) − (n − B) or its binomial form, of those with n > B. Its tail P(N >= n) becomes that of K windows by Boole's
inequality, less the pairs of neighbours whose counts all lie in the half that they share, a part 2^−n of them:
P(n) = (1 + (K − 1)(1 − 2^−n)) P(N >= n).

Counts are few, and P(n) leaps from one to the next. A randomised test (Lehmann and Romano, Testing Statistical
Hypotheses, 3.2) keeps what is asked for: p = P(n + 1) + u (P(n) − P(n + 1)) is uniform for u uniform in (0, 1), which
here is a hash of the pixel's number and counts: the same counts give the same answer.
"""

import math
from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_array, check_integer, check_number
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.base.native import one_minus_exp

__all__ = ["MIN_SIGNIFICANCE", "detection_significance"]

wp.set_module_options({"enable_backward": False})

MIN_SIGNIFICANCE = 4.0
"""Default of all estimators of depth: one false alarm in 10^4 pixels."""

COUNTS = (wp.int32, wp.int64)
"""Types of rows of counts."""

_HALF = 0.75
"""Half a window over the FWHM of a return: 92 % of a Gaussian one lie in a window about it, 80 % in the worst place."""

_LN10 = wp.constant(wp.float64(math.log(10.0)))
_HALF_LN_2PI = wp.constant(wp.float64(0.5 * math.log(2.0 * math.pi)))
_TERMS = wp.constant(64)  # of a tail, before the rest of it counts as a geometric series, which it stays below
_SMALL = wp.constant(wp.float64(1.0e-30))
_HASH_START, _HASH_FACTOR = wp.uint32(2166136261), wp.uint32(16777619)  # Fowler, Noll and Vo
_MIX_1, _MIX_2 = wp.uint32(0x85EBCA6B), wp.uint32(0xC2B2AE35)
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.struct
class Windows:
    """See `detection_significance`."""

    background: wp.array2d[float]
    level_known: bool
    pulses: wp.float64  # 0: any number of counts a pulse
    first: int
    stop: int
    half_width: int
    pixels: int


@wp.func
def _deviance(n: wp.float64, expected: wp.float64, trials: wp.float64) -> wp.float64:
    """ln of the likelihood of n at its own expectation over that at `expected`; trials 0: Poisson."""
    value = n * wp.log(n / expected)
    if trials <= _0:
        return value - (n - expected)
    if n < trials:
        value += (trials - n) * wp.log((trials - n) / (trials - expected))
    return value


@wp.func
def _stirling_error(n: wp.float64) -> wp.float64:
    """ln n! less Stirling's formula, n >= 1, to 3e-4."""
    return (_1 - _1 / (wp.float64(30.0) * n * n)) / (wp.float64(12.0) * n)


@wp.func
def _log_probability(n: wp.float64, expected: wp.float64, trials: wp.float64) -> wp.float64:
    """ln P(N = n), n >= 1 (Loader 2000): the deviance, and Stirling's formula."""
    half = wp.float64(0.5)
    value = -_deviance(n, expected, trials)
    left = trials - n
    if trials <= _0:
        return value - _HALF_LN_2PI - half * wp.log(n) - _stirling_error(n)
    if left < half:
        return value
    value += half * wp.log(trials / (n * left)) - _HALF_LN_2PI
    return value + _stirling_error(trials) - _stirling_error(n) - _stirling_error(left)


@wp.func
def _tail(n: wp.float64, expected: wp.float64, trials: wp.float64) -> wp.float64:
    """P(N > n) / P(N = n), n > expected."""
    total = _0
    term = _1
    ratio = _0
    odds = expected
    part = _0
    if trials > _0:
        part = _1 / trials
        odds = expected / (_1 - expected * part)
    j = n
    for _ in range(_TERMS):
        ratio = wp.max(odds * (_1 - j * part) / (j + _1), _0)
        term *= ratio
        total += term
        j += _1
        if term < wp.float64(1.0e-4) * total:
            return total
    return total + term * ratio / (_1 - ratio)


@wp.func
def _windows_in_effect(windows: wp.float64, n: wp.float64) -> wp.float64:
    return _1 + (windows - _1) * (_1 - wp.exp(-n * wp.float64(0.6931471805599453)))


@wp.func
def _significance(
    n: wp.float64, expected: wp.float64, trials: wp.float64, windows: wp.float64, u: wp.float64, level_known: bool
) -> wp.float64:
    """−log10 p of a pixel whose best window has n counts."""
    more = _tail(n, expected, trials)
    either = _windows_in_effect(windows, n) * (_1 + more)
    above = _windows_in_effect(windows, n + _1) * more
    one = _log_probability(n, expected, trials)
    if one > wp.float64(-30.0):
        # Not small: of Poisson counts windows are independent, of a given number of counts one of them holds each.
        scale = wp.exp(one)
        either = wp.where(level_known, _1 - wp.exp(-either * scale), wp.min(either * scale, _1))
        above = wp.where(level_known, _1 - wp.exp(-above * scale), wp.min(above * scale, _1))
        one = _0
    return -(one + wp.log(above + u * (either - above))) / _LN10


@wp.func
def _hashed(state: wp.uint32, word: wp.uint32) -> wp.uint32:
    return (state ^ word) * _HASH_FACTOR


@wp.func
def _uniform(state: wp.uint32) -> wp.float64:
    """In (0, 1), by the last steps of MurmurHash3."""
    mixed = (state ^ (state >> wp.uint32(16))) * _MIX_1
    mixed = (mixed ^ (mixed >> wp.uint32(13))) * _MIX_2
    mixed = mixed ^ (mixed >> wp.uint32(16))
    return (wp.float64(mixed) + wp.float64(0.5)) / wp.float64(4294967296.0)


@memoised
def _significance_kernel(dtype: Any) -> wp.Kernel:
    @wp.kernel(enable_backward=False, module="unique")
    def significance_kernel(
        first_pixel: int,
        counts: wp.array2d[dtype],
        search: Windows,
        # Out:
        significance: wp.array[float],
        window: wp.array[int],
    ):
        pixel = first_pixel + wp.tid()
        background = search.background
        row = pixel % background.shape[0]
        columns = background.shape[1]
        before = _0  # counts before the window
        if search.pulses > _0:
            for k in range(search.first):
                before += wp.float64(counts[pixel, k])
        total = _0
        level = _0
        if not search.level_known:
            for k in range(search.first, search.stop):
                total += wp.float64(counts[pixel, k])
                level += wp.float64(background[row, wp.min(k, columns - 1)])
            level = total / wp.max(level, _SMALL)
        state = _hashed(_HASH_START, wp.uint32(pixel % search.pixels))
        halves = (search.stop - search.first + search.half_width - 1) / search.half_width
        last_n = _0
        last_b = _0
        best = _0
        best_n = _0
        best_expected = _1
        best_trials = _0
        window[pixel] = search.first
        for m in range(halves):
            start = search.first + m * search.half_width
            n = _0
            b = float(0.0)
            for k in range(start, wp.min(start + search.half_width, search.stop)):
                count = counts[pixel, k]
                if count > counts.dtype(0):
                    n += wp.float64(count)
                    state = _hashed(_hashed(state, wp.uint32(k)), wp.uint32(count))
                b += background[row, wp.min(k, columns - 1)]
            if m > 0 or halves == 1:
                both = last_n + n
                expected = last_b + wp.float64(b)
                trials = total
                if not search.level_known:
                    expected = expected * level
                elif search.pulses > _0:
                    trials = wp.max(search.pulses - before, both)
                    expected = trials * one_minus_exp(expected / search.pulses)
                expected = wp.max(expected, _SMALL)
                above = both - expected
                variance = expected
                if trials > _0:
                    variance -= expected * expected / trials
                # The deviance is at most the square of the excess over the variance: most windows end here.
                if above > _0 and above * above > best * variance:
                    value = _deviance(both, expected, trials)
                    if value > best:
                        best = value
                        best_n = both
                        best_expected = expected
                        best_trials = trials
                        window[pixel] = wp.max(start - search.half_width, search.first)
                before += last_n
            last_n = n
            last_b = wp.float64(b)
        significance[pixel] = 0.0
        if best > _0:
            number = wp.float64(wp.max(halves - 1, 1))
            u = _uniform(state)
            found = _significance(best_n, best_expected, best_trials, number, u, search.level_known)
            significance[pixel] = wp.max(float(found), 0.0)

    return significance_kernel


class DetectionTest:
    """`detection_significance` for histograms of so many bins on a device, with everything prepared: a call allocates
    nothing and reads no value on the host. Arguments and errors are those of `detection_significance`."""

    def __init__(
        self,
        bins: int,
        device: wp.DeviceLike,
        width: float,
        background: wp.array | None = None,
        profile: wp.array | None = None,
        pulses: int = 0,
        pixels: int | None = None,
        first: int = 0,
        stop: int | None = None,
    ) -> None:
        self.device = wp.get_device(device)
        self.bins = check_integer("bins", bins, 0)
        self._windows = windows = Windows()
        windows.first = check_integer("first", first, 0, bins)
        windows.stop = bins if stop is None else check_integer("stop", stop, first, bins)
        windows.half_width = self.half_width = max(1, math.ceil(_HALF * check_number("width", width, "[0, 1e6]")))
        windows.pulses = float(check_integer("pulses", pulses, 0, 2**62))
        windows.pixels = 2**31 - 1 if pixels is None else check_integer("pixels", pixels, 1)
        if background is not None and profile is not None:
            raise ArgumentError("background and profile: one of them is needed, not both")
        windows.level_known = background is not None
        name = "profile" if background is None else "background"
        rows = profile if background is None else background
        if rows is None:
            rows = wp.ones((1, 1), dtype=float, device=self.device)
        check_array(name, rows, wp.float32, (None, None), self.device)
        if rows.shape[0] < 1 or rows.shape[1] not in (1, bins):
            raise ArgumentError(f"{name} has shape {rows.shape}; (1 or pixels, 1 or {bins}) is needed")
        windows.background = rows

    def __call__(self, counts: wp.array, significance: wp.array, window: wp.array) -> None:
        """Writes the significance, float32 `[pixel]`, and the first bin of the best window, int32 `[pixel]`."""
        check_array("counts", counts, COUNTS, (None, self.bins), self.device)
        shape = (counts.shape[0],)
        check_array("significance", significance, wp.float32, shape, self.device)
        check_array("window", window, wp.int32, shape, self.device)
        kernel = _significance_kernel(counts.dtype)
        launch_pixels(kernel, shape[0], [counts, self._windows, significance, window], device=self.device)


def detection_significance(counts: wp.array, **options: Any) -> wp.array:
    """Detection significance of every pixel, −log10 of the probability that background alone gives counts as unlikely.

    A pixel of background alone has more than s with the probability 10^−s. The background of a real return is known
    from a model of the sensor and the water, or from a recording without targets; otherwise its level is that of the
    pixel, and `profile` its shape.

    Args:
        counts: `[pixel, bin]`, int32 or int64, not negative.
        width: FWHM of a return [bins]: a window has 1.5 of it, rounded up to an even number of bins.
        background: Expected counts of background, float32 `[1 or pixel, 1 or bin]`; the row is the pixel modulo the
            rows.
        profile: In its place the shape of the background alone, in any unit, of such a shape; by default flat.
        pulses: Of a histogram, where each counts one photon at most and the background is known; 0: any number.
        pixels: Of a frame, where the rows are those of several: a pixel's answer then does not depend on the frame's
            number.
        first, stop: The bins looked at, [first, stop).

    Returns:
        float32 `[pixel]` on the device of the counts; 0 where no window has more counts than its background.

    Raises:
        ArgumentError: An array of another kind, or bins outside the histogram.
    """
    check_array("counts", counts, COUNTS, (None, None))
    found, window = (wp.empty(counts.shape[0], dtype=kind, device=counts.device) for kind in (float, int))
    DetectionTest(counts.shape[1], counts.device, **options)(counts, found, window)
    return found
