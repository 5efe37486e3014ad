"""The light that the water scatters back once, one thread a pixel: its rate, and where it comes from.

Rates are in detections per pulse and second, in float64.
"""

from typing import Any, NamedTuple

import warp as wp

from spadwarp_kernels.base.arguments import check_array, check_integer, check_number
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.base.native import HALF, ONE, PI, TWO, ZERO

from .lidar import Lidar
from .optics import IN_WATER, Optics, SightRay, check_optics, point_at

__all__ = ["single_scatter_table"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TABLE_EDGES = 65
"""Edges of the arrival-time table of single-scatter backscatter, in geometric progression of range."""


_PANELS = wp.constant(TABLE_EDGES - 1)


@wp.struct
class Scattering:
    """What the water scatters back, made by `make_scattering`."""

    lines: wp.array[wp.vec3d]  # photons per pulse, extinction and scattering [1/m] of each spectral line
    phase: wp.array[wp.float64]  # phase function [1/sr] at angles uniform on [0, π]
    profile: wp.array2d[float]  # backscatter detections per pulse and bin, see `statistics_maps`


@wp.func
def phase_at(phase: wp.array[wp.float64], cos_theta: wp.float64) -> wp.float64:
    """Phase function [1/sr] from its table over the scattering angle, uniform on [0, pi]."""
    last = phase.shape[0] - 1
    position = wp.acos(wp.clamp(cos_theta, -ONE, ONE)) / PI * wp.float64(last)
    k = wp.min(int(position), last - 1)
    w = position - wp.float64(k)
    return (ONE - w) * phase[k] + w * phase[k + 1]


class SingleScatter(NamedTuple):
    """Warp functions for single scattering seen through some optics."""

    per_metre: wp.Function  # (lidar, water, sight, r) -> detections per pulse and metre of range [1/m]
    rate: wp.Function  # (lidar, water, sight, time) -> C_back(t) [1/s]


@memoised
def make_single_scatter(optics: Optics) -> SingleScatter:
    """The functions for a camera and a laser with these optics."""
    light_at, range_of_path = optics.light, optics.range_of_path

    @wp.func
    def single_scatter_per_metre(lidar: Lidar, water: Scattering, sight: SightRay, r: wp.float64) -> wp.float64:
        """Single-scatter detections per pulse and metre of range at the range r [1/m], over all lines.

        For a laser in the lens, a narrow cone and the axis it is C_back(t) of Lu et al. 2024 times dt/dr.
        """
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
        cos_theta = -wp.dot(light.u, sight.u)
        axial = sight.view[2]
        cos_psi2 = axial * axial
        # A cos(psi)/r^2 to the lens times the r^2 (pitch/f)^2 cos^3(psi) that the pixel sees.
        collected = lidar.aperture_area * lidar.pixel_tangent * lidar.pixel_tangent * cos_psi2 * cos_psi2
        density = phase_at(water.phase, cos_theta)
        path = light.water + r
        for k in range(water.lines.shape[0]):
            line = water.lines[k]
            scale = line[0] * lidar.pde * line[2] * density * collected
            total += scale * light.fluence * wp.exp(-line[1] * path)
        return total * sight.radiance

    @wp.func
    def single_scatter_rate(lidar: Lidar, water: Scattering, sight: SightRay, time: wp.float64) -> wp.float64:
        """Single-scatter rate C_back(t) [1/s] on a line of sight without a target."""
        r = range_of_path(lidar.laser, lidar.ports, sight, time * lidar.speed)
        if r <= ZERO or sight.distance + r < lidar.nearest:
            return ZERO
        # path = |r u - p| + r, so that d path/dr = 1 - cos(scattering angle).
        stretch = ONE + wp.dot(light_at(lidar, point_at(sight, r)).u, sight.u)
        return single_scatter_per_metre(lidar, water, sight, r) * lidar.speed / stretch

    return SingleScatter(single_scatter_per_metre, single_scatter_rate)


single_scatter_rate = make_single_scatter(IN_WATER).rate
"""That of a camera and a laser in the water."""


@memoised
def _make_table_kernel(optics: Optics) -> wp.Kernel:
    see, light_at, range_of_path, illuminated = optics.see, optics.light, optics.range_of_path, optics.illuminated
    per_metre = make_single_scatter(optics).per_metre

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
        step = wp.log(far / near) / wp.float64(_PANELS)
        offset = wp.float64(0.7745966692414834)
        half = HALF * step
        sum = wp.float64(0.0)
        cumulative[i, 0] = 0.0
        r = wp.float64(near)
        for k in range(paths.shape[1]):
            s = r - sight.distance
            paths[i, k] = float(light_at(lidar, point_at(sight, s)).path + s + sight.delay)
            if k < _PANELS:
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


@memoised
def make_background_rate(optics: Optics) -> wp.Function:
    """The Warp function of the rate of dark counts and backscatter for these optics."""
    scatter_rate = make_single_scatter(optics).rate

    @wp.func
    def background_rate(
        lidar: Lidar, water: Scattering, i: int, sight: SightRay, beyond: int, time: wp.float64
    ) -> wp.float64:
        """C_dark + C_back at a time inside the gate [1/s]; a profile is interpolated between bin centres.

        `beyond` is 1 after the target's arrival, where water behind it scatters nothing back.
        """
        if lidar.source == 0:
            return lidar.dark + lidar.constant
        if lidar.source == 1:
            if beyond == 1:
                return lidar.dark
            return lidar.dark + scatter_rate(lidar, water, sight, time)
        row = i % water.profile.shape[0]
        last = water.profile.shape[1] - 1
        position = wp.clamp((time - lidar.start) / lidar.bin_width - HALF, ZERO, wp.float64(last))
        k = wp.min(int(position), wp.max(last - 1, 0))
        w = position - wp.float64(k)
        value = (ONE - w) * wp.float64(water.profile[row, k]) + w * wp.float64(water.profile[row, wp.min(k + 1, last)])
        return lidar.dark + value / lidar.bin_width

    return background_rate


def make_scattering(
    lidar: Any, phase: Any, device: wp.Device, *, lines: Any = None, profile: wp.array | None = None
) -> Scattering:
    """The lines given, or the lidar's own photons, extinction and scattering as one line; and a phase function, whose
    table is checked. Raises `ArgumentError`."""
    check_array("phase", phase, wp.float64, (None,), device)
    check_integer("entries of phase", phase.size, 2)
    if lines is None:
        own = wp.vec3d(float(lidar.photons), float(lidar.extinction), float(lidar.scattering))
        lines = wp.array([own], dtype=wp.vec3d, device=device)
    check_array("lines", lines, wp.vec3d, (None,), device)
    check_integer("number of lines", lines.size, 1)
    water = Scattering()
    water.lines, water.phase = lines, phase
    water.profile = wp.zeros((1, 1), dtype=float, device=device) if profile is None else profile
    return water


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
    optics = check_optics(lidar, optics)
    check_number("lidar.nearest", lidar.nearest, "(0, inf)")
    check_array("view", view, wp.vec3d, (None,))
    count, device = view.shape[0], view.device
    water = make_scattering(lidar, phase, device, lines=lines)
    check_array("distance", distance, wp.float64, (count,), device)
    paths = wp.empty((count, TABLE_EDGES), dtype=float, device=device)
    cumulative = wp.empty((count, TABLE_EDGES), dtype=float, device=device)
    total = wp.empty(count, dtype=wp.float64, device=device)
    inputs = [lidar, water, view, distance]
    launch_pixels(_make_table_kernel(optics), count, [*inputs, paths, cumulative, total], device=device)
    return paths, cumulative, total
