"""Tallies in 64-bit fixed point, whose sums do not depend on the order of their terms, and the batches of a run."""

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import launch_pixels

__all__ = ["COMPONENTS", "Batches", "add_tallies", "has_overflowed", "tally_rates"]

wp.set_module_options({"enable_backward": False})

# What a history's events make of its light: the first axis of the tally.
COMPONENTS = ("ballistic", "forward_scattered", "backscatter")
BALLISTIC, FORWARD_SCATTERED, BACKSCATTER, SURFACE = (wp.constant(i) for i in range(4))


def tally_components(sea: bool) -> tuple[str, ...]:
    """Those of a tally; with the surface of a sea also that of light which met the surface alone."""
    return (*COMPONENTS, "surface") if sea else COMPONENTS


# A voxel's sum beyond this has used up its 64 bits, or soon will.
VOXEL_LIMIT = wp.constant(wp.int64(1 << 62))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    atomicAdd(reinterpret_cast<unsigned long long*>(tally.data) + index, static_cast<unsigned long long>(value));
#else
    __atomic_fetch_add(reinterpret_cast<long long*>(tally.data) + index, static_cast<long long>(value),
    __ATOMIC_RELAXED);
#endif
""")
def atomic_add_int64(tally: wp.array[wp.int64], index: int, value: wp.int64):
    """Adds to a contiguous int64 array; atomic on CUDA and between CPU threads (Warp's own is a plain add on the
    CPU)."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned long long* voxel = reinterpret_cast<unsigned long long*>(tally.data) + index;
    if (low.shape.dims[0] > 0) {
        const unsigned part = static_cast<unsigned>(value);
        const unsigned before = atomicAdd(reinterpret_cast<unsigned*>(low.data) + index, part);
        const unsigned high = static_cast<unsigned>(value >> 32) + (before + part < part ? 1u : 0u);
        // 32 bits are enough: a carry out of the high half is lost in an addition of 64 bits, too.
        if (high) atomicAdd(reinterpret_cast<unsigned*>(voxel) + 1, high);
    } else {
        atomicAdd(voxel, static_cast<unsigned long long>(value));
    }
    return pending;
#else
    long long* voxels = reinterpret_cast<long long*>(tally.data);
    __builtin_prefetch(voxels + index, 1);
    __atomic_fetch_add(voxels + pending[0], static_cast<long long>(pending[1]), __ATOMIC_RELAXED);
    return wp::vec2l(index, value);
