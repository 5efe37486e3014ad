"""The view and the beam as convex regions, and which part of a mesh is inside them.

Planes are rows (n, d) with n·x + d >= 0 inside, `[P, 4]`; triangles are `[F, 3, 3]` [m].
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene.beam_profile import profile_axes, profile_extent

if TYPE_CHECKING:
    from spadwarp.scene import Camera, Laser

Points = NDArray[np.float64]

_GAUSSIAN_EDGE = 1.5  # tan of the outermost angle over tan θ: holds 98.9 % of a gaussian beam


def view_planes(camera: Camera) -> Points:
    """A pyramid that holds what the image shows, its tip at the lens centre."""
    left, top, right, bottom = camera.view_box
    sides = [[1, 0, -left, 0], [-1, 0, right, 0], [0, 1, -top, 0], [0, -1, bottom, 0], [0, 0, 1, 0]]
    return np.array(sides, dtype=np.float64)


def beam_planes(laser: Laser) -> Points:
    """24 planes around the beam, a pyramid or a prism that just holds it, 5 around a measured one; none if it is wider
    than a half-space."""
    axis, origin = np.array(laser.axis), np.array(laser.position)
    if laser.profile != "collimated" and laser.half_angle_deg >= 90.0:
        return np.zeros((0, 4))
    if laser.profile == "measured":
        wide, tall = profile_extent(laser)
        right, down = profile_axes(laser.axis)
        normals = np.array([wide * axis - right, wide * axis + right, tall * axis - down, tall * axis + down, axis])
        return np.column_stack([normals, -normals @ origin])
    other = np.eye(3)[np.argmin(np.abs(axis))]
    b1 = np.cross(axis, other) / np.linalg.norm(np.cross(axis, other))
    phi = np.arange(24) * (2.0 * math.pi / 24)
    outward = np.cos(phi)[:, None] * b1 + np.sin(phi)[:, None] * np.cross(axis, b1)
    slope, radius = 0.0, max(laser.beam_radius, 1e-6)
    if laser.profile != "collimated":
        slope = math.tan(laser.half_angle) * (_GAUSSIAN_EDGE if laser.profile == "gaussian" else 1.0)
        radius = 0.0
    normals = np.concatenate([slope * axis - outward, axis[None]])
    offsets = -normals @ origin + np.append(np.full(24, radius), 0.0)
    return np.column_stack([normals, offsets])


def points_inside(triangles: Points, planes: Points) -> Points:
    """Points of the triangles that are inside all planes, `[N, 3]`: none if and only if no triangle reaches in."""
    whole, outside = np.ones(len(triangles), dtype=bool), np.zeros(len(triangles), dtype=bool)
    for plane in planes:
        distance = triangles @ plane[:3] + plane[3]
        whole &= (distance >= 0.0).all(axis=1)
        outside |= (distance < 0.0).all(axis=1)
    found = [_spread(triangles[whole])]
    for triangle in triangles[~whole & ~outside]:
        polygon = _clip(triangle, planes)
        if len(polygon):
            fan = np.stack([np.broadcast_to(polygon[0], polygon[2:].shape), polygon[1:-1], polygon[2:]], axis=1)
            found.append(_spread(fan))
            if len(found) > 256:  # enough for every number that a check reports
                break
    return np.concatenate(found)


def _spread(triangles: Points) -> Points:
    """Points evenly over each triangle; of many triangles the corners alone."""
    steps = 6 if len(triangles) < 2000 else 1
    weights = [(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]
    return np.einsum("wc,fcx->fwx", np.array(weights) / steps, triangles).reshape(-1, 3)


def _clip(polygon: Points, planes: Points) -> Points:
    """The part of a convex polygon inside all planes (Sutherland & Hodgman 1974), `[K, 3]`, empty if there is none."""
    for plane in planes:
        distance = polygon @ plane[:3] + plane[3]
        kept: list[Points] = []
        for i, (d, x) in enumerate(zip(distance, polygon, strict=True)):
            before, y = distance[i - 1], polygon[i - 1]
            if (d >= 0.0) != (before >= 0.0):
                kept.append(y + (x - y) * (before / (before - d)))
            if d >= 0.0:
                kept.append(x)
        if len(kept) < 3:
            return np.zeros((0, 3))
        polygon = np.array(kept)
    return polygon
