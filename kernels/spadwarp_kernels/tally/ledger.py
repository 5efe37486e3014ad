"""The ledger: where the weight of the photons went, in integers that add up exactly, and counters."""

import warp as wp

from .tally import atomic_add_int64

__all__ = ["LEDGER_ENTRIES", "LEDGER_UNIT"]

# Ledger weights are counted in units of 2^-22 photon: 1e12 photons stay below 2^63, and a cut-off of 2e-4 is 839 units.
LEDGER_ONE = wp.constant(4194304.0)
LEDGER_UNIT = 1.0 / 4194304.0

# Copies of the ledger, so that threads seldom add to one address at the same time.
LEDGER_SLOTS = 4096

# Light outside the gate is counted in 2^8 tally units.
OUTSIDE_SHIFT = wp.constant(wp.int64(8))

# Where a history may leave the domain, in the order of `water.limits.exit_face`.
EXIT_FACES = ("lateral_limit", "exit_x_low", "exit_x_high", "exit_y_low", "exit_y_high", "exit_z_low", "exit_z_high")

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
# And those of a sea: what its facets mask, and what the air above it takes.
SEA_ENTRIES = ("surface_masking", "absorbed_air")
SEA_COUNTERS = ("crossings", "below_unit_surface")
_LAST = (PORT_ENTRY, *BOUNDARY_COUNTERS, *SEA_ENTRIES, *SEA_COUNTERS)
ALL_ENTRIES = LEDGER_ENTRIES + COUNTERS + _LAST
LEDGER_WIDTH = len(ALL_ENTRIES)
LASER_PORT, REFLECTIONS, BEYOND_MAX_REFLECTIONS, SURFACE_MASKING, ABSORBED_AIR, CROSSINGS, BELOW_UNIT_SURFACE = (
    wp.constant(ALL_ENTRIES.index(name)) for name in _LAST
)

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
