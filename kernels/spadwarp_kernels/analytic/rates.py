"""The light that comes back from the target, and that which the water scatters back once: one thread a pixel.

Equation numbers are those of *A Simulation Method for Underwater SPAD Depth Imaging Datasets*, Sensors 24, 3886 (2024).
Times are from the emission of the pulse, rates in detections per pulse and second; everything in float64.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.base.native import HALF, ONE, PI, TWO, ZERO

from .optics import IN_WATER, Lidar, Optics, SightRay, check_lidar, least_range, point_at

__all__ = ["signal_map", "single_scatter_table"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TABLE_EDGES = 65
"""Edges of the arrival-time table of single-scatter backscatter, in geometric progression of range."""

_PANELS = wp.constant(TABLE_EDGES - 1)


# ---- The target.


@wp.func
def lu2024_signal(lidar: Lidar, distance: wp.float64, reflectance: wp.float64) -> wp.float64:
    """Signal detections per pulse, eq 3 to 6 in a row: eq 7 with K = 8; the focal length, here 1 m, cancels."""
    passed = wp.exp(-lidar.extinction * distance)
    # Eq 3 and 5: photons per area on the target, and at the lens, reflected evenly into the half-space.
    on_target = lidar.photons * passed / (PI * distance * distance * lidar.tan2)
    # Eq 4: those on the part of the target that the pixel sees.
    on_target = on_target * distance * distance * (lidar.pixel_tangent * lidar.pixel_tangent)
    at_lens = reflectance * on_target * passed / (TWO * PI * distance * distance)
    # Eq 6: those that the lens collects.
    f_number = HALF / wp.sqrt(lidar.aperture_area / PI)
    radius = ONE / (TWO * f_number)
    return lidar.pde * at_lens * PI * radius * radius


@wp.func
def collection(lidar: Lidar, axial: wp.float64) -> wp.float64:
    """A cos(psi)/r² to the lens times the r² (pitch/f)² cos³(psi) that a pixel sees, cos(psi) = `axial` [m² sr]."""
    cos_psi2 = axial * axial
    return lidar.aperture_area * lidar.pixel_tangent * lidar.pixel_tangent * cos_psi2 * cos_psi2


@wp.func
def _beam_ray(lidar: Lidar, radial: wp.float64, azimuth: wp.float64):
    """Origin and direction of the ray at a quantile of the beam's radius and azimuth, both in [0, 1)."""
    sign = wp.where(lidar.axis[2] < ZERO, -ONE, ONE)
    a = -ONE / (sign + lidar.axis[2])
    b = lidar.axis[0] * lidar.axis[1] * a
    b1 = wp.vec3d(ONE + sign * lidar.axis[0] * lidar.axis[0] * a, sign * b, -sign * lidar.axis[0])
    b2 = wp.vec3d(b, sign + lidar.axis[1] * lidar.axis[1] * a, -lidar.axis[1])
    phi = TWO * PI * azimuth
    across = wp.cos(phi) * b1 + wp.sin(phi) * b2
    if lidar.profile == 0:
        t = lidar.spread * radial
        return lidar.laser, (ONE - t) * lidar.axis + wp.sqrt(t * (TWO - t)) * across
    if lidar.profile == 1:
        tangent = wp.sqrt(-HALF * lidar.tan2 * wp.log(ONE - radial))
        return lidar.laser, wp.normalize(lidar.axis + tangent * across)
    return lidar.laser + lidar.radius * wp.sqrt(radial) * across, lidar.axis


