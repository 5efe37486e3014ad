"""Counts at a quantile."""

import warp as wp


@wp.func
def count_quantile(z: float, pulses: float, alpha: float) -> float:
    """The count of Binomial(pulses, 1 − exp(−alpha)) at the normal quantile z.

    Below a mean of 8 by inversion; above it by the Cornish–Fisher expansion to the skewness, whose error in the
    distribution function is below 0.2 % there.
    """
    p = 1.0 - wp.exp(-alpha)
    if alpha < 1.0e-3:
        p = alpha * (1.0 - 0.5 * alpha)
    mean = pulses * p
    if mean >= 8.0:
        spread = wp.sqrt(mean * (1.0 - p))
        x = mean + spread * z + (1.0 - 2.0 * p) * (z * z - 1.0) / 6.0
        return wp.clamp(wp.floor(x + 0.5), 0.0, pulses)
    rest = 0.5 * wp.erfc(-z * 0.7071067811865476)
    probability = wp.exp(-pulses * alpha)
    count = float(0.0)
    while rest > probability and count < pulses and count < 64.0:
        rest = rest - probability
        count = count + 1.0
        probability = probability * p / (1.0 - p) * (pulses + 1.0 - count) / count
    return count
