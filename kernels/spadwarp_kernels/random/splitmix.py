"""Random numbers whose count is not known beforehand, from 64 random bits: SplitMix64 (Steele, Lea & Flood 2014).

`random_block` gives four words for each purpose of an event; tracking through a grid takes as many as there are
tentative collisions. It starts from words of the event's own blocks, so that a draw still depends on nothing else.
"""

import warp as wp

_GOLDEN = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
_A = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
_B = wp.constant(wp.uint64(0x94D049BB133111EB))


@wp.func
def join_words(high: wp.uint32, low: wp.uint32) -> wp.uint64:
    """64 bits from two random words, as a seed of `splitmix`."""
    return (wp.uint64(high) << wp.uint64(32)) | wp.uint64(low)


@wp.func
def splitmix(seed: wp.uint64, number: int) -> wp.vec2ui:
    """The two random words of a number, 1, 2, ..., in the sequence of a seed."""
    z = seed + wp.uint64(number) * _GOLDEN
    z = (z ^ (z >> wp.uint64(30))) * _A
    z = (z ^ (z >> wp.uint64(27))) * _B
    z = z ^ (z >> wp.uint64(31))
    return wp.vec2ui(wp.uint32(z >> wp.uint64(32)), wp.uint32(z & wp.uint64(0xFFFFFFFF)))
