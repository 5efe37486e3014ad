"""Organic targets: a fish, a starfish, mushrooms, a bust."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from .solids import (
    around,
    ball,
    box,
    capsule,
    implicit,
    lathe,
    loft,
    mirrored,
    plate,
    rod,
    smooth_union,
    spline,
    superellipse,
    tube,
    union,
    view,
)


def fish() -> Manifold:
    """Fish swimming to the left, fins spread.

    Size 1 × 1 × 1 m.
    """
    top = spline([(-1.75, 0.02), (-1.6, 0.16), (-1.2, 0.48), (-0.6, 0.74), (0.0, 0.74), (0.6, 0.5), (1.05, 0.22), (1.35, 0.18)], 8)
    bottom = spline([(-1.75, -0.06), (-1.6, -0.16), (-1.2, -0.4), (-0.6, -0.66), (0.0, -0.66), (0.6, -0.42), (1.05, -0.2), (1.35, -0.16)], 8)
    wide = spline([(-1.75, 0.05), (-1.6, 0.14), (-1.2, 0.3), (-0.6, 0.42), (0.0, 0.4), (0.6, 0.25), (1.05, 0.12), (1.35, 0.06)], 8)
    rings = []
    for x in np.linspace(-1.75, 1.35, 64):
        up, down, half = (np.interp(x, *curve.T) for curve in (top, bottom, wide))
        outline = superellipse(half, (up - down) / 2, 2.0, 48)
        rings.append(np.column_stack([np.full(48, x), outline[:, 1] + (up + down) / 2, outline[:, 0]]))
    body = loft(rings)
    tail = _fin((1.2, 0, 0), [(1.95, 0.85), (1.9, 0.62), (1.72, 0.35), (1.62, 0.12), (1.6, -0.08), (1.68, -0.32), (1.86, -0.6), (1.9, -0.82)], 0.05)
    dorsal = union(*(_fin((x0, 0.5, 0), tips, 0.045) for x0, tips in ((-0.1, [(-0.75, 0.8), (-0.6, 1.12), (-0.3, 1.22), (0.0, 1.16), (0.3, 1.0), (0.5, 0.85), (0.62, 0.6)]), (0.5, [(0.62, 0.65), (0.82, 0.78), (1.0, 0.6), (0.95, 0.35)]))))
    anal = _fin((0.3, -0.4, 0), [(0.25, -0.62), (0.45, -1.0), (0.7, -0.85), (0.82, -0.5)], 0.045)
    pectoral = _fin((0, 0, 0), [(0.35, 0.3), (0.52, 0.18), (0.6, 0.0), (0.55, -0.18), (0.4, -0.3)], 0.035).rotate((0, -35, -20)).translate((-0.75, -0.15, 0.38))
    pelvic = _fin((0, 0, 0), [(0.15, -0.5), (0.3, -0.48), (0.42, -0.36)], 0.035).rotate((-25, 0, 0)).translate((-0.5, -0.5, 0.2))
    gill = body.scale((1, 1, 1.14)) ^ rod((-1.28, 0.03, -1), (-1.28, 0.03, 1), 0.52, segments=64) ^ box((0.72, 2, 2), (-1.12, 0, 0))
    eye = union(ball((0.13, 0.13, 0.06), (-1.38, 0.17, 0.235)), ball(0.075, (-1.38, 0.17, 0.265)))
    mouth = rod((-1.85, -0.06, 0), (-1.45, -0.1, 0), 0.06, 0.015).scale((1, 0.7, 3))
    whole = union(body - mouth, gill, tail, dorsal, anal, mirrored(union(pectoral, pelvic, eye), "z"))
    return view(whole, 3.8, yaw=18, pitch=6)


def starfish() -> Manifold:
    """Starfish with five tapering, slightly curled arms and rows of knobs.

    Size 1 × 1 × 1 m.
    """
    arms = []
    for k, bend in enumerate((12, -8, 14, -12, 8)):
        s = np.linspace(0, 1, 30)
        angle = np.radians(90 + 72 * k + bend * s**2)
        arms.append((1.75 * s * np.cos(angle), 1.75 * s * np.sin(angle), 0.38 - 0.29 * s))

    def inside(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        fields = []
        for ax, ay, r in arms:
            fields.append(np.max([rk - np.sqrt((x - xk) ** 2 + (y - yk) ** 2 + (z * 1.15) ** 2) for xk, yk, rk in zip(ax, ay, r, strict=True)], axis=0))
        return np.minimum(smooth_union(fields, 0.28), z + 0.1)

    body = implicit(inside, (-2, -2, -0.2), (2, 2, 0.6), 0.05)
    knobs = []
    for ax, ay, r in arms:
        for i in range(3, 29, 3):
            knobs.append(ball(0.2 * r[i] + 0.012, (ax[i], ay[i], 0.87 * r[i] + 0.01), segments=16))
    return view(union(body, *knobs), 3.4, yaw=12, pitch=10)


def mushroom() -> Manifold:
    """Fly agaric with warts, ring and gills, and a young one beside it, seen from a little below.

    Size 1 × 1 × 1 m.
    """
    whole = union(_toadstool(1.0), _toadstool(0.5).rotate((0, 0, -8)).translate((1.15, -0.75, 0.35)))
    return view(whole, 3.3, yaw=0, pitch=-10)


def bust() -> Manifold:
    """Head and shoulders on a round foot.

    Size 1 × 1 × 1 m.
    """

    def inside(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        x = np.abs(x)  # symmetric

        def blob(at: tuple[float, float, float], r: tuple[float, float, float]) -> np.ndarray:
            q = np.sqrt(((x - at[0]) / r[0]) ** 2 + ((y - at[1]) / r[1]) ** 2 + ((z - at[2]) / r[2]) ** 2)
            return (1 - q) * min(r)

        head = smooth_union([
            blob((0, 0.85, -0.06), (0.52, 0.58, 0.62)),
            blob((0, 0.5, 0.16), (0.4, 0.52, 0.4)),
            blob((0, 0.16, 0.34), (0.17, 0.14, 0.16)),
        ], 0.2)
        head = smooth_union([head, blob((0.17, 0.79, 0.5), (0.2, 0.07, 0.09))], 0.08)
        head = -smooth_union([-head, blob((0.19, 0.65, 0.62), (0.13, 0.08, 0.13))], 0.08)
        face = smooth_union([
            head,
            blob((0.18, 0.655, 0.47), (0.09, 0.055, 0.06)),
            blob((0, 0.6, 0.58), (0.065, 0.2, 0.11)),
            blob((0, 0.47, 0.65), (0.09, 0.07, 0.09)),
            blob((0.07, 0.45, 0.58), (0.06, 0.05, 0.07)),
            blob((0, 0.335, 0.53), (0.15, 0.035, 0.07)),
            blob((0, 0.265, 0.52), (0.12, 0.04, 0.07)),
            blob((0.52, 0.62, -0.02), (0.06, 0.17, 0.11)),
        ], 0.05)
        neck = smooth_union([face, 0.3 - np.sqrt(x**2 + (z + 0.12) ** 2) + 0 * y - np.maximum(0, y - 0.4) * 2], 0.12)
        shoulders = smooth_union([
            blob((0, -0.85, -0.1), (0.85, 0.6, 0.45)),
            blob((0.75, -0.72, -0.12), (0.42, 0.36, 0.36)),
        ], 0.2)
        return np.minimum(smooth_union([neck, shoulders], 0.25), y + 1.15)

    body = implicit(inside, (-1.4, -1.3, -0.85), (1.4, 1.6, 0.95), 0.04)
    foot = lathe([(0, -1.75), (0.5, -1.75), (0.5, -1.62), (0.42, -1.58), (0.26, -1.4), (0.24, -1.3), (0.34, -1.2), (0.34, -1.1), (0, -1.1)])
    return view(union(body, foot), 3.4, yaw=-24, pitch=4)


def _fin(root: tuple[float, float, float], tips: list[tuple[float, float]], thickness: float) -> Manifold:
    """Fan of rays from `root` to `tips`, with a web between them."""
    points = np.array(tips)
    web = plate([root[:2], *points], thickness).translate((0, 0, root[2]))
    rays = [rod(root, (*p, root[2]), 1.6 * thickness, 0.5 * thickness, segments=10) for p in spline(points, 2)]
    return union(web, *rays)


def _toadstool(size: float) -> Manifold:
    """Fly agaric 2.9 · size tall."""
    dome = [(1.15 * np.sin(a), 0.35 + 0.95 * np.cos(a)) for a in np.radians(np.linspace(0, 95, 24))]
    cap = lathe([*dome, (1.1, 0.2), (1.02, 0.22), (0.6, 0.42), (0, 0.5)])
    gills = around(plate([(0.2, 0.5), (0.2, 0.24), (1.0, 0.16), (1.06, 0.24), (0.6, 0.44)], 0.03), 40)
    stem = lathe([(0, -1.6), *spline([(0.3, -1.6), (0.42, -1.45), (0.38, -1.25), (0.27, -1.0), (0.22, -0.4), (0.24, 0.5)], 6), (0, 0.5)])
    skirt = lathe([(0.2, -0.05), (0.3, -0.1), (0.48, -0.38), (0.44, -0.38), (0.2, -0.2)])
    warts = []
    for i in range(26):
        height = 1 - (i + 0.5) / 28
        a, turn = np.arccos(height), 2.399963 * i  # golden angle
        at = (1.15 * np.sin(a) * np.cos(turn), 0.35 + 0.95 * np.cos(a), 1.15 * np.sin(a) * np.sin(turn))
        warts.append(ball(0.08 + 0.035 * (i % 3), at, segments=16))
    return union(cap, gills, stem, skirt, *warts).scale((size,) * 3)


_ = capsule, tube
