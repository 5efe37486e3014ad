"""Depth frames: one arrival time per pixel from a histogram of counts, tallies or rates.

Times are fractional bins from the start of the first bin: bin k covers [k, k + 1), so its centre is k + 0.5.
Histograms are rows `[pixel, bin]` of int32, int64, float32 or float64; one thread a pixel.
"""

from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import launch_pixels, memoised

from .counts import RATES
from .significance import COUNTS, MIN_SIGNIFICANCE, DetectionTest

__all__ = ["PHASES", "arrival_bins"]

wp.set_module_options({"enable_backward": False})

_PHASE_BITS = wp.constant(4)
PHASES = wp.constant(16)
"""Sub-bin shifts at which the response is tabulated; a parabola goes between them."""

RESPONSE_FLOOR = 1e-6
"""Smallest response, relative to its peak, that the logarithm sees: one stray count must not exclude every delay."""

_NEWTON_STEPS = wp.constant(6)
_CONVERGED = wp.constant(1e-4)  # growth of the signal, near whose maximum the likelihood is flat


@wp.func
def _offer(position: float, score: float, best: wp.vec3) -> wp.vec3:
    """Keep (score, first position, last position) of the largest score: two positions tell a plateau from a peak."""
    if score > best[0]:
        return wp.vec3(score, position, position)
    if score == best[0]:
        return wp.vec3(score, best[1], position)
    return best


@wp.struct
class _Search:
    """The search in a histogram, see `arrival_bins`."""

    background: wp.array2d[float]
    first: int
    stop: int
    half_width: int
    response: wp.array2d[float]  # of the likelihood; of the matched filter its gain
    lowest_tap: int
    floor: float  # of the background, a part of the counts
    coarse_step: int  # of the first search [phases]
    # Of the detection:
    min_significance: float
    significance: wp.array[float]
    window: wp.array[int]
    half_width_of_window: int
    peak_tap: int  # of the response, from the bin of the return


@wp.func
def _bins_to_search(search: _Search, pixel: int) -> wp.vec2i:
    """First bin and stop: with a threshold the window that was detected, with half of it on either side, or none."""
    if search.min_significance <= 0.0:
        return wp.vec2i(search.first, search.stop)
    if search.significance[pixel] < search.min_significance:
        return wp.vec2i(0, 0)
    first = search.window[pixel] - search.half_width_of_window - search.peak_tap
    return wp.vec2i(wp.max(first, search.first), wp.min(first + 4 * search.half_width_of_window, search.stop))


@wp.func
def _level(search: _Search, pixel: int, bin: int) -> float:
    background = search.background
    return background[pixel % background.shape[0], wp.min(bin, background.shape[1] - 1)]


@memoised
def _peak_kernel(dtype: Any, centroid: bool) -> wp.Kernel:
    @wp.kernel(enable_backward=False, module="unique")
    def peak(first_pixel: int, histogram: wp.array2d[dtype], search: _Search, arrival: wp.array[float]):
        pixel = first_pixel + wp.tid()
        bins = _bins_to_search(search, pixel)
        peak_bin = int(-1)
        highest = float(0.0)
        for k in range(bins[0], bins[1]):
            excess = float(histogram[pixel, k]) - _level(search, pixel, k)
            if excess > highest:
                highest = excess
                peak_bin = k
        if peak_bin < 0:
            arrival[pixel] = wp.nan
            return
        shift = float(0.0)
        if wp.static(centroid):
            weight = float(0.0)
            moment = float(0.0)
            half_width = search.half_width
            for k in range(wp.max(search.first, peak_bin - half_width), wp.min(search.stop, peak_bin + half_width + 1)):
                # Relative to the peak, so that rates of any size keep their digits.
                excess = (float(histogram[pixel, k]) - _level(search, pixel, k)) / highest
                weight += excess
                moment += excess * float(k - peak_bin)
            if weight > 0.0:
                shift = wp.clamp(moment / weight, -float(half_width), float(half_width))
        arrival[pixel] = float(peak_bin) + 0.5 + shift

    return peak


