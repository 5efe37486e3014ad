"""The analytic simulator, one thread a pixel: photon budget, arrival time, Fisher information, outliers, depth frames.

Equation numbers are those of *A Simulation Method for Underwater SPAD Depth Imaging Datasets*, Sensors 24, 3886 (2024). Rates are in
detections per pulse and second, times are from the emission of the pulse, everything but the frames is float64.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from .philox import STREAM_ANALYTIC, random_block, u01

wp.set_module_options({"enable_backward": False})

_PI = wp.constant(wp.float64(3.141592653589793))
_SQRT2 = wp.constant(wp.float64(1.4142135623730951))
_SQRT_2PI = wp.constant(wp.float64(2.5066282746310002))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_HALF = wp.constant(wp.float64(0.5))

BACKSCATTER_SOURCES = ("constant", "single_scatter", "profile")
FORMS = ("radiometric", "paper")
COUNT_LAWS = ("per_pulse", "per_frame", "per_frame_paper")

TABLE_PANELS = wp.constant(64)
"""Panels of the arrival-time table of single-scatter backscatter, in geometric progression of range."""


@wp.struct
class Lidar:
    """Laser, water, camera and gate as the analytic model needs them.

    Attributes:
        paper: Whether the paper's photon budget (K = 8, small angles, no cosines) replaces radiometry.
        photons: Photons per pulse, E0 λ/hc.
        pde: Photon detection efficiency, PDP times fill factor.
        extinction, scattering: Of the water [1/m].
        speed: Group velocity c0/n_g [m/s].
        laser, axis: Position [m] and unit direction of the laser.
        profile: Index into LASER_PROFILES.
        spread: 1 - cos(half angle) (uniform cone); unused otherwise.
        tan2: tan^2 of the half angle.
        radius: Beam radius [m] (collimated).
        pixel_tangent: Pixel pitch over focal length.
        aperture_area: [m^2].
        start, stop: The gate [s].
        sigma: Standard deviation of the instrument response [s].
        dark: Rate of dark counts and ambient light [1/s].
        source: Index into BACKSCATTER_SOURCES.
        constant: Backscatter rate [1/s] (source 0).
        nearest: Range below which single scattering is left out [m] (source 1).
        bin_width: Of the profile [s] (source 2).
    """

    paper: int
    photons: wp.float64
    pde: wp.float64
    extinction: wp.float64
    scattering: wp.float64
    speed: wp.float64
    laser: wp.vec3d
    axis: wp.vec3d
    profile: int
    spread: wp.float64
    tan2: wp.float64
    radius: wp.float64
    pixel_tangent: wp.float64
    aperture_area: wp.float64
    start: wp.float64
    stop: wp.float64
    sigma: wp.float64
    dark: wp.float64
    source: int
    constant: wp.float64
    nearest: wp.float64
    bin_width: wp.float64


# ---- The paper's photon budget -------------------------------------------------------------------------------------------------


@wp.func
def pulse_fluence(energy: wp.float64, extinction: wp.float64, distance: wp.float64, tan2: wp.float64) -> wp.float64:
    """Energy of a pulse per area on the target [J/m^2] (eq 3)."""
    return energy * wp.exp(-extinction * distance) / (_PI * distance * distance * tan2)


@wp.func
def footprint_energy(
    fluence: wp.float64, distance: wp.float64, pixel_area: wp.float64, focal_length: wp.float64
) -> wp.float64:
    """Energy on the part of the target that a pixel of W x H = pixel_area [m^2] sees [J] (eq 4)."""
    return fluence * distance * distance * pixel_area / (focal_length * focal_length)


@wp.func
def lens_fluence(
    energy: wp.float64, reflectance: wp.float64, extinction: wp.float64, distance: wp.float64
) -> wp.float64:
    """Energy per area that comes back to the lens, reflected evenly into the half-space [J/m^2] (eq 5)."""
    return reflectance * energy * wp.exp(-extinction * distance) / (_TWO * _PI * distance * distance)


@wp.func
def pixel_energy(fluence: wp.float64, pdp: wp.float64, focal_length: wp.float64, f_number: wp.float64) -> wp.float64:
    """Energy collected by the lens and detected with probability pdp [J] (eq 6)."""
    radius = focal_length / (_TWO * f_number)
    return pdp * fluence * _PI * radius * radius


@wp.func
def paper_signal(lidar: Lidar, distance: wp.float64, reflectance: wp.float64) -> wp.float64:
    """Signal detections per pulse, eq 3 to 6 in a row, which is eq 7 with K = 8.

    In units of the focal length, which cancels: pixel area pixel_tangent^2, lens area as it is (f-number 1/(2 r) for f = 1).
    """
    rho = pulse_fluence(lidar.photons, lidar.extinction, distance, lidar.tan2)
    on_target = footprint_energy(rho, distance, lidar.pixel_tangent * lidar.pixel_tangent, _ONE)
    at_lens = lens_fluence(on_target, reflectance, lidar.extinction, distance)
    f_number = _HALF / wp.sqrt(lidar.aperture_area / _PI)
    return pixel_energy(at_lens, lidar.pde, _ONE, f_number)


# ---- Radiometry ----------------------------------------------------------------------------------------------------------------


@wp.func
def beam_path(lidar: Lidar, x: wp.vec3d) -> wp.float64:
    """Distance that light goes from the laser to x [m]; along the axis for a collimated beam."""
    y = x - lidar.laser
    if lidar.profile == 2:
        return wp.dot(y, lidar.axis)
    return wp.length(y)


@wp.func
def beam_direction(lidar: Lidar, x: wp.vec3d) -> wp.vec3d:
    """Unit direction in which the laser's light passes x."""
    if lidar.profile == 2:
        return lidar.axis
    return wp.normalize(x - lidar.laser)


