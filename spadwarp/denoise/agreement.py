"""Depths that agree with those beside them more often than backscatter can: they are a target's, however thin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["agreeing_depths"]

_NEAR = 0.008, 0.02  # parts of the gate within which two depths agree: at least, and at most where they scatter more
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
    with np.errstate(invalid="ignore"):
        error = np.abs(scaled - found)
    scatter = 1.48 * float(np.median(error[error <= _APART])) if (error <= _APART).any() else 0.0
    near = float(np.clip(4.0 * scatter, *_NEAR))
    padded = np.pad(scaled, 1, constant_values=np.nan)
    count = np.zeros(scaled.shape, np.int64)
    with np.errstate(invalid="ignore"):
        for y in range(3):
            for x in range(3):
                if (y, x) != (1, 1):
                    count += np.abs(padded[y : y + height, x : x + width] - scaled) < near
    share = np.count_nonzero(error > _APART) / scaled.size
    chance = np.clip(2.0 * near * density * share, 0.0, 1.0)
    agreeing = count >= 2
    agreeing[agreeing] = bdtrc(count[agreeing] - 1, 8, chance[agreeing]) < _CHANCE
    return agreeing
