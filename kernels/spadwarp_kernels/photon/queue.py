"""Requests for contributions, and on CUDA a warp's queue of them, which its 32 lanes serve together."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import bits_of, from_bits
from spadwarp_kernels.tally.tally import BACKSCATTER

from .lanes import (
    ADD_ENTRY,
    MOST_LEFT,
    count_lanes_before,
    fits_in_block,
    make_warp_memory,
    queue_pair,
    queue_size,
    queue_vector,
)
from .spec import TransportSpec
from .state import Carried


@wp.struct
class Request:
    """What is to be scored; plain enough for another thread to do it.

    Attributes:
        wanted: Whether there is anything.
        x: Where the photon scatters, or where the flight begins [m].
        u: Its direction until there, or of the flight.
        weight: Of the photon; in water times the albedo, but for flights through water that varies, whose albedo is
            that of the sampled point.
        path: Geometric path up to x [m].
        lens: The point of the lens by which a flight is scored; others draw one from `first`.
        interval: The part of the flight to take a point from [m]; empty for a scattering.
        first, second: Random words: of the lens's point or, of a flight, of the choice and the distance; both of the
            tracking through a grid. Of a spec that `scores_collisions` the second has the bits of the distance to the
            collision [m] where that is scored.
        rounding_sample: A random word, 24 bits of which are for the tally; what is scored must not depend on it.
        component: Index into COMPONENTS.
        slot: Of the face that scatters, see `SurfaceHit`; -1 for water.
        target: The pixel of a scan, else -1.
        carried: What rides along with the photon up to x.
    """

    wanted: bool
    x: wp.vec3
    u: wp.vec3
    weight: float
    path: float
    lens: wp.vec3
    interval: wp.vec2
    first: wp.uint32
    second: wp.uint32
    rounding_sample: wp.uint32
    component: int
    slot: int
    target: int
    carried: Carried


# A request's 24 bits for the tally share a word with its component.
_UPPER_24 = wp.constant(wp.uint32(0xFFFFFF00))

# Of a block's shared memory where a tree is walked: with 96 registers five blocks then leave 92 of an H200's 256 KiB to
# the cache, which holds the stacks.
_KIB_IN_TREE = 31


@wp.func
def _lane(lane: int, takes: bool) -> int:
    return lane


@wp.func
def _among_takers(lane: int, takes: bool) -> int:
    return count_lanes_before(takes)


def _vectors(more: bool, derivatives: int, polarised: bool) -> int:
    """Of a request, four numbers each; `more`: it has an interval, a point of the lens or a target."""
    return (4 if more else 3) + (1 if polarised else -(-derivatives // 4))


def queue_entries(points: int, long: bool) -> int:
    """Of a warp: requests that wait, and those that come, of flights by their points, with `long` an event as well."""
    return MOST_LEFT + 32 * (points + 1 if long else points)


def long_queue_fits(spec: TransportSpec, in_tree: bool) -> bool:
    """Whether a block's shared memory holds a `long` queue of flights and, `in_tree`, leaves the cache enough for the
    walk down the tree.

    Not in grids: with 72 registers the longer queues of all warps would leave 28 kB of cache, in place of 92 kB.
    """
    vectors = _vectors(True, len(spec.derivatives), spec.polarised) * queue_entries(spec.points, True)
    return spec.grid is None and fits_in_block(vectors, _KIB_IN_TREE if in_tree else 48)


@memoised
def _make_words(confocal: bool, short: bool, begin: int) -> tuple[wp.Function, wp.Function]:
    """Two Warp functions that write, ``(memory, entry, request)``, and read, ``(memory, entry, request) -> Request``,
    what a request has beside x, u, weight and path; `confocal`, `short`: see `make_queue`, `begin`: where it is."""

    @wp.func
    def write_pair(memory: int, entry: int, request: Request):
        words = wp.vec2(from_bits(int(request.first)), from_bits(int(request.rounding_sample)))
        queue_pair(memory, True, wp.static(begin), entry, words)

    @wp.func
    def read_pair(memory: int, entry: int, request: Request) -> Request:
        words = queue_pair(memory, False, wp.static(begin), entry, wp.vec2())
        request.first = wp.uint32(bits_of(words[0]))
        request.rounding_sample = wp.uint32(bits_of(words[1]))
        request.component = BACKSCATTER
        request.target = -1
        request.slot = -1
        return request

    @wp.func
    def write_vector(memory: int, entry: int, request: Request):
        packed = request.component + int(request.rounding_sample & _UPPER_24)
        queue_vector(
            memory,
            True,
            entry + wp.static(begin),
            wp.vec4(
                from_bits(int(request.first)),
                from_bits(int(request.second)),
                from_bits(packed),
                from_bits(wp.where(wp.static(confocal), request.target, request.slot)),
            ),
        )

    @wp.func
    def read_vector(memory: int, entry: int, request: Request) -> Request:
        c = queue_vector(memory, False, entry + wp.static(begin), wp.vec4())
        request.first = wp.uint32(bits_of(c[0]))
        request.second = wp.uint32(bits_of(c[1]))
        packed = bits_of(c[2])
        request.component = packed & 3
        request.rounding_sample = wp.uint32(packed)
        request.slot = bits_of(c[3])
        request.target = wp.where(wp.static(confocal), bits_of(c[3]), -1)
        return request

    return (write_pair, read_pair) if short else (write_vector, read_vector)


@memoised
def make_queue(
    flights: bool,
    used: bool,
    long: bool,
    traces: bool,
    confocal: bool,
    derivatives: int = 0,
    polarised: bool = False,
    points: int = 1,
    short: bool = False,
) -> tuple[wp.Function, wp.Function, wp.Function]:
    """Three Warp functions: ``warp_memory()``, see `make_warp_memory`; ``push(memory, request)`` adds what is wanted;
    ``pop(memory, lane, takes, size, count) -> Request``, the last ones for the so many lanes that take one.

    Args:
        flights: Whether requests have an interval and a point of the lens.
        used: Whether there is a queue at all; else `push` does nothing.
        long: Whether a lane may add two requests, a flight and an event, before the queue is read.
        traces: Whether there are lanes that take none, since they wait for a shadow ray.
        confocal: Whether they have a target.
        derivatives: How many log derivatives requests carry.
        polarised: Whether they have a Stokes vector.
        points: Requests that a flight adds, one for each of its points.
        short: Whether requests are of scatterings in water alone, and need one random word beside that of the tally.
    """
    more, rank_of = flights or confocal, _among_takers if traces else _lane
    derivative_vectors = -(-derivatives // 4)
    first_carried = 4 if more else 3
    entries = queue_entries(points, long)
    write_words, read_words = _make_words(confocal, short, 2 * entries)
    warp_memory = make_warp_memory(
        _vectors(more, derivatives, polarised) * entries if used else 0, flights and long and not traces
    )

    @wp.func
    def write(memory: int, entry: int, request: Request):
        queue_vector(memory, True, entry, wp.vec4(request.x[0], request.x[1], request.x[2], request.weight))
        queue_vector(
            memory, True, entry + wp.static(entries), wp.vec4(request.u[0], request.u[1], request.u[2], request.path)
        )
        write_words(memory, entry, request)
        if wp.static(more):
            lens = wp.vec2(request.lens[0], request.lens[1])
            if request.interval[0] >= request.interval[1]:
                lens[0] = from_bits(request.slot)  # an event has no point of the lens yet
            queue_vector(
                memory,
                True,
                entry + 3 * wp.static(entries),
                wp.vec4(request.interval[0], request.interval[1], lens[0], lens[1]),
            )
        for i in range(wp.static(derivative_vectors)):
            a = request.carried.log_derivatives
            part = wp.vec4(a[4 * i], a[4 * i + 1], a[4 * i + 2], a[4 * i + 3])
            queue_vector(memory, True, entry + (wp.static(first_carried) + i) * wp.static(entries), part)
        if wp.static(polarised):
            # Which cannot be combined with derivatives.
            queue_vector(memory, True, entry + wp.static(first_carried) * wp.static(entries), request.carried.stokes)

    @wp.func
    def push(memory: int, request: Request):
        if wp.static(used):
            if request.wanted:
                write(memory, queue_size(memory, ADD_ENTRY, 0), request)

    @wp.func
    def pop(memory: int, lane: int, takes: bool, size: int, count: int) -> Request:
        request = Request()
        index = wp.max(size - count, 0) + rank_of(lane, takes)
        request.wanted = takes and index < size
        entry = wp.min(index, size - 1)
        a = queue_vector(memory, False, entry, wp.vec4())
        b = queue_vector(memory, False, entry + wp.static(entries), wp.vec4())
        request.x = wp.vec3(a[0], a[1], a[2])
        request.weight = a[3]
        request.u = wp.vec3(b[0], b[1], b[2])
        request.path = b[3]
        request = read_words(memory, entry, request)
        if wp.static(more):
            d = queue_vector(memory, False, entry + 3 * wp.static(entries), wp.vec4())
            request.interval = wp.vec2(d[0], d[1])
            request.lens = wp.vec3(d[2], d[3], 0.0)
        if wp.static(confocal):
            request.slot = wp.where(d[0] < d[1], -1, bits_of(d[2]))
        for i in range(wp.static(derivative_vectors)):
            part = queue_vector(memory, False, entry + (wp.static(first_carried) + i) * wp.static(entries), wp.vec4())
            for k in range(4):
                request.carried.log_derivatives[4 * i + k] = part[k]
        if wp.static(polarised):
            request.carried.stokes = queue_vector(
                memory, False, entry + wp.static(first_carried) * wp.static(entries), wp.vec4()
            )
        return request

    return warp_memory, push, pop
