"""Exact binomial counts from Philox, in float64.

The success probability is given as a hazard: p = 1 − exp(−hazard), the chance of at least one event in a Poisson
process of that mean. Small p keeps all its digits, and so does 1 − p where p is near 1.
"""

import warp as wp

from .native import HALF, ONE, TWO, ZERO, expm1, log1p
from .philox import STREAM_DETECTOR, random_block

wp.set_module_options({"enable_backward": False})

# Purposes of a detector's random numbers, each with blocks of its own. A new random number takes the next one (to 15),
# so that the counts of the others keep their bits.
PURPOSE_COUNTS = wp.constant(wp.uint32(0))  # first-photon counts
PURPOSE_EVENTS = wp.constant(wp.uint32(1))  # detections one by one: the next photon or dark count, the next afterpulse
PURPOSE_DARK_COUNTS = wp.constant(wp.uint32(2))  # dark count rate of a pixel

_PURPOSE_SHIFT = wp.constant(wp.uint32(28))
_LN2 = wp.constant(wp.float64(0.6931471805599453))  # hazard of p = 1/2

_vec10d = wp.types.vector(length=10, dtype=wp.float64)
# ln k! minus Stirling's formula, k = 0 … 9 (Hörmann 1993).
_STIRLING_REST = wp.constant(
    _vec10d(
        0.08106146679532726,
        0.04134069595540929,
        0.02767792568499834,
        0.02079067210376509,
        0.01664469118982119,
        0.01387612882307075,
        0.01189670994589177,
        0.01041126526197209,
        0.009255462182712733,
        0.008330563433362871,
    )
)


@wp.func
def uniforms(seed: wp.uint64, id: wp.uint64, purpose: wp.uint32, block: wp.uint32) -> wp.vec2d:
    """Two float64 uniforms in [0, 1) on the grid k / 2^53; `purpose` (PURPOSE_…) and `block` (< 2^28) name the draw."""
    words = random_block(seed, id, (purpose << _PURPOSE_SHIFT) | block, STREAM_DETECTOR)
    scale = wp.float64(1.1102230246251565e-16)
    high = wp.float64(67108864.0)
    return wp.vec2d(
        (wp.float64(words[0] >> wp.uint32(5)) * high + wp.float64(words[1] >> wp.uint32(6))) * scale,
        (wp.float64(words[2] >> wp.uint32(5)) * high + wp.float64(words[3] >> wp.uint32(6))) * scale,
    )


@wp.func
def _stirling_rest(k: wp.float64) -> wp.float64:
    if k < wp.float64(9.5):
        return _STIRLING_REST[int(k)]
    x = ONE / (k + ONE)
    y = x * x
    return (wp.float64(1.0 / 12.0) - (wp.float64(1.0 / 360.0) - y * wp.float64(1.0 / 1260.0)) * y) * x


@wp.func
def _inversion(n: wp.float64, hazard: wp.float64, u: wp.float64) -> wp.float64:
    # Sequential search from 0: P(0) = exp(-n hazard), P(k) / P(k - 1) = (n + 1 - k) / k * p / q, both sides times k! so
    # that nothing is divided. Of means below 10, none ends above 100.
    odds = expm1(hazard)
    probability = wp.exp(-n * hazard)
    rest = wp.float64(u)
    count = wp.float64(0.0)
    last = wp.min(n, wp.float64(100.0))
    while rest > probability and count < last:
        count = count + ONE
        rest = (rest - probability) * count
        probability = probability * odds * (n + ONE - count)
    return count


@wp.func
def _rest(x: float) -> float:
    """As `_stirling_rest`, of 1 / (k + 1); 1e-5 for k >= 1."""
    y = x * x
    return (1.0 / 12.0 - (1.0 / 360.0 - y * (1.0 / 1260.0)) * y) * x


