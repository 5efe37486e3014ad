"""The depth at which a camera is focused."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene.port import PortGeometry
from spadwarp.scene.scene import camera_port
from spadwarp.scene.sight import points_inside, view_planes

if TYPE_CHECKING:
    from spadwarp.mesh import TriangleMesh
    from spadwarp.scene import Scene

__all__ = ["focus_distance"]

# Stands for infinity behind a port [m].
_FAR = 1e6


def focus_distance(scene: Scene, mesh: TriangleMesh | None) -> float | None:
    """Depth that the scene's camera images sharply [m]; None for a pinhole, which images all depths sharply.

    `camera.focus_distance`, or for "target" the depth of the first face on the optical axis; without one there, that of
    the point in view which is seen closest to the axis; without any, infinity. Nothing nearer than the focal length and
    the aperture's radius counts: no lens can be focused there. Behind a port, it is the depth in air at which the lens
    sees that point: 0.75 of it behind a flat one, some radii behind a dome.

    Args:
        scene: Whose camera.
        mesh: From `spadwarp.mesh.build_mesh`.
    """
    camera, port = scene.camera, camera_port(scene)
    if camera.pinhole:
        return None
    if camera.focus_distance != "target":
        return camera.focus_distance
    if port is not None:
        return _apparent_distance(scene, port, mesh)
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


def _apparent_distance(scene: Scene, port: PortGeometry, mesh: TriangleMesh | None) -> float:
    """Depth in air at which the lens sees the first target on its axis, or what is seen closest to that."""
    start, axis, _, _ = port.enter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    if mesh is None:
        return port.apparent_distance(start + _FAR * axis)
    frame = np.linalg.svd(axis[None])[2]
    frame = np.stack([frame[1], frame[2], axis])
    triangles = (mesh.vertices[mesh.faces].astype(np.float64) - start) @ frame.T
    met = _axis_depths(triangles)
    if (met > 0.0).any():
        return port.apparent_distance(start + met[met > 0.0].min() * axis)
    points = triangles.reshape(-1, 3)
    points = points[points[:, 2] > 0.0]
    if not len(points):
        return port.apparent_distance(start + _FAR * axis)
    closest = points[np.argmin(np.hypot(points[:, 0], points[:, 1]) / points[:, 2])]
    return port.apparent_distance(start + closest[2] * axis)


def _axis_depths(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depths at which the z axis meets triangles `[F, 3, 3]`, edges included."""
    x, y, z = np.moveaxis(triangles, 2, 0)
    # Twice the signed areas between the axis and each edge, as seen along it: the corners' weights.
    weights = np.roll(x, -1, axis=1) * np.roll(y, -2, axis=1) - np.roll(x, -2, axis=1) * np.roll(y, -1, axis=1)
    met = ((weights >= 0.0).all(axis=1) | (weights <= 0.0).all(axis=1)) & (weights != 0.0).any(axis=1)
    weights, z = weights[met], z[met]
    return (weights * z).sum(axis=1) / weights.sum(axis=1)