@memoised
def _make_score(dtype: Any, likelihood: bool) -> wp.Function:
    """The score of a delay, by the log-matched filter or the likelihood."""

    @wp.func
    def score_of(
        histogram: wp.array2d[dtype], search: _Search, pixel: int, phases: int, least: float, beat: float
    ) -> float:
        phase = phases & (PHASES - 1)
        base = (phases >> _PHASE_BITS) + search.lowest_tap
        low = wp.max(0, search.first - base)
        high = wp.min(search.response.shape[1], search.stop - base)
        if wp.static(not likelihood):
            score = float(0.0)
            for tap in range(low, high):
                score += float(histogram[pixel, base + tap]) * search.response[phase, tap]
            return score
        # max over S >= 0 of sum n ln(1 + S h / B) - S sum h: the log-likelihood ratio of a return at this delay.
        counts = float(0.0)
        slope = float(0.0)
        seen = float(0.0)
        for tap in range(low, high):
            h = search.response[phase, tap]
            n = float(histogram[pixel, base + tap])
            seen += h
            if n > 0.0:
                counts += n
                slope += n * h / wp.max(_level(search, pixel, base + tap), least)
        if slope <= seen or seen <= 0.0:
            return 0.0  # the likelihood falls with S from 0 on
        # Jensen's inequality bounds the maximum by that of one bin with the mean h / B: most delays end here.
        bound = counts * (wp.log(slope / seen) - 1.0 + seen / slope)
        if bound < beat:
            return -1.0
        # 1 / (sum n h / (B + S h)) is concave in S (a harmonic mean): Newton from S = 0 rises to the root, not past it.
        signal = float(0.0)
        step = int(0)
        grown = float(1.0)
        while step < _NEWTON_STEPS and grown > _CONVERGED * signal:
            slope = float(0.0)
            curvature = float(0.0)
            for tap in range(low, high):
                n = float(histogram[pixel, base + tap])
                if n > 0.0:
                    h = search.response[phase, tap]
                    ratio = h / (wp.max(_level(search, pixel, base + tap), least) + signal * h)
                    slope += n * ratio
                    curvature += n * ratio * ratio
            grown = wp.max((slope / seen - 1.0) * slope / curvature, 0.0)
            signal += grown
            step += 1
        value = -signal * seen
        for tap in range(low, high):
            n = float(histogram[pixel, base + tap])
            if n > 0.0:
                floor = wp.max(_level(search, pixel, base + tap), least)
                value += n * wp.log(1.0 + signal * search.response[phase, tap] / floor)
        return value

    return score_of


@memoised
def _search_kernel(dtype: Any, likelihood: bool) -> wp.Kernel:
    """The delay of the largest score."""
    score_of = _make_score(dtype, likelihood)

    # Unrolled and inlined at four places, the likelihood has 220 KB of code for a GPU.
    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 1})
    def find(first_pixel: int, histogram: wp.array2d[dtype], search: _Search, arrival: wp.array[float]):
        pixel = first_pixel + wp.tid()
        coarse_step = search.coarse_step
        bins = _bins_to_search(search, pixel)
        total = float(0.0)
        for k in range(search.first, search.stop):
            total += float(histogram[pixel, k])
        least = search.floor * total
        best = wp.vec3(0.0, -1.0, -1.0)
        if total > 0.0:
            for step in range(bins[0] * PHASES / coarse_step, bins[1] * PHASES / coarse_step):
                phases = step * coarse_step
                score = score_of(histogram, search, pixel, phases, least, best[0])
                if score > 0.0:
                    best = _offer(float(phases), score, best)
        if best[1] < 0.0:
            arrival[pixel] = wp.nan
            return
        middle = int(0.5 * (best[1] + wp.min(best[2], best[1] + float(coarse_step))))
        # Near its maximum the score has one peak: halves of the step lead to it, to where a plateau may begin.
        top_score = score_of(histogram, search, pixel, middle, least, 0.0)
        reach = coarse_step / 2
        while reach > 2:
            centre = middle
            for side in range(-1, 2, 2):
                score = score_of(histogram, search, pixel, centre + side * reach, least, top_score)
                if score > top_score:
                    top_score = score
                    middle = centre + side * reach
            reach = reach / 2
        fine = wp.vec3(-1.0, 0.0, 0.0)
        for phases in range(middle - 4, middle + 5):
            score = score_of(histogram, search, pixel, phases, least, 0.0)
            fine = _offer(float(phases), score, fine)
        top = 0.5 * (fine[1] + fine[2])
        if fine[1] == fine[2]:
            centre = int(fine[1])
            left = score_of(histogram, search, pixel, centre - 1, least, 0.0)
            right = score_of(histogram, search, pixel, centre + 1, least, 0.0)
            curvature = left - 2.0 * fine[0] + right
            if curvature < 0.0:  # the vertex of the parabola through the three
                top += wp.clamp(0.5 * (left - right) / curvature, -0.5, 0.5)
        arrival[pixel] = top / float(PHASES)

    return find