#endif
""")
def add_pending(
    tally: wp.array[wp.int64], low: wp.array[wp.uint32], pending: wp.vec2l, index: int, value: wp.int64
) -> wp.vec2l:
    """`atomic_add_int64` of value >= 0; on CUDA the low words of the voxels may be apart, else `low` is empty. On the
    CPU one call later: a core stands still while a voxel comes from memory, so the (index, value) that the call before
    returned is added now, and the memory of this one is requested."""
    ...


@wp.kernel
def find_overflow_kernel(tally: wp.array[wp.int64], least: wp.int64, found: wp.array[int]):
    """Launch: voxels."""
    voxel = wp.tid()
    if tally[voxel] < least or tally[voxel] >= VOXEL_LIMIT:
        found[0] = 1


def has_overflowed(tally: wp.array, *, signed: bool = False) -> bool:
    """Whether a voxel has left [0, 2^62), or with `signed` (-2^62, 2^62); waits for the device.

    Asked often enough, before a voxel can go round, this leaves no overflow unnoticed. Raises `ArgumentError` unless
    `tally` is an array of int64 with one axis.
    """
    check.array("tally", tally, wp.int64, (None,))
    check.kind("signed", signed, bool)
    found = wp.zeros(1, dtype=int, device=tally.device)
    least = wp.int64(1 - (1 << 62) if signed else 0)
    wp.launch(find_overflow_kernel, dim=tally.size, inputs=[tally, least], outputs=[found], device=tally.device)
    return bool(found.numpy()[0])


# Integers of another device's tally that are copied at a time: few, since a tally may nearly fill a device.
_PIECE = 1 << 22


def _pieces(size: int) -> list[slice]:
    return [slice(first, min(first + _PIECE, size)) for first in range(0, size, _PIECE)]


@wp.kernel
def add_kernel(more: wp.array[wp.int64], total: wp.array[wp.int64]):
    """Launch: integers."""
    i = wp.tid()
    total[i] += more[i]


def add_tallies(total: wp.array, more: wp.array) -> None:
    """Adds one tally to another, which may be on another device; no launch that writes `more` may be under way.

    Raises `ArgumentError` unless they are contiguous arrays of int64 with one axis and equally long.
    """
    check.array("total", total, wp.int64, (None,), contiguous=True)
    check.array("more", more, wp.int64, tuple(total.shape), contiguous=True)
    for piece in _pieces(total.size):
        part = more[piece].to(total.device)
        wp.launch(add_kernel, dim=part.size, inputs=[part], outputs=[total[piece]], device=total.device)


def exact_sums(slots: NDArray[np.int64]) -> list[int]:
    """Sums over the second axis, by halves, since they may exceed 64 bits."""
    high, low = (slots >> 32).sum(axis=1).tolist(), (slots & 0xFFFFFFFF).sum(axis=1).tolist()
    return [(upper << 32) + lower for upper, lower in zip(high, low, strict=True)]


# ---- Low words: in a large launch on CUDA the low 32 bits of a tally's voxels are added up in an array of their own.


# Bytes of the L2 cache of an H100 or H200, which Warp does not report; an A100 has 40 MB. On an H200, low words made
# the benchmark `water_20m`, 34 MB a component, 3 % slower, and `water`, 67 MB, 1.2 times as fast.
CACHE_BYTES = 50_000_000

# With fewer photons in a launch, reading all low words at its end would cost more than a few percent of it.
PHOTONS_PER_VOXEL = 4


def splitting_pays(voxels: int, photon_count: int) -> bool:
    """Whether low words make a launch of so many photons faster, with so many voxels in a component of the tally."""
    return 8 * voxels > CACHE_BYTES and photon_count >= PHOTONS_PER_VOXEL * voxels


@wp.kernel
def fold_kernel(split_accumulators: wp.array[wp.uint32], tally: wp.array[wp.int64]):
    """Launch: voxels of all components. Takes the low words and adds them to the tally; other launches may add to both
    meanwhile."""
    voxel = wp.tid()
    if split_accumulators[voxel] != wp.uint32(0):
        wp.atomic_add(tally, voxel, wp.int64(wp.atomic_exch(split_accumulators, voxel, wp.uint32(0))))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned long long* voxel = reinterpret_cast<unsigned long long*>(tally.data) + index;
    const unsigned low = static_cast<unsigned>(value) & 0xffffu, shift = (index & 1) << 4;
    const unsigned before = atomicAdd(reinterpret_cast<unsigned*>(halves.data) + (index >> 1), low << shift);
    unsigned long long more = value - low;
    if (((before >> shift) & 0xffffu) + low > 0xffffu) {
        more += 0x10000;
        // The carry went to the neighbour's half, and if that was full out of the word.
        if (!shift && index + 1 < tally.shape.dims[0])
            atomicAdd(voxel + 1, static_cast<unsigned long long>(before > 0xffffffffu - low ? 0xffffll : -1ll));
    }
    if (more) atomicAdd(voxel, more);
#endif
""")
def add_to_halves(tally: wp.array[wp.int64], halves: wp.array[wp.uint32], index: int, value: wp.int64):
    """Adds value >= 0 to a voxel whose low 16 bits are apart, two voxels in a word; on CUDA alone. A tally of 200 MB
    is then in the cache: scattered additions are up to 1.2 times as fast as to words, if few are of 2^16 or more."""
    ...


