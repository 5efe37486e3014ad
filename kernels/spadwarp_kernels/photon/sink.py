"""Where a photon's light and weight go: the tally, the tallies that have signs, and the energy balance."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.optics.camera import BEFORE
from spadwarp_kernels.tally.blocks import met_count, met_entry, score_entry
from spadwarp_kernels.tally.ledger import (
    AFTER_GATE,
    BEFORE_GATE,
    BELOW_UNIT,
    CLIPPED,
    INVALID,
    OUTSIDE_SHIFT,
    add_to_ledger,
    atomic_add_int64,
    to_ledger,
)
from spadwarp_kernels.tally.tally import COMPONENTS, DEPOSIT_LIMIT, Contribution, add_pending, add_to_words

from .world import World


@wp.struct
class Sink:
    """What photons add to; no stage writes to the struct itself, so that CUDA reads it where launches have put it.

    Attributes:
        tally: Histograms [component, pixel, bin], fixed point.
        low: Their low words, where those are apart, see `tally.splitting_pays`.
        gradients: The tallies that have signs [voxel, parameter].
        ledger: The energy balance and counters, see `add_to_ledger`.
        scale: Tally units per emitted photon.
    """

    tally: wp.array[wp.int64]
    low: wp.array[wp.uint32]
    gradients: wp.array[wp.int64]
    ledger: wp.array[wp.int64]
    scale: float


@wp.struct
class Account:
    """What a thread needs to add to a sink.

    Attributes:
        slot: Of the ledger, see `add_to_ledger`.
        pending: On a CPU the voxel and value that are still to be added, see `add_pending`.
    """

    slot: int
    pending: wp.vec2l


@wp.struct
class Weight:
    """The weight of a photon, and its account.

    Attributes:
        value: Fraction of the photon that is left.
        taken: By which the last change lowered it, in ledger units.
        absorbed_water: Sum over the thread's photons, in ledger units: what they had, less what was left and what was
            booked. It is what water took once the thread's other sums for the ledger are subtracted, at its end.
    """

    value: float
    taken: wp.int64
    absorbed_water: wp.int64


@wp.func
def reweigh(w: wp.ref[Weight], factor: float):
    """Multiplies the weight by a factor.

    The ledger is written where weight changes hands; water takes what is missing there. What is taken is to be added to
    one of the thread's sums for the ledger, or to be booked by `book_weight`.
    """
    before = to_ledger(w.value)
    w.value *= factor
    w.taken = before - to_ledger(w.value)


@wp.func
def book_weight(w: wp.ref[Weight], account: wp.ref[Account], sink: wp.ref[Sink], entry: int):
    """What the last change has taken goes to an entry of the ledger."""
    book(account, sink, entry, w.taken)
    w.absorbed_water -= w.taken


@wp.func
def book(account: wp.ref[Account], sink: wp.ref[Sink], entry: int, value: wp.int64):
    """Adds to an entry of the ledger."""
    add_to_ledger(sink.ledger, account.slot, entry, value)


@wp.func
def _deposit(account: wp.ref[Account], sink: wp.ref[Sink], c: Contribution):
    """Adds a contribution to its voxel of the tally; the ledger counts BEFORE and AFTER, and what is below one unit."""
    exact = c.value * sink.scale
    units = wp.int64(exact + c.rounding_sample)
    if not exact <= DEPOSIT_LIMIT:
        book(account, sink, wp.where(exact > DEPOSIT_LIMIT, CLIPPED, INVALID), wp.int64(1))
    elif c.index >= 0:
        if exact >= 1.0:
            account.pending = add_pending(sink.tally, account.pending, c.index, units)
        else:
            if units > wp.int64(0):
                account.pending = add_pending(sink.tally, account.pending, c.index, units)
            voxels = sink.tally.shape[0] // wp.static(len(COMPONENTS))
            component = wp.where(c.index >= voxels, 1, 0) + wp.where(c.index - voxels >= voxels, 1, 0)
            book(account, sink, BELOW_UNIT + component, wp.int64(1))
    else:
        # Coarser, since light from right before the lens is far brighter than what the unit was chosen for.
        entry = wp.where(c.index == BEFORE, BEFORE_GATE, AFTER_GATE)
        book(account, sink, entry, (units + wp.int64(128)) >> OUTSIDE_SHIFT)


@wp.func
def _deposit_signed(account: wp.ref[Account], sink: wp.ref[Sink], index: int, units: float, rounding_sample: float):
    """Adds to a tally that has signs; rounded down after the rounding sample is added, so that the mean is kept."""
    if wp.abs(units) <= DEPOSIT_LIMIT:
        whole = wp.int64(wp.floor(units + rounding_sample))
        if whole != wp.int64(0):
            atomic_add_int64(sink.gradients, index, whole)
    else:
        book(account, sink, wp.where(wp.abs(units) > DEPOSIT_LIMIT, CLIPPED, INVALID), wp.int64(1))


@memoised
def make_deposit(signed: int, kinds: int, split: bool) -> wp.Function:
    """The Warp function ``(account, sink, world, contribution)`` that adds a contribution to the tally, with so many
    parameters or channels that have signs and so many kinds of derivatives by block; `split`: the low words of the
    tally are apart."""

    @wp.func
    def deposit(account: wp.ref[Account], sink: wp.ref[Sink], world: wp.ref[World], c: Contribution):
        if wp.static(signed + kinds > 0):
            if c.index >= 0:
                blocks = world.derivatives.blocks
                width = wp.static(signed) + wp.static(kinds) * blocks.count
                for p in range(wp.static(signed)):
                    units = c.value * c.factors[p] * world.derivatives.scale[p]
                    _deposit_signed(account, sink, c.index * width + p, units, c.rounding_sample)
                if wp.static(kinds > 0):
                    for i in range(met_count(blocks, 1)):
                        k = int(blocks.memory[met_entry(blocks, 1, i)])
                        for q in range(wp.static(kinds)):
                            units = c.value * blocks.memory[score_entry(blocks, 1, q, k)] * blocks.scale[q]
                            p = wp.static(signed) + q * blocks.count + k
                            _deposit_signed(account, sink, c.index * width + p, units, c.rounding_sample)
        if wp.static(split):
            units = c.value * sink.scale
            if c.index >= 0 and units >= 1.0 and units <= DEPOSIT_LIMIT:
                add_to_words(sink.tally, sink.low, c.index, wp.int64(units + c.rounding_sample))
                return
        _deposit(account, sink, c)

    return deposit