class ArrivalEstimator:
    """`arrival_bins` for histograms of so many bins on a device, with everything prepared: a call reads no value on the
    host, and from the second one of as many pixels on allocates nothing. Arguments and errors: see `arrival_bins`."""

    def __init__(
        self,
        bins: int,
        device: wp.DeviceLike,
        method: str = "centroid",
        background: wp.array | None = None,
        response: np.ndarray | None = None,
        lowest_tap: int = 0,
        first: int = 0,
        stop: int | None = None,
        half_width: int = 3,
        min_significance: float = MIN_SIGNIFICANCE,
        width: float | None = None,
        **test: Any,
    ) -> None:
        check.choice("method", method, ("peak", "centroid", "matched", "likelihood"))
        self.device, self.method = wp.get_device(device), method
        self.bins = check.integer("bins", bins, 0)
        self._search = search = _Search()
        search.first = check.integer("first", first, 0, bins)
        search.stop = bins if stop is None else check.integer("stop", stop, first, bins)
        search.half_width = check.integer("half_width", half_width, 0, 2**24)
        search.lowest_tap = check.integer("lowest_tap", lowest_tap, -(2**24), 2**24)
        if background is None:
            background = wp.zeros((1, 1), dtype=float, device=self.device)
        check.array("background", background, wp.float32, (None, None), self.device)
        if background.shape[0] < 1 or background.shape[1] not in (1, bins):
            raise ArgumentError(f"background has shape {background.shape}; (1 or pixels, 1 or {bins}) is needed")
        search.background = background
        taps = np.zeros((0, 0))
        if method in ("matched", "likelihood"):
            if response is None:
                raise ArgumentError(f"method = {method!r} needs a response")
            taps = check.numbers("response", response, (int(PHASES), None), "[0, inf)")
            largest = check.number("largest of response", taps.max(initial=0.0), "(0, inf)")
            width = np.count_nonzero(taps[0] >= 0.5 * taps[0].max()) if width is None else width
            search.floor = floor = RESPONSE_FLOOR * float(largest)
            # A narrow response loses signal between the delays of the coarse search, a wide one does not.
            search.coarse_step = PHASES if largest < 0.25 else PHASES // 2 if largest < 0.5 else PHASES // 4
            if method == "matched":
                # ln(h / floor): counts outside the response add the same to every delay.
                taps = np.log(np.maximum(taps, floor) / floor)
            search.peak_tap = search.lowest_tap + int(np.argmax(taps[0]))
        search.response = wp.array(taps.astype(np.float32), device=self.device)
        search.min_significance = check.number("min_significance", min_significance, "[0, 1e6]")
        test = {"first": first, "stop": stop, "background": background if "profile" not in test else None, **test}
        self.test = DetectionTest(bins, self.device, half_width / 1.5 if width is None else width, **test)
        search.half_width_of_window = wide = self.test.half_width
        reach = max(search.half_width, taps.shape[1]) + 1 if min_significance > 0.0 else bins
        self.background_bins = None if method == "matched" else (-wide - reach, 3 * wide + reach)
        """Bins, from the first one of the best window on, in which a call reads the background."""

    def __call__(self, histogram: wp.array, arrival: wp.array, significance: wp.array | None = None) -> None:
        """Writes the arrival times of a histogram into `arrival`, float32 `[pixel]`, and of counts, where there is an
        array for it or a threshold, the significance."""
        check.array("histogram", histogram, RATES, (None, self.bins), self.device)
        pixels = histogram.shape[0]
        check.array("arrival", arrival, wp.float32, (pixels,), self.device)
        search = self._search
        if search.min_significance > 0.0 or significance is not None:
            if search.window is None or search.window.shape != (pixels,):
                search.window, search.significance = (wp.empty(pixels, kind, self.device) for kind in (int, float))
            if significance is not None:
                search.significance = significance
            self.test(histogram, search.significance, search.window)
        self._locate(histogram, arrival)

    def _locate(self, histogram: wp.array, arrival: wp.array) -> None:
        make = _peak_kernel if self.method in ("peak", "centroid") else _search_kernel
        kernel = make(histogram.dtype, self.method in ("centroid", "likelihood"))
        launch_pixels(kernel, arrival.size, [histogram, self._search, arrival], device=self.device)

    def locate(
        self,
        histogram: wp.array,
        arrival: wp.array,
        significance: wp.array,
        window: wp.array,
        background: wp.array | None = None,
    ) -> None:
        """As a call, of pixels that the caller has tested by `test.windows`; with `background` that is their own."""
        search = self._search
        search.significance, search.window = significance, window
        if background is not None:
            search.background = background
        self._locate(histogram, arrival)