@wp.func
def beam_fluence(lidar: Lidar, x: wp.vec3d) -> wp.float64:
    """Fraction of a pulse per area across the beam at x in clear water [1/m^2]."""
    y = x - lidar.laser
    along = wp.dot(y, lidar.axis)
    if along <= _ZERO:
        return _ZERO
    r2 = wp.dot(y, y)
    if lidar.profile == 0:
        # 1 - cos from the cross product: keeps narrow cones exact.
        across = wp.length_sq(wp.cross(y, lidar.axis))
        r = wp.sqrt(r2)
        if across > lidar.spread * r * (r + along):
            return _ZERO
        return _ONE / (_TWO * _PI * lidar.spread * r2)
    if lidar.profile == 1:
        tan2 = wp.length_sq(wp.cross(y, lidar.axis)) / (along * along)
        cos = along / wp.sqrt(r2)
        return _TWO / (_PI * lidar.tan2) * wp.exp(-_TWO * tan2 / lidar.tan2) / (cos * cos * cos * r2)
    if wp.length_sq(wp.cross(y, lidar.axis)) > lidar.radius * lidar.radius:
        return _ZERO
    return _ONE / (_PI * lidar.radius * lidar.radius)


@wp.func
def _beam_ray(lidar: Lidar, radial: wp.float64, azimuth: wp.float64, out_origin: wp.bool) -> wp.vec3d:
    """Origin or direction of the ray at a quantile of the beam's radius and azimuth, both in [0, 1)."""
    sign = wp.where(lidar.axis[2] < _ZERO, -_ONE, _ONE)
    a = -_ONE / (sign + lidar.axis[2])
    b = lidar.axis[0] * lidar.axis[1] * a
    b1 = wp.vec3d(_ONE + sign * lidar.axis[0] * lidar.axis[0] * a, sign * b, -sign * lidar.axis[0])
    b2 = wp.vec3d(b, sign + lidar.axis[1] * lidar.axis[1] * a, -lidar.axis[1])
    phi = _TWO * _PI * azimuth
    across = wp.cos(phi) * b1 + wp.sin(phi) * b2
    if out_origin:
        if lidar.profile == 2:
            return lidar.laser + lidar.radius * wp.sqrt(radial) * across
        return lidar.laser
    if lidar.profile == 0:
        t = lidar.spread * radial
        return (_ONE - t) * lidar.axis + wp.sqrt(t * (_TWO - t)) * across
    if lidar.profile == 1:
        tangent = wp.sqrt(-_HALF * lidar.tan2 * wp.log(_ONE - radial))
        return wp.normalize(lidar.axis + tangent * across)
    return lidar.axis


@wp.func
def _small_spot_signal(
    lidar: Lidar, x: wp.vec3d, view: wp.vec3d, normal: wp.vec3d, reflectance: wp.float64
) -> wp.float64:
    """Signal when the beam lights part of the pixel: the beam's rays are followed to the surface's tangent plane at x."""
    total = _ZERO * _ONE
    half = _HALF * lidar.pixel_tangent
    for i in range(16):
        for j in range(16):
            radial = (wp.float64(i) + _HALF) / wp.float64(16.0)
            azimuth = (wp.float64(j) + _HALF) / wp.float64(16.0)
            origin = _beam_ray(lidar, radial, azimuth, True)
            u = _beam_ray(lidar, radial, azimuth, False)
            facing = -wp.dot(normal, u)
            if facing > wp.float64(1.0e-6):
                s = wp.dot(normal, origin - x) / facing
                hit = origin + s * u
                inside = wp.abs(hit[0] - view[0] / view[2] * hit[2]) <= half * hit[2]
                inside = inside and wp.abs(hit[1] - view[1] / view[2] * hit[2]) <= half * hit[2]
                r = wp.length(hit)
                cos_out = -wp.dot(normal, hit) / r
                if s > _ZERO and inside and cos_out > _ZERO:
                    total += cos_out * (hit[2] / r) / (r * r) * wp.exp(-lidar.extinction * (s + r))
    scale = lidar.photons * lidar.pde * reflectance / _PI * lidar.aperture_area
    return scale * total / wp.float64(256.0)