@memoised
def make_radiometric_signal(optics: Optics) -> wp.Function:
    """The Warp function ``(lidar, sight, range, normal, reflectance)`` -> signal detections per pulse."""
    emit, receive, light_at, beside = optics.emit, optics.receive, optics.light, optics.beside
    spot, footprint, rough = optics.spot, optics.footprint, optics.rough

    @wp.func
    def small_spot_signal(
        lidar: Lidar, x: wp.vec3d, view: wp.vec3d, normal: wp.vec3d, reflectance: wp.float64
    ) -> wp.float64:
        """Signal where the beam illuminates part of the pixel: its rays go to the surface's tangent plane at x."""
        total = wp.float64(0.0)
        half = HALF * lidar.pixel_tangent
        for i in range(16):
            for j in range(16):
                radial = (wp.float64(i) + HALF) / wp.float64(16.0)
                azimuth = (wp.float64(j) + HALF) / wp.float64(16.0)
                origin, heading = _beam_ray(lidar, radial, azimuth)
                begin, u, passed = emit(lidar, origin, heading)
                facing = -wp.dot(normal, u)
                if facing > wp.float64(1.0e-6):
                    s = wp.dot(normal, begin - x) / facing
                    d, share, water = receive(lidar, normal, begin + s * u)
                    inside = wp.abs(d[0] - view[0] / view[2] * d[2]) <= half * d[2]
                    inside = inside and wp.abs(d[1] - view[1] / view[2] * d[2]) <= half * d[2]
                    if s > ZERO and inside and share > ZERO:
                        total += passed * share * wp.exp(-lidar.extinction * (s + water))
        scale = lidar.photons * lidar.pde * reflectance / PI * lidar.aperture_area
        return scale * total / wp.float64(256.0)

    @wp.func
    def radiometric_signal(
        lidar: Lidar, sight: SightRay, distance: wp.float64, normal: wp.vec3d, reflectance: wp.float64
    ) -> wp.float64:
        """Signal detections per pulse by radiometry: eq 7 with K = 4, cos(theta_in) cos^4(psi), the beam's own fluence.

        A surface that fills the pixel has no cos(theta_out), because its footprint grows by the inverse. A beam
        narrower than the pixel carries cos(theta_out) and not cos(theta_in).
        """
        x = point_at(sight, distance)
        light = light_at(lidar, x)
        if light.path <= ZERO:
            return ZERO
        if wp.static(not rough) and spot(lidar, light.path) < TWO * footprint(lidar, sight.distance + distance):
            return small_spot_signal(lidar, x, sight.view, normal, reflectance)
        fluence = light.fluence
        if wp.static(not rough) and lidar.profile != 1:
            # A pixel on the rim of the beam is partly illuminated.
            corners_inside = wp.int32(0)
            for corner in range(4):
                y = beside(lidar, sight, x, wp.float64(corner % 2) - HALF, wp.float64(corner / 2) - HALF)
                if light_at(lidar, y).fluence > ZERO:
                    corners_inside += 1
            if corners_inside > 0 and corners_inside < 4:
                fluence = ZERO
                for i in range(64):
                    a = (wp.float64(i % 8) + HALF) / wp.float64(8.0) - HALF
                    b = (wp.float64(i / 8) + HALF) / wp.float64(8.0) - HALF
                    fluence += light_at(lidar, beside(lidar, sight, x, a, b)).fluence / wp.float64(64.0)
        cos_in = wp.max(-wp.dot(normal, light.u), ZERO)
        attenuation = wp.exp(-lidar.extinction * (light.water + distance))
        collected = collection(lidar, sight.view[2])
        signal = lidar.photons * lidar.pde * fluence * cos_in * reflectance / PI * collected * attenuation
        return signal * sight.radiance

    return radiometric_signal


radiometric_signal = make_radiometric_signal(IN_WATER)
"""That of a camera and a laser in the water."""


@memoised
def _make_signal_kernel(optics: Optics) -> wp.Kernel:
    see, light_at, radiometric = optics.see, optics.light, make_radiometric_signal(optics)

    @wp.kernel(module="unique", module_options={"max_unroll": 1}, enable_backward=False)
    def signal_kernel(
        first: int,
        lidar: Lidar,
        view: wp.array[wp.vec3d],
        distance: wp.array[wp.float64],
        normal: wp.array[wp.vec3d],
        reflectance: wp.array[wp.float64],
        # Out:
        signal: wp.array[wp.float64],
        arrival: wp.array[wp.float64],
    ):
        """Launch grid: pixels."""
        i = first + wp.tid()
        r = distance[i]
        value = wp.float64(0.0)
        time = wp.float64(wp.nan)
        if r > ZERO:
            sight = see(lidar.ports, view[i])
            time = (light_at(lidar, point_at(sight, r)).path + r + sight.delay) / lidar.speed
            if lidar.lu2024 == 1:
                value = lu2024_signal(lidar, r, reflectance[i])
            else:
                value = radiometric(lidar, sight, r, normal[i], reflectance[i])
            if not (value > ZERO):
                value = ZERO
        signal[i] = value
        arrival[i] = time

    return signal_kernel


