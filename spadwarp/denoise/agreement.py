"""Depths that agree with those beside them more often than backscatter can: they are a target's, however thin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["agreeing_depths"]

_NEAR = 0.008  # part of the gate within which two depths agree
_APART = 0.01  # a depth this far from the answer was taken for backscatter
_CHANCE = 5e-5  # highest probability that backscatter agrees as often by chance


def agreeing_depths(
    scaled: NDArray[np.float32], found: NDArray[np.float32], density: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Pixels whose own depth agrees with at least two of the eight around it, where chance does not explain that.

    Surfaces one pixel wide look like backscatter to a network that has to doubt every single depth. Where few pixels
    report backscatter, two that agree by chance are rarer than such a surface.

    Args:
        scaled: Reported depth of a frame over the gate `[H, W]`; NaN where nothing was reported.
        found: The answer over the gate.
        density: Of the backscatter at the reported depths, relative to a flat one over this gate.
    """
    from scipy.special import bdtrc

    height, width = scaled.shape
    padded = np.pad(scaled, 1, constant_values=np.nan)
    count = np.zeros(scaled.shape, np.int64)
    with np.errstate(invalid="ignore"):
        for y in range(3):
            for x in range(3):
                if (y, x) != (1, 1):
                    count += np.abs(padded[y : y + height, x : x + width] - scaled) < _NEAR
        apart = np.abs(scaled - found) > _APART
    share = apart.sum() / scaled.size
    chance = np.clip(2.0 * _NEAR * density * share, 0.0, 1.0)
    agreeing = count >= 2
    agreeing[agreeing] = bdtrc(count[agreeing] - 1, 8, chance[agreeing]) < _CHANCE
    return agreeing
