"""The analytic photon budget, one thread a pixel: signal, arrival time and single-scatter backscatter.

Equation numbers are those of *A Simulation Method for Underwater SPAD Depth Imaging Datasets*, Sensors 24, 3886 (2024).
Times are from the emission of the pulse, rates in detections per pulse and second, everything in float64.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.pixels import launch_pixels

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_PI = wp.constant(wp.float64(3.141592653589793))
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))

BACKSCATTER_SOURCES = ("constant", "single_scatter", "monte_carlo")

TABLE_EDGES = 65
"""Edges of the arrival-time table of single-scatter backscatter, in geometric progression of range."""

_PANELS = wp.constant(TABLE_EDGES - 1)


@wp.struct
class Lidar:
    """Laser, water, camera and gate as the analytic model needs them.

    Attributes:
        lu2024: 1 if the photon budget of Lu et al. 2024 (K = 8, small angles, no cosines) replaces radiometry, else 0.
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
        bin_width: Of the Monte Carlo profile [s] (source 2).
    """

    lu2024: int
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


# The paper's photon budget


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
def lu2024_signal(lidar: Lidar, distance: wp.float64, reflectance: wp.float64) -> wp.float64:
    """Signal detections per pulse, eq 3 to 6 in a row, which is eq 7 with K = 8.

    The focal length cancels; here it is 1 m: the pixel's sides are pixel_tangent, the f-number is 1/(2 radius).
    """
    rho = pulse_fluence(lidar.photons, lidar.extinction, distance, lidar.tan2)
    on_target = footprint_energy(rho, distance, lidar.pixel_tangent * lidar.pixel_tangent, _ONE)
    at_lens = lens_fluence(on_target, reflectance, lidar.extinction, distance)
    f_number = _HALF / wp.sqrt(lidar.aperture_area / _PI)
    return pixel_energy(at_lens, lidar.pde, _ONE, f_number)


# Radiometry


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
    """Signal where the beam lights part of the pixel: its rays are followed to the surface's tangent plane at x."""
    total = wp.float64(0.0)
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
    """Signal detections per pulse by radiometry: eq 7 with K = 4, cos(theta_in) cos^4(psi) and the beam's own fluence.

    A surface that fills the pixel has no cos(theta_out), because its footprint grows by the inverse. A beam narrower
    than the pixel carries cos(theta_out) and not cos(theta_in).
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
        lit = wp.int32(0)
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
    first: int,
    lidar: Lidar,
    view: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64),
    normal: wp.array(dtype=wp.vec3d),
    reflectance: wp.array(dtype=wp.float64),
    # Out:
    signal: wp.array(dtype=wp.float64),
    arrival: wp.array(dtype=wp.float64),
):
    """Launch grid: pixels."""
    i = first + wp.tid()
    r = distance[i]
    gamma = reflectance[i]
    value = wp.float64(0.0)
    time = wp.float64(wp.nan)
    if r > _ZERO:
        time = (beam_path(lidar, r * view[i]) + r) / lidar.speed
        if lidar.lu2024 == 1:
            value = lu2024_signal(lidar, r, gamma)
        else:
            value = radiometric_signal(lidar, view[i], r, normal[i], gamma)
        if not (value > _ZERO):
            value = _ZERO
    signal[i] = value
    arrival[i] = time


# Backscatter


@wp.func
def range_of_path(lidar: Lidar, view: wp.vec3d, path: wp.float64) -> wp.float64:
    """Distance along `view` at which light has gone `path` from laser to target to lens [m]; 0 if there is none."""
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
    if lidar.lu2024 == 1:
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
    """The part [near, far] of a line of sight inside the laser's uniform cone; far < near if there is none."""
    far = wp.float64(1.0e30)
    if lidar.profile != 0 or lidar.spread >= _ONE or lidar.lu2024 == 1:
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
    first: int,
    lidar: Lidar,
    phase: wp.array(dtype=wp.float64),
    view: wp.array(dtype=wp.vec3d),
    distance: wp.array(dtype=wp.float64),
    # Out:
    paths: wp.array2d(dtype=float),
    cumulative: wp.array2d(dtype=float),
    total: wp.array(dtype=wp.float64),
):
    """Edges in path, cumulative distribution and total of single-scatter backscatter. Launch grid: pixels."""
    i = first + wp.tid()
    lit = lit_interval(lidar, view[i])
    near = wp.max(wp.max(lit[0], lidar.nearest), range_of_path(lidar, view[i], lidar.start * lidar.speed))
    far = wp.min(lit[1], range_of_path(lidar, view[i], lidar.stop * lidar.speed))
    if distance[i] > _ZERO:
        far = wp.min(far, distance[i])
    far = wp.max(far, near)
    # Gauss-Legendre of three nodes on panels of equal ln(range): the rate falls as a power times an exponential.
    step = wp.log(far / near) / wp.float64(_PANELS)
    offset = wp.float64(0.7745966692414834)
    half = _HALF * step
    sum = wp.float64(0.0)
    cumulative[i, 0] = 0.0
    r = wp.float64(near)
    for k in range(paths.shape[1]):
        x = r * view[i]
        paths[i, k] = float(beam_path(lidar, x) + r)
        if k < _PANELS:
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
        for k in range(paths.shape[1]):
            cumulative[i, k] = float(wp.float64(cumulative[i, k]) / sum)


@wp.func
def background_rate(
    lidar: Lidar,
    phase: wp.array(dtype=wp.float64),
    profile: wp.array2d(dtype=float),
    i: int,
    view: wp.vec3d,
    beyond: int,
    time: wp.float64,
) -> wp.float64:
    """C_dark + C_back at a time inside the gate [1/s]; a profile is interpolated between bin centres.

    `beyond` is 1 after the target's arrival, where water behind it scatters nothing back.
    """
    if lidar.source == 0:
        return lidar.dark + lidar.constant
    if lidar.source == 1:
        if beyond == 1:
            return lidar.dark
        return lidar.dark + single_scatter_rate(lidar, phase, view, time)
    row = i % profile.shape[0]
    last = profile.shape[1] - 1
    position = wp.clamp((time - lidar.start) / lidar.bin_width - _HALF, _ZERO, wp.float64(last))
    k = wp.min(int(position), wp.max(last - 1, 0))
    w = position - wp.float64(k)
    value = (_ONE - w) * wp.float64(profile[row, k]) + w * wp.float64(profile[row, wp.min(k + 1, last)])
    return lidar.dark + value / lidar.bin_width


# Launchers


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
    launch_pixels(_signal, count, [lidar, view, distance, normal, reflectance, signal, arrival], device=device)
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
        Edges in path float32 `[pixel, TABLE_EDGES]` [m], cumulative distribution of the same shape, and the total
        detections per pulse float64 `[pixel]`.
    """
    count, device = view.shape[0], view.device
    paths = wp.empty((count, TABLE_EDGES), dtype=float, device=device)
    cumulative = wp.empty((count, TABLE_EDGES), dtype=float, device=device)
    total = wp.empty(count, dtype=wp.float64, device=device)
    launch_pixels(_single_scatter_table, count, [lidar, phase, view, distance, paths, cumulative, total], device=device)
    return paths, cumulative, total
