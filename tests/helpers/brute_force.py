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


def check_hits(corners, x, u, reach, *hits):
    """Hits, (face, -1 for a miss; distance) of rays shorter than `reach`, against `brute_force`.

    Within a hair of an outline a ray may hit or miss, grazing rays meet a plane where rounding has it, and of two faces
    at nearly one distance either may count.
    """
    expected, inside = brute_force(corners, x.astype(float), u.astype(float))
    expected[expected >= reach] = np.inf
    nearest = expected.min(axis=1)
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosine = np.abs(u @ (n / np.linalg.norm(n, axis=1, keepdims=True)).T)
    clear = (np.where(np.isfinite(inside), np.abs(inside) * cosine, 1.0) > 1e-5).all(axis=1)
    clear &= (np.abs(np.where(np.isfinite(expected), expected, 9.0) - reach) > 1e-4).all(axis=1)
    alone = clear & ~(np.partition(expected, 1, axis=1)[:, 1] < nearest + 1e-4)
    for face, distance in hits:
        hit = face >= 0
        np.testing.assert_array_equal(hit[clear], np.isfinite(nearest)[clear])
        assert (alone & hit).mean() > 0.05
        np.testing.assert_array_equal(face[alone & hit], expected[alone & hit].argmin(axis=1))
        both = np.flatnonzero(alone & hit)
        assert (np.abs(distance - nearest)[both] * cosine[both, face[both]]).max() < 6e-6
        # Any hit, near an outline or not, is on the face that is named.
        rays = np.flatnonzero(hit)
        assert (inside[rays, face[rays]] * cosine[rays, face[rays]]).min() > -1e-5
