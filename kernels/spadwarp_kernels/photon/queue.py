"""Requests for contributions, and what the 32 lanes of a CUDA warp hand to each other; on a CPU a warp has one lane."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import bits_of, from_bits

from .spec import TransportSpec
from .state import Carried, PhotonRef, SinkRef, WorldRef

# Threads of a block of the transport kernel on CUDA.
BLOCK_SIZE = 128

# Requests that a warp's queue may hold when new ones come.
MOST_LEFT = 31


@wp.struct
class Request:
    """What is to be scored; plain enough for another thread to do it."""

    wanted: bool  # whether there is anything
    x: wp.vec3  # where the photon scatters, or where the flight begins [m]
    u: wp.vec3  # its direction until there, or of the flight
    # Of the photon; in water times the albedo, but for flights through water that varies, whose albedo is that of the
    # sampled point.
    weight: float
    path: float  # geometric path up to x [m]
    lens: wp.vec3  # the point of the lens by which a flight is scored; others draw one from `first`
    interval: wp.vec2  # the part of the flight to take a point from [m]; empty for a scattering
    # Random words: of the lens's point or, of a flight, of the choice and the distance; both of the tracking through a
    # grid. Of a spec that `scores_collisions` the second has the bits of the distance to the collision [m] where that
    # is scored.
    first: wp.uint32
    second: wp.uint32
    rounding_sample: wp.uint32  # random: 24 bits of it are for the tally; what is scored must not depend on it
    component: int  # index into COMPONENTS
    slot: int  # of the face that scatters, see `SurfaceHit`; -1 for water, SEA_SLOT for the surface of a sea
    target: int  # the pixel of a scan, else -1
    carried: Carried  # what rides along with the photon up to x


# ---- Votes.


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned int lanes = __ballot_sync(0xffffffffu, condition);
    return wp::vec2i(__popc(lanes & ((1u << (threadIdx.x & 31u)) - 1u)), __popc(lanes));
#else
    return wp::vec2i(0, condition ? 32 : 0);
#endif
""")
def vote(condition: bool) -> wp.vec2i:
    """Number of lanes of the warp before this one, and of all 32, in which the condition holds; every lane must take
    part, and all meet here."""
    ...


@wp.func
def count_lanes(condition: bool) -> int:
    """Number of lanes, out of 32, in which the condition holds, by a `vote`."""
    return vote(condition)[1]


# ---- A warp's shared memory, in units of 16 bytes: 32 vectors of six numbers, the size of its queue, and that.


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

# As if another lane had it: the assembler too, which looks through the above, then keeps it in a register.
_HELD = "__shfl_sync(0xffffffffu, begin, threadIdx.x & 31u)"


def _make_memory(vectors: int, held: bool) -> wp.Function:
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


# ---- The queue.


# A request's 24 bits for the tally share a word with its component.
_UPPER_24 = wp.constant(wp.uint32(0xFFFFFF00))

# Of a block's shared memory, 48 KiB, where a tree is walked: with 96 registers five blocks then leave 92 of an H200's
# 256 KiB to the cache, which holds the stacks.
_KIB_IN_TREE = 31


def _has_more(spec: TransportSpec, flights: bool) -> bool:
    """Whether a request has an interval, a point of the lens or a target."""
    return flights or spec.confocal


