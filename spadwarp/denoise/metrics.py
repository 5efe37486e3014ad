"""How good a denoised frame is: for eyes (8 bits over the gate), and for those who measure (millimetres)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError

__all__ = ["LARGER_IS_BETTER", "Scores", "Steps", "score", "staircase_steps"]

_EDGE = 0.05  # a jump of depth between neighbours that is an edge [m]
_NEAR_EDGE = 2  # pixels to each side that belong to it

LARGER_IS_BETTER = {
    "psnr": True,
    "ssim": True,
    "rmse_mm": False,
    "within_1cm": True,
    "within_5cm": True,
    "edge_mm": False,
}
"""Scores in which methods can be ranked."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Of one frame, over the pixels that see a target.

    Attributes:
        psnr: Of depth scaled to 8 bits over the gate [dB]; 100 where not a pixel differs.
        ssim: Structural similarity of the same, 11 × 11 Gaussian window of σ = 1.5 (Wang et al., IEEE TIP 13, 600,
            2004); what sees no target is white in both images.
        entropy: Shannon entropy of the denoised image [bit].
        rmse_mm: Root mean square error of depth [mm].
        within_1cm, within_5cm: Part of the pixels whose error is below.
        edge_mm: Mean absolute error within two pixels of an edge of the truth, a jump over 5 cm [mm]; NaN without.
    """

    psnr: float
    ssim: float
    entropy: float
    rmse_mm: float
    within_1cm: float
    within_5cm: float
    edge_mm: float

    @classmethod
    def mean(cls, scores: list[Scores]) -> Scores:
        """Field by field, NaN aside."""
        columns = {one.name: np.array([getattr(score, one.name) for score in scores]) for one in fields(cls)}
        return cls(
            **{
                name: float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
                for name, values in columns.items()
            }
        )


def score(clean: NDArray[np.float32], estimate: NDArray[np.float32], *, gate: tuple[float, float]) -> Scores:
    """Scores of a denoised frame.

    Args:
        clean: True depth `[H, W]` [m]; NaN where nothing is hit.
        estimate: Depth `[H, W]` [m]; NaN counts as the end of the gate.
        gate: (start, stop) over which 8 bits are scaled [m].

    Raises:
        ArgumentError: Shapes that differ, or no target in the frame within the gate.
    """
    from skimage.measure import shannon_entropy
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    if clean.shape != estimate.shape or clean.ndim != 2:
        raise ArgumentError(f"estimate has shape {estimate.shape}; {clean.shape} is needed")
    start, stop = gate
    seen = np.isfinite(clean) & (clean >= start) & (clean < stop)
    if not seen.any():
        raise ArgumentError(f"no pixel sees a target within {start:g} to {stop:g} m")
    estimate = np.nan_to_num(estimate, nan=stop)

    def eight_bits(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
        scaled = np.clip((np.where(seen, depth, stop) - start) / (stop - start), 0.0, 1.0)
        return np.round(255.0 * scaled).astype(np.uint8)

    truth, image = eight_bits(clean), eight_bits(estimate)
    same = np.array_equal(truth[seen], image[seen])
    psnr = 100.0 if same else float(peak_signal_noise_ratio(truth[seen], image[seen], data_range=255))
    side = min(truth.shape)
    _, similarity = structural_similarity(
        truth, image, data_range=255, full=True, sigma=1.5, gaussian_weights=side >= 11, use_sample_covariance=False,
        **({} if side >= 11 else {"win_size": side - 1 + side % 2}),
    )  # fmt: skip
    error = np.abs(estimate.astype(np.float64) - clean)[seen]
    edge = _edges(clean, seen)[seen]
    return Scores(
        psnr=psnr,
        ssim=float(similarity[seen].mean()),
        entropy=float(shannon_entropy(image)),
        rmse_mm=1e3 * float(np.sqrt(np.mean(error**2))),
        within_1cm=float(np.mean(error < 0.01)),
        within_5cm=float(np.mean(error < 0.05)),
        edge_mm=1e3 * float(error[edge].mean()) if edge.any() else float("nan"),
    )


def _edges(clean: NDArray[np.float32], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels near a jump of the true depth, or near the rim of the target."""
    from scipy.ndimage import binary_dilation

    filled = np.where(seen, clean, np.float32(1e3))
    jump = np.zeros(clean.shape, bool)
    for axis in (0, 1):
        step = np.abs(np.diff(filled, axis=axis)) > _EDGE
        first, second = np.swapaxes(jump, 0, axis)[:-1], np.swapaxes(jump, 0, axis)[1:]
        rows = np.swapaxes(step, 0, axis)
        first |= rows
        second |= rows
    return binary_dilation(jump, iterations=_NEAR_EDGE - 1) & seen


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Steps of about 10 cm between neighbouring faces: how many there are, and how many a frame resolves to ± 3 cm."""

    total: int
    resolved: int


def staircase_steps(clean: NDArray[np.float32], estimate: NDArray[np.float32]) -> Steps:
    """Counts neighbouring faces whose medians differ by 10 ± 3 cm in the truth, and by that ± 3 cm in the estimate.

    Faces are the connected parts of the true depth between jumps of more than 2.5 cm, of 100 pixels at least; two are
    neighbours if they come within eight pixels of each other.
    """
    from scipy.ndimage import binary_dilation, label

    seen = np.isfinite(clean)
    filled = np.where(seen, clean, np.float32(-1e3))
    flat = seen.copy()
    for axis in (0, 1):
        calm = np.abs(np.diff(filled, axis=axis)) < 0.025
        widths = [(0, 0), (0, 0)]
        widths[axis] = (0, 1)
        flat &= np.pad(calm, widths, constant_values=True)
    faces, count = label(flat)
    members = [faces == number for number in range(1, count + 1)]
    members = [one for one in members if one.sum() >= 100]
    estimate = np.nan_to_num(estimate, nan=0.0)
    grown = [binary_dilation(one, iterations=4) for one in members]
    total = resolved = 0
    for i, first in enumerate(members):
        for j in range(i + 1, len(members)):
            true_step = float(np.median(clean[first]) - np.median(clean[members[j]]))
            if 0.07 <= abs(true_step) <= 0.13 and (grown[i] & grown[j]).any():
                step = float(np.median(estimate[first]) - np.median(estimate[members[j]]))
                total += 1
                resolved += abs(step - true_step) <= 0.03
    return Steps(total=total, resolved=resolved)