@wp.func
def radiometric_signal(
    lidar: Lidar, view: wp.vec3d, distance: wp.float64, normal: wp.vec3d, reflectance: wp.float64
) -> wp.float64:
    """Signal detections per pulse by radiometry: eq 7 with K = 4, cos(theta_in) cos^4(psi) and the beam's exact fluence.

    A surface that fills the pixel has no cos(theta_out), because its footprint grows by the inverse. A beam that is narrower than
    two pixels carries cos(theta_out) instead of cos(theta_in).
    """
    x = distance * view
    path = beam_path(lidar, x)
    if path <= _ZERO:
        return _ZERO
    footprint = distance * lidar.pixel_tangent
    spot = lidar.radius
    if lidar.profile != 2:
        spot = path * wp.sqrt(lidar.tan2)
    if spot < _TWO * footprint:
        return _small_spot_signal(lidar, x, view, normal, reflectance)
    fluence = beam_fluence(lidar, x)
    if lidar.profile != 1:
        # A pixel on the rim of the beam is lit in part.
        lit = int(0)
        for corner in range(4):
            du = (wp.float64(corner % 2) - _HALF) * lidar.pixel_tangent * x[2]
            dv = (wp.float64(corner / 2) - _HALF) * lidar.pixel_tangent * x[2]
            if beam_fluence(lidar, x + wp.vec3d(du, dv, _ZERO)) > _ZERO:
                lit += 1
        if lit > 0 and lit < 4:
            fluence = _ZERO
            for i in range(64):
                du = ((wp.float64(i % 8) + _HALF) / wp.float64(8.0) - _HALF) * lidar.pixel_tangent * x[2]
                dv = ((wp.float64(i / 8) + _HALF) / wp.float64(8.0) - _HALF) * lidar.pixel_tangent * x[2]
                fluence += beam_fluence(lidar, x + wp.vec3d(du, dv, _ZERO)) / wp.float64(64.0)
    cos_in = wp.max(-wp.dot(normal, beam_direction(lidar, x)), _ZERO)
    cos_psi2 = view[2] * view[2]
    collected = lidar.aperture_area * lidar.pixel_tangent * lidar.pixel_tangent * cos_psi2 * cos_psi2
    attenuation = wp.exp(-lidar.extinction * (path + distance))
    return lidar.photons * lidar.pde * fluence * cos_in * reflectance / _PI * collected * attenuation


@wp.kernel
def _signal(
    lidar: Lidar,
    view: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64),
    normal: wp.array(dtype=wp.vec3d),
    reflectance: wp.array(dtype=wp.float64),
    first: int,
    # Out:
    signal: wp.array(dtype=wp.float64),
    arrival: wp.array(dtype=wp.float64),
):
    """Launch grid: pixels."""
    i = first + wp.tid()
    r = distance[i]
    gamma = reflectance[i]
    value = _ZERO * _ONE
    time = wp.float64(wp.nan)
    if r > _ZERO:
        time = (beam_path(lidar, r * view[i]) + r) / lidar.speed
        if lidar.paper == 1:
            value = paper_signal(lidar, r, gamma)
        else:
            value = radiometric_signal(lidar, view[i], r, normal[i], gamma)
        if not (value > _ZERO):
            value = _ZERO
    signal[i] = value
    arrival[i] = time


# ---- Backscatter ---------------------------------------------------------------------------------------------------------------


@wp.func
def range_of_path(lidar: Lidar, view: wp.vec3d, path: wp.float64) -> wp.float64:
    """Distance along `view` at which light has gone `path` from the laser by the target to the lens [m]; 0 if there is none."""
    baseline2 = wp.length_sq(lidar.laser)
    if path * path <= baseline2:
        return _ZERO
    return (path * path - baseline2) / (_TWO * (path - wp.dot(view, lidar.laser)))


@wp.func
def phase_at(phase: wp.array(dtype=wp.float64), cos_theta: wp.float64) -> wp.float64:
    """Phase function [1/sr] from its table over the scattering angle, uniform on [0, pi]."""
    last = phase.shape[0] - 1
    position = wp.acos(wp.clamp(cos_theta, -_ONE, _ONE)) / _PI * wp.float64(last)
    k = wp.min(int(position), last - 1)
    w = position - wp.float64(k)
    return (_ONE - w) * phase[k] + w * phase[k + 1]


@wp.func
def single_scatter_per_metre(
    lidar: Lidar, phase: wp.array(dtype=wp.float64), view: wp.vec3d, r: wp.float64
) -> wp.float64:
    """Single-scatter detections per pulse and metre of range at distance r along `view` [1/m].

    For a laser in the lens, a narrow cone and the axis it is C_back(t) of the paper's geometry times dt/dr.
    """
    if lidar.paper == 1:
        scale = lidar.photons * lidar.pde * lidar.scattering * phase[phase.shape[0] - 1]
        # pitch^2/N^2 = 4 A (pitch/f)^2/pi
        etendue = wp.float64(4.0) / _PI * lidar.aperture_area * lidar.pixel_tangent * lidar.pixel_tangent
        return scale * etendue * wp.exp(-_TWO * lidar.extinction * r) / (wp.float64(4.0) * lidar.tan2 * r * r)
    x = r * view
    cos_theta = -wp.dot(beam_direction(lidar, x), view)
    cos_psi2 = view[2] * view[2]
    # A cos(psi)/r^2 to the lens times the r^2 (pitch/f)^2 cos^3(psi) that the pixel sees.
    collected = lidar.aperture_area * lidar.pixel_tangent * lidar.pixel_tangent * cos_psi2 * cos_psi2
    scale = lidar.photons * lidar.pde * lidar.scattering * phase_at(phase, cos_theta) * collected
    return scale * beam_fluence(lidar, x) * wp.exp(-lidar.extinction * (beam_path(lidar, x) + r))


@wp.func
def single_scatter_rate(
    lidar: Lidar, phase: wp.array(dtype=wp.float64), view: wp.vec3d, time: wp.float64
) -> wp.float64:
    """Single-scatter rate C_back(t) [1/s] on a line of sight without a target."""
    r = range_of_path(lidar, view, time * lidar.speed)
    if r < lidar.nearest:
        return _ZERO
    # path = |r u - p| + r, so that d path/dr = 1 - cos(scattering angle).
    stretch = _ONE + wp.dot(beam_direction(lidar, r * view), view)
    return single_scatter_per_metre(lidar, phase, view, r) * lidar.speed / stretch


@wp.func
def lit_interval(lidar: Lidar, view: wp.vec3d) -> wp.vec2d:
    """The part [near, far] of a line of sight inside the laser's cone (eq: |across|^2 = tan^2 along^2), far < near if none."""
    far = wp.float64(1.0e30)
    if lidar.profile != 0 or lidar.spread >= _ONE or lidar.paper == 1:
        return wp.vec2d(_ZERO, far)
    cos_half = _ONE - lidar.spread
    k = cos_half * cos_half
    da = wp.dot(view, lidar.axis)
    pa = wp.dot(lidar.laser, lidar.axis)
    a = da * da - k
    b = da * pa - k * wp.dot(view, lidar.laser)
    c = pa * pa - k * wp.length_sq(lidar.laser)
    disc = b * b - a * c
    none = wp.vec2d(_ONE, -_ONE)
    if wp.abs(a) < wp.float64(1.0e-15):
        return wp.vec2d(_ZERO, far)
    root = wp.sqrt(wp.max(disc, _ZERO))
    low = wp.min((b - root) / a, (b + root) / a)
    high = wp.max((b - root) / a, (b + root) / a)
    if a > _ZERO:
        if da > _ZERO:
            return wp.vec2d(wp.max(high, _ZERO), far)
        return wp.vec2d(_ZERO, low)
    if disc <= _ZERO or _HALF * (low + high) * da - pa <= _ZERO:
        return none
    return wp.vec2d(wp.max(low, _ZERO), high)


@wp.kernel
def _single_scatter_table(
    lidar: Lidar,
    phase: wp.array(dtype=wp.float64),
    view: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64),
    first: int,
    # Out:
    paths: wp.array2d(dtype=float),
    cumulative: wp.array2d(dtype=float),
    total: wp.array(dtype=wp.float64),
):
    """Edges in path, cumulative distribution and total of each pixel's single-scatter backscatter. Launch grid: pixels."""
    i = first + wp.tid()
    lit = lit_interval(lidar, view[i])
    near = wp.max(wp.max(lit[0], lidar.nearest), range_of_path(lidar, view[i], lidar.start * lidar.speed))
    far = wp.min(lit[1], range_of_path(lidar, view[i], lidar.stop * lidar.speed))
    if distance[i] > _ZERO:
        far = wp.min(far, distance[i])
    far = wp.max(far, near)
    # Gauss-Legendre of three nodes on panels of equal ln(range): the rate falls as a power times an exponential.
    step = wp.log(far / near) / wp.float64(TABLE_PANELS)
    offset = wp.float64(0.7745966692414834)
    half = _HALF * step
    sum = _ZERO * _ONE
    cumulative[i, 0] = float(0.0)
    r = near * _ONE
    for k in range(TABLE_PANELS + 1):
        x = r * view[i]
        paths[i, k] = float(beam_path(lidar, x) + r)
        if k < TABLE_PANELS:
            mid = r * wp.exp(half)
            low = mid * wp.exp(-offset * half)
            high = mid * wp.exp(offset * half)
            f = wp.float64(8.0) * mid * single_scatter_per_metre(lidar, phase, view[i], mid)
            f += wp.float64(5.0) * low * single_scatter_per_metre(lidar, phase, view[i], low)
            f += wp.float64(5.0) * high * single_scatter_per_metre(lidar, phase, view[i], high)
            sum += f * step / wp.float64(18.0)
            cumulative[i, k + 1] = float(sum)
            r = r * wp.exp(step)
    total[i] = sum
    if sum > _ZERO:
        for k in range(TABLE_PANELS + 1):
            cumulative[i, k] = float(wp.float64(cumulative[i, k]) / sum)


@wp.func
def background_rate(
    lidar: Lidar,
    phase: wp.array(dtype=wp.float64),
    profile: wp.array2d(dtype=float),
    i: int,
    view: wp.vec3d,
    arrival: wp.float64,
    time: wp.float64,
) -> wp.float64:
    """C_dark + C_back at a time inside the gate [1/s]; a profile is interpolated between bin centres."""
    if lidar.source == 0:
        return lidar.dark + lidar.constant
    if lidar.source == 1:
        if time > arrival:
            return lidar.dark
        return lidar.dark + single_scatter_rate(lidar, phase, view, time)
    row = i % profile.shape[0]
    last = profile.shape[1] - 1
    position = wp.clamp((time - lidar.start) / lidar.bin_width - _HALF, _ZERO, wp.float64(last))
    k = wp.min(int(position), wp.max(last - 1, 0))
    w = position - wp.float64(k)
    value = (_ONE - w) * wp.float64(profile[row, k]) + w * wp.float64(profile[row, wp.min(k + 1, last)])
    return lidar.dark + value / lidar.bin_width


# ---- Fisher information --------------------------------------------------------------------------------------------------------


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
    """Probability that the maximum-likelihood delay locks on a cluster of background counts, over 4 sigma from the truth.

    The score of a delay is the sum over counts of g(z) = ln(1 + r exp(-z^2/2)), a Poisson shot noise. With K(s) the cumulant function
    of its background part, the signal's score is the same law tilted by s = 1, and the mean number of upcrossings of
    x = K'(s) over the window follows from Rice's formula with the saddlepoint density. P = E[1 - exp(-upcrossings(score of the signal))].
    Two factors stand for what the first order leaves out: 1/sqrt(1 + s) is the gain of the signal's score by the fit's own
    freedom (half a chi^2 of one degree), and 1 - 0.18 b/(b + 0.2) for crossings that come in clusters is fitted to Monte Carlo.

    Args:
        signal_count: Expected signal counts of the whole acquisition.
        level: Expected background counts per sigma, b.
        window: Gate over sigma.
    """
    if signal_count <= _ZERO:
        return _ONE
    if level <= _ZERO:
        return _ZERO
    ratio = signal_count / (level * _SQRT_2PI)
    reach = wp.max(wp.sqrt(_TWO * wp.log(_ONE + ratio)) + wp.float64(3.5), wp.float64(5.0))
    h = reach / wp.float64(24.0)
    spread = _ZERO * _ONE
    for j in range(25):
        z = wp.float64(j) * h
        e = ratio * wp.exp(-_HALF * z * z)
        g = wp.log(_ONE + e)
        spread += wp.where(j == 0, _ONE, _TWO) * (_ONE + e) * g * g
    width = wp.float64(7.0) / wp.sqrt(level * h * spread)
    low = wp.max(_ONE - width, -_ONE)
    high = wp.min(_ONE + width, wp.float64(3.0))
    step = (high - low) / wp.float64(32.0)
    clusters = wp.max(window - wp.float64(8.0), _ZERO) * (_ONE - wp.float64(0.18) * level / (level + wp.float64(0.2)))
    mass = _ZERO * _ONE
    lost = _ZERO * _ONE
    most = _ZERO * _ONE
    # From high scores to low ones, so that the number of crossings can be kept from falling below the mean score.
    for n in range(33):
        s = high - wp.float64(n) * step
        k0 = _ZERO * _ONE
        k1 = _ZERO * _ONE
        k2 = _ZERO * _ONE
        slope = _ZERO * _ONE
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
    return lost / mass


@wp.func
def recorded_photons(
    alpha: wp.float64, count_law: int, acquisitions: wp.float64, pulses_per_frame: wp.float64
) -> wp.float64:
    """Recorded photons of a pixel: `acquisitions` is the number of pulses (per_pulse) or of frames of ην pulses each."""
    if count_law == 0:
        return acquisitions * one_minus_exp(alpha)
    if count_law == 1:
        return acquisitions * one_minus_exp(alpha * pulses_per_frame)
    return acquisitions * (_ONE - wp.pow(wp.max(_ONE - alpha, _ZERO), pulses_per_frame))


