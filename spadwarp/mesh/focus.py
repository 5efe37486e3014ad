"""The depth at which a camera is focused."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene.frustum import points_inside, view_planes

if TYPE_CHECKING:
    from spadwarp.mesh import TriangleMesh
    from spadwarp.scene import Scene

__all__ = ["focus_distance"]


def focus_distance(scene: Scene, mesh: TriangleMesh | None) -> float | None:
    """Depth that the scene's camera images sharply [m]; None for a pinhole, which images all depths sharply.

    `camera.focus_distance`, or for "target" the depth of the first face on the optical axis; without one there, that of
    the point in view which is seen closest to the axis; without any, infinity. Nothing nearer than the focal length and
    the aperture's radius counts: no lens can be focused there.

    Args:
        scene: Whose camera.
        mesh: From `spadwarp.mesh.build_mesh`.
    """
    camera = scene.camera
    if camera.pinhole:
        return None
    if camera.focus_distance != "target":
        return camera.focus_distance
    if mesh is None:
        return math.inf
    triangles = mesh.vertices[mesh.faces].astype(np.float64)
    nearest = max(camera.focal_length or 0.0, camera.aperture_radius)
    depth = _axis_depths(triangles)
    if (depth > nearest).any():
        return float(depth[depth > nearest].min())
    points = points_inside(triangles, view_planes(camera))
    points = points[points[:, 2] > nearest]
    if not len(points):
        return math.inf
    return float(points[np.argmin(np.hypot(points[:, 0], points[:, 1]) / points[:, 2]), 2])


def _axis_depths(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depths at which the z axis meets triangles `[F, 3, 3]`, edges included."""
    x, y, z = np.moveaxis(triangles, 2, 0)
    # Twice the signed areas between the axis and each edge, as seen along it: the corners' weights.
    weights = np.roll(x, -1, axis=1) * np.roll(y, -2, axis=1) - np.roll(x, -2, axis=1) * np.roll(y, -1, axis=1)
    met = ((weights >= 0.0).all(axis=1) | (weights <= 0.0).all(axis=1)) & (weights != 0.0).any(axis=1)
    weights, z = weights[met], z[met]
    return (weights * z).sum(axis=1) / weights.sum(axis=1)