@wp.func
def _log_ratio(k: wp.float64, mode: wp.float64, trials: wp.float64, p: wp.float64, q: wp.float64) -> float:
    """ln of the probability of k over that of the mode, in float32: what cancels in the large terms is left out."""
    shift = float(k - mode)
    x = 1.0 / float(mode + ONE)
    y = 1.0 / float(trials - mode + ONE)
    part = float(((trials + ONE) * p - mode) / q) - 1.0
    value = shift * log1p(part * x) - float(k + HALF) * log1p(shift * x) - float(trials - k + HALF) * log1p(-shift * y)
    return value + _rest(x) - _rest(1.0 / float(k + ONE)) + _rest(y) - _rest(1.0 / float(trials - k + ONE))


@wp.func
def _exact_log_ratio(k: wp.float64, mode: wp.float64, trials: wp.float64, odds: wp.float64) -> wp.float64:
    return (
        (mode + HALF) * wp.log((mode + ONE) / (odds * (trials - mode + ONE)))
        + _stirling_rest(mode)
        + _stirling_rest(trials - mode)
        + (trials + ONE) * wp.log((trials - mode + ONE) / (trials - k + ONE))
        + (k + HALF) * wp.log(odds * (trials - k + ONE) / (k + ONE))
        - _stirling_rest(k)
        - _stirling_rest(trials - k)
    )


@wp.func
def binomial(
    n: int, hazard: wp.float64, seed: wp.uint64, id: wp.uint64, purpose: wp.uint32, first_block: wp.uint32
) -> tuple[int, wp.uint32]:
    """A count from Binomial(n, 1 − exp(−hazard)) and the first random block that it has not used.

    n in [0, 2^31), hazard in [0, inf]. Inversion while the mean (of the rarer outcome) is below 10, above it
    transformed rejection with squeeze, BTRS: W. Hörmann, "The generation of binomial random variates", J. Stat. Comput.
    Simul. 46, 101 (1993).
    """
    block = wp.uint32(first_block)
    if n <= 0 or hazard <= ZERO:
        return 0, block
    trials = wp.float64(n)
    swapped = hazard > _LN2
    rate = wp.float64(hazard)
    if swapped:
        rate = -log1p(-wp.exp(-hazard))  # of the failures
    p = -expm1(-rate)
    mean = trials * p
    if mean < wp.float64(10.0):
        single = uniforms(seed, id, purpose, block)
        few = _inversion(trials, rate, single[0])
        if swapped:
            few = trials - few
        return int(few), block + wp.uint32(1)

    q = ONE - p
    deviation = wp.sqrt(mean * q)
    b = wp.float64(1.15) + wp.float64(2.53) * deviation
    a = wp.float64(-0.0873) + wp.float64(0.0248) * b + wp.float64(0.01) * p
    alpha = (2.83 + 5.1 / float(b)) * float(deviation)
    centre = mean + HALF
    mode = wp.floor((trials + ONE) * p)
    count = wp.float64(-1.0)
    while count < ZERO:
        draw = uniforms(seed, id, purpose, block)
        block = block + wp.uint32(1)
        u = draw[0] - HALF
        v = draw[1]
        us = HALF - wp.abs(u)
        k = wp.floor((TWO * a / us + b) * u + centre)
        if us >= wp.float64(0.07) and v * b <= wp.float64(0.92) * b - wp.float64(4.2):
            count = k
        elif us > ZERO and k >= ZERO and k <= trials:
            # ln(v alpha / (a / us^2 + b)) decides: float32 does where its errors allow.
            square = float(us) * float(us)
            hat = wp.log(float(v) * alpha * square / (float(a) + float(b) * square))
            gap = _log_ratio(k, mode, trials, p, q) - hat
            doubt = wp.where(wp.min(k, trials - k) < ONE, 2.0e-3, 1.0e-5 + 2.0e-6 * wp.abs(float(k - mode)))
            accepted = gap > doubt
            if not accepted and gap >= -doubt:
                ratio = v * (wp.float64(2.83) + wp.float64(5.1) / b) * deviation / (a / (us * us) + b)
                accepted = wp.log(ratio) <= _exact_log_ratio(k, mode, trials, p / q)
            if accepted:
                count = k
    if swapped:
        count = trials - count
    return int(count), block


# ---- Counts at a quantile.


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
