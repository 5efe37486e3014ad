"""Tallies as rates on their device: sums over components in single precision."""

from typing import Any

import warp as wp

from spadwarp_kernels.arguments import ArgumentError, check_array, check_integer
from spadwarp_kernels.pixels import launch_pixels

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def _rates_kernel(
    first_pixel: int,
    tally: wp.array(dtype=wp.int64),
    scale: wp.array(dtype=wp.float64),
    component: int,
    stop_component: int,
    parameters: int,
    parameter: int,
    # Out:
    rates: wp.array2d(dtype=float),
):
    pixel = first_pixel + wp.tid()
    bins = rates.shape[1]
    for k in range(bins):
        total = wp.int64(0)
        for c in range(component, stop_component):
            voxel = (wp.int64(c) * wp.int64(rates.shape[0]) + wp.int64(pixel)) * wp.int64(bins) + wp.int64(k)
            total += tally[int(voxel) * parameters + parameter]
        rates[pixel, k] = float(wp.float64(total) * scale[pixel])


def tally_rates(
    tally: wp.array,
    scale: wp.array,
    *,
    bins: int,
    components: tuple[int, int] = (0, 3),
    parameters: int = 1,
    parameter: int = 0,
) -> wp.array:
    """Tallies added up over components, float32 `[pixel, bin]` on their device.

    Args:
        tally: int64, `Data.tally`, or `Data.gradients` with so many `parameters`.
        scale: float64 `[pixel]`: value of a tally unit.
        bins: Of the gate.
        components: First, and the one after the last, in the order of `COMPONENTS`.
        parameters: Derivatives side by side in a voxel.
        parameter: Which of them.

    Raises:
        ArgumentError: Arrays or numbers that do not fit each other.
    """
    check_array("tally", tally, wp.int64, (None,))
    check_array("scale", scale, wp.float64, (None,), tally.device)
    bins, parameters = check_integer("bins", bins, 1), check_integer("parameters", parameters, 1)
    if not (isinstance(components, tuple | list) and len(components) == 2):
        raise ArgumentError("components is not a pair such as (0, 3)")
    first, stop = (check_integer("components", one, 0) for one in components)
    parameter = check_integer("parameter", parameter, 0)
    pixels = scale.shape[0]
    if tally.size != 3 * pixels * bins * parameters:
        raise ArgumentError(f"tally has {tally.size} values; {3 * pixels * bins * parameters} are needed")
    if not (first < stop <= 3) or parameter >= parameters or tally.size >= 2**31:
        raise ArgumentError(f"components {first} to {stop} or parameter {parameter} is outside the tally")
    rates: Any = wp.empty((pixels, bins), dtype=float, device=tally.device)
    inputs = [tally, scale, first, stop, parameters, parameter, rates]
    launch_pixels(_rates_kernel, pixels, inputs, device=tally.device)
    return rates
