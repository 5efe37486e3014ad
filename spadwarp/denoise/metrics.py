"""Scores of a denoised frame: as an image (8 bits over the gate), and as a measurement (millimetres)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from spadwarp.values import ArgumentError

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
    """Scores of one frame, over the pixels that see a target.

    Attributes:
        psnr: Of depth scaled to 8 bits over the gate [dB]; 100 where no pixel differs.
        ssim: Structural similarity of the same, 11 × 11 Gaussian window of σ = 1.5 (Wang et al., IEEE TIP 13, 600,
            2004); pixels without a target are white in both images.
        entropy: Shannon entropy of the denoised image [bit].
        rmse_mm: Root mean square error of depth [mm].
        within_1cm, within_5cm: Part of the pixels whose error is below 1 cm and 5 cm.
        edge_mm: Mean absolute error within two pixels of an edge of the truth, a jump over 5 cm [mm]; else NaN.
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
        """Mean of each field, without NaN."""
        means = {}
        for field in fields(cls):
            values = np.array([getattr(score, field.name) for score in scores])
            means[field.name] = float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
        return cls(**means)


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
    """Pixels near a jump of the true depth, or near the border of the target."""
    from scipy.ndimage import binary_dilation

    filled = np.where(seen, clean, np.float32(1e3))
    jump = np.zeros(clean.shape, bool)
    for filled_rows, rows in ((filled, jump), (filled.T, jump.T)):
        step = np.abs(np.diff(filled_rows, axis=0)) > _EDGE
        rows[:-1] |= step
        rows[1:] |= step
    return binary_dilation(jump, iterations=_NEAR_EDGE - 1) & seen


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Steps of about 10 cm between neighbouring faces: their number, and how many a frame resolves to ± 3 cm."""

    total: int = 0
    resolved: int = 0

    def __add__(self, other: Steps) -> Steps:
        return Steps(total=self.total + other.total, resolved=self.resolved + other.resolved)


def staircase_steps(clean: NDArray[np.float32], estimate: NDArray[np.float32]) -> Steps:
    """Counts neighbouring faces whose medians differ by 10 ± 3 cm in the truth, and by that ± 3 cm in the estimate.

    Faces are the connected parts of the true depth between jumps of more than 2.5 cm, of at least 100 pixels; two are
    neighbours if they are within eight pixels of each other.
    """
    from scipy.ndimage import binary_dilation, label

    seen = np.isfinite(clean)
    filled = np.where(seen, clean, np.float32(-1e3))
    flat = seen.copy()
    for values, rows in ((filled, flat), (filled.T, flat.T)):
        rows[:-1] &= np.abs(np.diff(values, axis=0)) < 0.025
    faces, count = label(flat)
    masks = [faces == number for number in range(1, count + 1)]
    masks = [mask for mask in masks if mask.sum() >= 100]
    grown = [binary_dilation(mask, iterations=4) for mask in masks]
    estimate = np.nan_to_num(estimate, nan=0.0)
    total = resolved = 0
    for (first, near), (second, also_near) in combinations(zip(masks, grown, strict=True), 2):
        true_step = float(np.median(clean[first]) - np.median(clean[second]))
        if 0.07 <= abs(true_step) <= 0.13 and (near & also_near).any():
            step = float(np.median(estimate[first]) - np.median(estimate[second]))
            total += 1
            resolved += abs(step - true_step) <= 0.03
    return Steps(total=total, resolved=resolved)