def _size(spec: TransportSpec, flights: bool, long: bool) -> tuple[int, int]:
    """Entries of a warp, and vectors of each: requests that wait, and those that come, of flights by their points, with
    `long` an event as well."""
    vectors = 3 + _has_more(spec, flights) + (1 if spec.polarised or spec.lines else -(-len(spec.derivatives) // 4))
    return MOST_LEFT + 32 * (spec.points + 1 if long else spec.points), vectors


def long_queue_fits(spec: TransportSpec, in_tree: bool) -> bool:
    """Whether a block's shared memory holds a `long` queue of flights and, `in_tree`, leaves the cache enough for the
    walk down the tree.

    Not in grids: with 72 registers the longer queues of all warps would leave 28 kB of cache, in place of 92 kB.
    """
    entries, vectors = _size(spec, True, True)
    kib = _KIB_IN_TREE if in_tree else 48
    return spec.grid is None and 16 * (_QUEUE + vectors * entries) * BLOCK_SIZE // 32 <= kib * 1024


@memoised
def make_queue(
    spec: TransportSpec, flights: bool, used: bool, long: bool, traces: bool
) -> tuple[wp.Function, wp.Function, wp.Function]:
    """Three Warp functions: ``memory() -> int``, see `_make_memory`; ``push(s, request, world, sink, memory)`` adds
    what is wanted; ``pop(memory, lane, takes, size, count) -> Request``, the last for so many lanes that take one.

    Args:
        spec: Of the requests.
        flights: Whether requests have an interval and a point of the lens.
        used: Whether there is a queue at all; else `push` does nothing.
        long: Whether a lane may add two requests, a flight and an event, before the queue is read.
        traces: Whether there are lanes that take none, since they wait for a shadow ray.
    """
    confocal, polarised, has_slot, more = spec.confocal, spec.polarised, spec.mesh or spec.sea, _has_more(spec, flights)
    lines, derivative_vectors, carried = spec.lines, -(-len(spec.derivatives) // 4), 3 + more
    entries, vectors = _size(spec, flights, long)
    warp_memory = _make_memory(vectors * entries * used, flights and long and not traces)

    @wp.func
    def put(memory: int, entry: int, number: int, value: wp.vec4):
        queue_vector(memory, True, entry + number * wp.static(entries), value)

    @wp.func
    def get(memory: int, entry: int, number: int) -> wp.vec4:
        return queue_vector(memory, False, entry + number * wp.static(entries), wp.vec4())

    @wp.func
    def write(memory: int, entry: int, request: Request):
        put(memory, entry, 0, wp.vec4(request.x[0], request.x[1], request.x[2], request.weight))
        put(memory, entry, 1, wp.vec4(request.u[0], request.u[1], request.u[2], request.path))
        packed = from_bits(request.component + int(request.rounding_sample & _UPPER_24))
        last = from_bits(wp.where(wp.static(confocal), request.target, request.slot))
        put(memory, entry, 2, wp.vec4(from_bits(int(request.first)), from_bits(int(request.second)), packed, last))
        if wp.static(more):
            lens = wp.vec2(request.lens[0], request.lens[1])
            if request.interval[0] >= request.interval[1]:
                lens[0] = from_bits(request.slot)  # an event has no point of the lens yet
            put(memory, entry, 3, wp.vec4(request.interval[0], request.interval[1], lens[0], lens[1]))
        for i in range(wp.static(derivative_vectors)):
            a = request.carried.log_derivatives
            put(memory, entry, wp.static(carried) + i, wp.vec4(a[4 * i], a[4 * i + 1], a[4 * i + 2], a[4 * i + 3]))
        if wp.static(polarised):
            put(memory, entry, wp.static(carried), request.carried.stokes)  # which cannot be combined with derivatives
        if wp.static(lines):
            put(memory, entry, wp.static(carried), request.carried.shifted)  # nor can these, nor both

    @wp.func
    def push(s: PhotonRef, request: Request, world: WorldRef, sink: SinkRef, memory: int):
        if wp.static(used):
            if request.wanted:
                write(memory, queue_size(memory, ADD_ENTRY, 0), request)

    @wp.func
    def pop(memory: int, lane: int, takes: bool, size: int, count: int) -> Request:
        request = Request()
        rank = lane
        if wp.static(traces):
            rank = vote(takes)[0]
        index = wp.max(size - count, 0) + rank
        request.wanted = takes and index < size
        entry = wp.min(index, size - 1)
        a = get(memory, entry, 0)
        b = get(memory, entry, 1)
        request.x = wp.vec3(a[0], a[1], a[2])
        request.weight = a[3]
        request.u = wp.vec3(b[0], b[1], b[2])
        request.path = b[3]
        c = get(memory, entry, 2)
        request.first = wp.uint32(bits_of(c[0]))
        request.second = wp.uint32(bits_of(c[1]))
        request.component = bits_of(c[2]) & 3
        request.rounding_sample = wp.uint32(bits_of(c[2]))
        request.slot = bits_of(c[3])
        request.target = wp.where(wp.static(confocal), bits_of(c[3]), -1)
        if wp.static(more):
            d = get(memory, entry, 3)
            request.interval = wp.vec2(d[0], d[1])
            request.lens = wp.vec3(d[2], d[3], 0.0)
        if wp.static(confocal):
            request.slot = wp.where(d[0] < d[1], -1, bits_of(d[2]))
        if wp.static(not has_slot):
            request.slot = -1
        for i in range(wp.static(derivative_vectors)):
            part = get(memory, entry, wp.static(carried) + i)
            for k in range(4):
                request.carried.log_derivatives[4 * i + k] = part[k]
        if wp.static(polarised):
            request.carried.stokes = get(memory, entry, wp.static(carried))
        if wp.static(lines):
            request.carried.shifted = get(memory, entry, wp.static(carried))
        return request

    return warp_memory, push, pop