@wp.kernel
def _statistics(
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
    first: int,
    # Out:
    alpha: wp.array(dtype=wp.float64),
    fisher: wp.array(dtype=wp.float64),
    sigma_time: wp.array(dtype=wp.float64),
    outlier: wp.array(dtype=wp.float64),
):
    """α (integral of eq 8), Fisher information per detected photon (eq 9), σ* and the outlier probability. Grid: pixels."""
    i = first + wp.tid()
    s = signal[i]
    mu = arrival[i]
    sigma = lidar.sigma
    gate = lidar.stop - lidar.start
    noise = lidar.dark * gate + backscatter[i]
    fraction = _ZERO * _ONE
    if s > _ZERO:
        fraction = _normal_cdf((lidar.stop - mu) / sigma) - _normal_cdf((lidar.start - mu) / sigma)
    a = noise + s * fraction
    alpha[i] = a
    information = _ZERO * _ONE  # ∫ (dL/dμ)²/L dt [1/s²], per pulse
    local = _ZERO * _ONE  # background rate under the pulse
    local_weight = _ZERO * _ONE
    if s * fraction > _ZERO:
        # Halves on both sides of μ, where backscatter ends; 24 panels of five Gauss-Legendre nodes each, at most 0.5 σ wide.
        for side in range(2):
            low = wp.max(lidar.start, mu - wp.float64(12.0) * sigma)
            high = wp.min(lidar.stop, mu)
            if side == 1:
                low = wp.max(lidar.start, mu)
                high = wp.min(lidar.stop, mu + wp.float64(12.0) * sigma)
            half = (high - low) / wp.float64(48.0)
            if half > _ZERO:
                for panel in range(24):
                    middle = low + (_TWO * wp.float64(panel) + _ONE) * half
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
                        level = background_rate(lidar, phase, profile, i, view[i], mu, t)
                        rate = level + pulse
                        if rate > _ZERO:
                            information += w * half * pulse * (pulse / rate) * z * z / (sigma * sigma)
                        local += w * half * pulse * level
                        local_weight += w * half * pulse
    counts = recorded_photons(a, count_law, acquisitions, pulses_per_frame)
    f = _ZERO * _ONE
    sigma_star = wp.float64(wp.nan)
    p = _ONE * _ONE
    if information > _ZERO:
        f = information / a
        sigma_star = _ONE / wp.sqrt(counts * f)
        # The flat background of the model: harmonic mean of the level under the pulse and the mean over the gate.
        mean = noise / gate
        under = local / wp.max(local_weight, wp.float64(1.0e-300))
        flat = _ZERO * _ONE
        if mean > _ZERO and under > _ZERO:
            flat = _TWO * mean * under / (mean + under)
        p = outlier_probability(counts * s * fraction / a, counts * flat * sigma / a, gate / sigma)
    fisher[i] = f
    sigma_time[i] = sigma_star
    outlier[i] = p


# ---- Depth frames --------------------------------------------------------------------------------------------------------------


@wp.func
def _open01(word: wp.uint32) -> float:
    """Uniform in (0, 1] with full resolution near 0, for the logarithm of Box and Muller."""
    return (float(word) + 0.5) * 2.3283064365386963e-10


@wp.struct
class Sampler:
    """What turns a path into a depth: laser position [m] and first pixel and frame pair of the launch."""

    laser: wp.vec3
    pixels: int
    first_frame: int
    frames: int
    seed: wp.uint64


@wp.func
def _stray_depth(
    sampler: Sampler,
    view: wp.vec3,
    paths: wp.array2d(dtype=float),
    cumulative: wp.array2d(dtype=float),
    pixel: int,
    u: float,
) -> float:
    """Depth that belongs to a path drawn from a pixel's backscatter by the inverse of its distribution."""
    row = pixel % cumulative.shape[0]
    edges = pixel % paths.shape[0]
    low = int(0)
    high = int(cumulative.shape[1] - 1)
    while high - low > 1:
        middle = (low + high) / 2
        if cumulative[row, middle] <= u:
            low = middle
        else:
            high = middle
    below = cumulative[row, low]
    width = cumulative[row, high] - below
    w = float(0.5)
    if width > 0.0:
        w = wp.clamp((u - below) / width, 0.0, 1.0)
    path = paths[edges, low] + w * (paths[edges, high] - paths[edges, low])
    baseline2 = wp.length_sq(sampler.laser)
    if path * path <= baseline2:
        return wp.nan
    return view[2] * (path * path - baseline2) / (2.0 * (path - wp.dot(view, sampler.laser)))


