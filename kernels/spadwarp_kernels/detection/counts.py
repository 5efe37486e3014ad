"""Counts of a SPAD: first-photon TCSPC, with at most one count a pulse and pixel, and a detector that is followed event
by event, with dead time and afterpulses.

Every draw is keyed by (seed, frame · pixels + pixel), so that counts do not depend on how a launch is cut up.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_array,
    check_integer,
    check_number,
    check_numbers,
    check_range,
    check_seed,
)
from spadwarp_kernels.base.binomial import PURPOSE_COUNTS, PURPOSE_EVENTS, binomial, uniforms
from spadwarp_kernels.base.kernels import launch_pixels
from spadwarp_kernels.base.native import log1p

from .expected import first_invalid_row

__all__ = ["event_counts", "first_photon_counts"]

wp.set_module_options({"enable_backward": False})

_ONE = wp.constant(wp.uint32(1))

# Mean counts in a bin below which waiting times are cheaper than a binomial draw.
_SPARSE = wp.constant(wp.float64(2.0))

EVENT_LIMIT = 2**27
"""Most detections of a pixel in one frame of the event-driven detector: random blocks are numbered in 28 bits."""


class _Exposure(NamedTuple):
    """The numbers of an exposure, in range, and the largest count of a bin."""

    pulses: int
    frames: int
    first_frame: int
    depth: int
    seed: int


def _check_exposure(
    hazard: wp.array, pulses: int, counter_depth: int, seed: int, frames: int = 1, first_frame: int = 0
) -> _Exposure:
    """At most 2^31 - 1 rows in one call; raises `ArgumentError`."""
    check_array("hazard", hazard, wp.float32, (None, None))
    return _Exposure(
        check_integer("pulses", pulses, 0),
        check_integer("frames", frames, 1, (2**31 - 1) // max(hazard.shape[0], 1)),
        check_integer("first_frame", first_frame, 0, 2**63 - 1 - 2**31),
        check_integer("counter_depth", counter_depth, 0) or 2**31 - 1,
        check_seed(seed),
    )


def _check_rates(hazard: wp.array) -> None:
    """Every rate is one, on the CPU, where nobody has to wait for it."""
    check_array("hazard", hazard, wp.float32, (None, None))
    if hazard.device.is_cpu and (row := first_invalid_row(hazard)) is not None:
        raise ArgumentError(f"hazard of pixel {row} holds numbers that are negative or not finite")


def _zeroed_counts(array: wp.array | None, shape: tuple[int, int], device: Any) -> wp.array:
    """The caller's array of counts, or a new one, set to zero."""
    if array is None:
        return wp.zeros(shape, dtype=int, device=device)
    if not isinstance(array, wp.array) or array.size != shape[0] * shape[1]:
        raise ArgumentError(f"counts do not have the {shape[0] * shape[1]} entries of a contiguous int32 array {shape}")
    check_array("counts", array, wp.int32, tuple(array.shape), device, contiguous=True)
    array.zero_()
    return array.reshape(shape)


# ---- First photons.


@wp.func
def _exponential(seed: wp.uint64, id: wp.uint64, purpose: wp.uint32, block: wp.uint32) -> wp.float64:
    """Waiting time of unit rate, finite."""
    u = uniforms(seed, id, purpose, block)
    return -wp.log(wp.float64(1.0) - u[0])


@wp.func
def _draw_row(
    hazard: wp.array2d[float],
    pixel: int,
    row: int,
    pulses: int,
    depth: int,
    seed: wp.uint64,
    id: wp.uint64,
    # Out, zero before or counts to add to:
    counts: wp.array2d[int],
):
    """Adds the counts of `pulses` pulses of a pixel to a row; `id` names the draw."""
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
                    wait = _exponential(seed, id, PURPOSE_COUNTS, block)
                    block = block + _ONE
                    waiting = 1
                while left > 0 and wait < wp.float64(left) * h:
                    h = h - wait / wp.float64(left)
                    left = left - 1
                    count = count + 1
                    wait = _exponential(seed, id, PURPOSE_COUNTS, block)
                    block = block + _ONE
                wait = wait - wp.float64(left) * h
            else:
                # Exponential waits have no memory: the one begun may be dropped.
                waiting = 0
                count, block = binomial(left, h, seed, id, PURPOSE_COUNTS, block)
                left = left - count
            if count > 0:
                counts[row, k] = counts[row, k] + wp.min(count, depth)


