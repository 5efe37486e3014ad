"""Derivatives of the histogram: what they are with respect to, and their tallies in fixed point, which have signs.

The derivative of a contribution is the contribution times its score, the derivative of the logarithm of what the light
has met: flights, scatterings, bounces (the score function or likelihood ratio method; Glynn 1990).
"""

import functools
from collections.abc import Sequence
from typing import Any

import warp as wp

from spadwarp_kernels.arguments import ArgumentError, check_choice, check_device, check_integer, check_number

from .ledger import CLIPPED, INVALID, add_to_ledger, atomic_add_int64
from .tally import DEPOSIT_LIMIT, Contribution, Scores, deposit

# What a derivative may be with respect to, and the range of such a parameter: a at fixed b, b at fixed a, the mean
# cosine g of Henyey and Greenstein's phase function, and a reflectance or a factor on one that varies.
DERIVATIVES = {"absorption": "[0, inf)", "scattering": "(0, inf)", "anisotropy": "(-1, 1)", "reflectance": "(0, inf)"}

MOST_DERIVATIVES = len(Scores())


@wp.struct
class Derivatives:
    """The parameters of a spec with derivatives, in its order; made by `make_derivatives`.

    Attributes:
        value: Of each parameter.
        scale: Tally units of its derivative per emitted photon.
        waters: By layer, bit p set: parameter p is of this layer; not read without layers.
        faces: By face, bit p set: parameter p is this face's reflectance, or a factor on it.
    """

    value: Scores
    scale: Scores
    waters: wp.array(dtype=int)
    faces: wp.array(dtype=int)


def make_derivatives(
    kinds: Sequence[str],
    value: Sequence[float],
    scale: Sequence[float],
    *,
    waters: Sequence[int] = (),
    faces: Any = (),
    device: wp.DeviceLike = None,
) -> Derivatives:
    """The parameters of a spec whose `derivatives` are `kinds`; see `Derivatives` for the others.

    Raises `ArgumentError` for a kind that is not one of DERIVATIVES, or a number out of range.
    """
    device, count = check_device("device", device), check_integer("derivatives", len(kinds), 1, MOST_DERIVATIVES)
    if not len(value) == len(scale) == count:
        raise ArgumentError(f"{count} derivatives, {len(value)} values, {len(scale)} scales; one each are needed")
    for p, kind in enumerate(kinds):
        check_choice(f"kinds[{p}]", kind, DERIVATIVES)
        check_number(f"value[{p}], {kind},", value[p], DERIVATIVES[kind])
        check_number(f"scale[{p}]", scale[p], "(0, inf)")
    derivatives = Derivatives()
    rest = [0.0] * (MOST_DERIVATIVES - count)
    derivatives.value, derivatives.scale = Scores(*value, *rest), Scores(*scale, *rest)
    derivatives.waters = wp.array(waters, dtype=int, device=device, shape=len(waters))
    derivatives.faces = wp.array(faces, dtype=int, device=device, shape=len(faces))
    return derivatives


@functools.cache
def make_deposit(count: int) -> wp.Function:
    """The Warp function ``(tally, gradients, ledger, pending, thread, scale, derivatives, c) -> vec2l``:
    `deposit`, which also adds value times score of a contribution to the tally [voxel, derivative] of so many
    derivatives; rounded down after the rounding sample is added, so that the mean is kept."""

    @wp.func
    def deposit_derived(
        tally: wp.array(dtype=wp.int64),
        gradients: wp.array(dtype=wp.int64),
        ledger: wp.array(dtype=wp.int64),
        pending: wp.vec2l,
        thread: int,
        scale: float,
        derivatives: Derivatives,
        c: Contribution,
    ) -> wp.vec2l:
        if wp.static(count > 0):
            if c.index >= 0:
                for p in range(wp.static(count)):
                    units = c.value * c.scores[p] * derivatives.scale[p]
                    if wp.abs(units) <= DEPOSIT_LIMIT:
                        whole = wp.int64(wp.floor(units + c.rounding_sample))
                        if whole != wp.int64(0):
                            atomic_add_int64(gradients, c.index * wp.static(count) + p, whole)
                    else:
                        entry = wp.where(wp.abs(units) > DEPOSIT_LIMIT, CLIPPED, INVALID)
                        add_to_ledger(ledger, thread, entry, wp.int64(1))
        return deposit(tally, ledger, pending, thread, scale, c)

    return deposit_derived
