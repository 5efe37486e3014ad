"""The way from a rough start: pixels added up in blocks, and an exponential model of each cell between two renderings.

A histogram in water is nearly an exponential of its unknowns: of absorption times path, of the logarithm of a
reflectance. Steps of Newton's method, which takes it for a straight line, overshoot or stall from starts that are wrong
by factors; here the likelihood of the exponential model is maximised, within bounds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spadwarp.inverse.equations import Law
from spadwarp.inverse.rendering import Half

__all__ = ["Cells", "blocks_of", "coarse_step", "in_cells"]

Floats = NDArray[np.float64]

_ACROSS = 4  # blocks along each side of the image; more of them are noisier


class Cells:
    """Counts, their mean and its relative derivatives in blocks of pixels, float64 `[block, bin]`."""

    def __init__(self, counts: Floats, mean: Floats, slopes: Floats) -> None:
        self.counts, self.mean, self.slopes = counts, mean, slopes


def blocks_of(image: tuple[int, int]) -> NDArray[np.intp]:
    """The block of each pixel, `[pixel]`."""
    rows, columns = (np.arange(size) * min(_ACROSS, size) // size for size in image)
    return (rows[:, None] * (columns[-1] + 1) + columns).reshape(-1)


def in_cells(law: Law, half: Half, trials: NDArray, counts: NDArray, scales: Floats, blocks: NDArray) -> Cells:
    """The cells of a rendering; `scales` `[unknown]` are the units of the unknowns."""
    number = int(blocks.max()) + 1
    shape = (number, law.recorded)
    observed, mean = np.zeros(shape), np.zeros(shape)
    slopes = np.zeros((number, len(scales), law.recorded))
    order = np.argsort(blocks, kind="stable")
    for chosen in np.split(order, np.flatnonzero(np.diff(blocks[order])) + 1):
        block = blocks[chosen[0]]
        own = np.ascontiguousarray(half.slopes[:, chosen].transpose(1, 0, 2))
        observed[block] = counts[chosen].sum(axis=0)
        mean[block] = law.mean(half.rates[chosen], trials[chosen]).sum(axis=0)
        slopes[block] = law.slopes(half.rates[chosen], own, trials[chosen]).sum(axis=0) * scales[:, None]
    mean += 1e-3  # of a count: a cell that no photon has reached can still have one
    limits = half.limits[:, None] * scales[:, None]
    return Cells(observed, mean, np.clip(slopes / mean[:, None], -limits, limits))


def coarse_step(cells: Cells, largest: Floats, pull: Floats, prior: Floats) -> tuple[Floats, Floats]:
    """Step of the unknowns within ± `largest` `[unknown]` that maximises the likelihood, and its standard errors.

    The exponential model: means times exp(Σ relative derivative · step). `prior`, `pull`: information and score from
    elsewhere.
    """
    from scipy.optimize import minimize

    unknowns = cells.slopes.shape[1]
    slopes = cells.slopes.transpose(0, 2, 1).reshape(-1, unknowns)
    mean, counts = cells.mean.reshape(-1), cells.counts.reshape(-1)
    linear = counts @ slopes + pull
    total = max(counts.sum(), 1.0)

    def loss(step: Floats) -> tuple[float, Floats]:
        expected = mean * np.exp(np.minimum(slopes @ step, 60.0))
        value = expected.sum() - linear @ step + 0.5 * (prior * step * step).sum()
        return value / total, (expected @ slopes - linear + prior * step) / total

    bounds = [(-size, size) for size in largest]
    found = minimize(loss, np.zeros(unknowns), jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-12})
    expected = mean * np.exp(np.minimum(slopes @ found.x, 60.0))
    information = (slopes * expected[:, None]).T @ slopes + np.diag(prior)
    variance = np.diag(np.linalg.pinv(information))
    return found.x, np.sqrt(np.maximum(variance, 0.0))
