"""The analytic model in plain NumPy: photon budget, Fisher information, maximum-likelihood delays by Monte Carlo.

Equation numbers are those of *A Simulation Method for Underwater SPAD Depth Imaging Datasets*, Sensors 24, 3886 (2024).
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

PLANCK_TIMES_C = 6.626_070_15e-34 * 299_792_458.0


# The paper's photon budget; arguments as there: R range, c extinction, W and H effective sides of a pixel.


def eq3(E0: float, c: float, R: float, tan_theta: float) -> float:
    return E0 * math.exp(-c * R) / (math.pi * R**2 * tan_theta**2)


def eq4(rho: float, R: float, W: float, H: float, f: float) -> float:
    return rho * R**2 * W * H / f**2


def eq5(E1: float, reflectance: float, c: float, R: float) -> float:
    return reflectance * E1 * math.exp(-c * R) / (2 * math.pi * R**2)


def eq6(E2: float, q: float, f: float, f_number: float) -> float:
    return q * E2 * math.pi * (f / (2 * f_number)) ** 2


def eq7(
    E0: float, wavelength: float, pde: float, reflectance: float, c: float, R: float, pitch: float, f_number: float,
    tan_theta: float, K: float = 8.0,
) -> float:  # fmt: skip
    photons = E0 * wavelength / PLANCK_TIMES_C
    footprint = math.pi * R**2 * tan_theta**2
    return photons * pde * reflectance * math.exp(-2 * c * R) * pitch**2 / (K * f_number**2 * footprint)


# Information


def pulse(t: ArrayLike, mu: float, sigma: float) -> NDArray[np.float64]:
    z = (np.asarray(t) - mu) / sigma
    return np.exp(-0.5 * z * z) / (math.sqrt(2 * math.pi) * sigma)


def fisher_per_photon(signal: float, background: float, mu: float, sigma: float, window: tuple[float, float]) -> float:
    """Eq 9 by a dense midpoint rule over the part of the window within 14 σ of the pulse; `background` is a rate."""
    low, high = max(window[0], mu - 14 * sigma), min(window[1], mu + 14 * sigma)
    if high <= low:
        return 0.0
    nodes = 200_000
    step = (high - low) / nodes
    t = low + (np.arange(nodes) + 0.5) * step
    shape = signal * pulse(t, mu, sigma)
    slope = shape * (t - mu) / sigma**2
    with np.errstate(invalid="ignore"):
        information = np.nansum(slope**2 / (shape + background)) * step
    return float(information / alpha(signal, background, mu, sigma, window))


def alpha(signal: float, background: float, mu: float, sigma: float, window: tuple[float, float]) -> float:
    """Integral of eq 8 over the window."""
    cdf = [0.5 * math.erfc(-(edge - mu) / (sigma * math.sqrt(2))) for edge in window]
    return signal * (cdf[1] - cdf[0]) + background * (window[1] - window[0])


def binned_signal(edges: NDArray[np.float64], mu: float, sigma: float) -> NDArray[np.float64]:
    """Share of a Gaussian pulse in each bin."""
    return np.diff([0.5 * math.erfc(-(edge - mu) / (sigma * math.sqrt(2))) for edge in edges])


# Maximum likelihood


def likelihood_errors(
    signal_counts: float, level: float, window: float, trials: int, *, seed: int, bin_width: float = 0.1
) -> NDArray[np.float64]:
    """Errors of the maximum-likelihood delay in units of σ, known signal and background, `[trials]`.

    Poisson counts in bins of `bin_width` σ over a window of so many σ: `signal_counts` of the return, whose delay is
    uniform about the middle, and `level` background counts per σ. A parabola refines the delay of the highest score.
    """
    rng = np.random.default_rng(seed)
    bins = round(window / bin_width)
    reach = round(8 / bin_width)
    z = np.arange(-reach, reach + 1) * bin_width
    weight = np.log1p(signal_counts / (level * math.sqrt(2 * math.pi)) * np.exp(-0.5 * z * z))
    size = 1 << math.ceil(math.log2(bins + 2 * reach))
    response = np.fft.rfft(weight, size)
    errors = []
    batch = max(1, 2_000_000 // size)
    for start in range(0, trials, batch):
        count = min(batch, trials - start)
        counts = rng.poisson(level * bin_width, (count, bins)).astype(float)
        mu = window / 2 + rng.uniform(-5, 5, count)
        for row, delay in zip(counts, mu, strict=True):
            hits = (delay + rng.standard_normal(rng.poisson(signal_counts))) / bin_width
            np.add.at(row, hits[(hits >= 0) & (hits < bins)].astype(int), 1)
        score = np.fft.irfft(np.fft.rfft(counts, size, axis=1) * response, size, axis=1)[:, reach : reach + bins]
        best = np.clip(np.argmax(score, axis=1), 1, bins - 2)
        left, top, right = (score[np.arange(count), best + shift] for shift in (-1, 0, 1))
        bend = left - 2 * top + right
        shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, 1), 0.0)
        errors.append((best + 0.5 + np.clip(shift, -0.5, 0.5)) * bin_width - mu)
    return np.concatenate(errors)
