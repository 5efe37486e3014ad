"""Batch means: exact sums and sums of squares over equal batches of photons, for the error of every bin."""

from concurrent.futures import ThreadPoolExecutor

import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_array, check_integer, check_kind

from .ledger import atomic_add_int64
from .tally import VOXEL_LIMIT, add_tallies, has_overflowed, pieces

__all__ = ["Batches"]

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


@wp.kernel(enable_backward=False)
def close_batch_kernel(
    component_count: int,
    least: wp.int64,
    first: int,
    stop: int,
    run: int,
    batch: wp.array[wp.int64],
    # Out:
    total: wp.array[wp.int64],
    squares_low: wp.array[wp.uint64],
    squares_high: wp.array[wp.uint64],
    sums: wp.array[wp.int64],
    overflow: wp.array[int],
):
    """Adds a batch to the total and the square of its sum over components to a 128-bit sum, and empties it.

    `sums` takes its components, over voxels; `overflow` is set where a total leaves [least, 2^62).

    Integers, so that the sums depend neither on the order of the batches nor on how they were merged.
    Launch: runs of `run` voxels from `first` to `stop`.
    """
    begin = first + wp.tid() * run
    end = wp.min(begin + run, stop)
    voxels = squares_low.shape[0]
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
                batch[index] = wp.int64(0)
                if new < least or new >= VOXEL_LIMIT:
                    overflow[0] = 1
        if t != wp.int64(0):
            # Derivatives have signs. t^2 = high^2 2^64 + 2 low high 2^32 + low^2, with |t| < 2^63.
            t = wp.abs(t)
            low = wp.uint64(t) & _LOW32
            high = wp.uint64(t) >> wp.uint64(32)
            middle = wp.uint64(2) * low * high
            square_low = low * low + (middle << wp.uint64(32))
            square_high = high * high + (middle >> wp.uint64(32))
            if square_low < low * low:
                square_high += wp.uint64(1)
            sum_low = squares_low[voxel] + square_low
            if sum_low < square_low:
                square_high += wp.uint64(1)
            squares_low[voxel] = sum_low
            squares_high[voxel] = squares_high[voxel] + square_high


@wp.kernel(enable_backward=False)
def add_squares_kernel(
    more_low: wp.array[wp.uint64],
    more_high: wp.array[wp.uint64],
    squares_low: wp.array[wp.uint64],
    squares_high: wp.array[wp.uint64],
):
    """Adds 128-bit integers. Launch: voxels."""
    voxel = wp.tid()
    low = squares_low[voxel] + more_low[voxel]
    carry = wp.where(low < more_low[voxel], wp.uint64(1), wp.uint64(0))
    squares_low[voxel] = low
    squares_high[voxel] = squares_high[voxel] + more_high[voxel] + carry


class Batches:
    """Totals and squares on the device of a tally; `total` may be the caller's own array of zeros.

    `signed`: whether values may be negative, as those of derivatives.

    Raises `ArgumentError` for arrays that do not fit each other.

    Attributes:
        total: int64, as the tally.
        second_moment: Low and high halves of the sums of squares over batches, uint64 [voxels of one component] each.
        count: Batches closed.
    """

    def __init__(
        self, tally: wp.array, component_count: int, *, total: wp.array | None = None, signed: bool = False
    ) -> None:
        check_array("tally", tally, wp.int64, (None,), contiguous=True)
        self._component_count = check_integer("component_count", component_count, 1, max(tally.size, 1))
        if tally.size % component_count:
            raise ArgumentError(
                f"tally has {tally.size} entries, which {component_count} components do not share evenly"
            )
        if total is not None:
            check_array("total", total, wp.int64, tuple(tally.shape), tally.device, contiguous=True)
        voxels = tally.size // component_count
        self._sums = wp.zeros(component_count * _SLOTS, dtype=wp.int64, device=tally.device)
        self._signed, self._least = signed, wp.int64(1 - (1 << 62) if signed else 0)
        self._overflow = wp.zeros(1, dtype=int, device=tally.device)
        self.total = wp.zeros(tally.size, dtype=wp.int64, device=tally.device) if total is None else total
        self.second_moment = tuple(wp.zeros(voxels, dtype=wp.uint64, device=tally.device) for _ in range(2))
        self.count = 0

    def close(self, tally: wp.array, *, threads: int = 1) -> None:
        """Takes the tally over as one batch and sets it to zero; on a CPU with so many threads."""
        check_array("tally", tally, wp.int64, tuple(self.total.shape), self.total.device, contiguous=True)
        threads = 1 if tally.device.is_cuda else check_integer("threads", threads, 1, 4096)
        voxels = self.second_moment[0].size
        edges = [voxels * i // threads for i in range(threads + 1)]
        run = 1 if tally.device.is_cuda else _RUN
        outputs = [self.total, *self.second_moment, self._sums, self._overflow]

        def part(first: int, stop: int) -> None:
            inputs = [self._component_count, self._least, first, stop, run, tally]
            runs = -(-(stop - first) // run)
            wp.launch(close_batch_kernel, dim=runs, inputs=inputs, outputs=outputs, device=tally.device)

        if threads == 1 or self.count == 0:  # the first loads the kernel
            part(0, voxels)
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(part, edges[:-1], edges[1:]))
        self.count += 1

    def add(self, other: "Batches") -> None:
        """Adds the batches of another tally of the same components, which may be on another device and must rest.

        Raises `ArgumentError` for another size or number of components.
        """
        check_kind("other", other, Batches)
        if other.second_moment[0].size != self.second_moment[0].size:
            raise ArgumentError(f"other has {other.second_moment[0].size} voxels, not {self.second_moment[0].size}")
        device = self.total.device
        add_tallies(self.total, other.total)
        for piece in pieces(self.second_moment[0].size):
            more = [half[piece].to(device) for half in other.second_moment]
            outputs = [half[piece] for half in self.second_moment]
            wp.launch(add_squares_kernel, dim=more[0].size, inputs=more, outputs=outputs, device=device)
        if has_overflowed(self.total, signed=self._signed):
            self._overflow.fill_(1)
        self.count += other.count

    def has_overflowed(self) -> bool:
        """Whether a voxel of the total has left the range that `has_overflowed` allows; waits for the device."""
        return bool(self._overflow.numpy()[0])

    def take_sums(self) -> list[int]:
        """Each component of the batches closed since the last call, summed over voxels; waits for the device."""
        sums = self._sums.numpy().reshape(self._component_count, _SLOTS)
        # In halves, since a sum over all voxels may exceed 64 bits.
        halves = zip((sums >> 32).sum(axis=1), (sums & 0xFFFFFFFF).sum(axis=1), strict=True)
        found = [(int(high) << 32) + int(low) for high, low in halves]
        self._sums.zero_()
        return found
