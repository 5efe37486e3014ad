"""Where a camera sees a direction: intrinsics and lens distortion, as OpenCV defines them.

Image coordinates are in pixels, `[..., 2]` (column, row), and (0.5, 0.5) is the first pixel's centre; OpenCV's own are
half a pixel less. Tangents are x/z and y/z of a direction in the camera frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.scene.pose import rotation_matrix

if TYPE_CHECKING:
    from spadwarp.scene import Camera

__all__ = ["camera_attributes", "image_points", "image_tangents", "is_invertible", "pixel_views", "view_box"]

Points = NDArray[np.float64]

# Boxes are wider by this part of a pixel than what they hold: edges bend between the points that are looked at, and
# float32 rounds.
_MARGIN = 0.01


def image_points(camera: Camera, tangents: ArrayLike) -> Points:
    """Image coordinates at which directions with the given tangents are seen, `[..., 2]`."""
    return _distort(np.asarray(tangents, np.float64), camera.distortion) * camera.focal_pixels + camera.principal_point


def image_tangents(camera: Camera, points: ArrayLike) -> Points:
    """Tangents of the directions that are seen at image coordinates, `[..., 2]`: `image_points` undone, by Newton's
    method; NaN where no direction is seen."""
    seen = (np.asarray(points, np.float64) - camera.principal_point) / camera.focal_pixels
    if not any(camera.distortion):
        return seen
    tangents = seen.copy()
    with np.errstate(all="ignore"):
        for _ in range(50):
            a, b, d = _jacobian(tangents, camera.distortion)
            error = _distort(tangents, camera.distortion) - seen
            step = np.stack([d * error[..., 0] - b * error[..., 1], a * error[..., 1] - b * error[..., 0]], axis=-1)
            tangents -= step / (a * d - b * b)[..., None]
            if np.nanmax(np.abs(error), initial=0.0) < 1e-14:
                break
        error = np.abs(_distort(tangents, camera.distortion) - seen).max(axis=-1)
        tangents[~(error < 1e-10)] = np.nan
    return tangents


def is_invertible(camera: Camera) -> bool:
    """Whether each point of the image belongs to one direction of the view.

    The distortion is the gradient of a function of the tangents, so that a positive definite Jacobian throughout a
    convex region makes it one-to-one in it; tested on a grid over the box that holds the view.
    """
    if not any(camera.distortion):
        return True
    left, top, right, bottom = view_box(camera)
    if not np.isfinite([left, top, right, bottom]).all():
        return False
    a, b, d = _jacobian(_grid(np.linspace(left, right, 65), np.linspace(top, bottom, 65)), camera.distortion)
    return bool((a + d > 0.0).all() and (a * d - b * b > 0.0).all())


def view_box(camera: Camera) -> tuple[float, float, float, float]:
    """Least and largest tangents (left, top, right, bottom) of what the image shows, a hundredth of a pixel wider."""
    columns, rows = np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)
    if not any(camera.distortion):
        columns, rows = columns[[0, -1]], rows[[0, -1]]
    border = np.concatenate(
        [_grid(columns, rows[[0, -1]]).reshape(-1, 2), _grid(columns[[0, -1]], rows).reshape(-1, 2)]
    )
    tangents = image_tangents(camera, border)
    margin = _MARGIN / np.array(camera.focal_pixels)
    (left, top), (right, bottom) = tangents.min(axis=0) - margin, tangents.max(axis=0) + margin
    return float(left), float(top), float(right), float(bottom)


def pixel_views(camera: Camera) -> Points:
    """As `view_box` for each pixel alone: `[H, W, 4]`."""
    corners = image_tangents(camera, _grid(np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)))
    four = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]])
    margin = _MARGIN / np.array(camera.focal_pixels)
    return np.concatenate([four.min(axis=0) - margin, four.max(axis=0) + margin], axis=-1)


def camera_attributes(camera: Camera, focus_distance: float | None) -> dict[str, NDArray[np.float64] | float]:
    """What a file says of a camera, for readers without spadwarp: OpenCV's `camera_matrix` [pixels], 0 being the
    first pixel's centre, and `camera_distortion` (k1, k2, p1, p2, k3); `camera_position` [m] and `camera_rotation`, the
    camera's axes in the world as columns; `camera_focus_distance` [m], NaN if all depths are sharp.

    The matrices `[3, 3]` are 9 numbers, row after row: netCDF knows no attributes of two dimensions."""
    (fx, fy), (column, row) = camera.focal_pixels, camera.principal_point
    return {
        "camera_matrix": np.array([fx, 0.0, column - 0.5, 0.0, fy, row - 0.5, 0.0, 0.0, 1.0]),
        "camera_distortion": np.array(camera.distortion),
        "camera_position": np.array(camera.position),
        "camera_rotation": rotation_matrix(camera.rotation_deg).ravel(),
        "camera_focus_distance": np.nan if focus_distance is None else focus_distance,
    }


def _grid(columns: Points, rows: Points) -> Points:
    """`[R, C, 2]`."""
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def _distort(tangents: Points, coefficients: tuple[float, ...]) -> Points:
    """Brown's model (1966) in OpenCV's order k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = tangents[..., 0], tangents[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _jacobian(tangents: Points, coefficients: tuple[float, ...]) -> tuple[Points, Points, Points]:
    """Derivatives of `_distort`: of x by x, of x by y and of y by x, which are the same, of y by y."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = tangents[..., 0], tangents[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))  # of the radial factor by r², twice
    return (
        radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )
