"""What the camera would see through clear water: one ray a pixel against the mesh."""

import warp as wp

from spadwarp_kernels.sensor.camera import Camera, pixel_direction
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.reflectance import reflectance_at
from spadwarp_kernels.surface.trace import intersect_surfaces


@wp.kernel(enable_backward=False, module="unique")
def truth_along_kernel(
    surfaces: Surfaces,
    origins: wp.array2d(dtype=wp.vec3),
    directions: wp.array2d(dtype=wp.vec3),
    # Out, [height, width]:
    depth: wp.array2d(dtype=float),
    range: wp.array2d(dtype=float),
    normal: wp.array2d(dtype=wp.vec3),
    reflectance: wp.array2d(dtype=float),
):
    """As `truth_kernel` along rays of any origins [m], from which the range counts, such as those behind a port.

    Launch: (height, width).
    """
    row, column = wp.tid()
    x = origins[row, column]
    u = directions[row, column]
    hit = intersect_surfaces(surfaces, x, u, 1.0e29, False)
    if hit.face >= 0:
        depth[row, column] = x[2] + hit.distance * u[2]
        range[row, column] = hit.distance
        normal[row, column] = hit.normal
        reflectance[row, column] = reflectance_at(surfaces, hit.face, x + hit.distance * u)
    else:
        depth[row, column] = wp.NAN
        range[row, column] = wp.NAN
        normal[row, column] = wp.vec3(wp.NAN)
        reflectance[row, column] = wp.NAN


@wp.kernel(enable_backward=False, module="unique")
def truth_kernel(
    camera: Camera,
    surfaces: Surfaces,
    directions: wp.array2d(dtype=wp.vec3),
    # Out, [height, width]:
    depth: wp.array2d(dtype=float),
    range: wp.array2d(dtype=float),
    normal: wp.array2d(dtype=wp.vec3),
    reflectance: wp.array2d(dtype=float),
):
    """Depth z and range along the ray [m], normal on the camera's side, reflectance; NaN for a miss. Launch: (height,
    width).

    Rays go along `directions` (unit vectors through the pixel centres); where there are none, the camera has
    square pixels about its axis.
    """
    row, column = wp.tid()
    u = pixel_direction(camera, float(column) + 0.5, float(row) + 0.5)
    if directions.shape[0] > 0:
        u = directions[row, column]
    hit = intersect_surfaces(surfaces, wp.vec3(0.0), u, 1.0e29, False)
    if hit.face >= 0:
        depth[row, column] = hit.distance * u[2]
        range[row, column] = hit.distance
        normal[row, column] = hit.normal
        reflectance[row, column] = reflectance_at(surfaces, hit.face, hit.distance * u)
    else:
        depth[row, column] = wp.NAN
        range[row, column] = wp.NAN
        normal[row, column] = wp.vec3(wp.NAN)
        reflectance[row, column] = wp.NAN
