"""Organic targets: a fish, a starfish, mushrooms, a bust."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from manifold3d import Manifold

from spadwarp.mesh.shapes.solids import (
    around,
    ball,
    box,
    implicit,
    lathe,
    loft,
    mirrored,
    plate,
    rod,
    smooth_union,
    spline,
    station,
    union,
    view,
)


def fish() -> Manifold:
    """Fish swimming to the left, fins spread.

    Size 3.80 × 2.40 × 1.57 m.
    """
    top = spline(
        [(-1.75, 0.02), (-1.6, 0.16), (-1.2, 0.48), (-0.6, 0.74), (0, 0.74), (0.6, 0.5), (1.05, 0.22), (1.35, 0.18)]
    )
    bottom = spline(
        [(-1.75, -0.06), (-1.6, -0.16), (-1.2, -0.4), (-0.6, -0.66), (0, -0.66), (0.6, -0.42), (1.35, -0.16)]
    )
    wide = spline(
        [(-1.75, 0.05), (-1.6, 0.14), (-1.2, 0.3), (-0.6, 0.42), (0, 0.4), (0.6, 0.25), (1.05, 0.12), (1.35, 0.06)]
    )
    rings = []
    for x in np.linspace(-1.75, 1.35, 64):
        up, down, half = (np.interp(x, *curve.T) for curve in (top, bottom, wide))
        rings.append(station(x, down, up, half))
    body = loft(rings)
    tail = _fin(
        (1.2, 0),
        [
            (1.95, 0.85), (1.9, 0.62), (1.72, 0.35), (1.62, 0.12), (1.6, -0.08), (1.68, -0.32), (1.86, -0.6),
            (1.9, -0.82),
        ],
    )  # fmt: skip
    dorsal = union(
        _fin(
            (-0.1, 0.5),
            [(-0.75, 0.8), (-0.6, 1.12), (-0.3, 1.22), (0.0, 1.16), (0.3, 1.0), (0.5, 0.85), (0.62, 0.6)],
        ),
        _fin((0.5, 0.5), [(0.62, 0.65), (0.82, 0.78), (1.0, 0.6), (0.95, 0.35)]),
    )
    anal = _fin((0.3, -0.4), [(0.25, -0.62), (0.45, -1.0), (0.7, -0.85), (0.82, -0.5)])
    pectoral = _fin((0, 0), [(0.35, 0.3), (0.52, 0.18), (0.6, 0.0), (0.55, -0.18), (0.4, -0.3)])
    pectoral = pectoral.rotate((0, -35, -20)).translate((-0.75, -0.15, 0.38))
    pelvic = _fin((0, 0), [(0.15, -0.5), (0.3, -0.48), (0.42, -0.36)]).rotate((-25, 0, 0)).translate((-0.5, -0.5, 0.2))
    cover = rod((-1.28, 0.03, -1), (-1.28, 0.03, 1), 0.52, segments=64) ^ box((0.72, 2, 2), (-1.12, 0, 0))
    gill = body.scale((1, 1, 1.2)) ^ cover
    eye = union(ball((0.13, 0.13, 0.06), (-1.38, 0.17, 0.235)), ball(0.075, (-1.38, 0.17, 0.265)))
    mouth = rod((-1.85, -0.06, 0), (-1.45, -0.1, 0), 0.06, 0.015).scale((1, 0.7, 3))
    whole = union(body - mouth, gill, tail, dorsal, anal, mirrored(union(pectoral, pelvic, eye), "z"))
    return view(whole, 3.8, yaw=18, pitch=6)


def starfish() -> Manifold:
    """Starfish with five tapering, slightly curled arms and rows of knobs.

    Size 3.18 × 3.40 × 1.03 m.
    """
    arms = []  # each a row of balls: x, y, radius
    for k, bend in enumerate((12, -8, 14, -12, 8)):
        s = np.linspace(0, 1, 30)
        angle = np.radians(90 + 72 * k + bend * s**2)
        arms.append(np.stack([1.75 * s * np.cos(angle), 1.75 * s * np.sin(angle), 0.38 - 0.29 * s], axis=1))

    def inside(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        def arm(balls: Iterable[np.ndarray]) -> np.ndarray:
            return np.max([r - np.sqrt((x - bx) ** 2 + (y - by) ** 2 + (1.15 * z) ** 2) for bx, by, r in balls], axis=0)

        return np.minimum(smooth_union(map(arm, arms), 0.28), z + 0.1)  # flat below

    body = implicit(inside, (-2, -2, -0.2), (2, 2, 0.6), 0.05)
    knobs = [ball(0.2 * r + 0.012, (x, y, 0.87 * r + 0.01), segments=16) for a in arms for x, y, r in a[3::3]]
    return view(union(body, *knobs), 3.4, yaw=12, pitch=10)


def mushroom() -> Manifold:
    """Fly agaric with warts, ring and gills, and a young one beside it, seen from a little below.

    Size 3.09 × 3.30 × 2.49 m.
    """
    ground = ball((1.15, 0.28, 0.6), (0.5, -1.62, 0.1), segments=64) ^ box((4, 0.4, 4), (0, -1.5, 0))
    young = _toadstool(0.5).rotate((0, 0, -8)).translate((1.12, -0.72, 0.3))
    return view(union(_toadstool(1.0), young, ground), 3.3, pitch=-8)


def bust() -> Manifold:
    """Antique bust, curly head and shoulders on a round foot.

    Size 1.99 × 3.40 × 1.55 m.
    """
    body = implicit(_head_and_shoulders, (-1.25, -1.45, -0.85), (1.25, 1.65, 0.95), 0.032)
    foot = [
        (0, -1.85), (0.52, -1.85), (0.52, -1.7), (0.44, -1.66), (0.27, -1.5), (0.25, -1.4), (0.36, -1.3),
        (0.36, -1.2),
    ]  # fmt: skip
    return view(union(body, lathe([*foot, (0, -1.1)])), 3.4, yaw=-24, pitch=4)


def _head_and_shoulders(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Implicit field of the bust, positive inside, symmetric in x; the face looks along +z."""
    x = np.abs(x)

    def blob(at: tuple[float, float, float], half_axes: tuple[float, float, float]) -> np.ndarray:
        p = [(c - c0) / r for c, c0, r in zip((x, y, z), at, half_axes, strict=True)]
        k = np.sqrt(sum(c * c for c in p)) + 1e-9
        return k * (1 - k) / (np.sqrt(sum((c / r) ** 2 for c, r in zip(p, half_axes, strict=True))) + 1e-9)

    skull = smooth_union([blob((0, 0.86, -0.06), (0.5, 0.57, 0.6)), blob((0, 0.52, 0.17), (0.35, 0.46, 0.39))], 0.2)
    skull = smooth_union(
        [skull, blob((0, 0.17, 0.36), (0.17, 0.13, 0.15)), blob((0.15, 0.79, 0.46), (0.18, 0.05, 0.09))], 0.1
    )
    skull = smooth_union([skull, blob((0.25, 0.47, 0.3), (0.12, 0.16, 0.14))], 0.15)  # cheekbones
    sockets = smooth_union([-skull, blob((0.19, 0.67, 0.63), (0.13, 0.075, 0.14))], 0.08)
    face = smooth_union(
        [
            -sockets,
            blob((0.185, 0.665, 0.47), (0.1, 0.06, 0.07)),  # eyes
            blob((0, 0.63, 0.56), (0.06, 0.22, 0.12)),  # nose, its tip and wings
            blob((0, 0.475, 0.66), (0.085, 0.065, 0.1)),
            blob((0.075, 0.46, 0.58), (0.06, 0.05, 0.08)),
            blob((0, 0.345, 0.53), (0.15, 0.04, 0.08)),  # lips
            blob((0, 0.265, 0.52), (0.12, 0.045, 0.08)),
            blob((0.5, 0.62, 0.0), (0.06, 0.17, 0.11)),  # ears
        ],
        0.05,
    )
    curls = 0.05 * np.cos(20 * x) * np.cos(20 * y + 1) * np.cos(20 * z)
    hair = np.minimum(blob((0, 0.9, -0.12), (0.58, 0.6, 0.63)) + curls, 0.3 - z + 0.7 * (y - 0.9))
    neck = np.minimum(0.25 - np.sqrt(x**2 + (z + 0.1 - 0.12 * y) ** 2), 0.5 - np.abs(y))
    torso = smooth_union(
        [
            blob((0, -0.85, -0.12), (0.98, 0.68, 0.44)),
            blob((0.72, -0.7, -0.14), (0.36, 0.36, 0.34)),
            blob((0.36, -0.82, 0.12), (0.42, 0.3, 0.24)),
            blob((0.3, -0.28, -0.16), (0.5, 0.2, 0.22)),
        ],
        0.2,
    )
    torso = np.minimum(torso, 1.32 - np.sqrt((1.15 * x) ** 2 + y**2))  # rounded off below and at the arms
    return smooth_union([smooth_union([face, hair], 0.04), smooth_union([neck, torso], 0.25)], 0.06)


