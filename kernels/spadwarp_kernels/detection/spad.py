"""SPAD and TCSPC: from expected detections per pulse and bin to counts.

λ[pixel, bin] is a hazard: the mean number of detections that a pulse would cause in the bin if the detector were always
ready. Every draw is keyed by (seed, frame · pixels + pixel), so that counts do not depend on how a launch is cut up.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.pixels import launch_pixels
from spadwarp_kernels.random.binomial import binomial, expm1, log1p, uniforms

wp.set_module_options({"enable_backward": False})

_COUNTS = wp.constant(wp.uint32(0))
_EVENTS = wp.constant(wp.uint32(1))
_PATTERN = wp.constant(wp.uint32(2))
_ONE = wp.constant(wp.uint32(1))

EVENT_LIMIT = 2**27
"""Most detections of a pixel in one frame of the event-driven detector: random blocks are numbered in 28 bits."""

_SPARSE = wp.constant(
    wp.float64(2.0)
)  # mean counts in a bin below which waiting times are cheaper than a binomial draw


@wp.func
def _exponential(seed: wp.uint64, id: wp.uint64, purpose: wp.uint32, block: wp.uint32) -> wp.float64:
    """Waiting time of unit rate, finite."""
    u = uniforms(seed, id, purpose, block)
    return -wp.log(wp.float64(1.0) - u[0])


# Expected detections


@cache
def _response_kernel(dtype: Any) -> wp.Kernel:
    @wp.kernel(enable_backward=False, module="unique")
    def respond(
        first_pixel: int,
        source: wp.array2d(dtype=dtype),
        # Sparse rows, one a detector bin:
        row_start: wp.array(dtype=int),
        source_bin: wp.array(dtype=int),
        weight: wp.array(dtype=float),
        width: wp.array(dtype=float),
        noise_rate: wp.array(dtype=float),
        # Out:
        hazard: wp.array2d(dtype=float),
    ):
        pixel = first_pixel + wp.tid()
        noise = noise_rate[pixel]
        for k in range(width.shape[0]):
            total = float(noise * width[k])
            for entry in range(row_start[k], row_start[k + 1]):
                total += weight[entry] * float(source[pixel, source_bin[entry]])
            hazard[pixel, k] = total

    return respond


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
    rate: wp.array(dtype=float),
):
    pixel = first_pixel + wp.tid()
    id = wp.uint64(pixel)
    u = uniforms(seed, id, _PATTERN, wp.uint32(0))
    chance = uniforms(seed, id, _PATTERN, _ONE)
    if chance[0] < wp.float64(hot_fraction):
        rate[pixel] = hot_rate + offset
    else:
        # Box–Muller
        radius = wp.sqrt(wp.float64(-2.0) * wp.log(wp.float64(1.0) - u[0]))
        normal = radius * wp.cos(wp.float64(6.283185307179586) * u[1])
        rate[pixel] = median * float(wp.exp(wp.float64(spread) * normal)) + offset


@wp.kernel(enable_backward=False)
def _crosstalk_kernel(
    first_pixel: int,
    width: int,
    probability: float,
    detections: wp.array2d(dtype=float),
    # In and out:
    hazard: wp.array2d(dtype=float),
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


@cache
def _first_photon_law_kernel(dtype: Any) -> wp.Kernel:
    @wp.kernel(enable_backward=False, module="unique")
    def law(first_pixel: int, hazard: wp.array2d(dtype=dtype), probability: wp.array2d(dtype=dtype)):
        pixel = first_pixel + wp.tid()
        before = wp.float64(0.0)
        for k in range(hazard.shape[1]):
            h = wp.float64(hazard[pixel, k])
            probability[pixel, k] = probability.dtype(-wp.exp(-before) * expm1(-h))
            before += h

    return law


@wp.kernel(enable_backward=False)
def _free_running_kernel(
    first_pixel: int,
    hazard: wp.array2d(dtype=float),
    dead_time: float,
    period: float,
    probability: wp.array2d(dtype=float),
):
    pixel = first_pixel + wp.tid()
    total = float(0.0)
    for k in range(hazard.shape[1]):
        total += hazard[pixel, k]
    ready = 1.0 / (1.0 + total * dead_time / period)
    for k in range(hazard.shape[1]):
        probability[pixel, k] = hazard[pixel, k] * ready


@wp.kernel(enable_backward=False)
def _coates_kernel(
    first_pixel: int, counts: wp.array2d(dtype=int), pulses: wp.float64, hazard: wp.array2d(dtype=wp.float64)
):
    pixel = first_pixel + wp.tid()
    left = wp.float64(pulses)
    for k in range(counts.shape[1]):
        n = wp.float64(counts[pixel, k])
        if n < left:
            hazard[pixel, k] = -log1p(-n / left)
        else:
            hazard[pixel, k] = wp.float64(wp.nan)
        left = left - n


# First photon


@wp.kernel(enable_backward=False)
def _first_photon_kernel(
    first_row: int,
    hazard: wp.array2d(dtype=float),
    pulses: int,
    first_frame: wp.int64,
    summed: int,
    depth: int,
    seed: wp.uint64,
    # Out, zero before:
    counts: wp.array2d(dtype=int),
):
    row = first_row + wp.tid()
    pixels = hazard.shape[0]
    pixel = row % pixels
    for part in range(summed):
        frame = wp.uint64(first_frame) + wp.uint64(row / pixels * summed + part)
        id = frame * wp.uint64(pixels) + wp.uint64(pixel)
        block = wp.uint32(0)
        left = int(pulses)  # pulses without a count so far
        waiting = int(0)
        wait = wp.float64(0.0)  # hazard, summed over the pulses left, up to the next count
        for k in range(hazard.shape[1]):
            h = wp.float64(hazard[pixel, k])
            if h > wp.float64(0.0) and left > 0:
                count = int(0)
                if wp.float64(left) * h < _SPARSE:
                    # Counts one by one: what passes between two of them is exponential, whatever bins it spans.
                    if waiting == 0:
                        wait = _exponential(seed, id, _COUNTS, block)
                        block = block + _ONE
                        waiting = 1
                    while left > 0 and wait < wp.float64(left) * h:
                        h = h - wait / wp.float64(left)
                        left = left - 1
                        count = count + 1
                        wait = _exponential(seed, id, _COUNTS, block)
                        block = block + _ONE
                    wait = wait - wp.float64(left) * h
                else:
                    # Exponential waits have no memory: the one begun may be dropped.
                    waiting = 0
                    count, block = binomial(left, h, seed, id, _COUNTS, block)
                    left = left - count
                if count > 0:
                    counts[row, k] = counts[row, k] + wp.min(count, depth)


# Event by event


@wp.func
def _last_not_above(values: wp.array2d(dtype=wp.float64), row: int, x: wp.float64) -> int:
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
def _cumulative_kernel(
    first_pixel: int, offset: int, hazard: wp.array2d(dtype=float), cumulative: wp.array2d(dtype=wp.float64)
):
    pixel = first_pixel + wp.tid()
    total = wp.float64(0.0)
    cumulative[pixel, 0] = total
    for k in range(hazard.shape[1]):
        total += wp.float64(hazard[offset + pixel, k])
        cumulative[pixel, k + 1] = total


@wp.kernel(enable_backward=False)
def _event_kernel(
    first_row: int,
    # Pixels `offset` … of an image of `pixels`:
    cumulative: wp.array2d(dtype=wp.float64),
    offset: int,
    pixels: int,
    edges: wp.array2d(dtype=wp.float64),
    recorded: int,
    pulses: wp.int64,
    period: wp.float64,
    gated: int,
    dead_time: wp.float64,
    afterpulsing: wp.float64,
    time_constant: wp.float64,
    first_frame: wp.int64,
    depth: int,
    seed: wp.uint64,
    write_tags: int,
    tag_start: wp.array(dtype=wp.int64),
    # Out, counts zero before:
    counts: wp.array2d(dtype=int),
    tag_count: wp.array(dtype=int),
    tag_pulse: wp.array(dtype=wp.int64),
    tag_bin: wp.array(dtype=int),
):
    tid = first_row + wp.tid()
    local = tid % cumulative.shape[0]
    frame = tid / cumulative.shape[0]
    pixel = offset + local
    row = frame * pixels + pixel
    id = (wp.uint64(first_frame) + wp.uint64(frame)) * wp.uint64(pixels) + wp.uint64(pixel)
    bins = edges.shape[1] - 1
    end = edges[0, bins]
    total = cumulative[local, bins]
    zero = wp.float64(0.0)
    block = wp.uint32(0)
    tags = int(0)
    pulse = wp.int64(0)
    time = wp.float64(0.0)  # since the start of the window of `pulse`
    passed = wp.float64(0.0)  # hazard in [0, time)
    trapped = wp.float64(0.0)  # mean number of afterpulses still to come
    while pulse < pulses:
        draw = uniforms(seed, id, _EVENTS, block)
        block = block + _ONE
        # The next photon or dark count. The hazard repeats with the period.
        next_pulse = wp.int64(pulses)
        next_time = wp.float64(0.0)
        if total > zero:
            target = passed - wp.log(wp.float64(1.0) - draw[0])
            periods = wp.floor(target / total)
            if periods < wp.float64(pulses - pulse):
                target = wp.max(target - periods * total, zero)
                k = _last_not_above(cumulative, local, target)
                span = cumulative[local, k + 1] - cumulative[local, k]
                part = zero
                if span > zero:
                    part = wp.clamp((target - cumulative[local, k]) / span, zero, wp.float64(1.0))
                next_pulse = pulse + wp.int64(periods)
                next_time = edges[0, k] + part * (edges[0, k + 1] - edges[0, k])
        # The next afterpulse: the traps empty as one exponential, because all share the time constant.
        wait = -wp.log(wp.float64(1.0) - draw[1])
        if wait < trapped:
            later = time - time_constant * log1p(-wait / trapped)
            periods = wp.floor(later / period)
            if periods < wp.float64(pulses - pulse):
                after_pulse = pulse + wp.int64(periods)
                after_time = later - periods * period
                if after_pulse < next_pulse or (after_pulse == next_pulse and after_time < next_time):
                    next_pulse = after_pulse
                    next_time = after_time
        if next_pulse >= pulses:
            pulse = pulses
        else:
            elapsed = wp.float64(next_pulse - pulse) * period + (next_time - time)
            trapped = trapped * wp.exp(-elapsed / time_constant)
            pulse = next_pulse
            time = next_time
            fires = gated == 0 or time < end  # between two windows a gated detector is off
            if fires:
                k = _last_not_above(edges, 0, time)
                if k < recorded and time < edges[0, recorded]:
                    if write_tags == 1:
                        tag_pulse[tag_start[row] + wp.int64(tags)] = pulse
                        tag_bin[tag_start[row] + wp.int64(tags)] = k
                    elif counts[row, k] < depth:
                        counts[row, k] = counts[row, k] + 1
                    tags += 1
            if gated == 1:
                off = period - time
                trapped = trapped * wp.exp(-off / time_constant)
                if fires:
                    trapped += afterpulsing * wp.exp(-wp.max(off - dead_time, zero) / time_constant)
                pulse = pulse + wp.int64(1)
                time = zero
                passed = zero
            else:
                # `afterpulsing` is what is left of the traps when the dead time ends.
                trapped = trapped * wp.exp(-dead_time / time_constant) + afterpulsing
                time = time + dead_time
                periods = wp.floor(time / period)
                pulse = pulse + wp.int64(periods)
                time = time - periods * period
                k = _last_not_above(edges, 0, time)
                part = wp.clamp((time - edges[0, k]) / (edges[0, k + 1] - edges[0, k]), zero, wp.float64(1.0))
                passed = cumulative[local, k] + part * (cumulative[local, k + 1] - cumulative[local, k])
    tag_count[row] = tags


# Launchers


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
    `hot_rate`; `offset` is added to all. The seed is of the camera, not of the exposure.
    """
    rate = wp.empty(pixels, dtype=float, device=device)
    inputs = [seed, median, spread, hot_fraction, hot_rate, offset, rate]
    launch_pixels(_dark_count_kernel, pixels, inputs, device=rate.device)
    return rate


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
    """
    device = source.device
    hazard = wp.empty((source.shape[0], len(width)), dtype=float, device=device)
    matrix = [
        wp.array(row_start, dtype=int, device=device),
        wp.array(source_bin, dtype=int, device=device),
        wp.array(weight, dtype=float, device=device),
        wp.array(width, dtype=float, device=device),
    ]
    inputs = [source, *matrix, noise_rate, hazard]
    launch_pixels(_response_kernel(source.dtype), source.shape[0], inputs, device=device)
    return hazard


def add_crosstalk(hazard: wp.array, detections: wp.array, *, image_width: int, probability: float) -> None:
    """Add `probability` times the four neighbours' expected detections to λ, in place; both float32 `[pixel, bin]`."""
    inputs = [image_width, probability, detections, hazard]
    launch_pixels(_crosstalk_kernel, hazard.shape[0], inputs, device=hazard.device)