@wp.kernel
def fold_halves_kernel(halves: wp.array[wp.uint32], tally: wp.array[wp.int64]):
    """As `fold_kernel`. Launch: words."""
    i = wp.tid()
    if halves[i] != wp.uint32(0):
        word = wp.atomic_exch(halves, i, wp.uint32(0))
        wp.atomic_add(tally, 2 * i, wp.int64(word & wp.uint32(0xFFFF)))
        if 2 * i + 1 < tally.shape[0]:
            wp.atomic_add(tally, 2 * i + 1, wp.int64(word >> wp.uint32(16)))


def fold_accumulators(split_accumulators: wp.array, tally: wp.array) -> None:
    """Adds the low words of a tally, or their halves, to it and sets them to zero; asynchronous on CUDA."""
    kernel, size = fold_kernel, split_accumulators.size
    if size < tally.size:
        kernel = fold_halves_kernel
    wp.launch(kernel, dim=size, inputs=[split_accumulators, tally], device=tally.device)


# ---- Batch means: exact sums and sums of squares over equal batches of photons, for the error of every bin.


# Copies of a component's sum, so that threads seldom add to one address at the same time.
_SLOTS = wp.constant(4096)

_LOW32 = wp.constant(wp.uint64(0xFFFFFFFF))


# Voxels that one thread of a CPU closes: most of a large histogram has no light in one batch, and goes by in vectors.
_RUN = 32


@wp.func_native("""
    const int64_t* values = batch.data + first;
    int64_t any = 0;
    for (int i = 0; i < count; ++i)
        any |= values[i];
    return any != 0;
""")
def _has_light(batch: wp.array[wp.int64], first: int, count: int) -> bool:
    """Whether one of `count` neighbours in a contiguous array is not zero."""
    ...


@wp.func
def _add_wide(low: wp.array[wp.uint64], high: wp.array[wp.uint64], i: int, more_low: wp.uint64, more_high: wp.uint64):
    """Adds to a 128-bit integer."""
    total = low[i] + more_low
    high[i] = high[i] + more_high + wp.where(total < more_low, wp.uint64(1), wp.uint64(0))
    low[i] = total


@wp.kernel
def close_batch_kernel(
    first: int,
    component_count: int,
    least: wp.int64,
    run: int,
    weight: wp.float64,
    batch: wp.array[wp.int64],
    # Out:
    total: wp.array[wp.int64],
    half: wp.array[wp.int64],
    squares_low: wp.array[wp.uint64],
    squares_high: wp.array[wp.uint64],
    sums: wp.array[wp.int64],
    overflow: wp.array[int],
):
    """Adds a batch to the total, to `half` if that is as long, and the square of its sum over components, times
    `weight`, to a 128-bit sum, and empties it.

    `sums` takes its components, over voxels; `overflow` is set where a total leaves [least, 2^62).

    Integers, so that the sums depend neither on the order of the batches nor on how they were merged.
    Launch: runs of `run` voxels from the `first` on.
    """
    voxels = squares_low.shape[0]
    begin = (first + wp.tid()) * run
    end = wp.min(begin + run, voxels)
    lit = bool(False)
    for component in range(component_count):
        lit = lit or _has_light(batch, component * voxels + begin, end - begin)
    if not lit:
        return
    for voxel in range(begin, end):
        t = wp.int64(0)
        for component in range(component_count):
            index = component * voxels + voxel
            value = batch[index]
            if value != wp.int64(0):
                t += value
                atomic_add_int64(sums, component * _SLOTS + voxel % _SLOTS, value)
                new = total[index] + value
                total[index] = new
                if half.shape[0] == total.shape[0]:
                    half[index] = half[index] + value
                batch[index] = wp.int64(0)
                if new < least or new >= VOXEL_LIMIT:
                    overflow[0] = 1
        if t != wp.int64(0):
            # Derivatives have signs. t^2 = high^2 2^64 + 2 low high 2^32 + low^2, with |t| < 2^63.
            t = wp.abs(t)
            if weight != wp.float64(1.0):
                t = wp.int64(wp.rint(wp.float64(t) * weight))
            low = wp.uint64(t) & _LOW32
            high = wp.uint64(t) >> wp.uint64(32)
            middle = wp.uint64(2) * low * high
            _add_wide(squares_low, squares_high, voxel, low * low, high * high)
            _add_wide(squares_low, squares_high, voxel, middle << wp.uint64(32), middle >> wp.uint64(32))


