"""Double precision: constants, and functions that keep their digits where the plain formula cancels."""

import warp as wp

PI = wp.constant(wp.float64(3.141592653589793))
SQRT2 = wp.constant(wp.float64(1.4142135623730951))
SQRT_2PI = wp.constant(wp.float64(2.5066282746310002))
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))


@wp.func
def expm1(x: wp.float64) -> wp.float64:
    """exp(x) − 1 without cancellation: relative error below 1e-13."""
    if wp.abs(x) > wp.float64(0.01):
        return wp.exp(x) - wp.float64(1.0)
    series = wp.float64(1.0) + x * (
        wp.float64(1.0 / 2.0) + x * (wp.float64(1.0 / 6.0) + x * (wp.float64(1.0 / 24.0) + x * wp.float64(1.0 / 120.0)))
    )
    return x * series


@wp.func
def log1p(x: wp.float64) -> wp.float64:
    """ln(1 + x) without cancellation (Kahan's correction)."""
    y = wp.float64(1.0) + x
    if y == wp.float64(1.0):
        return x
    return x * wp.log(y) / (y - wp.float64(1.0))


@wp.func
def normal_cdf(z: wp.float64) -> wp.float64:
    """Probability below z of the normal distribution."""
    return HALF * wp.erfc(-z / SQRT2)


@wp.func
def one_minus_exp(x: wp.float64) -> wp.float64:
    """1 - exp(-x) for x >= 0 without cancellation."""
    if x < wp.float64(1.0e-4):
        return x * (ONE - x * (HALF - x / wp.float64(6.0)))
    return ONE - wp.exp(-x)