def signal_map(
    lidar: Any,
    view: wp.array,
    distance: wp.array,
    normal: wp.array,
    reflectance: wp.array,
    *,
    optics: Optics | None = None,
) -> tuple[wp.array, wp.array]:
    """Signal detections per pulse and arrival time of each pixel.

    Args:
        lidar: A `Lidar`.
        view: vec3d `[pixel]`, unit line of sight, as the lens sees it.
        distance: float64 `[pixel]`, length of the way in the water, from the lens or its port to the target [m]; NaN or
            0 where nothing is hit.
        normal: vec3d `[pixel]`, unit, towards the camera.
        reflectance: float64 `[pixel]`.
        optics: Of `make_optics`: what camera and laser are behind, with their parameters in `lidar.ports`; default:
            both are in the water.

    Returns:
        Signal float64 `[pixel]` (0 without a target) and arrival time float64 `[pixel]` [s] (NaN without a target).

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit each other.
    """
    optics, count, device = check_lidar(lidar, optics, view, distance=distance, reflectance=reflectance)
    check.array("normal", normal, wp.vec3d, (count,), device)
    out = tuple(wp.empty(count, dtype=wp.float64, device=device) for _ in range(2))
    inputs = [lidar, view, distance, normal, reflectance, *out]
    launch_pixels(_make_signal_kernel(optics), count, inputs, device=device)
    return out


# ---- The water.


@wp.struct
class Scattering:
    """What the water scatters back, made by `make_scattering`."""

    lines: wp.array[wp.vec3d]  # photons per pulse, extinction and scattering [1/m] of each spectral line
    phase: wp.array[wp.float64]  # phase function [1/sr] at angles uniform on [0, π]
    profile: wp.array2d[float]  # backscatter detections per pulse and bin, see `statistics_maps`


def make_scattering(
    lidar: Any, phase: Any, device: wp.Device, *, lines: Any = None, profile: wp.array | None = None
) -> Scattering:
    """The lines given, or the lidar's own photons, extinction and scattering as one line; and a phase function, whose
    table is checked. Raises `ArgumentError`."""
    check.array("phase", phase, wp.float64, (None,), device)
    check.integer("entries of phase", phase.size, 2)
    if lines is None:
        own = wp.vec3d(float(lidar.photons), float(lidar.extinction), float(lidar.scattering))
        lines = wp.array([own], dtype=wp.vec3d, device=device)
    check.array("lines", lines, wp.vec3d, (None,), device)
    check.integer("number of lines", lines.size, 1)
    water = Scattering()
    water.lines, water.phase = lines, phase
    water.profile = wp.zeros((1, 1), dtype=float, device=device) if profile is None else profile
    return water


@wp.func
def phase_at(phase: wp.array[wp.float64], cos_theta: wp.float64) -> wp.float64:
    """Phase function [1/sr] from its table over the scattering angle, uniform on [0, pi]."""
    last = phase.shape[0] - 1
    position = wp.acos(wp.clamp(cos_theta, -ONE, ONE)) / PI * wp.float64(last)
    k = wp.min(int(position), last - 1)
    w = position - wp.float64(k)
    return (ONE - w) * phase[k] + w * phase[k + 1]