@wp.kernel
def add_squares_kernel(
    more_low: wp.array[wp.uint64],
    more_high: wp.array[wp.uint64],
    squares_low: wp.array[wp.uint64],
    squares_high: wp.array[wp.uint64],
):
    """Adds 128-bit integers. Launch: voxels."""
    voxel = wp.tid()
    _add_wide(squares_low, squares_high, voxel, more_low[voxel], more_high[voxel])


class Batches:
    """Totals and squares on the device of a tally; `total` may be the caller's own array of zeros.

    `signed`: whether values may be negative, as those of derivatives; `halved`: whether the total of one half of the
    batches is wanted.

    Raises `ArgumentError` for arrays that do not fit each other.

    Attributes:
        total: int64, as the tally.
        half: int64, as the tally, the total of the batches of one half; None if not wanted.
        second_moment: Low and high halves of the sums of squares over batches, uint64 [voxels of one component] each.
        count: Batches closed.
    """

    MOST_SUMS = 16
    """Batches between two calls of `take_sums` at most."""

    def __init__(
        self,
        tally: wp.array,
        component_count: int,
        *,
        total: wp.array | None = None,
        signed: bool = False,
        halved: bool = False,
    ) -> None:
        check.array("tally", tally, wp.int64, (None,), contiguous=True)
        self._component_count = check.integer("component_count", component_count, 1, max(tally.size, 1))
        if tally.size % component_count:
            raise ArgumentError(
                f"tally has {tally.size} entries, which {component_count} components do not share evenly"
            )
        if total is not None:
            check.array("total", total, wp.int64, tuple(tally.shape), tally.device, contiguous=True)
        self._untaken, self._signed, self._least = 0, signed, wp.int64(1 - (1 << 62) if signed else 0)
        with wp.ScopedDevice(tally.device):
            self._sums = wp.zeros((self.MOST_SUMS, component_count * _SLOTS), dtype=wp.int64)
            self._overflow = wp.zeros(1, dtype=int)
            self.total = wp.zeros(tally.size, dtype=wp.int64) if total is None else total
            self.half = wp.zeros(tally.size, dtype=wp.int64) if halved else None
            self._no_half = wp.zeros(0, dtype=wp.int64)
            self.second_moment = tuple(wp.zeros(tally.size // component_count, dtype=wp.uint64) for _ in range(2))
        self.count = 0

    def close(self, tally: wp.array, *, in_half: bool = False, part: float = 1.0, threads: int = 1) -> None:
        """Takes the tally over as one batch, or a part of one in (0, 1], and sets it to zero; on a CPU with so many
        threads. The square of a part is divided by it, so that parts and batches add up to one estimate of the
        variance. `in_half`: whether it belongs to the half."""
        check.array("tally", tally, wp.int64, tuple(self.total.shape), self.total.device, contiguous=True)
        threads = 1 if tally.device.is_cuda else check.integer("threads", threads, 1, 4096)
        run = 1 if tally.device.is_cuda else _RUN
        half = self.half if in_half and self.half is not None else self._no_half
        weight = wp.float64(1.0 / math.sqrt(check.number("part", part, "(0, 1]")))
        inputs = [self._component_count, self._least, run, weight, tally, self.total, half, *self.second_moment]
        inputs += [self._sums[self._untaken % self.MOST_SUMS], self._overflow]
        runs = -(-self.second_moment[0].size // run)  # a thread costs as much as some hundred
        launch_pixels(close_batch_kernel, runs, inputs, device=tally.device, threads=min(threads, 1 + runs // 256))
        self.count, self._untaken = self.count + 1, self._untaken + 1

    def add(self, other: "Batches") -> None:
        """Adds the batches of another tally of the same components, which may be on another device and must rest.

        Raises `ArgumentError` for another size or number of components.
        """
        check.kind("other", other, Batches)
        if other.second_moment[0].size != self.second_moment[0].size:
            raise ArgumentError(f"other has {other.second_moment[0].size} voxels, not {self.second_moment[0].size}")
        device = self.total.device
        add_tallies(self.total, other.total)
        if self.half is not None and other.half is not None:
            add_tallies(self.half, other.half)
        for piece in _pieces(self.second_moment[0].size):
            more = [half[piece].to(device) for half in other.second_moment]
            outputs = [half[piece] for half in self.second_moment]
            wp.launch(add_squares_kernel, dim=more[0].size, inputs=more, outputs=outputs, device=device)
        if has_overflowed(self.total, signed=self._signed):
            self._overflow.fill_(1)
        self.count += other.count

    def has_overflowed(self) -> bool:
        """Whether a voxel of the total has left the range that `has_overflowed` allows; waits for the device."""
        return bool(self._overflow.numpy()[0])

    def take_sums(self) -> list[list[int]]:
        """Of each batch closed since the last call, `MOST_SUMS` at most: its components, summed over voxels; waits for
        the device."""
        rows, width = self._sums[: self._untaken], self._component_count
        sums = exact_sums(rows.numpy().reshape(-1, _SLOTS))
        rows.zero_()
        self._untaken = 0
        return [sums[first : first + width] for first in range(0, len(sums), width)]


# ---- Tallies as rates on their device: sums over components in single precision.


@wp.kernel
def _rates_kernel(
    first_pixel: int,
    tally: wp.array4d[wp.int64],
    scale: wp.array[wp.float64],
    components: int,
    parameter: int,
    # Out:
    rates: wp.array2d[float],
):
    pixel = first_pixel + wp.tid()
    for k in range(rates.shape[1]):
        total = wp.int64(0)
        for c in range(components):
            total += tally[c, pixel, k, parameter]
        rates[pixel, k] = float(wp.float64(total) * scale[pixel])


def tally_rates(
    tally: wp.array,
    scale: wp.array,
    *,
    bins: int,
    components: int | None = None,
    parameters: int = 1,
    parameter: int = 0,
) -> wp.array:
    """Tallies added up over components, float32 `[pixel, bin]` on their device.

    Args:
        tally: int64, `Data.tally`, or `Data.gradients` with so many `parameters`.
        scale: float64 `[pixel]`: value of a tally unit.
        bins: Of the gate.
        components: How many of `tally_components`, from the first on; by default all.
        parameters: Derivatives side by side in a voxel.
        parameter: Which of them.

    Raises:
        ArgumentError: Arrays or numbers that do not fit each other.
    """
    check.array("scale", scale, wp.float64, (None,), tally.device if isinstance(tally, wp.array) else None)
    bins, parameters = check.integer("bins", bins, 1), check.integer("parameters", parameters, 1)
    parameter = check.integer("parameter", parameter, 0, parameters - 1)
    voxels = check.integer("values of tally", scale.shape[0] * bins * parameters, 0)
    sea = isinstance(tally, wp.array) and tally.size == len(tally_components(True)) * voxels
    shape = (len(tally_components(sea)), scale.shape[0], bins, parameters)
    check.array("tally", tally, wp.int64, (math.prod(shape),), contiguous=True)
    components = check.integer("components", shape[0] if components is None else components, 1, shape[0])
    rates: Any = wp.empty(shape[1:3], dtype=float, device=tally.device)
    inputs = [tally.reshape(shape), scale, components, parameter, rates]
    launch_pixels(_rates_kernel, shape[1], inputs, device=tally.device)
    return rates