def arrival_bins(
    histogram: wp.array,
    *,
    min_significance: float | None = None,
    significance: wp.array | None = None,
    **search: Any,
) -> wp.array:
    """Arrival time of every pixel [bins from the start of bin 0], NaN where there is none.

    Args:
        histogram: `[pixel, bin]`, int32, int64, float32 or float64, not negative.
        search: Any of what follows, by name.
        method: `"peak"`: centre of the largest bin. `"centroid"`: mean over the peak ± `half_width` bins.
            `"matched"`: the delay μ that maximises Σ n_k ln h_k(μ), the log-matched filter, which is maximum
            likelihood without background. `"likelihood"`: the maximum over delay and signal of
            Σ n_k ln(S·h_k(μ) + B_k) − S·Σ h_k(μ), with known background B.
        background: expected background per bin, in the histogram's unit, float32 `[1 or pixel, 1 or bin]`; the row is
            the pixel modulo the rows. Peak and centroid subtract it, the matched filter ignores it.
        response: `[PHASES, tap]`: row p is the fraction of a return at time m + p / PHASES (m an integer) that falls in
            bin m + lowest_tap + tap. Needed by matched and likelihood.
        lowest_tap: bin of the first tap, relative to the bin of the return.
        first, stop: the bins looked at, [first, stop).
        half_width: of the centroid's window [bins].
        min_significance: pixels below this significance (`DetectionTest`) have no arrival time; in the others it is
            looked for where they have detected something. 0: every pixel reports, from all bins. Default: 4, one false
            alarm in 10^4 pixels; 0 for rates, which have no significance.
        significance: array to write that of each pixel into, float32 `[pixel]`.
        width, profile, pulses, pixels: of `DetectionTest`. By default the width is that of the response, or 2/3 of
            `half_width`; the profile takes the background's place in the test.

    Returns:
        float32 `[pixel]` on the histogram's device. NaN: nothing detected, or no counts above the background.

    Raises:
        ArgumentError: An array of another kind, bins outside the histogram, or a method without its response.
    """
    check.array("histogram", histogram, RATES, (None, None))
    if min_significance is None:
        min_significance = MIN_SIGNIFICANCE if histogram.dtype in COUNTS else 0.0
    arrival = wp.empty(histogram.shape[0], dtype=float, device=histogram.device)
    estimate = ArrivalEstimator(histogram.shape[1], histogram.device, min_significance=min_significance, **search)
    estimate(histogram, arrival, significance)
    return arrival
