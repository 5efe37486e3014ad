"""How well a delay can be known: Fisher information, Cramér–Rao bound, and where the bound is out of reach.

One thread a pixel, float64. The model is eq 8 of *A Simulation Method for Underwater SPAD Depth Imaging Datasets*,
Sensors 24, 3886 (2024): a Gaussian pulse on dark counts, ambient light and backscatter, as rates per pulse.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.base.native import HALF, ONE, PI, SQRT_2PI, TWO, ZERO, normal_cdf, one_minus_exp

from .optics import Lidar, Optics, SightRay, check_lidar
from .rates import Scattering, make_scattering, make_single_scatter

__all__ = ["histogram_information", "outlier_probabilities", "statistics_maps"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})


COUNT_LAWS = ("per_pulse", "per_frame", "per_frame_lu2024")


# ---- How often a fit reports background instead of the target: where the bound is out of reach.


@wp.func
def outlier_probability(signal_count: wp.float64, level: wp.float64, window: wp.float64) -> wp.float64:
    """Probability that the maximum-likelihood delay locks on background counts, more than 4 sigma from the truth.

    The score of a delay is the sum over counts of g(z) = ln(1 + r exp(-z^2/2)), a Poisson shot noise. K(s) is the
    cumulant function of its background part; the score at the true delay has the same law tilted to s = 1. Rice's
    formula with the saddlepoint density gives the mean number of upcrossings of x = K'(s) over the window, and
    P = E[1 - exp(-upcrossings of the true delay's score)]. Counts are those of the whole acquisition, `level` is
    the background per sigma, b, `window` the gate over sigma. What first order leaves out: 1/sqrt(1 + s) is the gain of
    the score by the fit's freedom (half a chi^2 of one degree), and 1 - 0.18 b/(b + 0.2), for crossings that come in
    clusters, is fitted to Monte Carlo.
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
    signal_count: wp.array[wp.float64],
    level: wp.array[wp.float64],
    window: wp.array[wp.float64],
    # Out:
    probability: wp.array[wp.float64],
):
    """Launch grid: elements."""
    i = first + wp.tid()
    probability[i] = outlier_probability(signal_count[i], level[i], window[i])


def outlier_probabilities(signal_count: wp.array, level: wp.array, window: wp.array) -> wp.array:
    """`outlier_probability` of every element: float64 arrays of one length in and out."""
    check.array("signal_count", signal_count, wp.float64, (None,))
    check.arrays(wp.float64, signal_count.shape, signal_count.device, level=level, window=window)
    out = wp.empty(signal_count.shape[0], dtype=wp.float64, device=signal_count.device)
    launch_pixels(_outliers, signal_count.shape[0], [signal_count, level, window, out], device=signal_count.device)
    return out


# ---- The bound of a pulse.


# Nodes in [-1, 1] and weights of the Gauss-Legendre rule of five nodes.
_NODES = 0.0, 0.5384693101056831, -0.5384693101056831, 0.9061798459386640, -0.9061798459386640
_WEIGHTS = 0.5688888888888889, 0.47862867049936647, 0.47862867049936647, 0.23692688505618908, 0.23692688505618908
_RULE = wp.constant(wp.types.matrix((2, 5), wp.float64)(*_NODES, *_WEIGHTS))


@memoised
def _make_statistics_kernel(optics: Optics) -> wp.Kernel:
    see, background_rate = optics.see, make_single_scatter(optics)[2]

    @wp.func
    def integrate_pulse(
        lidar: Lidar, water: Scattering, i: int, sight: SightRay, s: wp.float64, mu: wp.float64, ambient: wp.float64
    ):
        """∫ (dL/dμ)²/L dt [1/s²], ∫ S B dt [1/s] and ∫ S dt of the rates of signal S, background B and both L, for s
        detections that arrive at mu: on both sides, since backscatter ends there, 24 panels of at most σ/2."""
        information, shared, total = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
        sigma = lidar.sigma
        for side in range(2):
            low = wp.max(lidar.start, mu - wp.float64(12.0) * sigma)
            high = wp.min(lidar.stop, mu)
            if side == 1:
                low = wp.max(lidar.start, mu)
                high = wp.min(lidar.stop, mu + wp.float64(12.0) * sigma)
            half = (high - low) / wp.float64(48.0)
            if half > ZERO:
                right = background_rate(lidar, water, i, sight, side, low) + ambient
                for panel in range(24):
                    middle = low + (TWO * wp.float64(panel) + ONE) * half
                    left = wp.float64(right)
                    right = background_rate(lidar, water, i, sight, side, middle + half) + ambient
                    for node in range(5):
                        x = _RULE[0, node]
                        w = _RULE[1, node] * half
                        t = middle + x * half
                        z = (t - mu) / sigma
                        pulse = s / (sigma * SQRT_2PI) * wp.exp(-HALF * z * z)
                        # Straight across a panel; only a profile can have more detail than that.
                        noise_rate = HALF * (left + right) + HALF * (right - left) * x
                        if lidar.source == 2:
                            noise_rate = background_rate(lidar, water, i, sight, side, t) + ambient
                        rate = noise_rate + pulse
                        if rate > ZERO:
                            information += w * pulse * (pulse / rate) * z * z / (sigma * sigma)
                        shared += w * pulse * noise_rate
                        total += w * pulse
        return information, shared, total

    @wp.kernel(module="unique", module_options={"max_unroll": 1}, enable_backward=False)
    def statistics_kernel(
        first: int,
        lidar: Lidar,
        water: Scattering,
        view: wp.array[wp.vec3d],
        signal: wp.array[wp.float64],
        arrival: wp.array[wp.float64],
        backscatter: wp.array[wp.float64],
        ambient: wp.array[wp.float64],
        count_law: int,
        acquisitions: wp.float64,
        pulses_per_frame: wp.float64,
        with_outliers: int,
        # Out:
        alpha: wp.array[wp.float64],
        fisher: wp.array[wp.float64],
        sigma_time: wp.array[wp.float64],
        level: wp.array[wp.float64],
        outlier: wp.array[wp.float64],
    ):
        """α (integral of eq 8), Fisher information per photon (eq 9), σ*, outlier probability. Launch grid: pixels."""
        i = first + wp.tid()
        s = signal[i]
        mu = arrival[i]
        sigma = lidar.sigma
        gate = lidar.stop - lidar.start
        beside = ambient[i % ambient.shape[0]]
        noise = lidar.dark * gate + backscatter[i] + beside * gate
        fraction = wp.float64(0.0)
        if s > ZERO:
            fraction = normal_cdf((lidar.stop - mu) / sigma) - normal_cdf((lidar.start - mu) / sigma)
        a = noise + s * fraction
        information, shared, total = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
        if s * fraction > ZERO:
            information, shared, total = integrate_pulse(lidar, water, i, see(lidar.ports, view[i]), s, mu, beside)
        # In pulses, or in frames of ην pulses each.
        counts = acquisitions * one_minus_exp(a * wp.where(count_law == 1, pulses_per_frame, ONE))
        if count_law == 2:
            counts = acquisitions * (ONE - wp.pow(wp.max(ONE - a, ZERO), pulses_per_frame))
        f = wp.float64(0.0)
        sigma_star = wp.float64(wp.nan)
        p = wp.float64(wp.nan)
        # The outlier model takes the background as flat, at the level under the pulse: what is brighter elsewhere
        # weighs less in a fit that knows the background.
        flat = shared / wp.max(total, wp.float64(1.0e-300))
        if information > ZERO:
            f = information / a
            sigma_star = ONE / wp.sqrt(counts * f)
            if with_outliers == 1:
                p = outlier_probability(counts * s * fraction / a, counts * flat * sigma / a, gate / sigma)
        alpha[i] = a
        fisher[i] = f
        sigma_time[i] = sigma_star
        level[i] = flat * sigma
        outlier[i] = p

    return statistics_kernel


# ---- The bound of a histogram.


@wp.kernel
def _histogram_information(
    first: int,
    signal: wp.array2d[float],
    background: wp.array2d[float],
    taps: wp.array[wp.float64],
    slope_taps: wp.array[wp.float64],
    first_photon: int,
    # Out:
    information: wp.array[wp.float64],
):
    """Fisher information of the delay per pulse, in 1/bins². Launch grid: pixels. Taps convolve both cubes with the
    response; slope taps give the derivative of a bin's signal by the delay."""
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
        if rate > ZERO:
            if first_photon == 1:
                # One trial a bin among the pulses that have not fired: exp(-λ)(dλ)²/(1 - exp(-λ)).
                total += wp.exp(-before - rate) * slope * slope / one_minus_exp(rate)
                before += rate
            else:
                total += slope * slope / rate
    information[i] = total


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
    lines: wp.array | None = None,
    ambient: wp.array | None = None,
    optics: Optics | None = None,
) -> tuple[wp.array, wp.array, wp.array, wp.array, wp.array]:
    """α, Fisher information per photon [1/s²], σ* [s], background per σ, outlier probability: float64 `[pixel]` each.

    α and the background level, which is that under the pulse and which the outlier model takes as flat, are in
    detections per pulse. For backscatter that decays before the target the probability comes out right to up to twice
    as large.

    Args:
        lidar, phase, view, optics: As for `single_scatter_table`.
        profile: float32 `[1 or pixel, bin]`, backscatter detections per pulse and bin, used where `lidar.source` is 2.
        signal, arrival: Of `signal_map`.
        backscatter: float64 `[pixel]`, backscatter detections per pulse within the gate.
        count_law: One of `COUNT_LAWS`.
        acquisitions: Pulses (`"per_pulse"`), or frames.
        pulses_per_frame: ην, for the laws per frame.
        outliers: Whether their probability is wanted, which takes most of the time; else it is NaN.
        lines: As for `single_scatter_table`, used where `lidar.source` is 1.
        ambient: float64 `[1 or pixel]`, rate of each pixel on top of `lidar.dark` [1/s].

    Where no signal falls into the gate, F is 0, and σ* and the outlier probability are NaN.

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit each other.
    """
    columns = {"signal": signal, "arrival": arrival, "backscatter": backscatter}
    optics, count, device = check_lidar(lidar, optics, view, **columns)
    check.array("profile", profile, wp.float32, (None, None), device)
    if not profile.size:
        raise ArgumentError(f"profile has shape {profile.shape}; (1 or pixels, bins) is needed")
    water = make_scattering(lidar, phase, device, lines=lines, profile=profile)
    check.choice("count_law", count_law, COUNT_LAWS)
    check.within("(0, inf)", acquisitions=acquisitions, pulses_per_frame=pulses_per_frame)
    ambient = wp.zeros(1, dtype=wp.float64, device=device) if ambient is None else ambient
    check.array("ambient", ambient, wp.float64, (None,), device)
    if ambient.size not in (1, count):
        raise ArgumentError(f"ambient has {ambient.size} entries; 1 or {count} are needed")
    out: Any = tuple(wp.empty(count, dtype=wp.float64, device=device) for _ in range(5))
    counting = [COUNT_LAWS.index(count_law), acquisitions, pulses_per_frame, int(bool(outliers))]
    inputs = [lidar, water, view, *columns.values(), ambient, *counting, *out]
    launch_pixels(_make_statistics_kernel(optics), count, inputs, device=device)
    return out


