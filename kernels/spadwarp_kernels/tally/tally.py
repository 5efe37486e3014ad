"""Tallies: 64-bit fixed point, so that a sum does not depend on the order of its terms."""

from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_array, check_integer
from spadwarp_kernels.base.kernels import launch_pixels
from spadwarp_kernels.optics.camera import Camera, Gate, gate_bin

__all__ = ["COMPONENTS", "add_tallies", "has_overflowed", "tally_rates"]

# What a history's events make of its light: the first axis of the tally.
COMPONENTS = ("ballistic", "forward_scattered", "backscatter")
BALLISTIC, FORWARD_SCATTERED, BACKSCATTER = (wp.constant(i) for i in range(3))


LogDerivatives = wp.types.vector(length=8, dtype=float)
"""Derivatives of the logarithm of a photon's light with respect to the parameters of a spec, in its order."""


@wp.struct
class Contribution:
    """What a photon adds to the tally.

    Attributes:
        value: Fraction of the emitted light; 0 for nothing.
        index: Of the voxel, see `tally_index`.
        rounding_sample: Uniform in [0, 1), see `to_fixed_point`.
        factors: By which the value is multiplied for the tallies that have signs: log derivatives, or channels over I.
    """

    value: float
    index: int
    rounding_sample: float
    factors: LogDerivatives


# Index of light that has come to the lens by more reflections than count.
TOO_LONG = wp.constant(-4)

# Largest single contribution, in tally units, 2^58: what is above it is clipped and counted.
DEPOSIT_LIMIT = wp.constant(2.8823037615171174e17)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    atomicAdd(reinterpret_cast<unsigned long long*>(tally.data) + index, static_cast<unsigned long long>(value));
    return pending;
#else
    long long* voxels = reinterpret_cast<long long*>(tally.data);
    __builtin_prefetch(voxels + index, 1);
    __atomic_fetch_add(voxels + pending[0], static_cast<long long>(pending[1]), __ATOMIC_RELAXED);
    return wp::vec2l(index, value);
