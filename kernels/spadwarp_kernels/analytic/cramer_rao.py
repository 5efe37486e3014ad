"""How well a delay can be known: Fisher information, Cramér–Rao bound, and where the bound is out of reach.

One thread a pixel, float64. The model is eq 8 of *A Simulation Method for Underwater SPAD Depth Imaging Datasets*,
Sensors 24, 3886 (2024): a Gaussian pulse on dark counts, ambient light and backscatter, as rates per pulse.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_array, check_choice, check_integer, check_number
from spadwarp_kernels.base.kernels import launch_pixels, made_once
from spadwarp_kernels.base.native import HALF, ONE, SQRT_2PI, TWO, ZERO, normal_cdf, one_minus_exp

from .backscatter import check_phase, make_background_rate, spectral_lines
from .lidar import Lidar
from .optics import Optics, check_optics
from .outliers import outlier_probability

__all__ = ["COUNT_LAWS", "histogram_information", "statistics_maps"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})


COUNT_LAWS = ("per_pulse", "per_frame", "per_frame_lu2024")


@wp.func
def recorded_photons(
    alpha: wp.float64, count_law: int, acquisitions: wp.float64, pulses_per_frame: wp.float64
) -> wp.float64:
    """Photons that a pixel records in so many pulses (law 0) or frames of ην pulses each (laws 1 and 2)."""
    if count_law == 0:
        return acquisitions * one_minus_exp(alpha)
    if count_law == 1:
        return acquisitions * one_minus_exp(alpha * pulses_per_frame)
    return acquisitions * (ONE - wp.pow(wp.max(ONE - alpha, ZERO), pulses_per_frame))


@wp.struct
class PulseIntegrals:
    """Integrals over the time of the pulse of the signal's rate S, the background's B and the total L, per laser pulse.

    Attributes:
        information: ∫ (dL/dμ)²/L dt [1/s²].
        background: ∫ S B dt [1/s].
        signal: ∫ S dt.
    """

    information: wp.float64
    background: wp.float64
    signal: wp.float64


@wp.func
def _gauss_legendre(node: int) -> wp.vec2d:
    """Node in [-1, 1] and weight of the rule of five nodes."""
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
    return wp.vec2d(x, w)


@made_once
def _make_statistics_kernel(optics: Optics) -> wp.Kernel:
    Sight, see = optics.sight, optics.see
    background_rate = make_background_rate(optics)

    @wp.func
    def integrate_pulse(
        lidar: Lidar,
        lines: wp.array(dtype=wp.vec3d),
        phase: wp.array(dtype=wp.float64),
        profile: wp.array2d(dtype=float),
        i: int,
        sight: Sight,
        s: wp.float64,
        mu: wp.float64,
        ambient: wp.float64,
    ) -> PulseIntegrals:
        """The integrals for a signal of s detections that arrives at mu: on both sides, since backscatter ends there,
        24 panels of at most σ/2 with five Gauss-Legendre nodes."""
        total = PulseIntegrals()
        sigma = lidar.sigma
        for side in range(2):
            low = wp.max(lidar.start, mu - wp.float64(12.0) * sigma)
            high = wp.min(lidar.stop, mu)
            if side == 1:
                low = wp.max(lidar.start, mu)
                high = wp.min(lidar.stop, mu + wp.float64(12.0) * sigma)
            half = (high - low) / wp.float64(48.0)
            if half > ZERO:
                right = background_rate(lidar, lines, phase, profile, i, sight, side, low) + ambient
                for panel in range(24):
                    middle = low + (TWO * wp.float64(panel) + ONE) * half
                    left = wp.float64(right)
                    right = background_rate(lidar, lines, phase, profile, i, sight, side, middle + half) + ambient
                    for node in range(5):
                        rule = _gauss_legendre(node)
                        x = rule[0]
                        w = rule[1]
                        t = middle + x * half
                        z = (t - mu) / sigma
                        pulse = s / (sigma * SQRT_2PI) * wp.exp(-HALF * z * z)
                        # Straight across a panel; only a profile can have more detail than that.
                        noise_rate = HALF * (left + right) + HALF * (right - left) * x
                        if lidar.source == 2:
                            noise_rate = background_rate(lidar, lines, phase, profile, i, sight, side, t) + ambient
                        rate = noise_rate + pulse
                        if rate > ZERO:
                            total.information += w * half * pulse * (pulse / rate) * z * z / (sigma * sigma)
                        total.background += w * half * pulse * noise_rate
                        total.signal += w * half * pulse
        return total

    @wp.kernel(module="unique", module_options={"max_unroll": 1}, enable_backward=False)
    def statistics_kernel(
        first: int,
        lidar: Lidar,
        lines: wp.array(dtype=wp.vec3d),
        phase: wp.array(dtype=wp.float64),
        profile: wp.array2d(dtype=float),
        view: wp.array(dtype=wp.vec3d),
        signal: wp.array(dtype=wp.float64),
        arrival: wp.array(dtype=wp.float64),
        backscatter: wp.array(dtype=wp.float64),
        ambient: wp.array(dtype=wp.float64),
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
        alpha[i] = a
        pulse = PulseIntegrals()
        if s * fraction > ZERO:
            pulse = integrate_pulse(lidar, lines, phase, profile, i, see(lidar.ports, view[i]), s, mu, beside)
        counts = recorded_photons(a, count_law, acquisitions, pulses_per_frame)
        f = wp.float64(0.0)
        sigma_star = wp.float64(wp.nan)
        p = wp.float64(wp.nan)
        # The outlier model takes the background as flat, at the level under the pulse: what is brighter elsewhere
        # weighs less in a fit that knows the background.
        flat = pulse.background / wp.max(pulse.signal, wp.float64(1.0e-300))
        if pulse.information > ZERO:
            f = pulse.information / a
            sigma_star = ONE / wp.sqrt(counts * f)
            if with_outliers == 1:
                p = outlier_probability(counts * s * fraction / a, counts * flat * sigma / a, gate / sigma)
        fisher[i] = f
        sigma_time[i] = sigma_star
        level[i] = flat * sigma
        outlier[i] = p

    return statistics_kernel


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
        if rate > ZERO:
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
    optics = check_optics(lidar, optics)
    check_array("view", view, wp.vec3d, (None,))
    count, device = view.shape[0], view.device
    check_phase(phase, device)
    check_array("profile", profile, wp.float32, (None, None), device)
    check_integer("entries of profile", profile.size, 1)
    for name, array in {"signal": signal, "arrival": arrival, "backscatter": backscatter}.items():
        check_array(name, array, wp.float64, (count,), device)
    check_choice("count_law", count_law, COUNT_LAWS)
    check_number("acquisitions", acquisitions, "(0, inf)")
    check_number("pulses_per_frame", pulses_per_frame, "(0, inf)")
    out: Any = tuple(wp.empty(count, dtype=wp.float64, device=device) for _ in range(5))
    counting = [
        COUNT_LAWS.index(count_law),
        wp.float64(acquisitions),
        wp.float64(pulses_per_frame),
        int(bool(outliers)),
    ]
    if ambient is None:
        ambient = wp.zeros(1, dtype=wp.float64, device=device)
    check_array("ambient", ambient, wp.float64, (None,), device)
    if ambient.size not in (1, count):
        raise ArgumentError(f"ambient has {ambient.size} entries; 1 or {count} are needed")
    inputs = [lidar, spectral_lines(lidar, lines, device), phase, profile, view, signal, arrival, backscatter, ambient]
    launch_pixels(_make_statistics_kernel(optics), count, [*inputs, *counting, *out], device=device)
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

    Raises:
        ArgumentError: Arrays that do not fit each other.
    """
    check_array("signal", signal, wp.float32, (None, None))
    check_array("background", background, wp.float32, (None, None), signal.device)
    if background.shape[0] < 1 or background.shape[1] not in (1, signal.shape[1]):
        raise ArgumentError(f"background has shape {background.shape}; (1 or pixels, 1 or {signal.shape[1]}) is needed")
    for name, array in {"taps": taps, "slope_taps": slope_taps}.items():
        check_array(name, array, wp.float64, (None,), signal.device)
        if array.size % 2 == 0:
            raise ArgumentError(f"{name} has {array.size} entries; an odd number is needed")
    out = wp.empty(signal.shape[0], dtype=wp.float64, device=signal.device)
    inputs = [signal, background, taps, slope_taps, int(bool(first_photon))]
    launch_pixels(_histogram_information, signal.shape[0], [*inputs, out], device=signal.device)
    return out
