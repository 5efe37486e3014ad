"""Tallies: 64-bit fixed point, so that a sum does not depend on the order of its terms."""

import warp as wp

# Ledger weights are counted in units of 2^-22 photon: 1e12 photons stay below 2^63 and the paper's cut-off of 2e-4 is
# 839 units.
LEDGER_ONE = wp.constant(4194304.0)
LEDGER_UNIT = 1.0 / 4194304.0

# Largest single contribution, in tally units; what is above it is clipped and counted.
_DEPOSIT_LIMIT = wp.constant(9.007199254740992e15)

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
    "lateral_limit",
    "exit_x_low",
    "exit_x_high",
    "exit_y_low",
    "exit_y_high",
    "exit_z_low",
    "exit_z_high",
    "roulette",
    "directed",
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
)
LEDGER_WIDTH = len(LEDGER_ENTRIES) + len(COUNTERS)

ABSORBED_WATER, ABSORBED_SURFACE, WEIGHT_CUTOFF, MAX_COLLISIONS, MAX_PATH, LATERAL_LIMIT = (
    wp.constant(LEDGER_ENTRIES.index(name))
    for name in ("absorbed_water", "absorbed_surface", "weight_cutoff", "max_collisions", "max_path", "lateral_limit")
)
EXIT = wp.constant(LEDGER_ENTRIES.index("exit_x_low"))
ROULETTE = wp.constant(LEDGER_ENTRIES.index("roulette"))
DIRECTED = wp.constant(LEDGER_ENTRIES.index("directed"))
WATER_COLLISIONS, SURFACE_EVENTS, SURFACE_QUERIES, SHADOW_QUERIES = (
    wp.constant(len(LEDGER_ENTRIES) + COUNTERS.index(name))
    for name in ("water_collisions", "surface_events", "surface_queries", "shadow_queries")
)
CONTRIBUTIONS, BEFORE_GATE, AFTER_GATE, CLIPPED, INVALID = (
    wp.constant(len(LEDGER_ENTRIES) + COUNTERS.index(name))
    for name in ("contributions", "before_gate", "after_gate", "clipped", "invalid")
)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    atomicAdd(reinterpret_cast<unsigned long long*>(tally.data) + index, static_cast<unsigned long long>(value));
#else
    __atomic_fetch_add(reinterpret_cast<long long*>(tally.data) + index, static_cast<long long>(value),
    __ATOMIC_RELAXED);
#endif
""")
def atomic_add_int64(tally: wp.array(dtype=wp.int64), index: int, value: wp.int64):
    """Adds to a contiguous int64 array; atomic on CUDA and between CPU threads (Warp's own is a plain add on the
    CPU)."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    atomicAdd(reinterpret_cast<unsigned long long*>(tally.data) + index, static_cast<unsigned long long>(value));
    return late;
#else
    long long* voxels = reinterpret_cast<long long*>(tally.data);
    __builtin_prefetch(voxels + index, 1);
    __atomic_fetch_add(voxels + late[0], static_cast<long long>(late[1]), __ATOMIC_RELAXED);
    return wp::vec2l(index, value);
#endif
""")
def add_late(tally: wp.array(dtype=wp.int64), late: wp.vec2l, index: int, value: wp.int64) -> wp.vec2l:
    """`atomic_add_int64`, on the CPU one call late: a core that waits for a voxel to come from memory stands still, so
    the (index, value) that the call before returned is added now, and this one's voxel is sent for."""
    ...


@wp.func
def to_ledger(weight: float) -> wp.int64:
    """A weight >= 0 in ledger units, rounded to nearest."""
    return wp.int64(weight * LEDGER_ONE + 0.5)


@wp.func
def to_fixed_point(value: float, scale: float, dither: float) -> wp.int64:
    """value * scale >= 0, rounded up with probability equal to its fraction (dither uniform in [0, 1)).

    The dither that transport hands over has 256 steps: a value below 1/512 unit counts as nothing, and larger ones
    carry at most that as bias. Returns -1 for what is clipped and -2 for what is not a number.
    """
    units = value * scale
    if units <= _DEPOSIT_LIMIT:
        return wp.int64(units + dither)
    if units > _DEPOSIT_LIMIT:
        return wp.int64(-1)
    return wp.int64(-2)


@wp.func
def add_to_ledger(ledger: wp.array(dtype=wp.int64), thread: int, entry: int, value: wp.int64):
    """Adds to one entry in the slot of a thread; neighbouring threads write to neighbouring addresses."""
    atomic_add_int64(ledger, entry * LEDGER_SLOTS + thread % LEDGER_SLOTS, value)


@wp.func
def deposit(
    tally: wp.array(dtype=wp.int64),
    ledger: wp.array(dtype=wp.int64),
    late: wp.vec2l,
    thread: int,
    index: int,
    value: float,
    scale: float,
    dither: float,
) -> wp.vec2l:
    """Adds a contribution to a voxel of the tally, see `add_late`; index -1 or -2 counts it in the ledger as before or
    after the gate."""
    units = to_fixed_point(value, scale, dither)
    if units < wp.int64(0):
        add_to_ledger(ledger, thread, wp.where(units == wp.int64(-1), CLIPPED, INVALID), wp.int64(1))
    elif index >= 0:
        if units > wp.int64(0):
            late = add_late(tally, late, index, units)
    else:
        # Coarser, since light from right before the lens is far brighter than what the unit was chosen for.
        add_to_ledger(
            ledger, thread, wp.where(index == -1, BEFORE_GATE, AFTER_GATE), (units + wp.int64(128)) >> OUTSIDE_SHIFT
        )
    return late
