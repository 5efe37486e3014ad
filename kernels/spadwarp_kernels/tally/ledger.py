"""The ledger: where the weight of the photons went, in integers that add up exactly, and counters."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.water.limits import EXIT_FACES

__all__ = ["LEDGER_ENTRIES", "LEDGER_UNIT"]

# Ledger weights are counted in units of 2^-22 photon: 1e12 photons stay below 2^63, and a cut-off of 2e-4 is 839 units.
LEDGER_ONE = wp.constant(4194304.0)
LEDGER_UNIT = 1.0 / 4194304.0

# Copies of the ledger, so that threads seldom add to one address at the same time.
LEDGER_SLOTS = 4096

# Light outside the gate is counted in 2^8 tally units.
OUTSIDE_SHIFT = wp.constant(wp.int64(8))

LEDGER_ENTRIES = (
    "absorbed_water",
    "absorbed_surface",
    "weight_cutoff",
    "max_collisions",
    "max_path",
    *EXIT_FACES,
    "roulette",
    "importance_sampling_residual",
)
COUNTERS = (
    "water_collisions",
    "surface_events",
    "surface_queries",
    "shadow_queries",
    "contributions",
    "before_gate",
    "after_gate",
    "clipped",
    "invalid",
    "below_unit_ballistic",
    "below_unit_forward_scattered",
    "below_unit_backscatter",
)
# After all others: what a laser's port reflects, reported where there is one, and counters of faces that reflect.
PORT_ENTRY = "laser_port"
BOUNDARY_COUNTERS = ("reflections", "beyond_max_reflections")
LEDGER_WIDTH = len(LEDGER_ENTRIES) + len(COUNTERS) + 1 + len(BOUNDARY_COUNTERS)
LASER_PORT, REFLECTIONS, BEYOND_MAX_REFLECTIONS = (wp.constant(LEDGER_WIDTH - 3 + i) for i in range(3))

ABSORBED_WATER, ABSORBED_SURFACE, WEIGHT_CUTOFF, MAX_COLLISIONS, MAX_PATH, EXIT, ROULETTE, DIRECTED = (
    wp.constant(LEDGER_ENTRIES.index(name))
    for name in (*LEDGER_ENTRIES[:5], EXIT_FACES[0], "roulette", "importance_sampling_residual")
)
(
    WATER_COLLISIONS,
    SURFACE_EVENTS,
    SURFACE_QUERIES,
    SHADOW_QUERIES,
    CONTRIBUTIONS,
    BEFORE_GATE,
    AFTER_GATE,
    CLIPPED,
    INVALID,
    BELOW_UNIT,
) = (wp.constant(len(LEDGER_ENTRIES) + i) for i in range(len(COUNTERS) - 2))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    atomicAdd(reinterpret_cast<unsigned long long*>(tally.data) + index, static_cast<unsigned long long>(value));
#else
    __atomic_fetch_add(reinterpret_cast<long long*>(tally.data) + index, static_cast<long long>(value),
    __ATOMIC_RELAXED);
#endif
""")
def atomic_add_int64(tally: wp.array[wp.int64], index: int, value: wp.int64):
    """Adds to a contiguous int64 array; atomic on CUDA and between CPU threads (Warp's own is a plain add on the
    CPU)."""
    ...


@wp.func
def to_ledger(weight: float) -> wp.int64:
    """A weight >= 0 in ledger units, rounded to nearest."""
    return wp.int64(weight * LEDGER_ONE + 0.5)


@wp.func
def add_to_ledger(ledger: wp.array[wp.int64], thread: int, entry: int, value: wp.int64):
    """Adds to one entry in the slot of a thread; neighbouring threads write to neighbouring addresses."""
    atomic_add_int64(ledger, entry * LEDGER_SLOTS + thread % LEDGER_SLOTS, value)


@wp.func
def slot_of_core(first_id: wp.uint64) -> int:
    """A thread's number on the CPU: launches on several cores write to cache lines of their own."""
    return 8 * int((first_id >> wp.uint64(10)) & wp.uint64(511))


@memoised
def make_ledger_slot(cuda: bool) -> wp.Function:
    """The Warp function ``(thread, first_id) -> int``: what `add_to_ledger` takes as its thread."""

    @wp.func
    def ledger_slot(thread: int, first_id: wp.uint64) -> int:
        if wp.static(cuda):
            return thread
        return slot_of_core(first_id)

    return ledger_slot
