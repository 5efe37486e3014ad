"""Batch means: exact sums and sums of squares over equal batches of photons, for the error of every bin."""

import warp as wp

from spadwarp_kernels.arguments import ArgumentError, check_array, check_integer

from .ledger import atomic_add_int64

# Copies of a component's sum, so that threads seldom add to one address at the same time.
_SLOTS = wp.constant(4096)

_LOW32 = wp.constant(wp.uint64(0xFFFFFFFF))


@wp.kernel(enable_backward=False)
def close_batch_kernel(
    component_count: int,
    batch: wp.array(dtype=wp.int64),
    # Out:
    total: wp.array(dtype=wp.int64),
    squares_low: wp.array(dtype=wp.uint64),
    squares_high: wp.array(dtype=wp.uint64),
    sums: wp.array(dtype=wp.int64),
):
    """Adds a batch to the total and the square of its sum over components to a 128-bit sum, and empties it.

    `sums` takes its components, over voxels.

    Integers, so that the sums depend neither on the order of the batches nor on how they were merged.
    Launch: voxels of one component.
    """
    voxel = wp.tid()
    voxels = squares_low.shape[0]
    t = wp.int64(0)
    for component in range(component_count):
        index = component * voxels + voxel
        t += batch[index]
        if batch[index] != wp.int64(0):
            atomic_add_int64(sums, component * _SLOTS + voxel % _SLOTS, batch[index])
        total[index] = total[index] + batch[index]
        batch[index] = wp.int64(0)
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


class Batches:
    """Totals and squares on the device of a tally; `total` may be the caller's own array of zeros.

    Raises `ArgumentError` for arrays that do not fit each other.

    Attributes:
        total: int64, as the tally.
        second_moment: Low and high halves of the sums of squares over batches, uint64 [voxels of one component] each.
        count: Batches closed.
    """

    def __init__(self, tally: wp.array, component_count: int, *, total: wp.array | None = None) -> None:
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
        self.total = wp.zeros(tally.size, dtype=wp.int64, device=tally.device) if total is None else total
        self.second_moment = tuple(wp.zeros(voxels, dtype=wp.uint64, device=tally.device) for _ in range(2))
        self.count = 0

    def close(self, tally: wp.array) -> None:
        """Takes the tally over as one batch and sets it to zero."""
        check_array("tally", tally, wp.int64, tuple(self.total.shape), self.total.device, contiguous=True)
        wp.launch(
            close_batch_kernel,
            dim=self.second_moment[0].size,
            inputs=[self._component_count, tally],
            outputs=[self.total, *self.second_moment, self._sums],
            device=tally.device,
        )
        self.count += 1

    def take_sums(self) -> list[int]:
        """Each component of the batches closed since the last call, summed over voxels; waits for the device."""
        sums = self._sums.numpy().reshape(self._component_count, _SLOTS)
        # In halves, since a sum over all voxels may exceed 64 bits.
        halves = zip((sums >> 32).sum(axis=1), (sums & 0xFFFFFFFF).sum(axis=1), strict=True)
        found = [(int(high) << 32) + int(low) for high, low in halves]
        self._sums.zero_()
        return found
