"""The laser, water and camera of the analytic model, and the beam in clear water.

In float64; times are from the emission of the pulse.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import check_fields, check_integer, check_number, check_struct, check_vector
from spadwarp_kernels.base.native import ONE, PI, TWO, ZERO
from spadwarp_kernels.optics.port import Port

__all__ = ["BACKSCATTER_SOURCES", "Lidar", "Ports"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})


BACKSCATTER_SOURCES = ("constant", "single_scatter", "monte_carlo")


@wp.struct
class Ports:
    """The ports that an `Optics` of them reads; those of a camera and a laser in the water are as they are made.

    Attributes:
        camera: What the camera looks through.
        laser: What the laser shines through.
    """

    camera: Port
    laser: Port


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
        ports: What camera and laser are behind, for the optics that say so.
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
    ports: Ports


_RANGES = {
    "photons": "[0, inf)",
    "pde": "[0, 1]",
    "extinction": "[0, inf)",
    "scattering": "[0, inf)",
    "speed": "(0, inf)",
    "pixel_tangent": "(0, inf)",
    "aperture_area": "(0, inf)",
    "start": "[0, inf)",
    "sigma": "(0, inf)",
    "dark": "[0, inf)",
    "constant": "[0, inf)",
    "nearest": "[0, inf)",
}
# What each laser profile reads.
_BEAM = ({"spread": "[0, 2]"}, {"tan2": "[0, inf)"}, {"radius": "[0, inf)"})


def check_lidar(lidar: Any) -> None:
    """A `Lidar` whose numbers are in range; raises `ArgumentError`."""
    check_struct("lidar", lidar, Lidar)
    check_integer("lidar.lu2024", lidar.lu2024, 0, 1)
    check_fields("lidar", lidar, _RANGES)
    check_number("lidar.stop", lidar.stop, f"({float(lidar.start)}, inf)")
    check_vector("lidar.laser", lidar.laser)
    check_vector("lidar.axis", lidar.axis, unit=True)
    check_fields("lidar", lidar, _BEAM[check_integer("lidar.profile", lidar.profile, 0, len(_BEAM) - 1)])
    source = check_integer("lidar.source", lidar.source, 0, len(BACKSCATTER_SOURCES) - 1)
    if lidar.lu2024:
        check_number("lidar.tan2", lidar.tan2, "(0, inf)")
    if BACKSCATTER_SOURCES[source] == "monte_carlo":
        check_number("lidar.bin_width", lidar.bin_width, "(0, inf)")


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
    if along <= ZERO:
        return ZERO
    r2 = wp.dot(y, y)
    if lidar.profile == 0:
        # 1 - cos from the cross product: keeps narrow cones exact.
        across = wp.length_sq(wp.cross(y, lidar.axis))
        r = wp.sqrt(r2)
        if across > lidar.spread * r * (r + along):
            return ZERO
        return ONE / (TWO * PI * lidar.spread * r2)
    if lidar.profile == 1:
        tan2 = wp.length_sq(wp.cross(y, lidar.axis)) / (along * along)
        cos = along / wp.sqrt(r2)
        return TWO / (PI * lidar.tan2) * wp.exp(-TWO * tan2 / lidar.tan2) / (cos * cos * cos * r2)
    if wp.length_sq(wp.cross(y, lidar.axis)) > lidar.radius * lidar.radius:
        return ZERO
    return ONE / (PI * lidar.radius * lidar.radius)
