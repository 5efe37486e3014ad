"""The light that the water scatters back once, one thread a pixel: its rate, and where it comes from.

Rates are in detections per pulse and second, in float64.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.arguments import check_array, check_integer, check_number
from spadwarp_kernels.math.float64 import HALF, ONE, PI, TWO, ZERO
from spadwarp_kernels.pixels import launch_pixels

from .lidar import Lidar, beam_direction, beam_fluence, beam_path, check_lidar, range_of_path

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TABLE_EDGES = 65
"""Edges of the arrival-time table of single-scatter backscatter, in geometric progression of range."""


_PANELS = wp.constant(TABLE_EDGES - 1)


@wp.func
def phase_at(phase: wp.array(dtype=wp.float64), cos_theta: wp.float64) -> wp.float64:
    """Phase function [1/sr] from its table over the scattering angle, uniform on [0, pi]."""
    last = phase.shape[0] - 1
    position = wp.acos(wp.clamp(cos_theta, -ONE, ONE)) / PI * wp.float64(last)
    k = wp.min(int(position), last - 1)
    w = position - wp.float64(k)
    return (ONE - w) * phase[k] + w * phase[k + 1]


@wp.func
def single_scatter_per_metre(
    lidar: Lidar,
    lines: wp.array(dtype=wp.vec3d),
    phase: wp.array(dtype=wp.float64),
    view: wp.vec3d,
    r: wp.float64,
) -> wp.float64:
    """Single-scatter detections per pulse and metre of range at distance r along `view` [1/m], over all lines.

    For a laser in the lens, a narrow cone and the axis it is C_back(t) of the geometry of Lu et al. 2024 times dt/dr.
    """
    total = wp.float64(0.0)
    if lidar.lu2024 == 1:
        # pitch^2/N^2 = 4 A (pitch/f)^2/pi
        etendue = wp.float64(4.0) / PI * lidar.aperture_area * lidar.pixel_tangent * lidar.pixel_tangent
        for k in range(lines.shape[0]):
            line = lines[k]
            scale = line[0] * lidar.pde * line[2] * phase[phase.shape[0] - 1]
            total += scale * etendue * wp.exp(-TWO * line[1] * r) / (wp.float64(4.0) * lidar.tan2 * r * r)
        return total
    x = r * view
    cos_theta = -wp.dot(beam_direction(lidar, x), view)
    cos_psi2 = view[2] * view[2]
    # A cos(psi)/r^2 to the lens times the r^2 (pitch/f)^2 cos^3(psi) that the pixel sees.
    collected = lidar.aperture_area * lidar.pixel_tangent * lidar.pixel_tangent * cos_psi2 * cos_psi2
    density = phase_at(phase, cos_theta)
    fluence = beam_fluence(lidar, x)
    path = beam_path(lidar, x) + r
    for k in range(lines.shape[0]):
        line = lines[k]
        scale = line[0] * lidar.pde * line[2] * density * collected
        total += scale * fluence * wp.exp(-line[1] * path)
    return total


@wp.func
def single_scatter_rate(
    lidar: Lidar,
    lines: wp.array(dtype=wp.vec3d),
    phase: wp.array(dtype=wp.float64),
    view: wp.vec3d,
    time: wp.float64,
) -> wp.float64:
    """Single-scatter rate C_back(t) [1/s] on a line of sight without a target."""
    r = range_of_path(lidar, view, time * lidar.speed)
    if r < lidar.nearest:
        return ZERO
    # path = |r u - p| + r, so that d path/dr = 1 - cos(scattering angle).
    stretch = ONE + wp.dot(beam_direction(lidar, r * view), view)
    return single_scatter_per_metre(lidar, lines, phase, view, r) * lidar.speed / stretch


@wp.func
def illuminated_interval(lidar: Lidar, view: wp.vec3d) -> wp.vec2d:
    """The part [near, far] of a line of sight inside the laser's uniform cone; far < near if there is none."""
    far = wp.float64(1.0e30)
    if lidar.profile != 0 or lidar.spread >= ONE or lidar.lu2024 == 1:
        return wp.vec2d(ZERO, far)
    cos_half = ONE - lidar.spread
    k = cos_half * cos_half
    da = wp.dot(view, lidar.axis)
    pa = wp.dot(lidar.laser, lidar.axis)
    a = da * da - k
    b = da * pa - k * wp.dot(view, lidar.laser)
    c = pa * pa - k * wp.length_sq(lidar.laser)
    disc = b * b - a * c
    none = wp.vec2d(ONE, -ONE)
    if wp.abs(a) < wp.float64(1.0e-15):
        return wp.vec2d(ZERO, far)
    root = wp.sqrt(wp.max(disc, ZERO))
    low = wp.min((b - root) / a, (b + root) / a)
    high = wp.max((b - root) / a, (b + root) / a)
    if a > ZERO:
        if da > ZERO:
            return wp.vec2d(wp.max(high, ZERO), far)
        return wp.vec2d(ZERO, low)
    if disc <= ZERO or HALF * (low + high) * da - pa <= ZERO:
        return none
    return wp.vec2d(wp.max(low, ZERO), high)


