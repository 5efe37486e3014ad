"""The camera: origin at the lens centre, +z along the optical axis, +x right, +y down."""

import warp as wp

from .direction import cos_sin_turn


@wp.struct
class Camera:
    """A pinhole camera with a finite aperture disc.

    Attributes:
        width, height: Image size [pixels].
        pixel_tangent: Pixel pitch over focal length.
        aperture_radius: Radius of the entrance pupil [m].
        aperture_area: Its area [m^2].
    """

    width: int
    height: int
    pixel_tangent: float
    aperture_radius: float
    aperture_area: float


@wp.func
def project(camera: Camera, x: wp.vec3) -> int:
    """Row-major index of the pixel that images the point x (line through x and the lens centre), or -1 outside the
    view."""
    if x[2] <= 0.0:
        return -1
    scale = 1.0 / (x[2] * camera.pixel_tangent)
    column = wp.floor(x[0] * scale + 0.5 * float(camera.width))
    row = wp.floor(x[1] * scale + 0.5 * float(camera.height))
    # Compared as floats: a float beyond the int range has no defined int value.
    if column < 0.0 or row < 0.0 or column >= float(camera.width) or row >= float(camera.height):
        return -1
    return int(row) * camera.width + int(column)


@wp.func
def pixel_direction(camera: Camera, column: float, row: float) -> wp.vec3:
    """Unit direction from the lens centre through image coordinates in pixels; (0.5, 0.5) is the first pixel's
    centre."""
    return wp.normalize(
        wp.vec3(
            (column - 0.5 * float(camera.width)) * camera.pixel_tangent,
            (row - 0.5 * float(camera.height)) * camera.pixel_tangent,
            1.0,
        )
    )


@wp.func
def lens_point(camera: Camera, xi1: float, xi2: float) -> wp.vec3:
    """A uniform point on the aperture disc [m], for uniform xi1, xi2 in [0, 1)."""
    r = camera.aperture_radius * wp.sqrt(xi1)
    turn = cos_sin_turn(xi2)
    return wp.vec3(r * turn[0], r * turn[1], 0.0)