#endif
""")
def add_pending(tally: wp.array[wp.int64], pending: wp.vec2l, index: int, value: wp.int64) -> wp.vec2l:
    """`atomic_add_int64`, on the CPU one call later: a core stands still while a voxel comes from memory, so the
    (index, value) that the call before returned is added now, and the memory of this one is requested."""
    ...


@wp.func
def to_fixed_point(value: float, scale: float, rounding_sample: float) -> wp.int64:
    """value * scale >= 0, rounded up with probability equal to its fraction, for rounding_sample uniform in [0, 1).

    For samples on the grid k / 2^24 the mean is kept to 2^-25 unit, or 2^-24 of the value where that is more. Returns
    -1 for what is clipped and -2 for what is not a number.
    """
    units = value * scale
    if units <= DEPOSIT_LIMIT:
        return wp.int64(units + rounding_sample)
    if units > DEPOSIT_LIMIT:
        return wp.int64(-1)
    return wp.int64(-2)


# A voxel's sum beyond this has used up its 64 bits, or soon will.
VOXEL_LIMIT = wp.constant(wp.int64(1 << 62))


@wp.kernel(enable_backward=False)
def find_overflow_kernel(tally: wp.array[wp.int64], least: wp.int64, found: wp.array[int]):
    """Launch: voxels."""
    voxel = wp.tid()
    if tally[voxel] < least or tally[voxel] >= VOXEL_LIMIT:
        found[0] = 1


def has_overflowed(tally: wp.array, *, signed: bool = False) -> bool:
    """Whether a voxel has left [0, 2^62), or with `signed` (-2^62, 2^62); waits for the device.

    Asked often enough, before a voxel can go round, this leaves no overflow unnoticed.

    Raises:
        ArgumentError: `tally` is not an array of int64 with one axis.
    """
    check_array("tally", tally, wp.int64, (None,))
    found = wp.zeros(1, dtype=int, device=tally.device)
    least = wp.int64(1 - (1 << 62) if signed else 0)
    wp.launch(find_overflow_kernel, dim=tally.size, inputs=[tally, least], outputs=[found], device=tally.device)
    return bool(found.numpy()[0])


# Integers of another device's tally that are copied at a time: few, since a tally may nearly fill a device.
_PIECE = 1 << 22


def pieces(size: int) -> list[slice]:
    """Of so many integers, those that `_PIECE` allows at a time."""
    return [slice(first, min(first + _PIECE, size)) for first in range(0, size, _PIECE)]


@wp.kernel(enable_backward=False)
def add_kernel(more: wp.array[wp.int64], total: wp.array[wp.int64]):
    """Launch: integers."""
    i = wp.tid()
    total[i] += more[i]


def add_tallies(total: wp.array, more: wp.array) -> None:
    """Adds one tally to another, which may be on another device; no launch that writes `more` may be under way.

    Raises:
        ArgumentError: They are not contiguous arrays of int64 with one axis and equally long.
    """
    check_array("total", total, wp.int64, (None,), contiguous=True)
    check_array("more", more, wp.int64, tuple(total.shape), contiguous=True)
    for piece in pieces(total.size):
        part = more[piece].to(total.device)
        wp.launch(add_kernel, dim=part.size, inputs=[part], outputs=[total[piece]], device=total.device)


@wp.func
def tally_index(camera: Camera, gate: Gate, pixel: int, path: float, component: int) -> int:
    """Index into the tally [component, pixel, bin], or BEFORE or AFTER the gate."""
    k = gate_bin(gate, path)
    if k < 0:
        return k
    return (component * camera.width * camera.height + pixel) * gate.bins + k


# ---- Low words: in a large launch on CUDA the low 32 bits of a tally's voxels are added up in an array of their own.


# Bytes of the L2 cache of an H100 or H200, which Warp does not report; an A100 has 40 MB. On an H200, low words made
# the benchmark `water_20m`, 34 MB a component, 3 % slower, and `water`, 67 MB, 1.2 times as fast.
CACHE_BYTES = 50_000_000

# With fewer photons in a launch, reading all low words at its end would cost more than a few percent of it.
PHOTONS_PER_VOXEL = 4


def splitting_pays(voxels: int, photon_count: int) -> bool:
    """Whether low words make a launch of so many photons faster, with so many voxels in a component of the tally."""
    return 8 * voxels > CACHE_BYTES and photon_count >= PHOTONS_PER_VOXEL * voxels


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned low = static_cast<unsigned>(value);
    const unsigned before = atomicAdd(reinterpret_cast<unsigned*>(split_accumulators.data) + index, low);
    const unsigned high = static_cast<unsigned>(value >> 32) + (before + low < low ? 1u : 0u);
    // 32 bits are enough: a carry out of the high half is lost in an addition of 64 bits, too.
    if (high)
        atomicAdd(reinterpret_cast<unsigned*>(reinterpret_cast<long long*>(tally.data) + index) + 1, high);
#endif
""")
def add_to_words(tally: wp.array[wp.int64], split_accumulators: wp.array[wp.uint32], index: int, value: wp.int64):
    """Adds value >= 0 to a voxel whose low word is apart; on CUDA alone."""
    ...


@wp.kernel(enable_backward=False)
def fold_kernel(split_accumulators: wp.array[wp.uint32], tally: wp.array[wp.int64]):
    """Launch: voxels of all components. Takes the low words and adds them to the tally; other launches may add to both
    meanwhile."""
    voxel = wp.tid()
    if split_accumulators[voxel] != wp.uint32(0):
        wp.atomic_add(tally, voxel, wp.int64(wp.atomic_exch(split_accumulators, voxel, wp.uint32(0))))


def fold_accumulators(split_accumulators: wp.array, tally: wp.array) -> None:
    """Adds the low words of a tally to it and sets them to zero; asynchronous on CUDA."""
    wp.launch(fold_kernel, dim=tally.size, inputs=[split_accumulators, tally], device=tally.device)


# ---- Tallies as rates on their device: sums over components in single precision.


wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def _rates_kernel(
    first_pixel: int,
    tally: wp.array[wp.int64],
    scale: wp.array[wp.float64],
    component: int,
    stop_component: int,
    parameters: int,
    parameter: int,
    # Out:
    rates: wp.array2d[float],
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