@wp.kernel(enable_backward=False)
def _first_photon_kernel(
    first_row: int,
    hazard: wp.array2d[float],
    pulses: int,
    first_frame: wp.array[wp.int64],
    summed: int,
    depth: int,
    seed: wp.uint64,
    # Out, zero before:
    counts: wp.array2d[int],
):
    row = first_row + wp.tid()
    pixels = hazard.shape[0]
    pixel = row % pixels
    for part in range(summed):
        frame = wp.uint64(first_frame[0]) + wp.uint64(row / pixels * summed + part)
        id = frame * wp.uint64(pixels) + wp.uint64(pixel)
        _draw_row(hazard, pixel, row, pulses, depth, seed, id, counts)


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
    _check_rates(hazard)
    shot = _check_exposure(hazard, pulses, counter_depth, seed, frames, first_frame)
    pixels, bins = hazard.shape
    rows = pixels if summed else shot.frames * pixels
    counts = _zeroed_counts(counts, (rows, bins), hazard.device)
    first = wp.array([shot.first_frame], dtype=wp.int64, device=hazard.device)
    inputs = [hazard, shot.pulses, first, shot.frames if summed else 1, shot.depth, shot.seed, counts]
    launch_pixels(_first_photon_kernel, rows, inputs, device=hazard.device)
    return counts


def first_photon_step(
    hazard: wp.array, *, pulses: int, frame: wp.array, counter_depth: int = 0, seed: int, counts: wp.array
) -> None:
    """One frame of `first_photon_counts` whose number is on the device, for a step that is captured in a graph.

    Nothing is allocated and no value is read on the host: the counts are those of `first_photon_counts` with
    `first_frame` = frame[0].

    Args:
        hazard: As there; its values are not checked.
        frame: int64 `[1]`, the number of the frame, which the caller moves on.
        counts: int32 `[pixel, bin]`, overwritten.
        pulses, counter_depth, seed: As there.

    Raises:
        ArgumentError: A number out of range, or an array of another kind.
    """
    shot = _check_exposure(hazard, pulses, counter_depth, seed)
    check_array("frame", frame, wp.int64, (1,), hazard.device)
    check_array("counts", counts, wp.int32, hazard.shape, hazard.device, contiguous=True)
    counts.zero_()
    inputs = [hazard, shot.pulses, frame, 1, shot.depth, shot.seed, counts]
    launch_pixels(_first_photon_kernel, hazard.shape[0], inputs, device=hazard.device)


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
class Moment:
    """A time since the start of the window of a pulse [s]; `pulse` at the number of pulses stands for never."""

    pulse: wp.int64
    time: wp.float64


@wp.func
def _next_primary(
    cumulative: wp.array2d[wp.float64],
    edges: wp.array2d[wp.float64],
    local: int,
    pulses: wp.int64,
    pulse: wp.int64,
    passed: wp.float64,
    xi: wp.float64,
) -> Moment:
    """The next photon or dark count after the hazard `passed` of a pulse. The hazard repeats with the period."""
    zero = wp.float64(0.0)
    found = Moment()
    found.pulse = pulses
    total = cumulative[local, cumulative.shape[1] - 1]
    if total > zero:
        target = passed - wp.log(wp.float64(1.0) - xi)
        periods = wp.floor(target / total)
        if periods < wp.float64(pulses - pulse):
            target = wp.max(target - periods * total, zero)
            k = _last_not_above(cumulative, local, target)
            span = cumulative[local, k + 1] - cumulative[local, k]
            part = zero
            if span > zero:
                part = wp.clamp((target - cumulative[local, k]) / span, zero, wp.float64(1.0))
            found.pulse = pulse + wp.int64(periods)
            found.time = edges[0, k] + part * (edges[0, k + 1] - edges[0, k])
    return found


@wp.func
def _next_afterpulse(
    first: Moment,
    now: Moment,
    pulses: wp.int64,
    period: wp.float64,
    time_constant: wp.float64,
    trapped: wp.float64,
    xi: wp.float64,
) -> Moment:
    """The next afterpulse if it comes before `first`, else that: the traps empty as one exponential, because all share
    the time constant."""
    wait = -wp.log(wp.float64(1.0) - xi)
    if wait < trapped:
        later = now.time - time_constant * log1p(-wait / trapped)
        periods = wp.floor(later / period)
        if periods < wp.float64(pulses - now.pulse):
            after = Moment()
            after.pulse = now.pulse + wp.int64(periods)
            after.time = later - periods * period
            if after.pulse < first.pulse or (after.pulse == first.pulse and after.time < first.time):
                return after
    return first


