"""Rays against shapes in closed form: points lie on the surface, and nothing stands before them."""

import numpy as np
import pytest
import warp as wp

from helpers.launch import each, unit
from spadwarp_kernels.worlds import SHAPE_KINDS
from spadwarp_kernels.worlds.shapes import ShapeHit, intersect_shape

SIZE = (0.4, 0.7, 0.3)


def trace(kind, size, x, u, device):
    hit = each(intersect_shape, [SHAPE_KINDS.index(kind), wp.vec3(*size), 0, x, u, 1e10], [ShapeHit], device)
    return hit["distance"].astype(float), hit["normal"]


def inside(kind, p):
    """How deep a point lies in a shape: positive inside, 0 on the surface (not a distance)."""
    a, b, c = SIZE
    x, y, z = np.moveaxis(p, -1, 0)
    r = np.hypot(x, y)
    if kind == "plane":
        return np.where((abs(x) <= a / 2) & (abs(y) <= b / 2), -z, -1.0)
    if kind == "sphere":
        return a - np.sqrt(r**2 + z**2)
    if kind == "capsule":
        return a - np.hypot(r, np.maximum(abs(z) - b, 0.0))
    if kind == "ellipsoid":
        return 1.0 - np.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2)
    if kind == "cylinder":
        return np.minimum(a - r, b - abs(z))
    if kind == "box":
        return np.minimum(np.minimum(a - abs(x), b - abs(y)), c - abs(z))
    return np.minimum(a * (b - z) / (2 * b) - r, z + b)  # cone


@pytest.mark.parametrize("kind", [kind for kind in SHAPE_KINDS if kind not in ("mesh", "plane")])
@pytest.mark.parametrize("start", ["outside", "inside"])
def test_nearest_point_is_on_the_surface(kind, start, device):
    rng = np.random.default_rng(5)
    count = 2000
    u = unit(rng.normal(size=(count, 3)))
    x = rng.uniform(-0.6, 0.6, (count, 3)) - 3.0 * u
    if start == "inside":
        x = rng.uniform(-1, 1, (8 * count, 3)) * SIZE
        x = x[inside(kind, x) > 1e-3][:count]
    x, u = x.astype(np.float32), u[: len(x)].astype(np.float32)
    s, n = trace(kind, SIZE, x, u, device)
    hit = s > 0.0
    assert hit.mean() > 0.2 if start == "outside" else hit.all()
    assert np.abs(inside(kind, x[hit] + s[hit, None] * u[hit])).max() < 2e-5
    # Nothing before it: 400 points of each ray up to the hit, or up to its end.
    end = np.where(hit, s - 1e-3, 6.0)
    steps = np.linspace(0.0, 1.0, 400)[1:-1, None, None] * end[:, None]
    depth = inside(kind, x + steps * u)
    assert ((depth < 2e-4) if start == "outside" else (depth > -2e-4)).all()
    # The normal is the direction in which the depth changes most.
    p, h = (x + s[:, None] * u)[hit].astype(np.float64), 1e-6
    slope = unit(np.stack([inside(kind, p + h * e) - inside(kind, p - h * e) for e in np.eye(3)], axis=-1))
    assert np.quantile(1.0 - np.abs(np.sum(slope * n[hit], axis=-1)), 0.98) < 1e-3  # edges aside


def test_plane_ends_at_its_width(device):
    x = np.array([(0.19, 0.34, 1.0), (0.21, 0.0, 1.0), (0.0, 0.36, 1.0), (0.0, 0.0, -1.0)])
    u = np.array([(0.0, 0.0, -1.0)] * 4)
    for size, expected in ((SIZE, [1.0, -1.0, -1.0, -1.0]), ((0.0, 0.0, 0.0), [1.0, 1.0, 1.0, -1.0])):
        assert trace("plane", size, x, u, device)[0].tolist() == expected
