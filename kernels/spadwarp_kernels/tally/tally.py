"""Tallies: 64-bit fixed point, so that a sum does not depend on the order of its terms."""

import warp as wp

from spadwarp_kernels.sensor.camera import Camera
from spadwarp_kernels.sensor.gate import BEFORE, Gate, gate_bin

from .ledger import AFTER_GATE, BEFORE_GATE, CLIPPED, INVALID, OUTSIDE_SHIFT, add_to_ledger

# What a history's events make of its light: the first axis of the tally.
COMPONENTS = ("ballistic", "forward_scattered", "backscatter")
BALLISTIC, FORWARD_SCATTERED, BACKSCATTER = (wp.constant(i) for i in range(3))


@wp.struct
class Contribution:
    """What a photon adds to the tally.

    Attributes:
        value: Fraction of the emitted light; 0 for nothing.
        index: Of the voxel, see `tally_index`.
        rounding_sample: Uniform in [0, 1), see `to_fixed_point`.
    """

    value: float
    index: int
    rounding_sample: float


# Largest single contribution, in tally units; what is above it is clipped and counted.
_DEPOSIT_LIMIT = wp.constant(9.007199254740992e15)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    atomicAdd(reinterpret_cast<unsigned long long*>(tally.data) + index, static_cast<unsigned long long>(value));
    return pending;
#else
    long long* voxels = reinterpret_cast<long long*>(tally.data);
    __builtin_prefetch(voxels + index, 1);
    __atomic_fetch_add(voxels + pending[0], static_cast<long long>(pending[1]), __ATOMIC_RELAXED);
    return wp::vec2l(index, value);
#endif
""")
def add_pending(tally: wp.array(dtype=wp.int64), pending: wp.vec2l, index: int, value: wp.int64) -> wp.vec2l:
    """`atomic_add_int64`, on the CPU one call later: a core stands still while a voxel comes from memory, so the
    (index, value) that the call before returned is added now, and the memory of this one is requested."""
    ...


@wp.func
def to_fixed_point(value: float, scale: float, rounding_sample: float) -> wp.int64:
    """value * scale >= 0, rounded up with probability equal to its fraction, for rounding_sample uniform in [0, 1).

    For samples on the grid k / 2^24 the mean is kept to 2^-25 unit, or 2^-24 of the value where that is more. Returns
    -1 for what is clipped and -2 for what is not a number.
    """
    units = value * scale
    if units <= _DEPOSIT_LIMIT:
        return wp.int64(units + rounding_sample)
    if units > _DEPOSIT_LIMIT:
        return wp.int64(-1)
    return wp.int64(-2)


@wp.func
def tally_index(camera: Camera, gate: Gate, pixel: int, path: float, component: int) -> int:
    """Index into the tally [component, pixel, bin], or BEFORE or AFTER the gate."""
    k = gate_bin(gate, path)
    if k < 0:
        return k
    return (component * camera.width * camera.height + pixel) * gate.bins + k


@wp.func
def deposit(
    tally: wp.array(dtype=wp.int64),
    ledger: wp.array(dtype=wp.int64),
    pending: wp.vec2l,
    thread: int,
    scale: float,
    c: Contribution,
) -> wp.vec2l:
    """Adds a contribution to its voxel of the tally; BEFORE or AFTER is counted in the ledger.

    Returns what `add_pending` returns, which the next call takes as `pending`.
    """
    units = to_fixed_point(c.value, scale, c.rounding_sample)
    if units < wp.int64(0):
        add_to_ledger(ledger, thread, wp.where(units == wp.int64(-1), CLIPPED, INVALID), wp.int64(1))
    elif c.index >= 0:
        if units > wp.int64(0):
            pending = add_pending(tally, pending, c.index, units)
    else:
        # Coarser, since light from right before the lens is far brighter than what the unit was chosen for.
        entry = wp.where(c.index == BEFORE, BEFORE_GATE, AFTER_GATE)
        add_to_ledger(ledger, thread, entry, (units + wp.int64(128)) >> OUTSIDE_SHIFT)
    return pending
