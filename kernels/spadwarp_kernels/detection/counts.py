"""Expected detections of a SPAD per pulse and bin, and counts drawn from them.

λ[pixel, bin] is a hazard: the mean number of detections that a pulse would cause in the bin if the detector were always
ready. Counts are those of first-photon TCSPC, with at most one a pulse and pixel, or of a detector that is followed
event by event, with dead time and afterpulses. Every draw is keyed by (seed, frame · pixels + pixel), so that counts do
not depend on how a launch is cut up.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.binomial import PURPOSE_COUNTS, PURPOSE_DARK_COUNTS, PURPOSE_EVENTS, binomial, uniforms
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.base.native import expm1, log1p

__all__ = ["add_crosstalk", "coates", "dark_count_rates", "event_counts", "expected_detections", "first_invalid_row"]
__all__ += ["first_photon_counts", "first_photon_probabilities", "free_running_probabilities"]

wp.set_module_options({"enable_backward": False})

_ONE = wp.constant(wp.uint32(1))

EVENT_LIMIT = 2**27
"""Most detections of a pixel in one frame of the event-driven detector: random blocks are numbered in 28 bits."""

RATES = (wp.int32, wp.int64, wp.float32, wp.float64)
"""Types of rows of counts, tallies or rates."""


def _by_row(kernel: wp.Kernel, inputs: Sequence[Any], out: wp.array) -> wp.array:
    """Launches a kernel over the rows of its last argument, and returns that."""
    launch_pixels(kernel, out.shape[0], [*inputs, out], device=out.device)
    return out


@memoised
def _invalid_kernel(dtype: Any) -> wp.Kernel:
    @wp.kernel(enable_backward=False, module="unique")
    def invalid(first_pixel: int, values: wp.array2d[dtype], worst: wp.array[int]):
        pixel = first_pixel + wp.tid()
        for k in range(values.shape[1]):
            value = float(values[pixel, k])
            if value < 0.0 or not wp.isfinite(value):
                wp.atomic_min(worst, 0, pixel)
                return

    return invalid


def first_invalid_row(values: wp.array) -> int | None:
    """The first row of `values` `[pixel, bin]` that holds a negative or non-finite number, or None."""
    check.array("values", values, RATES, (None, None))
    if values.shape[0] == 0:
        return None
    worst = wp.full(1, 2**31 - 1, dtype=int, device=values.device)
    launch_pixels(_invalid_kernel(values.dtype), values.shape[0], [values, worst], device=values.device)
    row = int(worst.numpy()[0])
    return None if row == 2**31 - 1 else row


# ---- Expected detections.


@memoised
def _response_kernel(dtype: Any) -> wp.Kernel:
    @wp.kernel(enable_backward=False, module="unique")
    def respond(
        first_pixel: int,
        source: wp.array2d[dtype],
        # Sparse rows, one a detector bin:
        row_start: wp.array[int],
        source_bin: wp.array[int],
        weight: wp.array[float],
        width: wp.array[float],
        noise_rate: wp.array[float],
        # Out:
        hazard: wp.array2d[float],
    ):
        pixel = first_pixel + wp.tid()
        noise = noise_rate[pixel]
        for k in range(width.shape[0]):
            total = float(noise * width[k])
            for entry in range(row_start[k], row_start[k + 1]):
                total += weight[entry] * float(source[pixel, source_bin[entry]])
            hazard[pixel, k] = total

    return respond


def expected_detections(
    source: wp.array,
    *,
    row_start: np.ndarray,
    source_bin: np.ndarray,
    weight: np.ndarray,
    width: np.ndarray,
    noise_rate: wp.array,
) -> wp.array:
    """λ per pulse in each detector bin, float32 `[pixel, detector bin]`.

    λ_k = Σ weight · source[source_bin] over the entries row_start[k] … row_start[k + 1] + noise_rate · width_k.

    Args:
        source: `[pixel, source bin]`, detections per pulse.
        row_start, source_bin, weight: sparse matrix (CSR) of the response, detector bins by source bins.
        width: of the detector bins [s].
        noise_rate: of dark counts and ambient light per pixel [1/s], float32.

    Raises:
        ArgumentError: Arrays that do not fit each other, or a matrix that points outside the source.
    """
    check.array("source", source, RATES, (None, None))
    device = source.device
    check.array("noise_rate", noise_rate, wp.float32, (source.shape[0],), device)
    widths = check.numbers("width", width, (None,), "[0, inf)")
    entries = check.numbers("source_bin", source_bin, (None,), f"[0, {source.shape[1] - 1}]", whole=True)
    factors = check.numbers("weight", weight, entries.shape, "[0, inf)")
    rows = check.numbers("row_start", row_start, (widths.size + 1,), f"[0, {entries.size}]", whole=True)
    if rows[0] != 0 or rows[-1] != entries.size or (np.diff(rows) < 0).any():
        raise ArgumentError(f"row_start does not rise from 0 to {entries.size}, the number of entries")
    hazard = wp.empty((source.shape[0], widths.size), dtype=float, device=device)
    kinds = ((rows, int), (entries, int), (factors, float), (widths, float))
    matrix = [wp.array(values, dtype=kind, device=device) for values, kind in kinds]
    return _by_row(_response_kernel(source.dtype), [source, *matrix, noise_rate], hazard)


@wp.kernel(enable_backward=False)
def _dark_count_kernel(
    first_pixel: int,
    seed: wp.uint64,
    median: float,
    spread: float,
    hot_fraction: float,
    hot_rate: float,
    offset: float,
    # Out:
    rate: wp.array[float],
):
    pixel = first_pixel + wp.tid()
    id = wp.uint64(pixel)
    u = uniforms(seed, id, PURPOSE_DARK_COUNTS, wp.uint32(0))
    chance = uniforms(seed, id, PURPOSE_DARK_COUNTS, _ONE)
    if chance[0] < wp.float64(hot_fraction):
        rate[pixel] = hot_rate + offset
    else:
        # Box–Muller
        radius = wp.sqrt(wp.float64(-2.0) * wp.log(wp.float64(1.0) - u[0]))
        normal = radius * wp.cos(wp.float64(6.283185307179586) * u[1])
        rate[pixel] = median * float(wp.exp(wp.float64(spread) * normal)) + offset


def dark_count_rates(
    pixels: int,
    *,
    median: float,
    spread: float = 0.0,
    hot_fraction: float = 0.0,
    hot_rate: float = 0.0,
    offset: float = 0.0,
    seed: int = 0,
    device: Any = None,
) -> wp.array:
    """Dark count rate of every pixel [1/s], float32.

    Lognormal about `median` with `spread` the standard deviation of ln(rate); hot pixels, a `hot_fraction` of all, have
    `hot_rate`; `offset` is added to all. The seed is of the camera, not of the exposure. Raises `ArgumentError`.
    """
    pixels, seed = check.integer("pixels", pixels, 0), check.integer("seed", seed, 0, 2**64 - 1)
    check.within("[0, 1e12]", median=median, hot_rate=hot_rate, offset=offset)
    check.number("spread", spread, "[0, 10]")
    check.number("hot_fraction", hot_fraction, "[0, 1]")
    rate = wp.empty(pixels, dtype=float, device=check.device("device", device))
    return _by_row(_dark_count_kernel, [seed, median, spread, hot_fraction, hot_rate, offset], rate)


@wp.kernel(enable_backward=False)
def _crosstalk_kernel(
    first_pixel: int, width: int, probability: float, detections: wp.array2d[float], hazard: wp.array2d[float]
):
    pixel = first_pixel + wp.tid()
    x = pixel % width
    for k in range(hazard.shape[1]):
        light = float(0.0)
        if x > 0:
            light += detections[pixel - 1, k]
        if x < width - 1:
            light += detections[pixel + 1, k]
        if pixel >= width:
            light += detections[pixel - width, k]
        if pixel + width < hazard.shape[0]:
            light += detections[pixel + width, k]
        hazard[pixel, k] = hazard[pixel, k] + probability * light


def add_crosstalk(hazard: wp.array, detections: wp.array, *, image_width: int, probability: float) -> None:
    """Add `probability` times the four neighbours' expected detections to λ, in place; both float32 `[pixel, bin]`.

    Raises `ArgumentError`.
    """
    check.array("hazard", hazard, wp.float32, (None, None))
    check.array("detections", detections, wp.float32, hazard.shape, hazard.device)
    image_width = check.integer("image_width", image_width, 1)
    check.number("probability", probability, "[0, 1]")
    if hazard.shape[0] % image_width:
        raise ArgumentError(f"image_width = {image_width} does not divide hazard's {hazard.shape[0]} pixels")
    _by_row(_crosstalk_kernel, [image_width, probability, detections], hazard)


# ---- The mean of what a detector makes of them.


@memoised
def _first_photon_law_kernel(dtype: Any) -> wp.Kernel:
    @wp.kernel(enable_backward=False, module="unique")
    def law(first_pixel: int, hazard: wp.array2d[dtype], probability: wp.array2d[dtype]):
        pixel = first_pixel + wp.tid()
        before = wp.float64(0.0)
        for k in range(hazard.shape[1]):
            h = wp.float64(hazard[pixel, k])
            probability[pixel, k] = probability.dtype(-wp.exp(-before) * expm1(-h))
            before += h

    return law


def first_photon_probabilities(hazard: wp.array) -> wp.array:
    """P(first photon in bin k) = exp(−Σ_{j<k} λ_j)·(1 − exp(−λ_k)), of λ's shape `[pixel, bin]` and float type."""
    check.array("hazard", hazard, (wp.float32, wp.float64), (None, None))
    law = wp.empty(hazard.shape, dtype=hazard.dtype, device=hazard.device)
    return _by_row(_first_photon_law_kernel(hazard.dtype), [hazard], law)