def _fin(root: tuple[float, float], tips: list[tuple[float, float]]) -> Manifold:
    """Fan of rays in the plane z = 0 from `root` to `tips`, with a web between them."""
    ends = np.asarray(root) + 1.03 * (spline(tips, 2) - root)  # past the web, so that no edges coincide
    rays = [rod((*root, 0), (*end, 0), 0.07, 0.031, segments=10) for end in ends]
    return union(plate([root, *tips], 0.045), *rays)


def _toadstool(size: float) -> Manifold:
    """Fly agaric 2.9 · size tall."""
    dome = [(1.15 * np.sin(a), 0.35 + 0.95 * np.cos(a)) for a in np.radians(np.linspace(0, 95, 24))]
    cap = lathe([*dome, (1.1, 0.2), (1.02, 0.22), (0.6, 0.42), (0, 0.5)])
    gills = around(plate([(0.2, 0.5), (0.2, 0.24), (1.0, 0.16), (1.06, 0.24), (0.6, 0.44)], 0.03), 40)
    side = spline([(0.3, -1.6), (0.42, -1.45), (0.38, -1.25), (0.27, -1.0), (0.22, -0.4), (0.24, 0.5)])
    stem = lathe([(0, -1.6), *side, (0, 0.5)])
    skirt = lathe([(0.2, -0.05), (0.3, -0.1), (0.48, -0.38), (0.44, -0.38), (0.2, -0.2)])
    warts = []
    for i in range(26):
        height = 1 - (i + 0.5) / 28
        a, turn = np.arccos(height), 2.399963 * i  # golden angle
        wart = ball((0.1 + 0.035 * (i % 3), 0.07, 0.1 + 0.03 * (i % 2)), segments=20).rotate((0, 0, -np.degrees(a)))
        warts.append(wart.translate((1.13 * np.sin(a), 0.35 + 0.93 * np.cos(a), 0)).rotate((0, np.degrees(turn), 0)))
    return union(cap, gills, stem, skirt, *warts).scale((size,) * 3)