@memoised
def make_single_scatter(optics: Optics) -> tuple[wp.Function, wp.Function, wp.Function, wp.Function]:
    """Warp functions for single scattering seen through some optics: detections per pulse and metre of range [1/m],
    C_back(t) without a target [1/s], and C_dark + C_back of a pixel i inside the gate [1/s]; and detections per pulse
    of the light that the surface of a sea reflects."""
    light_at, range_of_path = optics.light, optics.range_of_path

    @wp.func
    def single_scatter_per_metre(lidar: Lidar, water: Scattering, sight: SightRay, r: wp.float64) -> wp.float64:
        """Over all lines. For a laser in the lens, a narrow cone and the axis it is C_back(t) of Lu et al. 2024 times
        dt/dr."""
        total = wp.float64(0.0)
        if lidar.lu2024 == 1:
            # pitch^2/N^2 = 4 A (pitch/f)^2/pi
            etendue = wp.float64(4.0) / PI * lidar.aperture_area * lidar.pixel_tangent * lidar.pixel_tangent
            for k in range(water.lines.shape[0]):
                line = water.lines[k]
                scale = line[0] * lidar.pde * line[2] * water.phase[water.phase.shape[0] - 1]
                total += scale * etendue * wp.exp(-TWO * line[1] * r) / (wp.float64(4.0) * lidar.tan2 * r * r)
            return total
        light = light_at(lidar, point_at(sight, r))
        density = phase_at(water.phase, -wp.dot(light.u, sight.u))
        collected = collection(lidar, sight.view[2])
        path = light.water + r
        for k in range(water.lines.shape[0]):
            line = water.lines[k]
            scale = line[0] * lidar.pde * line[2] * density * collected
            total += scale * light.fluence * wp.exp(-line[1] * path)
        return total * sight.radiance

    @wp.func
    def single_scatter_rate(lidar: Lidar, water: Scattering, sight: SightRay, time: wp.float64) -> wp.float64:
        r = range_of_path(lidar.laser, lidar.ports, sight, time * lidar.speed)
        if r <= ZERO or sight.distance + r < lidar.nearest:
            return ZERO
        # path = |r u - p| + r, so that d path/dr = 1 - cos(scattering angle).
        stretch = ONE + wp.dot(light_at(lidar, point_at(sight, r)).u, sight.u)
        return single_scatter_per_metre(lidar, water, sight, r) * lidar.speed / stretch

    @wp.func
    def background_rate(
        lidar: Lidar, water: Scattering, i: int, sight: SightRay, beyond: int, time: wp.float64
    ) -> wp.float64:
        """`beyond` is 1 after the target's arrival, where water behind it scatters nothing back; a profile is
        interpolated between bin centres."""
        if lidar.source == 0:
            return lidar.dark + lidar.constant
        if lidar.source == 1:
            if beyond == 1:
                return lidar.dark
            return lidar.dark + single_scatter_rate(lidar, water, sight, time)
        row = i % water.profile.shape[0]
        last = water.profile.shape[1] - 1
        position = wp.clamp((time - lidar.start) / lidar.bin_width - HALF, ZERO, wp.float64(last))
        k = wp.min(int(position), wp.max(last - 1, 0))
        w = position - wp.float64(k)
        value = (ONE - w) * wp.float64(water.profile[row, k]) + w * wp.float64(water.profile[row, wp.min(k + 1, last)])
        return lidar.dark + value / lidar.bin_width

    @wp.func
    def glint(lidar: Lidar, sight: SightRay) -> wp.float64:
        """By facets across the line of sight, along which the laser is taken to shine."""
        s = least_range(sight)
        light = light_at(lidar, point_at(sight, s))
        path = light.path + s + sight.delay
        if path < lidar.start * lidar.speed or path > lidar.stop * lidar.speed:
            return ZERO
        port = lidar.ports.camera
        cosine = wp.dot(sight.view, wp.vec3d(port.normal))
        cos2 = cosine * cosine
        mss = TWO * lidar.ports.slope * lidar.ports.slope
        facets = wp.exp((ONE - ONE / cos2) / mss) / (PI * mss * cos2 * cos2)
        amplitude = wp.float64((port.index[2] - port.index[0]) / (port.index[2] + port.index[0]))
        # Over what the surface transmits, and spreads, as the fluence below it is.
        reflected = amplitude * amplitude / (ONE - amplitude * amplitude)
        above = light.fluence * wp.dot(sight.u, wp.vec3d(port.normal)) / cosine
        radiance = above * reflected * facets / (wp.float64(4.0) * cosine)
        return lidar.photons * lidar.pde * radiance * collection(lidar, sight.view[2])

    return single_scatter_per_metre, single_scatter_rate, background_rate, glint


single_scatter_rate = make_single_scatter(IN_WATER)[1]
"""That of a camera and a laser in the water."""


