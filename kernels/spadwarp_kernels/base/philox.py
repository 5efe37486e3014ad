"""Counter-based random numbers: Philox4x32-10 (Salmon et al. 2011).

A draw is a pure function of (seed, 64-bit id, event, stream): it does not depend on launch size, thread or history, so
one id gives the same numbers however a launch is cut up.
"""

import warp as wp

from .kernels import memoised
from .native import fill

__all__ = ["STREAM_ANALYTIC", "STREAM_DETECTOR", "STREAM_EMISSION", "STREAM_FLIGHT_SAMPLE", "STREAM_FRAMES"]
__all__ += ["STREAM_ROULETTE", "STREAM_SURFACE", "STREAM_TRANSPORT", "random_block", "u01", "u01_tail"]

_M0 = wp.constant(wp.uint32(0xD2511F53))
_M1 = wp.constant(wp.uint32(0xCD9E8D57))
_W0 = wp.constant(wp.uint32(0x9E3779B9))
_W1 = wp.constant(wp.uint32(0xBB67AE85))
_LOW32 = wp.constant(wp.uint64(0xFFFFFFFF))
_ROUNDS = 10
_Keys = wp.types.vector(length=_ROUNDS, dtype=wp.uint32)

# Streams: one block of four numbers per purpose and event.
STREAM_EMISSION = wp.constant(wp.uint32(0))
STREAM_TRANSPORT = wp.constant(wp.uint32(1))
STREAM_FLIGHT_SAMPLE = wp.constant(wp.uint32(2))
STREAM_ROULETTE = wp.constant(wp.uint32(3))
STREAM_DETECTOR = wp.constant(wp.uint32(5))
STREAM_ANALYTIC = wp.constant(wp.uint32(6))
STREAM_SURFACE = wp.constant(wp.uint32(7))
STREAM_FRAMES = wp.constant(wp.uint32(16))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("" : "+r"(word));
#endif
    return word;
""")
def _opaque(word: wp.uint32) -> wp.uint32:
    """The word itself, out of the compiler's sight: else it keeps all ten round keys in registers across a kernel's
    loops."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // Both halves from one instruction: a compiler that sees the two computes the lower one twice.
    unsigned int low, high;
    asm("{.reg .u64 p; mul.wide.u32 p, %2, %3; mov.b64 {%0, %1}, p;}" : "=r"(low), "=r"(high) : "r"(a), "r"(b));
    return wp::vec2ui(low, high);
#else
    const uint64_t product = static_cast<uint64_t>(a) * b;
    return wp::vec2ui(static_cast<uint32_t>(product), static_cast<uint32_t>(product >> 32));
