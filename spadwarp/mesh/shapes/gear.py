"""Targets of glass, brass and iron: a camera, a diver's helmet, a valve."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from spadwarp.mesh.shapes.solids import (
    around,
    ball,
    box,
    copies,
    lathe,
    mirrored,
    plate,
    rod,
    spline,
    superellipse,
    torus,
    tube,
    union,
    view,
)


def camera() -> Manifold:
    """Single-lens reflex camera with prism hump, dials and a long lens barrel.

    Size 3.60 × 2.44 × 2.67 m.
    """
    body = plate(superellipse(1.65, 0.85, 7, 96), 0.75)
    strip = plate(superellipse(1.69, 0.5, 12, 96, at=(0, -0.1)), 0.81)
    grip = box((0.5, 1.5, 0.5), (-1.35, -0.05, 0.3), rounding=0.2)
    hump = plate([(-0.62, 0.6), (-0.3, 1.22), (0.3, 1.22), (0.62, 0.6)], 0.7)
    shoe = box((0.4, 0.08, 0.4), (0, 1.25, 0))
    barrel = [
        (0, 0), (0.78, 0), (0.78, 0.3), (0.7, 0.32), (0.7, 0.42), (0.74, 0.44), (0.74, 0.7), (0.66, 0.72),
        (0.66, 0.78), (0.7, 0.8), (0.7, 0.95), (0.62, 0.95), (0.5, 0.7), (0.3, 0.78), (0, 0.81),
    ]  # fmt: skip
    lens = lathe(barrel, axis="z").translate((0, -0.08, 0.3))
    ribs = around(box((0.06, 0.05, 0.2), (0, 0.74, 0.87)), 36, axis="z").translate((0, -0.08, 0))
    dials = union(
        lathe([(0, 0), (0.27, 0), (0.27, 0.22), (0.22, 0.25), (0, 0.25)]).translate((-0.95, 0.82, 0)),
        lathe([(0, 0), (0.22, 0), (0.22, 0.16), (0.18, 0.18), (0, 0.18)]).translate((1.2, 0.82, 0)),
        lathe([(0, 0), (0.12, 0), (0.1, 0.16), (0, 0.18)]).translate((-1.38, 0.82, 0.12)),
    )
    window = box((0.3, 0.16, 0.2), (-0.95, 0.62, 0.36))
    timer = union(
        rod((1.15, 0.2, 0.35), (1.15, 0.2, 0.5), 0.12), box((0.1, 0.42, 0.08), (1.15, 0.05, 0.48), rounding=0.035)
    )
    lugs = mirrored(torus(0.1, 0.035, axis="z").translate((1.74, 0.5, 0)))
    return view(union(body, strip, grip, hump, shoe, lens, ribs, dials, timer, lugs) - window, 3.6, yaw=-24, pitch=12)


def diver_helmet() -> Manifold:
    """Copper diving helmet on its breastplate: three barred ports, collar, bolts, hose elbows.

    Size 3.20 × 3.30 × 2.88 m.
    """
    bonnet = ball((0.95, 1.02, 0.98), (0, 0.62, 0), segments=96)
    collar = lathe(
        [(0, -0.45), (0.92, -0.45), (0.92, -0.28), (0.84, -0.22), (0.84, -0.12), (0.92, -0.1), (0.92, 0.02), (0, 0.08)]
    )
    breast = lathe(
        [(0, -1.35), *spline([(1.38, -1.35), (1.36, -1.15), (1.2, -0.85), (0.95, -0.6), (0.82, -0.4)], 6), (0, -0.4)]
    ).scale((1.1, 1, 0.82))
    rim = lathe([(1.3, -1.42), (1.47, -1.42), (1.47, -1.3), (1.3, -1.22)]).scale((1.1, 1, 0.82))
    bolt = union(rod((0, -0.02, 0), (0, 0.14, 0), 0.04, segments=12), box((0.2, 0.06, 0.06), (0, 0.08, 0)))
    angles = np.radians(np.arange(0, 360, 30) + 15)
    bolts = union(*(bolt.translate((1.52 * np.cos(a), -1.27, 1.13 * np.sin(a))) for a in angles))
    port = union(
        lathe([(0.36, 0.75), (0.52, 0.75), (0.52, 1.04), (0.47, 1.1), (0.36, 1.1)], axis="z"),
        rod((0, 0, 0.7), (0, 0, 0.98), 0.4),
        *(box((0.055, 0.8, 0.06), (x, 0, 1.06)) for x in (-0.13, 0.13)),
        *(box((0.8, 0.055, 0.06), (0, y, 1.06)) for y in (-0.13, 0.13)),
        around(ball(0.05, (0.52, 0, 1.0), segments=16), 8, axis="z", first=22.5),
    )
    side = port.scale((0.85, 0.85, 1)).rotate((0, 78, 0)).translate((-0.08, 0.62, 0))
    top = port.scale((0.62, 0.62, 1)).rotate((-42, 0, 0)).translate((0, 0.66, 0))
    elbow = tube(spline([(0.45, 0.95, -0.7), (0.6, 1.15, -0.95), (0.85, 1.1, -1.15), (1.05, 0.75, -1.2)]), 0.15)
    valve = rod((0.55, 0.15, 0.55), (0.78, 0.06, 0.86), 0.13)
    whole = union(
        bonnet, collar, breast, rim, bolts, port.translate((0, 0.6, 0.04)), mirrored(side), top, mirrored(elbow), valve
    )
    return view(whole, 3.3, yaw=-22, pitch=10)


def pipe_valve() -> Manifold:
    """Flanged pipe run with an elbow and a gate valve whose handwheel leans towards the viewer.

    Size 3.90 × 2.88 × 2.68 m.
    """
    flange = union(
        rod((-0.08, 0, 0), (0.08, 0, 0), 0.52, segments=64),
        around(rod((-0.15, 0.42, 0), (0.15, 0.42, 0), 0.055, segments=6), 8, axis="x", first=22.5),
    )
    run = rod((-1.9, 0, 0), (1.0, 0, 0), 0.3, segments=48)
    a = np.linspace(0, np.pi / 2, 13)
    bend = tube(np.stack([1.0 + 0.55 * np.sin(a), 0.55 * np.cos(a) - 0.55, 0 * a], axis=1), 0.3, sides=48)
    drop = rod((1.55, -0.5, 0), (1.55, -1.3, 0), 0.3, segments=48)
    flanges = copies(flange, [(x, 0, 0) for x in (-1.75, -1.05, -0.88, 0.58, 0.75)])
    outlet = flange.rotate((0, 0, 90)).translate((1.55, -1.2, 0))
    bonnet = [
        (0, 0), (0.36, 0), (0.36, 0.5), (0.5, 0.52), (0.5, 0.64), (0.48, 0.65), (0.5, 0.66), (0.5, 0.78), (0.3, 0.8),
        (0.2, 1.05), (0.22, 1.08), (0.22, 1.16), (0.06, 1.18), (0.06, 1.75), (0, 1.75),
    ]  # fmt: skip
    nuts = around(rod((0.42, 0.48, 0), (0.42, 0.84, 0), 0.05, segments=6), 8, first=22.5)
    wheel = union(
        torus(0.68, 0.075),
        around(tube(spline([(0.05, 0.06, 0), (0.35, 0.0, 0), (0.68, 0, 0)]), 0.05), 5, first=18),
        lathe([(0, -0.08), (0.15, -0.08), (0.13, 0.16), (0, 0.16)]),
    ).translate((0, 1.5, 0))
    yoke = mirrored(tube(spline([(0.24, 0.8, 0), (0.28, 1.1, 0), (0.1, 1.36, 0)]), 0.06))
    valve = union(lathe(bonnet), nuts, wheel, yoke).rotate((40, 0, 0)).translate((-0.15, 0, 0))
    body = union(ball((0.62, 0.5, 0.5), (-0.15, 0, 0)), run, bend, drop, flanges, outlet, valve)
    return view(body, 3.9, yaw=14, pitch=8)
