"""Random numbers whose count is not known beforehand, from 64 random bits: those of a linear congruential generator
(Knuth's MMIX) that starts from a number of SplitMix64 (Steele, Lea & Flood 2014).

`random_block` gives four words for each purpose of an event; tracking through a grid takes as many as there are
tentative collisions. It starts from words of the event's own blocks, so that a draw still depends on nothing else.
"""

import warp as wp

_GOLDEN = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
_A = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
_B = wp.constant(wp.uint64(0x94D049BB133111EB))
_FACTOR = wp.constant(wp.uint64(6364136223846793005))
_ADDED = wp.constant(wp.uint64(1442695040888963407))


@wp.func
def join_words(high: wp.uint32, low: wp.uint32) -> wp.uint64:
    """64 bits from two random words, as a seed of `splitmix`."""
    return (wp.uint64(high) << wp.uint64(32)) | wp.uint64(low)


@wp.func
def begin_sequence(seed: wp.uint64) -> wp.uint64:
    """The state from which `step_sequence` goes on: a number of SplitMix64, since seeds may be alike."""
    z = seed + _GOLDEN
    z = (z ^ (z >> wp.uint64(30))) * _A
    z = (z ^ (z >> wp.uint64(27))) * _B
    return z ^ (z >> wp.uint64(31))


@wp.func
def step_sequence(state: wp.uint64) -> wp.uint64:
    """Its upper half, `sequence_word`, is the next random number: four instructions, SplitMix64 has twenty-five."""
    return state * _FACTOR + _ADDED


@wp.func
def sequence_word(state: wp.uint64) -> wp.uint32:
    """The random word of a state."""
    return wp.uint32(state >> wp.uint64(32))