@wp.kernel(enable_backward=False)
def _free_running_kernel(
    first_pixel: int, hazard: wp.array2d[float], dead_time: float, period: float, probability: wp.array2d[float]
):
    pixel = first_pixel + wp.tid()
    total = float(0.0)
    for k in range(hazard.shape[1]):
        total += hazard[pixel, k]
    ready = 1.0 / (1.0 + total * dead_time / period)
    for k in range(hazard.shape[1]):
        probability[pixel, k] = hazard[pixel, k] * ready


def free_running_probabilities(hazard: wp.array, *, dead_time: float, period: float) -> wp.array:
    """Mean detections per pulse and bin behind a dead time, λ_k / (1 + Σλ · dead_time / period), `[pixel, bin]`.

    Exact in the sum for a steady rate; the shadow that a strong return casts over the bins behind it is spread out.
    """
    check.array("hazard", hazard, wp.float32, (None, None))
    check.number("dead_time", dead_time, "[0, inf)")
    check.number("period", period, "(0, inf)")
    seen = wp.empty(hazard.shape, dtype=float, device=hazard.device)
    return _by_row(_free_running_kernel, [hazard, dead_time, period], seen)


@wp.kernel(enable_backward=False)
def _coates_kernel(first_pixel: int, counts: wp.array2d[int], pulses: wp.float64, hazard: wp.array2d[wp.float64]):
    pixel = first_pixel + wp.tid()
    left = wp.float64(pulses)
    for k in range(counts.shape[1]):
        n = wp.float64(counts[pixel, k])
        if n < left:
            hazard[pixel, k] = -log1p(-n / left)
        else:
            hazard[pixel, k] = wp.float64(wp.nan)
        left = left - n