def first_photon_probabilities(hazard: wp.array) -> wp.array:
    """P(first photon in bin k) = exp(−Σ_{j<k} λ_j)·(1 − exp(−λ_k)), of λ's shape `[pixel, bin]` and float type."""
    law = wp.empty(hazard.shape, dtype=hazard.dtype, device=hazard.device)
    launch_pixels(_first_photon_law_kernel(hazard.dtype), hazard.shape[0], [hazard, law], device=hazard.device)
    return law


def free_running_probabilities(hazard: wp.array, *, dead_time: float, period: float) -> wp.array:
    """Mean detections per pulse and bin behind a dead time, λ_k / (1 + Σλ · dead_time / period), `[pixel, bin]`.

    Exact in the sum for a steady rate; the shadow that a strong return casts over the bins behind it is spread out.
    """
    seen = wp.empty(hazard.shape, dtype=float, device=hazard.device)
    inputs = [hazard, dead_time, period, seen]
    launch_pixels(_free_running_kernel, hazard.shape[0], inputs, device=hazard.device)
    return seen


def coates(counts: wp.array, *, pulses: float) -> wp.array:
    """Coates' correction: λ̂_k = −ln(1 − n_k / (pulses − Σ_{j<k} n_j)), float64 `[pixel, bin]` of int32 counts.

    NaN from the bin on that holds the last pulse left: nothing can be said of what follows.
    Source: P. B. Coates, "The correction for photon pile-up in the measurement of radiative lifetimes", J. Phys. E 1,
    878 (1968).
    """
    hazard = wp.empty(counts.shape, dtype=wp.float64, device=counts.device)
    launch_pixels(_coates_kernel, counts.shape[0], [counts, pulses, hazard], device=counts.device)
    return hazard


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
        hazard: λ, float32 `[pixel, bin]`, not negative.
        pulses: per frame, below 2^31.
        frames, first_frame: numbers of the frames; a frame's counts depend on its number, not on the call.
        summed: add the frames up.
        counter_depth: largest count of a bin and frame, 0: unlimited.
        seed: 64 bits.
        counts: the caller's own contiguous array of that size to write into.

    Returns:
        int32 `[frames · pixel, bin]`, or `[pixel, bin]` if summed. At most one count per pulse and pixel.
    """
    pixels, bins = hazard.shape
    rows = pixels if summed else frames * pixels
    counts = _zeroed(counts, (rows, bins), hazard.device)
    inputs = [hazard, pulses, first_frame, frames if summed else 1, counter_depth or 2**31 - 1, seed, counts]
    launch_pixels(_first_photon_kernel, rows, inputs, device=hazard.device)
    return counts


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
        hazard: λ, float32 `[pixel, bin]`.
        edges: of its bins [s], float64 `[bin + 1]`, from 0 to at most `period`; no photon comes after the last.
        recorded: the first `recorded` bins are histogrammed; in the others the detector fires unseen.
        gated: off from a detection, or from the last edge, to the next pulse: first-photon TCSPC. Else free-running.
        dead_time, afterpulsing_time_constant: [s].
        tags: also return the stream of detections.
        pulses, frames, first_frame, counter_depth, seed, counts: as in `first_photon_counts`.

    Returns:
        int32 `[frames · pixel, recorded]` and, with `tags`, the arrays `row` (frame · pixels + pixel, int64), `pulse`
        (int64) and `bin` (int32) in the order of row and time; otherwise None.
    """
    device = hazard.device
    pixels, bins = hazard.shape
    rows = frames * pixels
    counts = _zeroed(counts, (rows, recorded), device)
    number = wp.zeros(rows, dtype=int, device=device)
    # A period without dead time holds any number of detections: only then does the mean have to be looked up.
    most = 1.0 if gated else period / dead_time + 1.0 if dead_time > 0 else np.inf
    if pulses * most > EVENT_LIMIT:
        most = min(most, float(hazard.numpy().sum(axis=1, dtype=np.float64).max()) / (1.0 - afterpulsing_probability))
    if pulses * most > EVENT_LIMIT:
        raise ValueError(f"a pixel may see {pulses * most:.3g} counts in a frame, above {EVENT_LIMIT}: use more frames")
    edge_row = wp.array(np.asarray(edges, np.float64)[None, :], dtype=wp.float64, device=device)
    chunk = max(1, min(pixels, 2**25 // (bins + 1)))

    def run(write: int, start: wp.array, pulse: wp.array, bin: wp.array) -> None:
        for offset in range(0, pixels, chunk):
            size = min(chunk, pixels - offset)
            cumulative = wp.empty((size, bins + 1), dtype=wp.float64, device=device)
            launch_pixels(_cumulative_kernel, size, [offset, hazard, cumulative], device=device)
            inputs = [cumulative, offset, pixels, edge_row, recorded, pulses, period, int(gated), dead_time]
            inputs += [afterpulsing_probability, afterpulsing_time_constant, first_frame]
            inputs += [counter_depth or 2**31 - 1, seed, write, start, counts, number, pulse, bin]
            launch_pixels(_event_kernel, frames * size, inputs, device=device)

    none = wp.zeros(1, dtype=wp.int64, device=device)
    run(0, none, none, wp.zeros(1, dtype=int, device=device))
    if not tags:
        return counts, None
    # The same draws again, now that each row's place in the stream is known.
    per_row = number.numpy().astype(np.int64)
    start = np.concatenate([[0], np.cumsum(per_row)])
    pulse = wp.empty(max(int(start[-1]), 1), dtype=wp.int64, device=device)
    bin = wp.empty(max(int(start[-1]), 1), dtype=int, device=device)
    run(1, wp.array(start, dtype=wp.int64, device=device), pulse, bin)
    stream = {"row": np.repeat(np.arange(rows), per_row)}
    stream |= {"pulse": pulse.numpy()[: start[-1]], "bin": bin.numpy()[: start[-1]]}
    return counts, stream


def _zeroed(array: wp.array | None, shape: tuple[int, int], device: Any) -> wp.array:
    if array is None:
        return wp.zeros(shape, dtype=int, device=device)
    if array.dtype is not wp.int32 or array.size != shape[0] * shape[1] or not array.is_contiguous:
        raise ValueError(f"counts are {array.dtype.__name__} {array.shape}; contiguous int32 {shape} is needed")
    array.zero_()
    return array.reshape(shape)
