"""Derivatives of the histogram: what they are with respect to, and their tallies in fixed point, which have signs.

The derivative of a contribution is the contribution times the derivative of the logarithm of what the light has met:
flights, scatterings, bounces (the score function or likelihood ratio method; Glynn 1990).
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

from .blocks import Blocks
from .tally import LogDerivatives

__all__ = ["DERIVATIVES", "MOST_DERIVATIVES", "Derivatives", "make_derivatives"]

# What a derivative may be with respect to, and the range of such a parameter: a at fixed b, b at fixed a, the mean
# cosine g of Henyey and Greenstein's phase function, and a reflectance or a factor on one that varies.
DERIVATIVES = {"absorption": "[0, inf)", "scattering": "(0, inf)", "anisotropy": "(-1, 1)", "reflectance": "(0, inf)"}

MOST_DERIVATIVES = len(LogDerivatives())


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

    value: LogDerivatives
    scale: LogDerivatives
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
    derivatives.value = LogDerivatives(*value, *[0.0] * (MOST_DERIVATIVES - count))
    derivatives.scale = LogDerivatives(*scale, *[0.0] * (MOST_DERIVATIVES - tallies))
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