#endif
""")
def _multiply(a: wp.uint32, b: wp.uint32) -> wp.vec2ui:
    """(low, high) half of a product."""
    ...


@wp.func
def _round(words: wp.vec4ui, x: wp.uint32, y: wp.uint32) -> wp.vec4ui:
    p = _multiply(words[0], _M0)
    q = _multiply(words[2], _M1)
    return wp.vec4ui(q[1] ^ words[1] ^ x, q[0], p[1] ^ words[3] ^ y, p[0])


@wp.func
def random_block(seed: wp.uint64, id: wp.uint64, event: wp.uint32, stream: wp.uint32) -> wp.vec4ui:
    """The four 32-bit random words of (seed, id, event, stream); id is 64-bit (a photon, a pixel, ...)."""
    words = wp.vec4ui(wp.uint32(id & _LOW32), wp.uint32(id >> wp.uint64(32)), event, stream)
    x = _opaque(wp.uint32(seed & _LOW32))
    y = _opaque(wp.uint32(seed >> wp.uint64(32)))
    for _ in range(wp.static(_ROUNDS)):
        words = _round(words, x, y)
        x = x + _W0
        y = y + _W1
    return words


@wp.struct
class RoundKeys:
    """The keys of all rounds, from `round_keys`: as arguments of a kernel they cost a GPU no instruction."""

    x: _Keys
    y: _Keys


def round_keys(seed: int) -> RoundKeys:
    """The round keys of a seed of 64 bits."""
    words = ((seed, int(_W0)), (seed >> 32, int(_W1)))
    x, y = ([(first + i * step) & 0xFFFFFFFF for i in range(_ROUNDS)] for first, step in words)
    return fill(RoundKeys(), x=x, y=y)


@wp.func
def random_block_keyed(keys: RoundKeys, id: wp.uint64, event: wp.uint32, stream: wp.uint32) -> wp.vec4ui:
    """`random_block` for the seed that the keys were made from."""
    words = wp.vec4ui(wp.uint32(id & _LOW32), wp.uint32(id >> wp.uint64(32)), event, stream)
    for i in range(wp.static(_ROUNDS)):
        words = _round(words, keys.x[i], keys.y[i])
    return words


@wp.func
def u01(word: wp.uint32) -> float:
    """Uniform float32 in [0, 1) on the grid k / 2^24: never 1, so log(1 - u01) is finite."""
    return float(word >> wp.uint32(8)) * 5.9604644775390625e-08


@wp.func
def u01_high(word: wp.uint32) -> float:
    """Uniform in [0, 1) from the upper 16 bits, on the grid (k + 1/2) / 2^16."""
    return (float(word >> wp.uint32(16)) + 0.5) * 1.52587890625e-05


@wp.func
def u01_low(word: wp.uint32) -> float:
    """Uniform in [0, 1) from the lower 16 bits, on the grid (k + 1/2) / 2^16; independent of `u01_high`."""
    return (float(word & wp.uint32(0xFFFF)) + 0.5) * 1.52587890625e-05


@wp.func
def u01_fine(word: wp.uint32) -> float:
    """Uniform float32 in [0, 1 - 2^-24] with the full 32-bit resolution near 0, for densities that peak at 0."""
    return wp.min(float(word) * 2.3283064365386963e-10, 0.99999994)


@wp.func
def u01_open(word: wp.uint32) -> float:
    """Uniform in (0, 1] with full resolution near 0, for the logarithm of Box and Muller."""
    return (float(word) + 0.5) * 2.3283064365386963e-10


@wp.func
def u01_tail(word: wp.uint32, more: wp.uint32) -> float:
    """Uniform float32 in [2^-41, 1] from a word and the last 8 bits of another, which `u01` leaves. For logarithms: -ln
    reaches 28.4, and the probability of more than l is exp(-l) to 0.1 % up to l = 20."""
    return float(word) * 2.3283064365386963e-10 + (float(more & wp.uint32(0xFF)) + 0.5) * 9.094947017729282e-13


# ---- Random words of the events to come, for a CPU: its vector registers compute eight Philox blocks at once.


# Philox blocks that are computed together, and their 32-bit words.
_BLOCKS = 8
PREFETCHED_WORDS = wp.constant(4 * _BLOCKS)

# `random_block_keyed` in 64-bit lanes, each with 32 bits of a counter.
_CODE = """
    typedef uint64_t lanes __attribute__((vector_size(64)));
    typedef uint32_t row __attribute__((vector_size(32)));
    typedef uint32_t unaligned_row __attribute__((vector_size(32), aligned(4)));
    const uint64_t low = 0xFFFFFFFFu;
    const lanes zero = {};
    lanes c0 = zero + (id & low), c1 = zero + (id >> 32);
    lanes c2 = (lanes{EVENTS} + event) & low, c3 = lanes{STREAMS};
    for (int i = 0; i < 10; ++i) {
        const lanes p = (c0 & low) * 0xD2511F53u, q = (c2 & low) * 0xCD9E8D57u;
        c0 = (q >> 32) ^ (c1 & low) ^ static_cast<uint64_t>(keys.x[i]);
        c1 = q;
        c2 = (p >> 32) ^ (c3 & low) ^ static_cast<uint64_t>(keys.y[i]);
        c3 = p;
    }
    unaligned_row* rows = reinterpret_cast<unaligned_row*>(words.data);
    rows[0] = __builtin_convertvector(c0, row);
    rows[1] = __builtin_convertvector(c1, row);
    rows[2] = __builtin_convertvector(c2, row);
    rows[3] = __builtin_convertvector(c3, row);
"""


@memoised
def make_prefetch(*streams: int) -> tuple[int, wp.Function]:
    """How many events, a power of 2, and the Warp function ``(words, keys, id, event)`` that writes the blocks of these
    events, from `event` on, of each stream into an array of PREFETCHED_WORDS integers, see `prefetched_block`. The
    number of streams divides 8."""
    events = _BLOCKS // len(streams)
    steps = [str(lane % events) for lane in range(_BLOCKS)]
    ids = [str(int(streams[lane // events])) for lane in range(_BLOCKS)]

    @wp.func_native(_CODE.replace("EVENTS", ", ".join(steps)).replace("STREAMS", ", ".join(ids)))
    def prefetch(words: wp.array[int], keys: RoundKeys, id: wp.uint64, event: wp.uint32): ...

    return events, prefetch


@wp.func
def prefetched_block(words: wp.array[int], lane: int) -> wp.vec4ui:
    """Block `lane` of what `prefetch` has written: the number of the stream times the number of events, plus that of
    the event."""
    return wp.vec4ui(
        wp.uint32(words[lane]), wp.uint32(words[lane + 8]), wp.uint32(words[lane + 16]), wp.uint32(words[lane + 24])
    )


# ---- Random numbers whose count is not known beforehand: a linear congruential generator (Knuth's MMIX) that starts
# from a number of SplitMix64 (Steele, Lea & Flood 2014).

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
