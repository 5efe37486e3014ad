"""Expected detections of a SPAD per pulse and bin, and what a histogram of counts says about them.

λ[pixel, bin] is a hazard: the mean number of detections that a pulse would cause in the bin if the detector were always
ready.
"""

from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_array,
    check_device,
    check_integer,
    check_number,
    check_numbers,
    check_range,
    check_seed,
)
from spadwarp_kernels.base.binomial import PURPOSE_DARK_COUNTS, uniforms
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.base.native import expm1, log1p

__all__ = [
    "add_crosstalk",
    "coates",
    "dark_count_rates",
    "expected_detections",
    "first_invalid_row",
    "first_photon_probabilities",
    "free_running_probabilities",
]

wp.set_module_options({"enable_backward": False})

_ONE = wp.constant(wp.uint32(1))

RATES = (wp.int32, wp.int64, wp.float32, wp.float64)
"""What rows of counts, tallies or rates may be."""


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
    check_array("values", values, RATES, (None, None))
    if values.shape[0] == 0:
        return None
    worst = wp.full(1, 2**31 - 1, dtype=int, device=values.device)
    launch_pixels(_invalid_kernel(values.dtype), values.shape[0], [values, worst], device=values.device)
    row = int(worst.numpy()[0])
    return None if row == 2**31 - 1 else row


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


@wp.kernel(enable_backward=False)
def _crosstalk_kernel(
    first_pixel: int,
    width: int,
    probability: float,
    detections: wp.array2d[float],
    # In and out:
    hazard: wp.array2d[float],
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
    pixels, seed = check_integer("pixels", pixels, 0), check_seed(seed)
    check_range("[0, inf)", median=median, spread=spread, hot_rate=hot_rate, offset=offset)
    check_number("hot_fraction", hot_fraction, "[0, 1]")
    device = check_device("device", device)
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

    Raises:
        ArgumentError: Arrays that do not fit each other, or a matrix that points outside the source.
    """
    check_array("source", source, RATES, (None, None))
    device = source.device
    check_array("noise_rate", noise_rate, wp.float32, (source.shape[0],), device)
    _check_matrix(source.shape[1], row_start, source_bin, weight, width)
    hazard = wp.empty((source.shape[0], len(width)), dtype=float, device=device)
    kinds = ((row_start, int), (source_bin, int), (weight, float), (width, float))
    matrix = [wp.array(values, dtype=kind, device=device) for values, kind in kinds]
    inputs = [source, *matrix, noise_rate, hazard]
    launch_pixels(_response_kernel(source.dtype), source.shape[0], inputs, device=device)
    return hazard


def _check_matrix(
    columns: int, row_start: np.ndarray, source_bin: np.ndarray, weight: np.ndarray, width: np.ndarray
) -> None:
    rows, entries = check_numbers("row_start", row_start, 1), check_numbers("source_bin", source_bin, 1)
    weight, width = check_numbers("weight", weight, 1), check_numbers("width", width, 1)
    if rows.size != width.size + 1:
        raise ArgumentError(f"row_start has shape {rows.shape}; one entry more than width, {width.shape}, is needed")
    if weight.shape != entries.shape:
        raise ArgumentError(f"source_bin {entries.shape} and weight {weight.shape} are not two equal lists")
    if rows[0] != 0 or rows[-1] != entries.size or (np.diff(rows) < 0).any():
        raise ArgumentError(f"row_start does not rise from 0 to {entries.size}, the number of entries")
    if entries.size and not (entries.min() >= 0 and entries.max() < columns):
        raise ArgumentError(f"source_bin holds {entries.min():g} to {entries.max():g}, outside [0, {columns - 1}]")
    for name, values in {"weight": weight, "width": width}.items():
        if not np.isfinite(values).all() or np.min(values, initial=0.0) < 0.0:
            raise ArgumentError(f"{name} holds numbers that are negative or not finite")


def add_crosstalk(hazard: wp.array, detections: wp.array, *, image_width: int, probability: float) -> None:
    """Add `probability` times the four neighbours' expected detections to λ, in place; both float32 `[pixel, bin]`.

    Raises `ArgumentError`.
    """
    check_array("hazard", hazard, wp.float32, (None, None))
    check_array("detections", detections, wp.float32, hazard.shape, hazard.device)
    image_width = check_integer("image_width", image_width, 1)
    check_number("probability", probability, "[0, 1]")
    if hazard.shape[0] % image_width:
        raise ArgumentError(f"image_width = {image_width} does not divide hazard's {hazard.shape[0]} pixels")
    inputs = [image_width, probability, detections, hazard]
    launch_pixels(_crosstalk_kernel, hazard.shape[0], inputs, device=hazard.device)


def first_photon_probabilities(hazard: wp.array) -> wp.array:
    """P(first photon in bin k) = exp(−Σ_{j<k} λ_j)·(1 − exp(−λ_k)), of λ's shape `[pixel, bin]` and float type."""
    check_array("hazard", hazard, (wp.float32, wp.float64), (None, None))
    law = wp.empty(hazard.shape, dtype=hazard.dtype, device=hazard.device)
    launch_pixels(_first_photon_law_kernel(hazard.dtype), hazard.shape[0], [hazard, law], device=hazard.device)
    return law


def free_running_probabilities(hazard: wp.array, *, dead_time: float, period: float) -> wp.array:
    """Mean detections per pulse and bin behind a dead time, λ_k / (1 + Σλ · dead_time / period), `[pixel, bin]`.

    Exact in the sum for a steady rate; the shadow that a strong return casts over the bins behind it is spread out.
    """
    check_array("hazard", hazard, wp.float32, (None, None))
    check_number("dead_time", dead_time, "[0, inf)")
    check_number("period", period, "(0, inf)")
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
    check_array("counts", counts, wp.int32, (None, None))
    check_number("pulses", pulses, "(0, inf)")
    hazard = wp.empty(counts.shape, dtype=wp.float64, device=counts.device)
    launch_pixels(_coates_kernel, counts.shape[0], [counts, pulses, hazard], device=counts.device)
    return hazard
