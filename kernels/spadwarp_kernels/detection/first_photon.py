"""Counts of first-photon TCSPC: at most one count a pulse and pixel.

Every draw is keyed by (seed, frame · pixels + pixel), so that counts do not depend on how a launch is cut up.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_array, check_integer, check_seed
from spadwarp_kernels.base.binomial import PURPOSE_COUNTS, binomial, uniforms
from spadwarp_kernels.base.kernels import launch_pixels

from .rates import first_invalid_row

__all__ = ["first_photon_counts"]

wp.set_module_options({"enable_backward": False})

_ONE = wp.constant(wp.uint32(1))

_SPARSE = wp.constant(
    wp.float64(2.0)
)  # mean counts in a bin below which waiting times are cheaper than a binomial draw


@wp.func
def _exponential(seed: wp.uint64, id: wp.uint64, purpose: wp.uint32, block: wp.uint32) -> wp.float64:
    """Waiting time of unit rate, finite."""
    u = uniforms(seed, id, purpose, block)
    return -wp.log(wp.float64(1.0) - u[0])


@wp.func
def _draw_row(
    hazard: wp.array2d(dtype=float),
    pixel: int,
    row: int,
    pulses: int,
    depth: int,
    seed: wp.uint64,
    id: wp.uint64,
    # Out, zero before or counts to add to:
    counts: wp.array2d(dtype=int),
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
        _draw_row(hazard, pixel, row, pulses, depth, seed, id, counts)


@wp.kernel(enable_backward=False)
def _first_photon_step_kernel(
    first_row: int,
    hazard: wp.array2d(dtype=float),
    pulses: int,
    frame: wp.array(dtype=wp.int64),
    depth: int,
    seed: wp.uint64,
    # Out, zero before:
    counts: wp.array2d(dtype=int),
):
    pixel = first_row + wp.tid()
    id = wp.uint64(frame[0]) * wp.uint64(hazard.shape[0]) + wp.uint64(pixel)
    _draw_row(hazard, pixel, pixel, pulses, depth, seed, id, counts)


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
    check_rates("hazard", hazard)
    pulses, frames, first_frame, counter_depth, seed = check_exposure(
        hazard, pulses, frames, first_frame, counter_depth, seed
    )
    pixels, bins = hazard.shape
    rows = pixels if summed else frames * pixels
    counts = zeroed_counts(counts, (rows, bins), hazard.device)
    inputs = [hazard, pulses, first_frame, frames if summed else 1, counter_depth or 2**31 - 1, seed, counts]
    launch_pixels(_first_photon_kernel, rows, inputs, device=hazard.device)
    return counts


def first_photon_step(
    hazard: wp.array,
    *,
    pulses: int,
    frame: wp.array,
    counter_depth: int = 0,
    seed: int,
    counts: wp.array,
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
    check_array("hazard", hazard, wp.float32, (None, None))
    check_array("frame", frame, wp.int64, (1,), hazard.device)
    check_array("counts", counts, wp.int32, hazard.shape, hazard.device, contiguous=True)
    pulses, _, _, counter_depth, seed = check_exposure(hazard, pulses, 1, 0, counter_depth, seed)
    counts.zero_()
    inputs = [hazard, pulses, frame, counter_depth or 2**31 - 1, seed, counts]
    launch_pixels(_first_photon_step_kernel, hazard.shape[0], inputs, device=hazard.device)


def check_rates(name: str, rates: wp.array) -> None:
    """float32 `[pixel, bin]`; on the CPU, where nobody has to wait for it, also that every rate is one."""
    check_array(name, rates, wp.float32, (None, None))
    if rates.device.is_cpu and (row := first_invalid_row(rates)) is not None:
        raise ArgumentError(f"{name} of pixel {row} holds numbers that are negative or not finite")


def check_exposure(
    hazard: wp.array, pulses: int, frames: int, first_frame: int, counter_depth: int, seed: int
) -> tuple[int, int, int, int, int]:
    """The numbers of an exposure, in range: at most 2^31 - 1 rows in one call."""
    return (
        check_integer("pulses", pulses, 0),
        check_integer("frames", frames, 1, (2**31 - 1) // max(hazard.shape[0], 1)),
        check_integer("first_frame", first_frame, 0, 2**63 - 1 - 2**31),
        check_integer("counter_depth", counter_depth, 0),
        check_seed(seed),
    )


def zeroed_counts(array: wp.array | None, shape: tuple[int, int], device: Any) -> wp.array:
    """The caller's array of counts, or a new one, set to zero."""
    if array is None:
        return wp.zeros(shape, dtype=int, device=device)
    if not isinstance(array, wp.array) or array.size != shape[0] * shape[1]:
        raise ArgumentError(f"counts do not have the {shape[0] * shape[1]} entries of a contiguous int32 array {shape}")
    check_array("counts", array, wp.int32, tuple(array.shape), device, contiguous=True)
    array.zero_()
    return array.reshape(shape)
