"""Classical estimates of depth from histograms: the likelihood of pixels, of pooled pixels, and of whole frames.

All see the same data as the network for histograms: counts, the expected background and the instrument response.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.denoise.histogram_inputs import histogram_tensors
from spadwarp.denoise.network_files import require_torch
from spadwarp.errors import ArgumentError
from spadwarp.limits import check_real

__all__ = ["CLASSICAL", "TUNINGS", "Classical", "classical_depth"]

Classical = Literal["likelihood", "pooled", "semi-global", "total-variation", "belief-propagation"]

CLASSICAL: tuple[Classical, ...] = get_args(Classical)
"""Classical estimates from histograms."""

TUNINGS: dict[str, tuple[Any, ...]] = {
    "likelihood": (1,),
    "pooled": (3, 5, 7, 11, 15),
    "semi-global": (5.0, 10.0, 20.0, 40.0),
    "total-variation": (0.5, 1.0, 2.0, 4.0),
    "belief-propagation": (2.5, 4.0, 8.0, 16.0),
}
"""Tuned values: sides of the window [pixels], penalties of a jump [nats], strengths."""


def classical_depth(
    counts: ArrayLike,
    *,
    background: ArrayLike,
    response: ArrayLike,
    method: Classical,
    tuning: float | None = None,
    device: str | None = None,
) -> NDArray[np.float32]:
    """Depth over the gate, `[N, H, W]`, 0 at its start and 1 at its end.

    `"likelihood"`: of each pixel alone. `"pooled"`: of windows of pixels. `"semi-global"`:
    `spadwarp.denoise.classical` on the likelihoods. `"total-variation"`: of the likelihood depth, each pixel weighted
    by how far its likelihood stands out. `"belief-propagation"`: `spadwarp.denoise.classical` on the
    likelihoods, the strongest of these in most cases.

    Args:
        counts: `[H, W, T]` or `[N, H, W, T]`, not negative.
        background: Expected background counts, the same for all pixels `[T]`, or of each pixel `[H, W, T]`.
        response: Instrument response per bin centred on its time zero, `[2 r + 1]`.
        method: One of `CLASSICAL`.
        tuning: Above 0, see `TUNINGS`; default: 7 pixels, `usual_jump`, strength 1, a penalty of 4 nats.
        device: torch device.

    Raises:
        ArgumentError: A method that does not exist; shapes or values that cannot be.
    """
    if method not in CLASSICAL:
        raise ArgumentError(f"method = {method!r} is not one of {', '.join(map(repr, CLASSICAL))}")
    tuning = None if tuning is None else check_real("tuning", tuning, "(0, inf)")
    if method == "pooled" and tuning is not None and tuning % 2 != 1:
        raise ArgumentError(f"tuning = {tuning:g} is not an odd number of pixels, such as {TUNINGS[method]}")
    torch = require_torch()
    from spadwarp.denoise.classical import JUMPS, aggregate, beliefs, total_variation, usual_jump
    from spadwarp.denoise.histogram_features import highest, log_likelihood, pooled

    found = []
    with torch.inference_mode():
        for cube, level, tap in histogram_tensors(counts, background, response, device):
            score = log_likelihood(cube, level, tap)
            if method == "pooled":
                score = pooled(score, int(tuning or 7))
            elif method == "semi-global":
                jump = usual_jump(score)
                score = aggregate(score, jump=jump if tuning is None else torch.full_like(jump, tuning))
            elif method == "belief-propagation":
                score = beliefs(score, score.new_full((1, 1, 1, 1), JUMPS[0] if tuning is None else tuning))
            depth = highest(score)
            if method == "total-variation":
                weight = score.amax(dim=-1).clamp(0.0, 20.0)
                weight /= weight.mean().clamp_min(1e-9)
                depth = total_variation(depth, weight, strength=tuning or 1.0)
            found.append(depth[0].cpu().numpy())
    return np.stack(found).astype(np.float32)
