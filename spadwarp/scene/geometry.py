"""Between time of flight, path, range and depth in the camera frame: the one place for all of these.

The path of light is the geometric length from the laser by the target to the lens; the range runs along a pixel's line
of sight, the depth along the optical axis (z). For cameras and lasers in the water; `spadwarp.scene.sight` is for all.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from spadwarp.scene import Camera, Scene

__all__ = [
    "depth_from_range",
    "gate_deviation",
    "path_from_range",
    "pixel_directions",
    "range_from_depth",
    "range_from_path",
    "scan_axes",
]

Floats = NDArray[np.float64]


def pixel_directions(camera: Camera) -> Floats:
    """Unit vectors from the lens centre through the pixel centres, float64 `[H, W, 3]`."""
    from spadwarp.scene.intrinsics import image_tangents

    centres = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)
    rays = np.concatenate([image_tangents(camera, centres), np.ones((camera.height, camera.width, 1))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def scan_axes(scene: Scene) -> Floats:
    """Axis of the beam of a confocal scan at each pixel, unit vectors in the camera frame, float64 `[H, W, 3]`.

    From the laser to the point of the line of sight at `scan.distance`; parallel to it where that is infinite.
    """
    view = pixel_directions(scene.camera)
    if math.isinf(scene.scan.distance):
        return view
    axes = scene.scan.distance * view - np.asarray(scene.beam.position)
    return axes / np.linalg.norm(axes, axis=-1, keepdims=True)


def range_from_path(path: ArrayLike, directions: ArrayLike, laser_position: ArrayLike) -> Floats:
    """Range along a line of sight at which light has gone `path` from the laser by the target to the lens.

    The points of one path lie on an ellipsoid with laser p and lens 0 as foci. |r·u − p| + r = L has one solution along
    u: r = (L² − |p|²) / (2 (L − u·p)). For a laser in the lens it is L/2.

    Args:
        path: Geometric path L [m], any shape.
        directions: Unit vectors u from the lens, `[..., 3]`, broadcast against `path`.
        laser_position: p [m], `[3]`.

    Returns:
        Range r [m]; NaN where L is NaN or too short to go from laser to lens.
    """
    length = np.asarray(path, dtype=np.float64)
    laser = np.asarray(laser_position, dtype=np.float64)
    baseline = np.linalg.norm(laser)
    possible = length > baseline
    safe = np.where(possible, length, baseline + 1.0)  # keeps the unused branch free of 0/0
    distance = (safe - baseline) * (safe + baseline) / (2.0 * (safe - np.asarray(directions) @ laser))
    return np.where(possible, distance, np.nan)


def path_from_range(distance: ArrayLike, directions: ArrayLike, laser_position: ArrayLike) -> Floats:
    """Geometric path [m] from the laser by the point at a range r [m] to the lens, |r·u − p| + r.

    Arguments as in `range_from_path`, which is its inverse.
    """
    along = np.asarray(distance, dtype=np.float64)
    points = along[..., None] * np.asarray(directions)
    return np.linalg.norm(points - np.asarray(laser_position, dtype=np.float64), axis=-1) + along


def depth_from_range(distance: Any, directions: Floats) -> Any:
    """Planar depth [m] at ranges along unit vectors `[..., 3]`."""
    return distance * directions[..., 2]


def range_from_depth(depth: Any, directions: Floats) -> Any:
    """Range [m] along unit vectors `[..., 3]` at planar depths."""
    return depth / directions[..., 2]


def gate_deviation(scene: Scene, directions: Floats) -> Floats:
    """Standard deviation [m] of a depth that is guessed evenly over the gate; unit vectors are those in the water."""
    gate = scene.gate
    return 0.5 * scene.medium.pulse_speed * (gate.stop - gate.start) / math.sqrt(12.0) * directions[..., 2]
