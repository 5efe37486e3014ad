"""The light that comes back from the target, one thread a pixel: detections per pulse and arrival time.

Equation numbers are those of *A Simulation Method for Underwater SPAD Depth Imaging Datasets*, Sensors 24, 3886 (2024).
Times are from the emission of the pulse; everything in float64.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import check_array, check_arrays
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.base.native import HALF, ONE, PI, TWO, ZERO

from .lidar import Lidar
from .optics import IN_WATER, Optics, SightRay, check_optics, point_at

__all__ = ["signal_map"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def pulse_fluence(energy: wp.float64, extinction: wp.float64, distance: wp.float64, tan2: wp.float64) -> wp.float64:
    """Energy of a pulse per area on the target [J/m^2] (eq 3)."""
    return energy * wp.exp(-extinction * distance) / (PI * distance * distance * tan2)


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
    return reflectance * energy * wp.exp(-extinction * distance) / (TWO * PI * distance * distance)


@wp.func
def pixel_energy(fluence: wp.float64, pdp: wp.float64, focal_length: wp.float64, f_number: wp.float64) -> wp.float64:
    """Energy collected by the lens and detected with probability pdp [J] (eq 6)."""
    radius = focal_length / (TWO * f_number)
    return pdp * fluence * PI * radius * radius


@wp.func
def lu2024_signal(lidar: Lidar, distance: wp.float64, reflectance: wp.float64) -> wp.float64:
    """Signal detections per pulse, eq 3 to 6 in a row, which is eq 7 with K = 8.

    The focal length cancels; here it is 1 m: the pixel's sides are pixel_tangent, the f-number is 1/(2 radius).
    """
    rho = pulse_fluence(lidar.photons, lidar.extinction, distance, lidar.tan2)
    on_target = footprint_energy(rho, distance, lidar.pixel_tangent * lidar.pixel_tangent, ONE)
    at_lens = lens_fluence(on_target, reflectance, lidar.extinction, distance)
    f_number = HALF / wp.sqrt(lidar.aperture_area / PI)
    return pixel_energy(at_lens, lidar.pde, ONE, f_number)


@wp.func
def _beam_ray(lidar: Lidar, radial: wp.float64, azimuth: wp.float64, out_origin: wp.bool) -> wp.vec3d:
    """Origin or direction of the ray at a quantile of the beam's radius and azimuth, both in [0, 1)."""
    sign = wp.where(lidar.axis[2] < ZERO, -ONE, ONE)
    a = -ONE / (sign + lidar.axis[2])
    b = lidar.axis[0] * lidar.axis[1] * a
    b1 = wp.vec3d(ONE + sign * lidar.axis[0] * lidar.axis[0] * a, sign * b, -sign * lidar.axis[0])
    b2 = wp.vec3d(b, sign + lidar.axis[1] * lidar.axis[1] * a, -lidar.axis[1])
    phi = TWO * PI * azimuth
    across = wp.cos(phi) * b1 + wp.sin(phi) * b2
    if out_origin:
        if lidar.profile == 2:
            return lidar.laser + lidar.radius * wp.sqrt(radial) * across
        return lidar.laser
    if lidar.profile == 0:
        t = lidar.spread * radial
        return (ONE - t) * lidar.axis + wp.sqrt(t * (TWO - t)) * across
    if lidar.profile == 1:
        tangent = wp.sqrt(-HALF * lidar.tan2 * wp.log(ONE - radial))
        return wp.normalize(lidar.axis + tangent * across)
    return lidar.axis


@memoised
def make_radiometric_signal(optics: Optics) -> wp.Function:
    """The Warp function ``(lidar, sight, distance, normal, reflectance)`` -> signal detections per pulse, `distance`
    being the range."""
    emit, receive, light_at, beside = optics.emit, optics.receive, optics.light, optics.beside
    spot, footprint = optics.spot, optics.footprint

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
                origin = _beam_ray(lidar, radial, azimuth, True)
                ray = emit(lidar, origin, _beam_ray(lidar, radial, azimuth, False))
                facing = -wp.dot(normal, ray.u)
                if facing > wp.float64(1.0e-6):
                    s = wp.dot(normal, ray.x - x) / facing
                    seen = receive(lidar, normal, ray.x + s * ray.u)
                    d = seen.ray
                    inside = wp.abs(d[0] - view[0] / view[2] * d[2]) <= half * d[2]
                    inside = inside and wp.abs(d[1] - view[1] / view[2] * d[2]) <= half * d[2]
                    if s > ZERO and inside and seen.share > ZERO:
                        total += ray.transmission * seen.share * wp.exp(-lidar.extinction * (s + seen.water))
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
        view = sight.view
        light = light_at(lidar, x)
        if light.path <= ZERO:
            return ZERO
        if spot(lidar, light.path) < TWO * footprint(lidar, sight.distance + distance):
            return small_spot_signal(lidar, x, view, normal, reflectance)
        fluence = light.fluence
        if lidar.profile != 1:
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
        cos_psi2 = view[2] * view[2]
        collected = lidar.aperture_area * lidar.pixel_tangent * lidar.pixel_tangent * cos_psi2 * cos_psi2
        attenuation = wp.exp(-lidar.extinction * (light.water + distance))
        signal = lidar.photons * lidar.pde * fluence * cos_in * reflectance / PI * collected * attenuation
        return signal * sight.radiance

    return radiometric_signal


radiometric_signal = make_radiometric_signal(IN_WATER)
"""That of a camera and a laser in the water."""


@memoised
def _make_kernel(optics: Optics) -> wp.Kernel:
    see, light_at = optics.see, optics.light
    radiometric = make_radiometric_signal(optics)

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
        gamma = reflectance[i]
        value = wp.float64(0.0)
        time = wp.float64(wp.nan)
        if r > ZERO:
            sight = see(lidar.ports, view[i])
            time = (light_at(lidar, point_at(sight, r)).path + r + sight.delay) / lidar.speed
            if lidar.lu2024 == 1:
                value = lu2024_signal(lidar, r, gamma)
            else:
                value = radiometric(lidar, sight, r, normal[i], gamma)
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
    optics = check_optics(lidar, optics)
    check_array("view", view, wp.vec3d, (None,))
    count, device = view.shape[0], view.device
    check_arrays(wp.float64, (count,), device, distance=distance, reflectance=reflectance)
    check_array("normal", normal, wp.vec3d, (count,), device)
    signal = wp.empty(count, dtype=wp.float64, device=device)
    arrival = wp.empty(count, dtype=wp.float64, device=device)
    inputs = [lidar, view, distance, normal, reflectance, signal, arrival]
    launch_pixels(_make_kernel(optics), count, inputs, device=device)
    return signal, arrival