@memoised
def _make_table_kernel(optics: Optics) -> wp.Kernel:
    see, light_at, range_of_path, illuminated = optics.see, optics.light, optics.range_of_path, optics.illuminated
    (per_metre, *_, glint), rough = make_single_scatter(optics), optics.rough

    @wp.kernel(module="unique", module_options={"max_unroll": 1}, enable_backward=False)
    def table_kernel(
        first: int,
        lidar: Lidar,
        water: Scattering,
        view: wp.array[wp.vec3d],
        distance: wp.array[wp.float64],
        # Out:
        paths: wp.array2d[float],
        cumulative: wp.array2d[float],
        total: wp.array[wp.float64],
    ):
        """Edges in path, cumulative distribution and total of single-scatter backscatter. Launch grid: pixels."""
        i = first + wp.tid()
        sight = see(lidar.ports, view[i])
        opens = range_of_path(lidar.laser, lidar.ports, sight, lidar.start * lidar.speed)
        near = wp.max(wp.max(lidar.nearest - sight.distance, ZERO), opens)
        far = range_of_path(lidar.laser, lidar.ports, sight, lidar.stop * lidar.speed)
        if distance[i] > ZERO:
            far = wp.min(far, distance[i])
        lit = illuminated(lidar, sight, near, far)
        near = sight.distance + lit[0]
        far = wp.max(sight.distance + lit[1], near)
        # Gauss-Legendre of three nodes on panels of equal ln(distance from the lens): the rate falls as a power times
        # an exponential.
        step = wp.log(far / near) / wp.float64(wp.static(TABLE_EDGES - 1 - int(rough)))
        offset = wp.float64(0.7745966692414834)
        half = HALF * step
        sum = wp.float64(0.0)
        cumulative[i, 0] = 0.0
        r = wp.float64(near)
        for k in range(paths.shape[1]):
            s = r - sight.distance
            paths[i, k] = float(light_at(lidar, point_at(sight, s)).path + s + sight.delay)
            if wp.static(rough) and k == 0:
                sum = glint(lidar, sight)  # a panel of its own, without width
                cumulative[i, 1] = float(sum)
            elif k < _PANELS:
                mid = r * wp.exp(half)
                low = mid * wp.exp(-offset * half)
                high = mid * wp.exp(offset * half)
                f = wp.float64(8.0) * mid * per_metre(lidar, water, sight, mid - sight.distance)
                f += wp.float64(5.0) * low * per_metre(lidar, water, sight, low - sight.distance)
                f += wp.float64(5.0) * high * per_metre(lidar, water, sight, high - sight.distance)
                sum += f * step / wp.float64(18.0)
                cumulative[i, k + 1] = float(sum)
                r = r * wp.exp(step)
        total[i] = sum
        if sum > ZERO:
            for k in range(paths.shape[1]):
                cumulative[i, k] = float(wp.float64(cumulative[i, k]) / sum)

    return table_kernel


def single_scatter_table(
    lidar: Any,
    phase: wp.array,
    view: wp.array,
    distance: wp.array,
    *,
    lines: wp.array | None = None,
    optics: Optics | None = None,
) -> tuple[wp.array, wp.array, wp.array]:
    """Where and when each pixel's single-scatter backscatter comes from.

    Args:
        lidar: A `Lidar`; the table runs over its gate, from `nearest` on and up to the target.
        phase: float64 `[n]`, phase function [1/sr] at angles uniform on [0, π].
        view, distance, optics: As for `signal_map`.
        lines: vec3d `[line]`, a spectrum as photons per pulse, extinction and scattering [1/m] of each line, in place
            of the lidar's own; one speed holds for all.

    Returns:
        Edges in path float32 `[pixel, TABLE_EDGES]` [m], cumulative distribution of the same shape, and the total
        detections per pulse float64 `[pixel]`.

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit each other.
    """
    optics, count, device = check_lidar(lidar, optics, view, distance=distance)
    check.number("lidar.nearest", lidar.nearest, "(0, inf)")
    water = make_scattering(lidar, phase, device, lines=lines)
    paths, cumulative = (wp.empty((count, TABLE_EDGES), dtype=float, device=device) for _ in range(2))
    total = wp.empty(count, dtype=wp.float64, device=device)
    inputs = [lidar, water, view, distance, paths, cumulative, total]
    launch_pixels(_make_table_kernel(optics), count, inputs, device=device)
    return paths, cumulative, total
