"""The camera: origin at the lens centre, +z along the optical axis, +x right, +y down."""

import warp as wp

from .direction import cos_sin_turn
from .philox import STREAM_LENS, random_block, u01


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


@wp.struct
class LensSample:
    """A point on the aperture disc and a number in [0, 1) for the rounding of what is deposited."""

    point: wp.vec3
    dither: float


@wp.func
def sample_lens(camera: Camera, seed: wp.uint64, id: wp.uint64, event: wp.uint32) -> LensSample:
    """A uniform point on the aperture disc, the same for every use within one event of one photon."""
    block = random_block(seed, id, event, STREAM_LENS)
    r = camera.aperture_radius * wp.sqrt(u01(block[0]))
    turn = cos_sin_turn(u01(block[1]))
    sample = LensSample()
    sample.point = wp.vec3(r * turn[0], r * turn[1], 0.0)
    sample.dither = u01(block[2])
    return sample