@wp.kernel
def _frames(
    sampler: Sampler,
    view: wp.array(dtype=wp.vec3),
    depth: wp.array(dtype=float),
    sigma_depth: wp.array(dtype=float),
    probability: wp.array(dtype=float),
    paths: wp.array2d(dtype=float),
    cumulative: wp.array2d(dtype=float),
    first: int,
    # Out:
    frames: wp.array2d(dtype=float),
    labels: wp.array2d(dtype=wp.bool),
):
    """μ + N(0, σ*²), or with some probability a backscatter photon. Launch grid: frame pairs x pixels.

    One block of random numbers serves two frames; a draw depends on seed, pixel and frame number alone.
    """
    tid = first + wp.tid()
    pair = tid / sampler.pixels
    pixel = tid - pair * sampler.pixels
    pair += sampler.first_frame / 2
    block = random_block(sampler.seed, wp.uint64(pixel), wp.uint32(2 * pair), STREAM_ANALYTIC)
    radius = sigma_depth[pixel] * wp.sqrt(-2.0 * wp.log(_open01(block[0])))
    angle = 6.283185307179586 * u01(block[1])
    p = probability[pixel]
    for k in range(2):
        frame = 2 * pair + k - sampler.first_frame
        if frame >= 0 and frame < sampler.frames:
            shift = radius * wp.cos(angle)
            word = block[2]
            if k == 1:
                shift = radius * wp.sin(angle)
                word = block[3]
            value = depth[pixel] + shift
            stray = u01(word) < p
            if stray:
                extra = random_block(sampler.seed, wp.uint64(pixel), wp.uint32(2 * pair + 1), STREAM_ANALYTIC)
                draw = extra[0]
                if k == 1:
                    draw = extra[1]
                value = _stray_depth(sampler, view[pixel], paths, cumulative, pixel, u01(draw))
            frames[frame, pixel] = value
            labels[frame, pixel] = stray


# ---- Cramér–Rao bound of a histogram -------------------------------------------------------------------------------------------


@wp.kernel
def _histogram_information(
    signal: wp.array2d(dtype=float),
    background: wp.array2d(dtype=float),
    taps: wp.array(dtype=wp.float64),
    slope_taps: wp.array(dtype=wp.float64),
    first_photon: int,
    first: int,
    # Out:
    information: wp.array(dtype=wp.float64),
):
    """Fisher information of the delay per pulse, in 1/bins². Launch grid: pixels.

    Taps convolve both cubes with the response; slope taps give the derivative of a bin's signal with respect to the delay.
    """
    i = first + wp.tid()
    row = i % background.shape[0]
    bins = signal.shape[1]
    levels = background.shape[1]
    reach = taps.shape[0] / 2
    slope_reach = slope_taps.shape[0] / 2
    total = _ZERO * _ONE
    before = _ZERO * _ONE
    for k in range(bins):
        rate = _ZERO * _ONE
        for j in range(wp.max(0, k - reach), wp.min(bins, k + reach + 1)):
            tap = taps[k - j + reach]
            rate += tap * (wp.float64(signal[i, j]) + wp.float64(background[row, wp.min(j, levels - 1)]))
        slope = _ZERO * _ONE
        for j in range(wp.max(0, k - slope_reach), wp.min(bins, k + slope_reach + 1)):
            slope += slope_taps[k - j + slope_reach] * wp.float64(signal[i, j])
        if rate > _ZERO:
            if first_photon == 1:
                # One trial a bin among the pulses that have not fired: exp(-λ)(dλ)²/(1 - exp(-λ)).
                total += wp.exp(-before - rate) * slope * slope / one_minus_exp(rate)
                before += rate
            else:
                total += slope * slope / rate
    information[i] = total


# ---- Launchers -----------------------------------------------------------------------------------------------------------------


