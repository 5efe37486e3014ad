"""The lanes of a CUDA warp, and what they hand to each other; on the CPU a warp has one lane."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised

# Threads of a block of the transport kernel on CUDA.
BLOCK_SIZE = 128


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(__ballot_sync(0xffffffffu, condition));
#else
    return condition ? 32 : 0;
#endif
""")
def count_lanes(condition: bool) -> int:
    """Number of lanes, out of 32, in which the condition holds; every lane of the warp must take part, and all meet
    here."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(__ballot_sync(0xffffffffu, condition) & ((1u << (threadIdx.x & 31u)) - 1u));
#else
    return 0;
#endif
""")
def count_lanes_before(condition: bool) -> int:
    """Number of lanes of the warp before this one in which the condition holds; every lane must take part."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned int lanes = __ballot_sync(0xffffffffu, condition);
    return wp::vec2i(__popc(lanes & ((1u << (threadIdx.x & 31u)) - 1u)), __popc(lanes));
#else
    return wp::vec2i(0, condition ? 32 : 0);
#endif
""")
def vote(condition: bool) -> wp.vec2i:
    """`count_lanes_before` and `count_lanes` of one vote."""
    ...


# A warp's shared memory, in units of 16 bytes: 32 vectors of six numbers, the size of its queue, and that.
_SIZE = 48
_QUEUE = 49

_MEMORY = """
#if defined(__CUDA_ARCH__)
    __shared__ float4 memory[%d];
    unsigned int begin = __cvta_generic_to_shared(memory + %du * (threadIdx.x >> 5u));
    // Out of the compiler's sight, which else computes it anew, in six instructions, wherever it is used.
    asm volatile("" : "+r"(begin));
    return %s;
#else
    return 0;
#endif
"""


def fits_in_block(vectors: int, kib: int) -> bool:
    """Whether so much shared memory of a block, at most 48 KiB, is enough for queues of so many vec4 in each of its
    warps."""
    return 16 * (_QUEUE + vectors) * BLOCK_SIZE // 32 <= kib * 1024


# As if another lane had it: the assembler too, which looks through the above, then keeps it in a register.
_HELD = "__shfl_sync(0xffffffffu, begin, threadIdx.x & 31u)"


@memoised
def make_warp_memory(vectors: int, held: bool = False) -> wp.Function:
    """The Warp function ``() -> int``: where the shared memory of a warp begins, with so many vec4 in its queue; CUDA
    alone. Kernels take no more than they need, since the cache has the rest. `held`: in a register, come what may."""
    of_warp = _QUEUE + vectors

    @wp.func_native(_MEMORY % (of_warp * BLOCK_SIZE // 32, of_warp, _HELD if held else "begin"))
    def warp_memory() -> int: ...

    return warp_memory


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float* mine = static_cast<float*>(__cvta_shared_to_generic(static_cast<unsigned int>(memory)));
    if (put) {
        __syncwarp();
        for (int i = 0; i < 6; ++i) mine[32 * i + entry] = value[i];
        __syncwarp();
        return value;
    }
    wp::spatial_vector taken;
    for (int i = 0; i < 6; ++i) taken[i] = mine[32 * i + entry];
    return taken;
#else
    return value;
#endif
""")
def exchange(memory: int, put: bool, entry: int, value: wp.spatial_vector) -> wp.spatial_vector:
    """32 vectors that a warp shares: every lane puts one, and later any lane takes any; CUDA alone."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    int first = 0;
    if ((threadIdx.x & 31u) == 0u) first = atomicAdd(cursor.data, 32);
    return __shfl_sync(0xffffffffu, first, 0);
#else
    return 0;
#endif
""")
def take_photons(cursor: wp.array[int]) -> int:
    """First of the next 32 photons, which are this warp's; every lane must take part. Warps come for more as they get
    done, so that all end together; CUDA alone."""
    ...


# Requests that a warp's queue may hold when new ones come.
MOST_LEFT = 31


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    float4* mine = static_cast<float4*>(__cvta_shared_to_generic(static_cast<unsigned int>(memory))) + {_QUEUE};
    if (put) mine[entry] = make_float4(value[0], value[1], value[2], value[3]);
    const float4 held = mine[entry];
    return wp::vec4(held.x, held.y, held.z, held.w);
#else
    return value;
#endif
""")
def queue_vector(memory: int, put: bool, entry: int, value: wp.vec4) -> wp.vec4:
    """Writes or reads one of the vectors of the warp's queue; CUDA alone."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    float4* mine = static_cast<float4*>(__cvta_shared_to_generic(static_cast<unsigned int>(memory))) + {_QUEUE} + begin;
    float2* pairs = reinterpret_cast<float2*>(mine);
    if (put) pairs[entry] = make_float2(value[0], value[1]);
    const float2 held = pairs[entry];
    return wp::vec2(held.x, held.y);
#else
    return value;
#endif
""")
def queue_pair(memory: int, put: bool, begin: int, entry: int, value: wp.vec2) -> wp.vec2:
    """Writes or reads one of the pairs of numbers that the warp's queue has where its vectors from `begin` on would be;
    CUDA alone."""
    ...


ADD_ENTRY, READ_SIZE, SET_SIZE = (wp.constant(i) for i in range(3))


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    int* size = static_cast<int*>(__cvta_shared_to_generic(static_cast<unsigned int>(memory))) + 4 * {_SIZE};
    if (act == 0) return atomicAdd(size, 1);
    __syncwarp();
    if (act == 1) {{
        const int held = *size;
        __syncwarp();  // all have read it before one adds an entry
        return held;
    }}
    if ((threadIdx.x & 31u) == 0u) *size = number;
    __syncwarp();
#endif
    return number;
""")
def queue_size(memory: int, act: int, number: int) -> int:
    """The number of entries of the warp's queue; CUDA alone.

    ADD_ENTRY: any lane adds one and gets its index. READ_SIZE: all lanes together read the size, after which they see
    what the entries hold. SET_SIZE: all lanes together set it to a number.
    """
    ...
