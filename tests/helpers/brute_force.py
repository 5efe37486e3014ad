"""Rays against every face, in float64."""

import numpy as np


def brute_force(corners, x, u):
    """Distance to every face [rays, faces], infinite for a miss, and how far inside all edges the ray passes [m]."""
    p, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    n = np.cross(e1, e2)
    size = np.linalg.norm(n, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((p - x[:, None]) * n).sum(axis=2) / (u @ n.T)
        y = x[:, None] + distance[..., None] * u[:, None]
        inside = np.full(distance.shape, np.inf)
        for k in range(3):
            a, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
            height = (np.cross(edge, y - a) * n).sum(axis=2) / (size * np.linalg.norm(edge, axis=1))
            inside = np.minimum(inside, height)
    return np.where((inside >= 0) & (distance >= 0), distance, np.inf), inside