def _launch(kernel: wp.Kernel, size: int, inputs: Sequence[Any], outputs: Sequence[Any], device: Any) -> None:
    """Launches over `size` threads; the CPU's share is cut up between Python threads, which run while a launch holds no lock."""
    device = wp.get_device(device)
    limit = 1 << 30  # wp.tid() is a 32-bit integer
    workers = min(os.cpu_count() or 1, max(size // 4096, 1)) if device.is_cpu else 1
    chunk = min(limit, -(-size // workers))
    starts = range(0, size, chunk)

    def one(start: int) -> None:
        wp.launch(kernel, dim=min(chunk, size - start), inputs=[*inputs, start], outputs=[*outputs], device=device)

    if len(starts) == 1 or not device.is_cpu:
        for start in starts:
            one(start)
        return
    kernel.module.load(device)  # compiled once, not by every thread
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, starts))


def signal_map(
    lidar: Any, view: wp.array, distance: wp.array, normal: wp.array, reflectance: wp.array
) -> tuple[wp.array, wp.array]:
    """Signal detections per pulse and arrival time of each pixel.

    Args:
        lidar: A `Lidar`.
        view: vec3d `[pixel]`, unit line of sight.
        distance: float64 `[pixel]` [m]; NaN or 0 where nothing is hit.
        normal: vec3d `[pixel]`, unit, towards the camera.
        reflectance: float64 `[pixel]`.

    Returns:
        Signal float64 `[pixel]` (0 without a target) and arrival time float64 `[pixel]` [s] (NaN without a target).
    """
    count, device = view.shape[0], view.device
    signal = wp.empty(count, dtype=wp.float64, device=device)
    arrival = wp.empty(count, dtype=wp.float64, device=device)
    _launch(_signal, count, [lidar, view, distance, normal, reflectance], [signal, arrival], device)
    return signal, arrival


def single_scatter_table(
    lidar: Any, phase: wp.array, view: wp.array, distance: wp.array
) -> tuple[wp.array, wp.array, wp.array]:
    """Where and when each pixel's single-scatter backscatter comes from.

    Args:
        lidar: A `Lidar`; the table runs over its gate, from `nearest` on and up to the target.
        phase: float64 `[n]`, phase function [1/sr] at angles uniform on [0, π].
        view, distance: As for `signal_map`.

    Returns:
        Edges in path float32 `[pixel, TABLE_PANELS + 1]` [m], cumulative distribution of the same shape, and the total
        detections per pulse float64 `[pixel]`.
    """
    count, device = view.shape[0], view.device
    panels = int(TABLE_PANELS) + 1
    paths = wp.empty((count, panels), dtype=float, device=device)
    cumulative = wp.empty((count, panels), dtype=float, device=device)
    total = wp.empty(count, dtype=wp.float64, device=device)
    _launch(_single_scatter_table, count, [lidar, phase, view, distance], [paths, cumulative, total], device)
    return paths, cumulative, total


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
) -> tuple[wp.array, wp.array, wp.array, wp.array]:
    """Detections per pulse α, Fisher information per photon [1/s²], σ* [s] and outlier probability, float64 `[pixel]` each.

    Args:
        lidar, phase, view: As for `single_scatter_table`.
        profile: float32 `[1 or pixel, bin]`, backscatter detections per pulse and bin; used when `lidar.source` says so.
        signal, arrival: Of `signal_map`.
        backscatter: float64 `[pixel]`, backscatter detections per pulse within the gate.
        count_law: One of `COUNT_LAWS`.
        acquisitions: Pulses (`"per_pulse"`), or frames.
        pulses_per_frame: ην, for the laws per frame.

    σ* is NaN and F is 0 where no signal falls into the gate.
    """
    count, device = view.shape[0], view.device
    out = tuple(wp.empty(count, dtype=wp.float64, device=device) for _ in range(4))
    law = COUNT_LAWS.index(count_law)
    inputs = [
        lidar,
        phase,
        profile,
        view,
        signal,
        arrival,
        backscatter,
        law,
        float(acquisitions),
        float(pulses_per_frame),
    ]
    _launch(_statistics, count, inputs, out, device)
    return out


def sample_frames(
    view: wp.array,
    depth: wp.array,
    sigma_depth: wp.array,
    probability: wp.array,
    paths: wp.array,
    cumulative: wp.array,
    *,
    laser: Sequence[float],
    first_frame: int,
    frames: int,
    seed: int,
    out: tuple[wp.array, wp.array] | None = None,
    progress: Callable[[int], None] | None = None,
) -> tuple[wp.array, wp.array]:
    """Depth frames and which of their pixels report backscatter: float32 and bool `[frames, pixel]`.

    Frame n is the same whatever range of frames it is drawn in.

    Args:
        view: vec3 `[pixel]`.
        depth, sigma_depth: float32 `[pixel]` [m]; NaN for no estimate.
        probability: float32 `[pixel]`, that a pixel reports backscatter instead.
        paths, cumulative: Edges in path [m] and distribution of the backscatter, float32 `[1 or pixel, n]`.
        laser: Position of the laser [m].
        first_frame, frames: The range of frames.
        seed: 64-bit.
        out: Arrays to write into.
        progress: Called with the number of frames done.
    """
    pixels, device = view.shape[0], view.device
    if out is None:
        out = (
            wp.empty((frames, pixels), dtype=float, device=device),
            wp.empty((frames, pixels), dtype=wp.bool, device=device),
        )
    pairs_per_launch = max((1 << 30) // pixels, 1) // 2 * 2 or 1
    for start in range(0, frames, 2 * pairs_per_launch):
        stop = min(start + 2 * pairs_per_launch, frames)
        sampler = Sampler()
        sampler.laser = wp.vec3(*map(float, laser))
        sampler.pixels = pixels
        sampler.first_frame = first_frame + start
        sampler.frames = stop - start
        sampler.seed = wp.uint64(seed)
        pairs = (first_frame + stop + 1) // 2 - (first_frame + start) // 2
        inputs = [sampler, view, depth, sigma_depth, probability, paths, cumulative]
        _launch(_frames, pairs * pixels, inputs, [out[0][start:stop], out[1][start:stop]], device)
        if progress is not None:
            progress(stop)
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
    _launch(_histogram_information, signal.shape[0], inputs, [out], signal.device)
    return out
