"""Random words of the events to come, for a CPU: its vector registers compute eight Philox blocks at once."""

import warp as wp

from spadwarp_kernels.math.once import made_once

from .philox import RoundKeys

# Philox blocks that are computed together, and their 32-bit words.
_BLOCKS = 8
WORDS_AHEAD = wp.constant(4 * _BLOCKS)

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


@made_once
def make_draw_ahead(*streams: int) -> tuple[int, wp.Function]:
    """How many events, a power of 2, and the Warp function ``(words, keys, id, event)`` that writes the blocks of these
    events, from `event` on, of each stream into an array of WORDS_AHEAD integers, see `block_ahead`.

    The number of streams must divide 8.
    """
    events = _BLOCKS // len(streams)
    steps = [str(lane % events) for lane in range(_BLOCKS)]
    ids = [str(int(streams[lane // events])) for lane in range(_BLOCKS)]

    @wp.func_native(_CODE.replace("EVENTS", ", ".join(steps)).replace("STREAMS", ", ".join(ids)))
    def draw_ahead(words: wp.array(dtype=int), keys: RoundKeys, id: wp.uint64, event: wp.uint32): ...

    return events, draw_ahead


@wp.func
def block_ahead(words: wp.array(dtype=int), lane: int) -> wp.vec4ui:
    """Block `lane` of what `draw_ahead` has written: the number of the stream times the number of events, plus that of
    the event."""
    return wp.vec4ui(
        wp.uint32(words[lane]), wp.uint32(words[lane + 8]), wp.uint32(words[lane + 16]), wp.uint32(words[lane + 24])
    )