@wp.kernel(enable_backward=False)
def _event_kernel(
    first_row: int,
    # Pixels `offset` … of an image of `pixels`:
    cumulative: wp.array2d[wp.float64],
    offset: int,
    pixels: int,
    edges: wp.array2d[wp.float64],
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
    bins = edges.shape[1] - 1
    end = edges[0, bins]
    zero = wp.float64(0.0)
    block = wp.uint32(0)
    tags = int(0)
    now = Moment()
    passed = wp.float64(0.0)  # hazard of the window up to now
    trapped = wp.float64(0.0)  # mean number of afterpulses still to come
    while now.pulse < pulses:
        draw = uniforms(seed, id, PURPOSE_EVENTS, block)
        block = block + _ONE
        found = _next_primary(cumulative, edges, local, pulses, now.pulse, passed, draw[0])
        found = _next_afterpulse(found, now, pulses, period, time_constant, trapped, draw[1])
        if found.pulse >= pulses:
            now.pulse = pulses
        else:
            elapsed = wp.float64(found.pulse - now.pulse) * period + (found.time - now.time)
            trapped = trapped * wp.exp(-elapsed / time_constant)
            now.pulse = found.pulse
            now.time = found.time
            fires = gated == 0 or now.time < end  # between two windows a gated detector is off
            if fires:
                k = _last_not_above(edges, 0, now.time)
                if k < recorded and now.time < edges[0, recorded]:
                    if write_tags == 1:
                        tag_pulse[tag_start[row] + wp.int64(tags)] = now.pulse
                        tag_bin[tag_start[row] + wp.int64(tags)] = k
                    elif counts[row, k] < depth:
                        counts[row, k] = counts[row, k] + 1
                    tags += 1
            if gated == 1:
                off = period - now.time
                trapped = trapped * wp.exp(-off / time_constant)
                if fires:
                    trapped += afterpulsing * wp.exp(-wp.max(off - dead_time, zero) / time_constant)
                now.pulse = now.pulse + wp.int64(1)
                now.time = zero
                passed = zero
            else:
                # `afterpulsing` is what is left of the traps when the dead time ends.
                trapped = trapped * wp.exp(-dead_time / time_constant) + afterpulsing
                later = now.time + dead_time
                periods = wp.floor(later / period)
                now.pulse = now.pulse + wp.int64(periods)
                now.time = later - periods * period
                k = _last_not_above(edges, 0, now.time)
                part = wp.clamp((now.time - edges[0, k]) / (edges[0, k + 1] - edges[0, k]), zero, wp.float64(1.0))
                passed = cumulative[local, k] + part * (cumulative[local, k + 1] - cumulative[local, k])
    tag_count[row] = tags


def _rising_edges(edges: np.ndarray, bins: int, period: float) -> np.ndarray:
    edges = check_numbers("edges", edges)
    if edges.shape != (bins + 1,):
        raise ArgumentError(f"edges has shape {edges.shape}; ({bins + 1},), one more than the bins, is needed")
    if not (edges[0] == 0.0 and (np.diff(edges) > 0.0).all() and edges[-1] <= period * (1.0 + 1e-9)):
        raise ArgumentError(f"edges do not rise from 0 to at most the period, {period} s")
    return edges


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
    _check_rates(hazard)
    shot = _check_exposure(hazard, pulses, counter_depth, seed, frames, first_frame)
    pulses, frames, device = shot.pulses, shot.frames, hazard.device
    pixels, bins = hazard.shape
    recorded = check_integer("recorded", recorded, 1, bins)
    check_range("(0, inf)", period=period, afterpulsing_time_constant=afterpulsing_time_constant)
    check_number("dead_time", dead_time, "[0, inf)")
    check_number("afterpulsing_probability", afterpulsing_probability, "[0, 1)")
    edges = _rising_edges(edges, bins, period)
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
    edge_row = wp.array(edges[None, :], dtype=wp.float64, device=device)
    chunk = max(1, min(pixels, 2**25 // (bins + 1)))

    def run(write: int, start: wp.array, pulse: wp.array, bin: wp.array) -> None:
        for offset in range(0, pixels, chunk):
            size = min(chunk, pixels - offset)
            cumulative = wp.empty((size, bins + 1), dtype=wp.float64, device=device)
            launch_pixels(_cumulative_kernel, size, [offset, hazard, cumulative], device=device)
            inputs = [cumulative, offset, pixels, edge_row, recorded, pulses, period, int(bool(gated)), dead_time]
            inputs += [afterpulsing_probability, afterpulsing_time_constant, shot.first_frame]
            inputs += [shot.depth, shot.seed, write, start, counts, number, pulse, bin]
            launch_pixels(_event_kernel, frames * size, inputs, device=device)

    none = wp.zeros(1, dtype=wp.int64, device=device)
    run(0, none, none, wp.zeros(1, dtype=int, device=device))
    if not tags:
        return counts, None
    # The same draws again, now that the position of each row in the stream is known.
    per_row = number.numpy().astype(np.int64)
    start = np.concatenate([[0], np.cumsum(per_row)])
    pulse = wp.empty(max(int(start[-1]), 1), dtype=wp.int64, device=device)
    bin = wp.empty(max(int(start[-1]), 1), dtype=int, device=device)
    run(1, wp.array(start, dtype=wp.int64, device=device), pulse, bin)
    stream = {"row": np.repeat(np.arange(rows), per_row)}
    stream |= {"pulse": pulse.numpy()[: start[-1]], "bin": bin.numpy()[: start[-1]]}
    return counts, stream
