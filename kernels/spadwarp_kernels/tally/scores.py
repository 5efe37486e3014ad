"""Derivatives of the histogram: what they are with respect to, and their tallies in fixed point, which have signs.

The derivative of a contribution is the contribution times its score, the derivative of the logarithm of what the light
has met: flights, scatterings, bounces (the score function or likelihood ratio method; Glynn 1990).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_choice,
    check_device,
    check_integer,
    check_items,
    check_number,
    check_numbers,
    check_struct,
)
from spadwarp_kernels.base.kernels import memoised

from .blocks import Blocks, met_count, met_entry, score_entry
from .ledger import CLIPPED, INVALID, add_to_ledger, atomic_add_int64
from .tally import DEPOSIT_LIMIT, Contribution, Scores, add_to_words, deposit

__all__ = ["DERIVATIVES", "MOST_DERIVATIVES", "Derivatives", "make_derivatives"]

# What a derivative may be with respect to, and the range of such a parameter: a at fixed b, b at fixed a, the mean
# cosine g of Henyey and Greenstein's phase function, and a reflectance or a factor on one that varies.
DERIVATIVES = {"absorption": "[0, inf)", "scattering": "(0, inf)", "anisotropy": "(-1, 1)", "reflectance": "(0, inf)"}

MOST_DERIVATIVES = len(Scores())


@wp.struct
class Derivatives:
    """The parameters of a spec with derivatives, in its order, or of its channels; made by `make_derivatives`.

    Attributes:
        value: Of each parameter.
        scale: Tally units of its derivative per emitted photon.
        waters: By layer, bit p set: parameter p is of this layer; not read without layers.
        faces: By face, bit p set: parameter p is this face's reflectance, or a factor on it.
        blocks: Of a spec with blocks, from `make_blocks`.
    """

    value: Scores
    scale: Scores
    waters: wp.array[int]
    faces: wp.array[int]
    blocks: Blocks


def make_derivatives(
    kinds: Sequence[str],
    value: Sequence[float],
    scale: Sequence[float],
    *,
    channels: int = 0,
    waters: Sequence[int] = (),
    faces: Any = (),
    blocks: Any = None,
    device: wp.DeviceLike = None,
) -> Derivatives:
    """The parameters of a spec whose `derivatives` are `kinds`; see `Derivatives` for the others. Of one with
    `channels` so many, which have scales alone.

    `blocks`: from `make_blocks`, of a spec with blocks; without them, one kind at least. Raises `ArgumentError` for a
    kind that is not one of DERIVATIVES, or a number out of range.
    """
    channels = check_integer("channels", channels, 0, MOST_DERIVATIVES)
    given = {"kinds": kinds, "value": value, "scale": scale}
    kinds, value, scale = (check_items(name, items) for name, items in given.items())
    device, count = check_device("device", device), check_integer("derivatives", len(kinds), 0, MOST_DERIVATIVES)
    least = 1 if blocks is None else 0
    tallies = check_integer("derivatives and channels", count + channels, least, MOST_DERIVATIVES)
    if len(value) != count or len(scale) != tallies:
        raise ArgumentError(
            f"{count} derivatives, {channels} channels, {len(value)} values, {len(scale)} scales: each needs a scale, "
            "derivatives a value"
        )
    for p, kind in enumerate(kinds):
        check_choice(f"kinds[{p}]", kind, DERIVATIVES)
        check_number(f"value[{p}], {kind},", value[p], DERIVATIVES[kind])
    for p, one in enumerate(scale):
        check_number(f"scale[{p}]", one, "(0, inf)")
    derivatives = Derivatives()
    derivatives.value = Scores(*value, *[0.0] * (MOST_DERIVATIVES - count))
    derivatives.scale = Scores(*scale, *[0.0] * (MOST_DERIVATIVES - tallies))
    derivatives.waters = _numbers_of_parts("waters", waters, device)
    derivatives.faces = _numbers_of_parts("faces", faces, device)
    if blocks is not None:
        check_struct("blocks", blocks, Blocks)
        derivatives.blocks = blocks
    return derivatives


def _numbers_of_parts(name: str, values: Any, device: wp.Device) -> wp.array:
    numbers = check_numbers(name, values, 1)
    whole = np.nan_to_num(numbers).astype(np.int32) if np.abs(numbers).max(initial=0.0) < 2**31 else None
    if whole is None or not np.array_equal(whole, numbers):
        raise ArgumentError(f"{name} holds numbers that are not whole or beyond 2^31")
    return wp.array(whole, dtype=int, device=device, shape=whole.size)


@memoised
def make_deposit(count: int, kinds: int = 0, split_accumulators: bool = False) -> wp.Function:
    """The Warp function ``(tally, low, gradients, ledger, pending, thread, scale, derivatives, c) -> vec2l``:
    `deposit`, which also adds value times score of a contribution to the tally [voxel, derivative] of so many
    derivatives, and after them of so many kinds of derivatives by block; rounded down after the rounding sample is
    added, so that the mean is kept. With `split_accumulators`, those of the tally are in `low`."""

    @wp.func
    def deposit_scored(
        gradients: wp.array[wp.int64],
        ledger: wp.array[wp.int64],
        thread: int,
        index: int,
        units: float,
        rounding_sample: float,
    ):
        if wp.abs(units) <= DEPOSIT_LIMIT:
            whole = wp.int64(wp.floor(units + rounding_sample))
            if whole != wp.int64(0):
                atomic_add_int64(gradients, index, whole)
        else:
            entry = wp.where(wp.abs(units) > DEPOSIT_LIMIT, CLIPPED, INVALID)
            add_to_ledger(ledger, thread, entry, wp.int64(1))

    @wp.func
    def deposit_derived(
        tally: wp.array[wp.int64],
        low: wp.array[wp.uint32],
        gradients: wp.array[wp.int64],
        ledger: wp.array[wp.int64],
        pending: wp.vec2l,
        thread: int,
        scale: float,
        derivatives: Derivatives,
        c: Contribution,
    ) -> wp.vec2l:
        if wp.static(count + kinds > 0):
            if c.index >= 0:
                blocks = derivatives.blocks
                width = wp.static(count) + wp.static(kinds) * blocks.count
                for p in range(wp.static(count)):
                    units = c.value * c.scores[p] * derivatives.scale[p]
                    deposit_scored(gradients, ledger, thread, c.index * width + p, units, c.rounding_sample)
                if wp.static(kinds > 0):
                    for i in range(met_count(blocks, 1)):
                        k = int(blocks.memory[met_entry(blocks, 1, i)])
                        for q in range(wp.static(kinds)):
                            units = c.value * blocks.memory[score_entry(blocks, 1, q, k)] * blocks.scale[q]
                            p = wp.static(count) + q * blocks.count + k
                            deposit_scored(gradients, ledger, thread, c.index * width + p, units, c.rounding_sample)
        if wp.static(split_accumulators):
            units = c.value * scale
            if c.index >= 0 and units >= 1.0 and units <= DEPOSIT_LIMIT:
                add_to_words(tally, low, c.index, wp.int64(units + c.rounding_sample))
                return pending
        return deposit(tally, ledger, pending, thread, scale, c)

    return deposit_derived
