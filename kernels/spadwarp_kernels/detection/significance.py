"""Whether a pixel has detected anything: the significance of the best window of its counts over the background.

A window is two halves of some bins, and shares one with the next. Of background alone its count N is binomial: of the
pulses that have not counted yet, where each counts one photon at most; of the pixel's counts, where the background's
level is not known; Poisson, the limit of many trials, else. The best window has the largest deviance of those above
their expectation. Boole's inequality makes its tail that of K windows, less the pairs of neighbours whose n counts all
lie in the half that they share, 2^−n of them: P(n) = (1 + (K − 1)(1 − 2^−n)) P(N >= n). Since P leaps from one count
to the next, the test is randomised (Lehmann and Romano, Testing Statistical Hypotheses, 3.2): P(n + 1) + u (P(n) −
P(n + 1)) is uniform for u uniform in (0, 1), here a hash of the pixel's number and counts.
"""

import math
from typing import Any

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.base.native import HALF, ONE, TWO, ZERO, expm1, log1p, one_minus_exp
from spadwarp_kernels.base.philox import begin_sequence, sequence_word, u01_open

__all__ = ["MIN_SIGNIFICANCE", "DetectionTest"]

wp.set_module_options({"enable_backward": False})

MIN_SIGNIFICANCE = 4.0
"""Default of all estimators of depth: one false alarm in 10^4 pixels."""

COUNTS = (wp.int32, wp.int64)

_LN10, _LN_2PI = wp.constant(wp.float64(math.log(10.0))), wp.constant(wp.float64(math.log(2.0 * math.pi)))
_MANY, _LEAST = wp.constant(1.0e9), wp.constant(1.0e-30)
_TERMS = wp.constant(64)  # of a tail, before the rest of it counts as a geometric series, which it stays below
_HASH_START, _HASH_FACTOR = wp.uint32(2166136261), wp.uint32(16777619)  # Fowler, Noll and Vo


@wp.struct
class Windows:
    """See `DetectionTest`."""

    background: wp.array2d[float]
    level_known: bool
    pulses: wp.float64
    first: int
    stop: int
    half_width: int
    pixels: int


@wp.func
def _deviance(n: Any, mean: Any, trials: Any):
    """ln of the likelihood of n at its own expectation over that at the mean, n >= 1; float32 or float64."""
    excess = n - mean
    value = n * log1p(excess / mean)
    if n < trials:
        value += (trials - n) * log1p(-excess / (trials - mean))
    return value


@wp.func
def _stirling_error(n: wp.float64) -> wp.float64:
    """ln n! less Stirling's formula, n >= 1, to 3e-4."""
    return (ONE - ONE / (wp.float64(30.0) * n * n)) / (wp.float64(12.0) * n)


@wp.func
def _significance(
    n: wp.float64, mean: wp.float64, trials: wp.float64, windows: wp.float64, u: wp.float64, level_known: bool
) -> wp.float64:
    """−log10 of the probability that one of the windows has n counts or more, randomised; n > mean."""
    log_p = -_deviance(n, mean, trials)  # ln P(N = n): Loader, Fast and accurate computation of binomials, 2000
    left = trials - n
    if left >= HALF:
        log_p += HALF * (wp.log(trials / (n * left)) - _LN_2PI)
        log_p += _stirling_error(trials) - _stirling_error(n) - _stirling_error(left)
    more = ZERO  # P(N > n) / P(N = n)
    term = ONE
    ratio = ZERO
    for k in range(_TERMS):
        j = n + wp.float64(k)
        ratio = wp.max(mean * (trials - j) / ((j + ONE) * (trials - mean)), ZERO)
        term *= ratio
        more += term
    more += term * ratio / (ONE - ratio)
    shared = wp.pow(TWO, -n)
    either = (ONE + (windows - ONE) * (ONE - shared)) * (ONE + more)
    above = (ONE + (windows - ONE) * (ONE - HALF * shared)) * more
    if log_p > wp.float64(-30.0):
        # Not small: windows are independent, but of a given number of counts each is in one.
        p = wp.exp(log_p)
        either = wp.where(level_known, one_minus_exp(either * p), wp.min(either * p, ONE))
        above = wp.where(level_known, one_minus_exp(above * p), wp.min(above * p, ONE))
        log_p = ZERO
    return wp.max(-(log_p + wp.log(above + u * (either - above))) / _LN10, ZERO)


@wp.struct
class WindowSearch:
    """The best window of the bins of a pixel that have been offered so far, one after the other. In float32, whose
    rounding is far below the noise of counts: of two windows that it confuses, either will do."""

    per_pulse: float  # 1 over the pulses of the histogram, see `DetectionTest`; 0: any number of counts
    left: wp.float64  # of the pulses, those without a count before the window
    total: float  # counts of the pixel, where the level is not known
    level: float  # of the background
    last_n: float  # counts and background of the half before, and of this one
    last_b: float
    own_n: float
    own_b: float
    deviance: float  # of the best window
    best: wp.vec3  # its counts, mean, trials
    window: int  # its first bin
    begin: int  # first bin of this half
    state: wp.uint32  # hash of the counts


@wp.func
def begin_search(search: Windows, pixel: int, pulses: wp.float64) -> WindowSearch:
    """The search in the bins from `search.first` on, with a known level."""
    s = WindowSearch()
    s.per_pulse = wp.where(pulses > ZERO, float(ONE / pulses), 0.0)
    s.left = pulses
    s.level = 1.0
    s.window = search.first
    s.begin = search.first
    s.state = (_HASH_START ^ wp.uint32(pixel % search.pixels)) * _HASH_FACTOR
    return s