def histogram_information(
    signal: wp.array, background: wp.array, taps: wp.array, slope_taps: wp.array, *, first_photon: bool
) -> wp.array:
    """Fisher information of the delay per pulse [1/bins²], float64 `[pixel]`.

    Args:
        signal: float32 `[pixel, bin]`, expected detections per pulse.
        background: float32 `[1 or pixel, 1 or bin]`.
        taps, slope_taps: float64, odd lengths: response per bin and its derivative with respect to the delay in bins.
        first_photon: Whether at most the first photon of a pulse is recorded.

    Raises:
        ArgumentError: Arrays that do not fit each other.
    """
    check.array("signal", signal, wp.float32, (None, None))
    check.array("background", background, wp.float32, (None, None), signal.device)
    if background.shape[0] < 1 or background.shape[1] not in (1, signal.shape[1]):
        raise ArgumentError(f"background has shape {background.shape}; (1 or pixels, 1 or {signal.shape[1]}) is needed")
    for name, array in {"taps": taps, "slope_taps": slope_taps}.items():
        check.array(name, array, wp.float64, (None,), signal.device)
        if array.size % 2 == 0:
            raise ArgumentError(f"{name} has {array.size} entries; an odd number is needed")
    out = wp.empty(signal.shape[0], dtype=wp.float64, device=signal.device)
    inputs = [signal, background, taps, slope_taps, int(bool(first_photon))]
    launch_pixels(_histogram_information, signal.shape[0], [*inputs, out], device=signal.device)
    return out
