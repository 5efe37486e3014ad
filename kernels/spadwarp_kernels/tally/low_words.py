"""Low words: during a large launch on CUDA the low 32 bits of a tally's voxels are added up in an array of their own.

A GPU adds to memory in its L2 cache. Where a component of the tally is larger than that, most additions wait for memory
beyond it; its low words are half as large. Few contributions have more than 32 bits or make a carry: only these add to
the high half of the voxel, too, at once. When the launch has ended, the low words are added to the tally and are zero
again: the sums are those of additions of 64 bits.
"""

import warp as wp

# Bytes of the L2 cache of an H100 or H200, which Warp does not report; an A100 has 40 MB. On an H200, low words made
# the benchmark `water_20m`, 34 MB a component, 3 % slower, and `water`, 67 MB, 1.2 times as fast.
CACHE_BYTES = 50_000_000

# With fewer photons in a launch, reading all low words at its end would cost more than a few percent of it.
PHOTONS_PER_VOXEL = 4


def low_words_pay(voxels: int, photon_count: int) -> bool:
    """Whether low words make a launch of so many photons faster, with so many voxels in a component of the tally."""
    return 8 * voxels > CACHE_BYTES and photon_count >= PHOTONS_PER_VOXEL * voxels


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned low = static_cast<unsigned>(value);
    const unsigned before = atomicAdd(reinterpret_cast<unsigned*>(low_words.data) + index, low);
    const unsigned high = static_cast<unsigned>(value >> 32) + (before + low < low ? 1u : 0u);
    // 32 bits are enough: a carry out of the high half is lost in an addition of 64 bits, too.
    if (high)
        atomicAdd(reinterpret_cast<unsigned*>(reinterpret_cast<long long*>(tally.data) + index) + 1, high);
#endif
""")
def add_to_words(tally: wp.array(dtype=wp.int64), low_words: wp.array(dtype=wp.uint32), index: int, value: wp.int64):
    """Adds value >= 0 to a voxel whose low word is apart; on CUDA alone."""
    ...


@wp.kernel(enable_backward=False)
def fold_kernel(low_words: wp.array(dtype=wp.uint32), tally: wp.array(dtype=wp.int64)):
    """Launch: voxels of all components. Takes the low words and adds them to the tally; other launches may add to both
    meanwhile."""
    voxel = wp.tid()
    if low_words[voxel] != wp.uint32(0):
        wp.atomic_add(tally, voxel, wp.int64(wp.atomic_exch(low_words, voxel, wp.uint32(0))))


def fold_low_words(low_words: wp.array, tally: wp.array) -> None:
    """Adds the low words of a tally to it and sets them to zero; asynchronous on CUDA."""
    wp.launch(fold_kernel, dim=tally.size, inputs=[low_words, tally], device=tally.device)
