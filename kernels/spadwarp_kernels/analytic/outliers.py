"""How often a fit reports background instead of the target: where the Cramér–Rao bound is out of reach."""

import warp as wp

from spadwarp_kernels.base.arguments import check_array
from spadwarp_kernels.base.kernels import launch_pixels
from spadwarp_kernels.base.native import HALF, ONE, PI, SQRT_2PI, TWO, ZERO, one_minus_exp

__all__ = ["outlier_probabilities"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def outlier_probability(signal_count: wp.float64, level: wp.float64, window: wp.float64) -> wp.float64:
    """Probability that the maximum-likelihood delay locks on background counts, more than 4 sigma from the truth.

    The score of a delay is the sum over counts of g(z) = ln(1 + r exp(-z^2/2)), a Poisson shot noise. K(s) is the
    cumulant function of its background part; the score at the true delay has the same law tilted to s = 1. Rice's
    formula with the saddlepoint density gives the mean number of upcrossings of x = K'(s) over the window, and
    P = E[1 - exp(-upcrossings of the true delay's score)].
    What first order leaves out: 1/sqrt(1 + s) is the gain of the score by the fit's freedom (half a chi^2 of one
    degree), and 1 - 0.18 b/(b + 0.2), for crossings that come in clusters, is fitted to Monte Carlo.

    Args:
        signal_count: Expected signal counts of the whole acquisition.
        level: Expected background counts per sigma, b.
        window: Gate over sigma.
    """
    # A fit that knows nothing is anywhere in the window.
    blind = wp.max(ONE - wp.float64(8.0) / window, ZERO)
    if signal_count <= ZERO:
        return blind
    if level <= ZERO:
        return ZERO
    ratio = signal_count / (level * SQRT_2PI)
    reach = wp.max(wp.sqrt(TWO * wp.log(ONE + ratio)) + wp.float64(3.5), wp.float64(5.0))
    h = reach / wp.float64(24.0)
    spread = wp.float64(0.0)
    half_way = wp.float64(0.0)
    for j in range(25):
        z = wp.float64(j) * h
        e = ratio * wp.exp(-HALF * z * z)
        g = wp.log(ONE + e)
        w = wp.where(j == 0, ONE, TWO)
        spread += w * (ONE + e) * g * g
        half_way += w * (wp.sqrt(ONE + e) - ONE)
    # Signal and background scores overlap most at s = 1/2: exp(2 K(1/2) - K(1)) bounds the probability.
    if TWO * level * h * half_way - signal_count + wp.log(window) < wp.float64(-60.0):
        return ZERO
    width = wp.float64(7.0) / wp.sqrt(level * h * spread)
    low = wp.max(ONE - width, -ONE)
    high = wp.min(ONE + width, wp.float64(3.0))
    step = (high - low) / wp.float64(32.0)
    clusters = wp.max(window - wp.float64(8.0), ZERO) * (ONE - wp.float64(0.18) * level / (level + wp.float64(0.2)))
    mass = wp.float64(0.0)
    lost = wp.float64(0.0)
    most = wp.float64(0.0)
    # From high scores to low ones, so that the number of crossings can be kept from falling below the mean score.
    for n in range(33):
        s = high - wp.float64(n) * step
        k0 = wp.float64(0.0)
        k1 = wp.float64(0.0)
        k2 = wp.float64(0.0)
        slope = wp.float64(0.0)
        for j in range(25):
            z = wp.float64(j) * h
            e = ratio * wp.exp(-HALF * z * z)
            g = wp.log(ONE + e)
            w = wp.where(j == 0, ONE, TWO)
            tilt = wp.exp(s * g)
            dg = z * e / (ONE + e)
            k0 += w * (tilt - ONE)
            k1 += w * tilt * g
            k2 += w * tilt * g * g
            slope += w * tilt * dg * dg
        k0 *= level * h
        k1 *= level * h
        k2 *= level * h
        slope *= level * h
        log_density = k0 - s * k1 - HALF * wp.log(TWO * PI * k2)
        crossings = clusters * wp.exp(wp.min(log_density, wp.float64(50.0))) * wp.sqrt(slope / (TWO * PI))
        most = wp.max(most, crossings / wp.sqrt(ONE + wp.max(s, ZERO)))
        weight = k2 * wp.exp(wp.min(log_density + k1 - signal_count, wp.float64(50.0)))
        mass += weight
        lost += weight * one_minus_exp(most)
    if not (mass > ZERO):
        return blind  # too faint for the sums
    return wp.min(lost / mass, blind)


@wp.kernel
def _outliers(
    first: int,
    signal_count: wp.array(dtype=wp.float64),
    level: wp.array(dtype=wp.float64),
    window: wp.array(dtype=wp.float64),
    # Out:
    probability: wp.array(dtype=wp.float64),
):
    """Launch grid: elements."""
    i = first + wp.tid()
    probability[i] = outlier_probability(signal_count[i], level[i], window[i])


def outlier_probabilities(signal_count: wp.array, level: wp.array, window: wp.array) -> wp.array:
    """`outlier_probability` of every element: float64 arrays of one length in and out."""
    check_array("signal_count", signal_count, wp.float64, (None,))
    for name, array in {"level": level, "window": window}.items():
        check_array(name, array, wp.float64, signal_count.shape, signal_count.device)
    out = wp.empty(signal_count.shape[0], dtype=wp.float64, device=signal_count.device)
    launch_pixels(_outliers, signal_count.shape[0], [signal_count, level, window, out], device=signal_count.device)
    return out
