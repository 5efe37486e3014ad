"""Weighted total variation of a depth map: min over d of Σ w |d − d₀| + λ TV(d), by primal-dual steps.

Rudin, Osher & Fatemi, Physica D 60, 259 (1992), with the L1 norm of Chan & Esedoḡlu, SIAM J. Appl. Math. 65, 1817
(2005), which leaves outliers behind; solved as Chambolle & Pock, J. Math. Imaging Vision 40, 120 (2011).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["STRENGTHS", "total_variation"]

STRENGTHS = (0.5, 1.0, 2.0, 4.0)
"""Values of λ that are tried."""


def total_variation(
    depth: NDArray[np.float32], weight: NDArray[np.float32], *, strength: float = 1.0, iterations: int = 300
) -> NDArray[np.float32]:
    """The smoothed map `[H, W]`.

    Args:
        depth: d₀ `[H, W]`, any unit; finite.
        weight: w of each pixel `[H, W]`, ≥ 0; 0 where nothing was reported.
        strength: λ.
        iterations: Primal-dual steps.
    """
    low, high = float(depth.min()), float(depth.max())
    scale = max(high - low, 1e-12)
    data = ((depth - low) / scale).astype(np.float64)
    found, ahead = data.copy(), data.copy()
    flow = np.zeros((2, *depth.shape))
    step = 0.35
    for _ in range(iterations):
        flow[0, :-1] += step * np.diff(ahead, axis=0)
        flow[1, :, :-1] += step * np.diff(ahead, axis=1)
        flow /= np.maximum(1.0, np.hypot(*flow) / strength)
        back = flow.sum(axis=0)
        back[1:] -= flow[0, :-1]
        back[:, 1:] -= flow[1, :, :-1]
        moved = found + step * back
        apart = moved - data
        new = data + np.sign(apart) * np.maximum(np.abs(apart) - step * weight, 0.0)
        ahead = 2.0 * new - found
        found = new
    return (low + scale * found).astype(np.float32)