@wp.kernel
def _single_scatter_table(
    first: int,
    lidar: Lidar,
    lines: wp.array(dtype=wp.vec3d),
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
    illuminated = illuminated_interval(lidar, view[i])
    near = wp.max(wp.max(illuminated[0], lidar.nearest), range_of_path(lidar, view[i], lidar.start * lidar.speed))
    far = wp.min(illuminated[1], range_of_path(lidar, view[i], lidar.stop * lidar.speed))
    if distance[i] > ZERO:
        far = wp.min(far, distance[i])
    far = wp.max(far, near)
    # Gauss-Legendre of three nodes on panels of equal ln(range): the rate falls as a power times an exponential.
    step = wp.log(far / near) / wp.float64(_PANELS)
    offset = wp.float64(0.7745966692414834)
    half = HALF * step
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
            f = wp.float64(8.0) * mid * single_scatter_per_metre(lidar, lines, phase, view[i], mid)
            f += wp.float64(5.0) * low * single_scatter_per_metre(lidar, lines, phase, view[i], low)
            f += wp.float64(5.0) * high * single_scatter_per_metre(lidar, lines, phase, view[i], high)
            sum += f * step / wp.float64(18.0)
            cumulative[i, k + 1] = float(sum)
            r = r * wp.exp(step)
    total[i] = sum
    if sum > ZERO:
        for k in range(paths.shape[1]):
            cumulative[i, k] = float(wp.float64(cumulative[i, k]) / sum)


@wp.func
def background_rate(
    lidar: Lidar,
    lines: wp.array(dtype=wp.vec3d),
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
        return lidar.dark + single_scatter_rate(lidar, lines, phase, view, time)
    row = i % profile.shape[0]
    last = profile.shape[1] - 1
    position = wp.clamp((time - lidar.start) / lidar.bin_width - HALF, ZERO, wp.float64(last))
    k = wp.min(int(position), wp.max(last - 1, 0))
    w = position - wp.float64(k)
    value = (ONE - w) * wp.float64(profile[row, k]) + w * wp.float64(profile[row, wp.min(k + 1, last)])
    return lidar.dark + value / lidar.bin_width


def spectral_lines(lidar: Any, lines: wp.array | None, device: wp.Device) -> wp.array:
    """The lines given, or the lidar's own photons, extinction and scattering as one line."""
    if lines is None:
        own = wp.vec3d(float(lidar.photons), float(lidar.extinction), float(lidar.scattering))
        return wp.array([own], dtype=wp.vec3d, device=device)
    check_array("lines", lines, wp.vec3d, (None,), device)
    check_integer("number of lines", lines.size, 1)
    return lines


def check_phase(phase: Any, device: wp.Device) -> None:
    """A table of a phase function over the scattering angle."""
    check_array("phase", phase, wp.float64, (None,), device)
    check_integer("entries of phase", phase.size, 2)


def single_scatter_table(
    lidar: Any, phase: wp.array, view: wp.array, distance: wp.array, *, lines: wp.array | None = None
) -> tuple[wp.array, wp.array, wp.array]:
    """Where and when each pixel's single-scatter backscatter comes from.

    Args:
        lidar: A `Lidar`; the table runs over its gate, from `nearest` on and up to the target.
        phase: float64 `[n]`, phase function [1/sr] at angles uniform on [0, π].
        view, distance: As for `signal_map`.
        lines: vec3d `[line]`, a spectrum as photons per pulse, extinction and scattering [1/m] of each line, in place
            of the lidar's own; one speed holds for all.

    Returns:
        Edges in path float32 `[pixel, TABLE_EDGES]` [m], cumulative distribution of the same shape, and the total
        detections per pulse float64 `[pixel]`.

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit each other.
    """
    check_lidar(lidar)
    check_number("lidar.nearest", lidar.nearest, "(0, inf)")
    check_array("view", view, wp.vec3d, (None,))
    count, device = view.shape[0], view.device
    check_phase(phase, device)
    check_array("distance", distance, wp.float64, (count,), device)
    paths = wp.empty((count, TABLE_EDGES), dtype=float, device=device)
    cumulative = wp.empty((count, TABLE_EDGES), dtype=float, device=device)
    total = wp.empty(count, dtype=wp.float64, device=device)
    inputs = [lidar, spectral_lines(lidar, lines, device), phase, view, distance]
    launch_pixels(_single_scatter_table, count, [*inputs, paths, cumulative, total], device=device)
    return paths, cumulative, total
