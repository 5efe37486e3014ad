"""How well a delay can be known: Fisher information, Cramér–Rao bound, and where the bound is out of reach.

One thread a pixel, float64. The model is eq 8 of *A Simulation Method for Underwater SPAD Depth Imaging Datasets*,
Sensors 24, 3886 (2024): a Gaussian pulse on dark counts, ambient light and backscatter, as rates per pulse.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.pixels import launch_pixels

from .lidar import Lidar, background_rate

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_PI = wp.constant(wp.float64(3.141592653589793))
_SQRT2 = wp.constant(wp.float64(1.4142135623730951))
_SQRT_2PI = wp.constant(wp.float64(2.5066282746310002))
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))

COUNT_LAWS = ("per_pulse", "per_frame", "per_frame_lu2024")


@wp.func
def _normal_cdf(z: wp.float64) -> wp.float64:
    return _HALF * wp.erfc(-z / _SQRT2)


@wp.func
def one_minus_exp(x: wp.float64) -> wp.float64:
    """1 - exp(-x) for x >= 0 without cancellation."""
    if x < wp.float64(1.0e-4):
        return x * (_ONE - x * (_HALF - x / wp.float64(6.0)))
    return _ONE - wp.exp(-x)


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
    blind = wp.max(_ONE - wp.float64(8.0) / window, _ZERO)
    if signal_count <= _ZERO:
        return blind
    if level <= _ZERO:
        return _ZERO
    ratio = signal_count / (level * _SQRT_2PI)
    reach = wp.max(wp.sqrt(_TWO * wp.log(_ONE + ratio)) + wp.float64(3.5), wp.float64(5.0))
    h = reach / wp.float64(24.0)
    spread = wp.float64(0.0)
    half_way = wp.float64(0.0)
    for j in range(25):
        z = wp.float64(j) * h
        e = ratio * wp.exp(-_HALF * z * z)
        g = wp.log(_ONE + e)
        w = wp.where(j == 0, _ONE, _TWO)
        spread += w * (_ONE + e) * g * g
        half_way += w * (wp.sqrt(_ONE + e) - _ONE)
    # Signal and background scores overlap most at s = 1/2: exp(2 K(1/2) - K(1)) bounds the probability.
    if _TWO * level * h * half_way - signal_count + wp.log(window) < wp.float64(-60.0):
        return _ZERO
    width = wp.float64(7.0) / wp.sqrt(level * h * spread)
    low = wp.max(_ONE - width, -_ONE)
    high = wp.min(_ONE + width, wp.float64(3.0))
    step = (high - low) / wp.float64(32.0)
    clusters = wp.max(window - wp.float64(8.0), _ZERO) * (_ONE - wp.float64(0.18) * level / (level + wp.float64(0.2)))
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
            e = ratio * wp.exp(-_HALF * z * z)
            g = wp.log(_ONE + e)
            w = wp.where(j == 0, _ONE, _TWO)
            tilt = wp.exp(s * g)
            dg = z * e / (_ONE + e)
            k0 += w * (tilt - _ONE)
            k1 += w * tilt * g
            k2 += w * tilt * g * g
            slope += w * tilt * dg * dg
        k0 *= level * h
        k1 *= level * h
        k2 *= level * h
        slope *= level * h
        log_density = k0 - s * k1 - _HALF * wp.log(_TWO * _PI * k2)
        crossings = clusters * wp.exp(wp.min(log_density, wp.float64(50.0))) * wp.sqrt(slope / (_TWO * _PI))
        most = wp.max(most, crossings / wp.sqrt(_ONE + wp.max(s, _ZERO)))
        weight = k2 * wp.exp(wp.min(log_density + k1 - signal_count, wp.float64(50.0)))
        mass += weight
        lost += weight * one_minus_exp(most)
    if not (mass > _ZERO):
        return blind  # too faint for the sums
    return wp.min(lost / mass, blind)


@wp.func
def recorded_photons(
    alpha: wp.float64, count_law: int, acquisitions: wp.float64, pulses_per_frame: wp.float64
) -> wp.float64:
    """Photons that a pixel records in so many pulses (law 0) or frames of ην pulses each (laws 1 and 2)."""
    if count_law == 0:
        return acquisitions * one_minus_exp(alpha)
    if count_law == 1:
        return acquisitions * one_minus_exp(alpha * pulses_per_frame)
    return acquisitions * (_ONE - wp.pow(wp.max(_ONE - alpha, _ZERO), pulses_per_frame))


@wp.kernel
def _statistics(
    first: int,
    lidar: Lidar,
    phase: wp.array(dtype=wp.float64),
    profile: wp.array2d(dtype=float),
    view: wp.array(dtype=wp.vec3d),
    signal: wp.array(dtype=wp.float64),
    arrival: wp.array(dtype=wp.float64),
    backscatter: wp.array(dtype=wp.float64),
    count_law: int,
    acquisitions: wp.float64,
    pulses_per_frame: wp.float64,
    with_outliers: int,
    # Out:
    alpha: wp.array(dtype=wp.float64),
    fisher: wp.array(dtype=wp.float64),
    sigma_time: wp.array(dtype=wp.float64),
    level: wp.array(dtype=wp.float64),
    outlier: wp.array(dtype=wp.float64),
):
    """α (integral of eq 8), Fisher information per photon (eq 9), σ* and outlier probability. Launch grid: pixels."""
    i = first + wp.tid()
    s = signal[i]
    mu = arrival[i]
    sigma = lidar.sigma
    gate = lidar.stop - lidar.start
    noise = lidar.dark * gate + backscatter[i]
    fraction = wp.float64(0.0)
    if s > _ZERO:
        fraction = _normal_cdf((lidar.stop - mu) / sigma) - _normal_cdf((lidar.start - mu) / sigma)
    a = noise + s * fraction
    alpha[i] = a
    information = wp.float64(0.0)  # ∫ (dL/dμ)²/L dt [1/s²], per pulse
    local = wp.float64(0.0)  # background rate under the pulse
    local_weight = wp.float64(0.0)
    if s * fraction > _ZERO:
        # On both sides of μ, where backscatter ends, 24 panels of at most σ/2 with five Gauss-Legendre nodes.
        for side in range(2):
            low = wp.max(lidar.start, mu - wp.float64(12.0) * sigma)
            high = wp.min(lidar.stop, mu)
            if side == 1:
                low = wp.max(lidar.start, mu)
                high = wp.min(lidar.stop, mu + wp.float64(12.0) * sigma)
            half = (high - low) / wp.float64(48.0)
            if half > _ZERO:
                right = background_rate(lidar, phase, profile, i, view[i], side, low)
                for panel in range(24):
                    middle = low + (_TWO * wp.float64(panel) + _ONE) * half
                    left = wp.float64(right)
                    right = background_rate(lidar, phase, profile, i, view[i], side, middle + half)
                    for node in range(5):
                        x = wp.float64(0.0)
                        w = wp.float64(0.5688888888888889)
                        if node == 1 or node == 2:
                            x = wp.float64(0.5384693101056831)
                            w = wp.float64(0.47862867049936647)
                        if node == 3 or node == 4:
                            x = wp.float64(0.9061798459386640)
                            w = wp.float64(0.23692688505618908)
                        if node % 2 == 0:
                            x = -x
                        t = middle + x * half
                        z = (t - mu) / sigma
                        pulse = s / (sigma * _SQRT_2PI) * wp.exp(-_HALF * z * z)
                        # Straight across a panel; only a profile can have more detail than that.
                        noise_rate = _HALF * (left + right) + _HALF * (right - left) * x
                        if lidar.source == 2:
                            noise_rate = background_rate(lidar, phase, profile, i, view[i], side, t)
                        rate = noise_rate + pulse
                        if rate > _ZERO:
                            information += w * half * pulse * (pulse / rate) * z * z / (sigma * sigma)
                        local += w * half * pulse * noise_rate
                        local_weight += w * half * pulse
    counts = recorded_photons(a, count_law, acquisitions, pulses_per_frame)
    f = wp.float64(0.0)
    sigma_star = wp.float64(wp.nan)
    p = wp.float64(wp.nan)
    # The outlier model takes the background as flat, at the level under the pulse: what is brighter elsewhere weighs
    # less in a fit that knows the background.
    flat = local / wp.max(local_weight, wp.float64(1.0e-300))
    if information > _ZERO:
        f = information / a
        sigma_star = _ONE / wp.sqrt(counts * f)
        if with_outliers == 1:
            p = outlier_probability(counts * s * fraction / a, counts * flat * sigma / a, gate / sigma)
    fisher[i] = f
    sigma_time[i] = sigma_star
    level[i] = flat * sigma
    outlier[i] = p


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


# The bound of a histogram


@wp.kernel
def _histogram_information(
    first: int,
    signal: wp.array2d(dtype=float),
    background: wp.array2d(dtype=float),
    taps: wp.array(dtype=wp.float64),
    slope_taps: wp.array(dtype=wp.float64),
    first_photon: int,
    # Out:
    information: wp.array(dtype=wp.float64),
):
    """Fisher information of the delay per pulse, in 1/bins². Launch grid: pixels.

    Taps convolve both cubes with the response; slope taps give the derivative of a bin's signal by the delay.
    """
    i = first + wp.tid()
    row = i % background.shape[0]
    bins = signal.shape[1]
    levels = background.shape[1]
    reach = taps.shape[0] / 2
    slope_reach = slope_taps.shape[0] / 2
    total = wp.float64(0.0)
    before = wp.float64(0.0)
    for k in range(bins):
        rate = wp.float64(0.0)
        for j in range(wp.max(0, k - reach), wp.min(bins, k + reach + 1)):
            tap = taps[k - j + reach]
            rate += tap * (wp.float64(signal[i, j]) + wp.float64(background[row, wp.min(j, levels - 1)]))
        slope = wp.float64(0.0)
        for m in range(-slope_reach, slope_reach + 1):
            # What lies beyond the gate is unknown: taken to go on level, which has no slope.
            slope += slope_taps[m + slope_reach] * wp.float64(signal[i, wp.clamp(k - m, 0, bins - 1)])
        if rate > _ZERO:
            if first_photon == 1:
                # One trial a bin among the pulses that have not fired: exp(-λ)(dλ)²/(1 - exp(-λ)).
                total += wp.exp(-before - rate) * slope * slope / one_minus_exp(rate)
                before += rate
            else:
                total += slope * slope / rate
    information[i] = total


# Launchers


def statistics_maps(
    lidar: Any,
    phase: wp.array,
    profile: wp.array,
    view: wp.array,
    signal: wp.array,
    arrival: wp.array,
    backscatter: wp.array,
    *,
    count_law: str,
    acquisitions: float,
    pulses_per_frame: float = 1.0,
    outliers: bool = True,
) -> tuple[wp.array, wp.array, wp.array, wp.array, wp.array]:
    """α, Fisher information per photon [1/s²], σ* [s], background per σ, outlier probability: float64 `[pixel]` each.

    α and the background level, which is that under the pulse and which the outlier model takes as flat, are in
    detections per pulse. For backscatter that decays before the target the probability comes out right to up to twice
    as large.

    Args:
        lidar, phase, view: As for `single_scatter_table`.
        profile: float32 `[1 or pixel, bin]`, backscatter detections per pulse and bin, used where `lidar.source` is 2.
        signal, arrival: Of `signal_map`.
        backscatter: float64 `[pixel]`, backscatter detections per pulse within the gate.
        count_law: One of `COUNT_LAWS`.
        acquisitions: Pulses (`"per_pulse"`), or frames.
        pulses_per_frame: ην, for the laws per frame.
        outliers: Whether their probability is wanted, which takes most of the time; else it is NaN.

    Where no signal falls into the gate, F is 0, and σ* and the outlier probability are NaN.
    """
    count, device = view.shape[0], view.device
    out: Any = tuple(wp.empty(count, dtype=wp.float64, device=device) for _ in range(5))
    counting = [COUNT_LAWS.index(count_law), wp.float64(acquisitions), wp.float64(pulses_per_frame), int(outliers)]
    inputs = [lidar, phase, profile, view, signal, arrival, backscatter, *counting, *out]
    launch_pixels(_statistics, count, inputs, device=device)
    return out


def histogram_information(
    signal: wp.array,
    background: wp.array,
    taps: wp.array,
    slope_taps: wp.array,
    *,
    first_photon: bool,
) -> wp.array:
    """Fisher information of the delay per pulse [1/bins²], float64 `[pixel]`.

    Args:
        signal: float32 `[pixel, bin]`, expected detections per pulse.
        background: float32 `[1 or pixel, 1 or bin]`.
        taps, slope_taps: float64, odd lengths: response per bin and its derivative with respect to the delay in bins.
        first_photon: Whether at most the first photon of a pulse is recorded.
    """
    out = wp.empty(signal.shape[0], dtype=wp.float64, device=signal.device)
    inputs = [signal, background, taps, slope_taps, int(first_photon)]
    launch_pixels(_histogram_information, signal.shape[0], [*inputs, out], device=signal.device)
    return out


def outlier_probabilities(signal_count: wp.array, level: wp.array, window: wp.array) -> wp.array:
    """`outlier_probability` of every element: float64 arrays of one length in and out."""
    out = wp.empty(signal_count.shape[0], dtype=wp.float64, device=signal_count.device)
    launch_pixels(_outliers, signal_count.shape[0], [signal_count, level, window, out], device=signal_count.device)
    return out