def coates(counts: wp.array, *, pulses: float) -> wp.array:
    """Coates' correction: λ̂_k = −ln(1 − n_k / (pulses − Σ_{j<k} n_j)), float64 `[pixel, bin]` of int32 counts.

    NaN from the bin on that holds the last pulse left: nothing can be said of what follows.
    Source: P. B. Coates, "The correction for photon pile-up in the measurement of radiative lifetimes", J. Phys. E 1,
    878 (1968).
    """
    check.array("counts", counts, wp.int32, (None, None))
    check.number("pulses", pulses, "(0, inf)")
    hazard = wp.empty(counts.shape, dtype=wp.float64, device=counts.device)
    return _by_row(_coates_kernel, [counts, pulses], hazard)


# ---- Counts.


def _check_exposure(
    hazard: wp.array, pulses: int, counter_depth: int, seed: int, frames: int, first_frame: int
) -> tuple[int, int, int, int]:
    """Pulses, frames, the largest count of a bin and the seed, in range; on the CPU, rates are checked, too."""
    check.array("hazard", hazard, wp.float32, (None, None))
    check.integer("first_frame", first_frame, 0, 2**63 - 1 - 2**31)
    if hazard.device.is_cpu and (row := first_invalid_row(hazard)) is not None:
        raise ArgumentError(f"hazard of pixel {row} holds numbers that are negative or not finite")
    return (
        check.integer("pulses", pulses, 0),
        check.integer("frames", frames, 1, (2**31 - 1) // max(hazard.shape[0], 1)),
        check.integer("counter_depth", counter_depth, 0) or 2**31 - 1,
        check.integer("seed", seed, 0, 2**64 - 1),
    )


def _zeroed_counts(array: wp.array | None, shape: tuple[int, int], device: Any) -> wp.array:
    """The caller's array of counts, or a new one, set to zero."""
    if array is None:
        return wp.zeros(shape, dtype=int, device=device)
    if not isinstance(array, wp.array) or array.size != shape[0] * shape[1]:
        raise ArgumentError(f"counts do not have the {shape[0] * shape[1]} entries of a contiguous int32 array {shape}")
    check.array("counts", array, wp.int32, tuple(array.shape), device, contiguous=True)
    array.zero_()
    return array.reshape(shape)


# ---- First photons.


@wp.func
def _exponential(seed: wp.uint64, id: wp.uint64, purpose: wp.uint32, block: wp.uint32) -> wp.float64:
    """Waiting time of unit rate, finite."""
    u = uniforms(seed, id, purpose, block)
    return -wp.log(wp.float64(1.0) - u[0])


@wp.struct
class FirstPhotons:
    """Counts of first photons, drawn bin by bin."""

    left: int  # pulses without a count so far
    count: int  # of the bin
    waiting: int
    wait: wp.float64  # hazard, summed over the pulses left, up to the next count
    block: wp.uint32  # of random numbers


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return 0.25;
#else
    return 2.0;
#endif
""")
def _sparse() -> wp.float64:
    """Mean counts of a bin below which waiting for each is cheaper than a binomial draw: a warp waits for all lanes."""


@wp.func
def draw_bin(draws: FirstPhotons, hazard: float, seed: wp.uint64, id: wp.uint64) -> FirstPhotons:
    """The counts of the next bin; `id` names the pixel and frame."""
    draws.count = 0
    h = wp.float64(hazard)
    if h > wp.float64(0.0) and draws.left > 0:
        if wp.float64(draws.left) * h < _sparse():
            # Counts one by one: what passes between two of them is exponential, whatever bins it spans.
            if draws.waiting == 0:
                draws.wait = _exponential(seed, id, PURPOSE_COUNTS, draws.block)
                draws.block = draws.block + _ONE
                draws.waiting = 1
            while draws.left > 0 and draws.wait < wp.float64(draws.left) * h:
                h = h - draws.wait / wp.float64(draws.left)
                draws.left = draws.left - 1
                draws.count = draws.count + 1
                draws.wait = _exponential(seed, id, PURPOSE_COUNTS, draws.block)
                draws.block = draws.block + _ONE
            draws.wait = draws.wait - wp.float64(draws.left) * h
        else:
            # Exponential waits have no memory: the one begun may be dropped.
            draws.waiting = 0
            count, block = binomial(draws.left, h, seed, id, PURPOSE_COUNTS, draws.block)
            draws.count = count
            draws.block = block
            draws.left = draws.left - count
    return draws


@wp.kernel(enable_backward=False)
def _first_photon_kernel(
    first_row: int,
    hazard: wp.array2d[float],
    pulses: int,
    first_frame: wp.int64,
    summed: int,
    depth: int,
    seed: wp.uint64,
    # Out, zero before:
    counts: wp.array2d[int],
):
    """Counts of `summed` frames in a row; frame and pixel name a draw. Launch: rows."""
    row = first_row + wp.tid()
    pixels = hazard.shape[0]
    pixel = row % pixels
    for part in range(summed):
        frame = wp.uint64(first_frame) + wp.uint64(row / pixels * summed + part)
        id = frame * wp.uint64(pixels) + wp.uint64(pixel)
        draws = FirstPhotons()
        draws.left = pulses
        for k in range(hazard.shape[1]):
            draws = draw_bin(draws, hazard[pixel, k], seed, id)
            if draws.count > 0:
                counts[row, k] = counts[row, k] + wp.min(draws.count, depth)


def first_photon_counts(
    hazard: wp.array,
    *,
    pulses: int,
    frames: int = 1,
    first_frame: int = 0,
    summed: bool = False,
    counter_depth: int = 0,
    seed: int,
    counts: wp.array | None = None,
) -> wp.array:
    """Counts of first-photon TCSPC, drawn exactly: bin after bin a binomial of the pulses that have not counted yet.

    Args:
        hazard: λ, float32 `[pixel, bin]`, finite and not negative, which is checked on the CPU alone: on a GPU every
            call would wait for it.
        pulses: per frame, below 2^31.
        frames, first_frame: numbers of the frames; a frame's counts depend on its number, not on the call.
        summed: add the frames up.
        counter_depth: largest count of a bin and frame, 0: unlimited.
        seed: 64 bits.
        counts: the caller's own contiguous array of that size to write into.

    Returns:
        int32 `[frames · pixel, bin]`, or `[pixel, bin]` if summed. At most one count per pulse and pixel.

    Raises:
        ArgumentError: A number out of range, or an array of another kind.
    """
    pulses, frames, depth, seed = _check_exposure(hazard, pulses, counter_depth, seed, frames, first_frame)
    pixels, bins = hazard.shape
    rows = pixels if summed else frames * pixels
    counts = _zeroed_counts(counts, (rows, bins), hazard.device)
    return _by_row(_first_photon_kernel, [hazard, pulses, first_frame, frames if summed else 1, depth, seed], counts)


# ---- Event by event.


@wp.func
def _last_not_above(values: wp.array2d[wp.float64], row: int, x: wp.float64) -> int:
    """Index i of the interval [values[i], values[i + 1]) of a rising row that holds x, clamped to the row."""
    low = int(0)
    high = values.shape[1] - 1
    while high - low > 1:
        middle = (low + high) / 2
        if values[row, middle] <= x:
            low = middle
        else:
            high = middle
    return low


@wp.kernel(enable_backward=False)
def _cumulative_kernel(first_pixel: int, offset: int, hazard: wp.array2d[float], cumulative: wp.array2d[wp.float64]):
    pixel = first_pixel + wp.tid()
    total = wp.float64(0.0)
    cumulative[pixel, 0] = total
    for k in range(hazard.shape[1]):
        # What is no rate counts as none: a history must come to its end.
        if hazard[offset + pixel, k] > 0.0:
            total += wp.float64(wp.min(hazard[offset + pixel, k], 1.0e30))
        cumulative[pixel, k + 1] = total


@wp.struct
class _Detector:
    """See `event_counts`."""

    edges: wp.array2d[wp.float64]  # one row
    recorded: int
    pulses: wp.int64
    period: wp.float64
    gated: bool
    dead_time: wp.float64
    afterpulsing: wp.float64
    time_constant: wp.float64


@wp.struct
class Moment:
    """A time since the start of the window of a pulse [s]; `pulse` at the number of pulses stands for never."""

    pulse: wp.int64
    time: wp.float64


@wp.func
def _next_primary(
    detector: _Detector,
    cumulative: wp.array2d[wp.float64],
    local: int,
    pulse: wp.int64,
    passed: wp.float64,
    xi: wp.float64,
) -> Moment:
    """The next photon or dark count after the hazard `passed` of a pulse. The hazard repeats with the period."""
    zero = wp.float64(0.0)
    found = Moment()
    found.pulse = detector.pulses
    total = cumulative[local, cumulative.shape[1] - 1]
    if total > zero:
        target = passed - wp.log(wp.float64(1.0) - xi)
        periods = wp.floor(target / total)
        if periods < wp.float64(detector.pulses - pulse):
            target = wp.max(target - periods * total, zero)
            k = _last_not_above(cumulative, local, target)
            span = cumulative[local, k + 1] - cumulative[local, k]
            part = zero
            if span > zero:
                part = wp.clamp((target - cumulative[local, k]) / span, zero, wp.float64(1.0))
            found.pulse = pulse + wp.int64(periods)
            found.time = detector.edges[0, k] + part * (detector.edges[0, k + 1] - detector.edges[0, k])
    return found


@wp.func
def _next_afterpulse(detector: _Detector, first: Moment, now: Moment, trapped: wp.float64, xi: wp.float64) -> Moment:
    """The next afterpulse if it comes before `first`, else that: the traps empty as one exponential, because all share
    the time constant."""
    wait = -wp.log(wp.float64(1.0) - xi)
    if wait < trapped:
        later = now.time - detector.time_constant * log1p(-wait / trapped)
        periods = wp.floor(later / detector.period)
        if periods < wp.float64(detector.pulses - now.pulse):
            after = Moment()
            after.pulse = now.pulse + wp.int64(periods)
            after.time = later - periods * detector.period
            if after.pulse < first.pulse or (after.pulse == first.pulse and after.time < first.time):
                return after
    return first


@wp.kernel(enable_backward=False)
def _event_kernel(
    first_row: int,
    detector: _Detector,
    # Pixels `offset` … of an image of `pixels`:
    cumulative: wp.array2d[wp.float64],
    offset: int,
    pixels: int,
    first_frame: wp.int64,
    depth: int,
    seed: wp.uint64,
    # Where a row's tags begin in those of all; empty if none are written:
    tag_start: wp.array[wp.int64],
    # Out, counts zero before:
    counts: wp.array2d[int],
    tag_count: wp.array[int],
    tag_pulse: wp.array[wp.int64],
    tag_bin: wp.array[int],
):
    tid = first_row + wp.tid()
    local = tid % cumulative.shape[0]
    frame = tid / cumulative.shape[0]
    pixel = offset + local
    row = frame * pixels + pixel
    id = (wp.uint64(first_frame) + wp.uint64(frame)) * wp.uint64(pixels) + wp.uint64(pixel)
    edges = detector.edges
    end = edges[0, edges.shape[1] - 1]
    zero = wp.float64(0.0)
    block = wp.uint32(0)
    tags = int(0)
    now = Moment()
    passed = wp.float64(0.0)  # hazard of the window up to now
    trapped = wp.float64(0.0)  # mean number of afterpulses still to come
    while now.pulse < detector.pulses:
        draw = uniforms(seed, id, PURPOSE_EVENTS, block)
        block = block + _ONE
        found = _next_primary(detector, cumulative, local, now.pulse, passed, draw[0])
        found = _next_afterpulse(detector, found, now, trapped, draw[1])
        if found.pulse >= detector.pulses:
            now.pulse = detector.pulses
        else:
            elapsed = wp.float64(found.pulse - now.pulse) * detector.period + (found.time - now.time)
            trapped = trapped * wp.exp(-elapsed / detector.time_constant)
            now.pulse = found.pulse
            now.time = found.time
            fires = not detector.gated or now.time < end  # between two windows a gated detector is off
            if fires:
                k = _last_not_above(edges, 0, now.time)
                if k < detector.recorded and now.time < edges[0, detector.recorded]:
                    if tag_start.shape[0] > 0:
                        tag_pulse[tag_start[row] + wp.int64(tags)] = now.pulse
                        tag_bin[tag_start[row] + wp.int64(tags)] = k
                    elif counts[row, k] < depth:
                        counts[row, k] = counts[row, k] + 1
                    tags += 1
            if detector.gated:
                off = detector.period - now.time
                trapped = trapped * wp.exp(-off / detector.time_constant)
                if fires:
                    after = wp.max(off - detector.dead_time, zero)
                    trapped += detector.afterpulsing * wp.exp(-after / detector.time_constant)
                now.pulse = now.pulse + wp.int64(1)
                now.time = zero
                passed = zero
            else:
                # `afterpulsing` is what is left of the traps when the dead time ends.
                trapped = trapped * wp.exp(-detector.dead_time / detector.time_constant) + detector.afterpulsing
                later = now.time + detector.dead_time
                periods = wp.floor(later / detector.period)
                now.pulse = now.pulse + wp.int64(periods)
                now.time = later - periods * detector.period
                k = _last_not_above(edges, 0, now.time)
                part = wp.clamp((now.time - edges[0, k]) / (edges[0, k + 1] - edges[0, k]), zero, wp.float64(1.0))
                passed = cumulative[local, k] + part * (cumulative[local, k + 1] - cumulative[local, k])
    tag_count[row] = tags


def event_counts(
    hazard: wp.array,
    *,
    edges: np.ndarray,
    recorded: int,
    period: float,
    pulses: int,
    gated: bool = False,
    dead_time: float = 0.0,
    afterpulsing_probability: float = 0.0,
    afterpulsing_time_constant: float = 1.0,
    frames: int = 1,
    first_frame: int = 0,
    counter_depth: int = 0,
    tags: bool = False,
    seed: int,
    counts: wp.array | None = None,
) -> tuple[wp.array, dict[str, np.ndarray] | None]:
    """Counts of a detector followed event by event through `pulses` periods; the cost is per detection.

    The hazard of photons and dark counts repeats with every period. A detection is followed by the dead time (which
    photons that meet it do not extend) and by afterpulses: on average `afterpulsing_probability` of them after the dead
    time, with exponential delay; afterpulses have afterpulses.

    Args:
        hazard: λ, as in `first_photon_counts`.
        edges: of its bins [s], float64 `[bin + 1]`, from 0 to at most `period`; no photon comes after the last.
        recorded: the first `recorded` bins are histogrammed; in the others the detector fires unseen.
        gated: off from a detection, or from the last edge, to the next pulse: first-photon TCSPC. Else free-running.
        dead_time, afterpulsing_time_constant: [s].
        tags: also return the stream of detections.
        pulses, frames, first_frame, counter_depth, seed, counts: as in `first_photon_counts`.

    Returns:
        int32 `[frames · pixel, recorded]` and, with `tags`, the arrays `row` (frame · pixels + pixel, int64), `pulse`
        (int64) and `bin` (int32) in the order of row and time; otherwise None.

    Raises:
        ArgumentError: A number out of range, an array of another kind, or too many detections in a frame.
    """
    pulses, frames, depth, seed = _check_exposure(hazard, pulses, counter_depth, seed, frames, first_frame)
    device, (pixels, bins) = hazard.device, hazard.shape
    detector = _Detector()
    detector.recorded = recorded = check.integer("recorded", recorded, 1, bins)
    check.within("(0, inf)", period=period, afterpulsing_time_constant=afterpulsing_time_constant)
    detector.pulses, detector.period, detector.gated = pulses, period, bool(gated)
    detector.dead_time = check.number("dead_time", dead_time, "[0, inf)")
    detector.afterpulsing = check.number("afterpulsing_probability", afterpulsing_probability, "[0, 1)")
    detector.time_constant = afterpulsing_time_constant
    rising = check.numbers("edges", edges, (bins + 1,))
    if not (rising[0] == 0.0 and (np.diff(rising) > 0.0).all() and rising[-1] <= period * (1.0 + 1e-9)):
        raise ArgumentError(f"edges do not rise from 0 to at most the period, {period} s")
    detector.edges = wp.array(rising[None, :], dtype=wp.float64, device=device)
    rows = frames * pixels
    counts = _zeroed_counts(counts, (rows, recorded), device)
    number = wp.zeros(rows, dtype=int, device=device)
    # A period without dead time holds any number of detections: only then does the mean have to be looked up.
    most = 1.0 if gated else period / dead_time + 1.0 if dead_time > 0 else np.inf
    if pulses * most > EVENT_LIMIT:
        mean = np.nan_to_num(hazard.numpy(), posinf=1e30).clip(0.0, 1e30).sum(axis=1, dtype=np.float64).max(initial=0.0)
        most = min(most, float(mean) / (1.0 - afterpulsing_probability))
    if pulses * most > EVENT_LIMIT:
        raise ArgumentError(
            f"a pixel may see {pulses * most:.3g} counts in a frame, above {EVENT_LIMIT}: use more frames"
        )
    chunk = max(1, min(pixels, 2**25 // (bins + 1)))

    def run(start: wp.array, pulse: wp.array, bin: wp.array) -> None:
        for offset in range(0, pixels, chunk):
            size = min(chunk, pixels - offset)
            cumulative = wp.empty((size, bins + 1), dtype=wp.float64, device=device)
            _by_row(_cumulative_kernel, [offset, hazard], cumulative)
            inputs = [detector, cumulative, offset, pixels, first_frame, depth, seed, start, counts, number, pulse, bin]
            launch_pixels(_event_kernel, frames * size, inputs, device=device)

    none = wp.zeros(0, dtype=wp.int64, device=device)
    run(none, none, wp.zeros(0, dtype=int, device=device))
    if not tags:
        return counts, None
    # The same draws again, now that the position of each row in the stream is known.
    per_row = number.numpy().astype(np.int64)
    start = np.append(0, np.cumsum(per_row))
    pulse, bin = (wp.empty(int(start[-1]), dtype=kind, device=device) for kind in (wp.int64, wp.int32))
    run(wp.array(start, dtype=wp.int64, device=device), pulse, bin)
    return counts, {"row": np.repeat(np.arange(rows), per_row), "pulse": pulse.numpy(), "bin": bin.numpy()}