@wp.func
def offer_bin(search: Windows, s: WindowSearch, k: int, count: wp.int64, background: float) -> WindowSearch:
    """The next bin, k in [first, stop), of a pixel; at the end of a half the window that it closes is looked at."""
    if count > wp.int64(0):
        s.own_n += float(count)
        s.state = (((s.state ^ wp.uint32(k)) * _HASH_FACTOR) ^ wp.uint32(count)) * _HASH_FACTOR
    s.own_b += background
    if k + 1 == wp.min(s.begin + search.half_width, search.stop):
        n = s.last_n + s.own_n
        if n > 0.0 and (s.begin > search.first or search.stop - search.first <= search.half_width):
            mean = wp.max((s.last_b + s.own_b) * s.level, _LEAST)
            trials = wp.where(search.level_known, _MANY * (n + mean), s.total)
            if s.per_pulse > 0.0:
                trials = wp.max(float(s.left), n)
                mean = wp.max(-trials * expm1(-mean * s.per_pulse), _LEAST)
            excess = n - mean
            # The deviance is at most the square of the excess over the variance: most windows end here.
            if excess > 0.0 and excess * excess > s.deviance * mean * (1.0 - mean / trials):
                value = _deviance(n, mean, trials)
                if value > s.deviance:
                    s.deviance = value
                    s.best = wp.vec3(n, mean, trials)
                    s.window = wp.max(s.begin - search.half_width, search.first)
        s.begin = k + 1
        s.left -= wp.float64(s.last_n)
        s.last_n = s.own_n
        s.last_b = s.own_b
        s.own_n = 0.0
        s.own_b = 0.0
    return s


@wp.func
def significance_of(search: Windows, s: WindowSearch) -> float:
    """Of the best window of all."""
    if s.deviance <= 0.0:
        return 0.0
    number = wp.float64(wp.max((search.stop - search.first - 1) / search.half_width, 1))
    u = wp.float64(u01_open(sequence_word(begin_sequence(wp.uint64(s.state)))))
    best = wp.vec3d(s.best)
    return float(_significance(best[0], best[1], best[2], number, u, search.level_known))


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
        background = search.background[pixel % search.background.shape[0]]
        last_column = background.shape[0] - 1
        s = begin_search(search, pixel, search.pulses)
        for k in range(wp.where(search.pulses > ZERO, search.first, 0)):
            s.left -= wp.float64(counts[pixel, k])
        if not search.level_known:
            level = float(0.0)
            for k in range(search.first, search.stop):
                s.total += float(counts[pixel, k])
                level += background[wp.min(k, last_column)]
            s.level = s.total / wp.max(level, _LEAST)
        for k in range(search.first, search.stop):
            s = offer_bin(search, s, k, wp.int64(counts[pixel, k]), background[wp.min(k, last_column)])
        window[pixel] = s.window
        significance[pixel] = significance_of(search, s)

    return significance_kernel


class DetectionTest:
    """Detection significance of the counts of every pixel: −log10 of the probability that background alone gives counts
    as unlikely. Of background alone, a part 10^−s of the pixels has a significance of s or more; of those with a count,
    where its level is that of the pixel's counts.

    Everything is prepared: a call allocates nothing and reads no value on the host.

    Args:
        bins, device: Of the histograms.
        width: FWHM of a return [bins]; a window has 1.5 of it, an even number of bins, and 80 to 92 % of the return.
        background: Expected counts of background, float32 `[1 or pixel, 1 or bin]`; the row is the pixel modulo the
            rows. None: its level is that of the pixel's counts, and its shape over time `profile`, likewise, or flat.
        pulses: Of a histogram, where each counts one photon at most and the background is known; 0: any number.
        pixels: Of a frame, where the rows are those of several: a pixel's answer does not depend on the frame's number.
        first, stop: The bins looked at, [first, stop).

    Raises:
        ArgumentError: An array of another kind, or bins outside the histogram.
    """

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
        self.device, self.bins = wp.get_device(device), check.integer("bins", bins, 0)
        self.windows = windows = Windows()
        windows.first = check.integer("first", first, 0, bins)
        windows.stop = bins if stop is None else check.integer("stop", stop, first, bins)
        windows.half_width = self.half_width = max(1, math.ceil(0.75 * check.number("width", width, "[0, 1e6]")))
        windows.level_known = background is not None
        windows.pulses = float(check.integer("pulses", pulses, 0, 2**62)) if windows.level_known else 0.0
        windows.pixels = 2**31 - 1 if pixels is None else check.integer("pixels", pixels, 1)
        name, rows = ("profile", profile) if background is None else ("background", background)
        rows = wp.ones((1, 1), dtype=float, device=self.device) if rows is None else rows
        windows.background = check.array(name, rows, wp.float32, (None, None), self.device)
        if rows.shape[0] < 1 or rows.shape[1] not in (1, bins):
            raise ArgumentError(f"{name} has shape {rows.shape}; (1 or pixels, 1 or {bins}) is needed")

    def __call__(self, counts: wp.array, significance: wp.array, window: wp.array) -> None:
        """Writes the significance, float32 `[pixel]`, and the first bin of the best window, int32 `[pixel]`, of counts
        int32 or int64 `[pixel, bin]`."""
        check.array("counts", counts, COUNTS, (None, self.bins), self.device)
        shape = (counts.shape[0],)
        check.array("significance", significance, wp.float32, shape, self.device)
        check.array("window", window, wp.int32, shape, self.device)
        inputs = [counts, self.windows, significance, window]
        launch_pixels(_significance_kernel(counts.dtype), shape[0], inputs, device=self.device)
