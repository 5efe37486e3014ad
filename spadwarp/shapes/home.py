"""Targets from land: furniture, a car, a jar."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from .solids import (
    around,
    ball,
    box,
    capsule,
    lathe,
    loft,
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


def amphora() -> Manifold:
    """Wine jar with two handles and a pointed foot.

    Size 1 × 1 × 1 m.
    """
    outer = spline(
        [(0.02, -1.75), (0.13, -1.7), (0.16, -1.55), (0.17, -1.4), (0.42, -1.0), (0.72, -0.45), (0.9, 0.1), (0.92, 0.45),
         (0.75, 0.78), (0.42, 0.98), (0.27, 1.12), (0.24, 1.4), (0.26, 1.6)], 6,
    )  # fmt: skip
    lip = [(0.3, 1.62), (0.36, 1.68), (0.36, 1.78), (0.3, 1.82), (0.21, 1.8), (0.17, 1.4), (0.17, 1.0), (0, 1.0)]
    body = lathe([(0, -1.75), *outer, *lip])
    grooves = union(*(torus(r, 0.028).translate((0, y, 0)) for r, y in ((0.925, 0.3), (0.91, 0.15), (0.255, 1.22))))
    handle = spline([(0.2, 1.5, 0), (0.45, 1.62, 0), (0.68, 1.5, 0), (0.76, 1.2, 0), (0.74, 0.95, 0), (0.64, 0.72, 0)], 6)
    whole = union(body, grooves, mirrored(tube(handle, 0.085).scale((1, 1, 1.3))))
    return view(whole, 3.4, yaw=-18, pitch=14)


def chair() -> Manifold:
    """Wooden chair with turned legs and a spindle back.

    Size 1 × 1 × 1 m.
    """
    turned = [(0, 0), (0.06, 0), (0.07, 0.15), (0.095, 0.4), (0.065, 0.5), (0.1, 0.58), (0.065, 0.66), (0.1, 1.0), (0.085, 1.4), (0, 1.4)]
    leg = lathe(turned, segments=32)
    legs = union(*(leg.rotate((-5 * z, 0, 5 * x)).translate((0.68 * x, -1.7, 0.62 * z)) for x in (-1, 1) for z in (-1, 1)))
    seat = box((1.65, 0.17, 1.5), (0, -0.3, 0), rounding=0.08)
    rungs = union(
        *(rod((x, -1.15, -0.6), (x, -1.15, 0.6), 0.055) for x in (-0.65, 0.65)),
        rod((-0.65, -1.15, 0), (0.65, -1.15, 0), 0.055),
        rod((-0.65, -0.95, 0.59), (0.65, -0.95, 0.59), 0.055),
    )
    posts = [tube(spline([(x, -0.3, -0.62), (x * 1.02, 0.5, -0.7), (x * 1.05, 1.6, -0.95)]), 0.085) for x in (-0.7, 0.7)]
    finials = [ball(0.12, (x * 1.05, 1.63, -0.955), segments=24) for x in (-0.7, 0.7)]
    spindles = [tube(spline([(x, -0.3, -0.63), (x, 0.5, -0.7), (x, 1.35, -0.88)]), 0.045, sides=12) for x in np.linspace(-0.45, 0.45, 5)]
    crest = plate(spline([(-0.72, 1.2), (-0.4, 1.22), (0, 1.25), (0.4, 1.22), (0.72, 1.2), (0.72, 1.5), (0.4, 1.6), (0, 1.66), (-0.4, 1.6), (-0.72, 1.5)], 6, closed=True), 0.12)
    crest = crest.translate((0, 0, -0.87)).rotate((-1.5, 0, 0))
    return view(union(legs, seat, rungs, *posts, *finials, *spindles, crest), 3.4, yaw=30, pitch=16)


def sofa() -> Manifold:
    """Two-seat sofa with loose cushions and round arms.

    Size 1 × 1 × 1 m.
    """
    base = box((3.0, 0.5, 1.3), (0, -0.55, 0), rounding=0.08)
    back = box((3.0, 1.3, 0.4), (0, 0.05, -0.6), rounding=0.16)
    seats = union(*(box((1.24, 0.32, 1.12), (x, -0.17, 0.14), rounding=0.13) for x in (-0.62, 0.62)))
    backs = union(*(box((1.2, 0.8, 0.36), (0, 0, 0), rounding=0.16).rotate((-10, 0, 0)).translate((x, 0.33, -0.3)) for x in (-0.62, 0.62)))
    arm = union(box((0.36, 0.8, 1.4), (1.46, -0.4, 0.02), rounding=0.06), rod((1.46, 0.08, -0.7), (1.46, 0.08, 0.74), 0.27), rod((1.46, 0.08, 0.6), (1.46, 0.08, 0.77), 0.1))
    feet = union(*(rod((1.4, -0.7, z), (1.43, -1.02, z), 0.1, 0.06) for z in (-0.5, 0.55)))
    pillow = ball((0.42, 0.42, 0.16)).rotate((0, 0, 45)).rotate((-24, 12, 0)).translate((0.85, 0.28, 0.05))
    return view(union(base, back, seats, backs, mirrored(union(arm, feet)), pillow), 3.8, yaw=22, pitch=20)


def television() -> Manifold:
    """Old television set with a curved tube, knobs, splayed legs and a rabbit-ear aerial.

    Size 1 × 1 × 1 m.
    """
    case = box((2.7, 1.75, 1.1), rounding=0.12)
    outline = superellipse(0.9, 0.7, 5, 64) + (-0.32, 0)
    recess = plate(outline, 0.3).translate((0, 0, 0.55))
    glass = (ball((1.5, 1.2, 0.42), (-0.32, 0, 0.16), segments=96) ^ plate(outline * (1, 1), 1.2))
    bezel = plate(superellipse(0.98, 0.78, 5, 64) + (-0.32, 0), 0.12).translate((0, 0, 0.55))
    knob = union(rod((0, 0, 0.5), (0, 0, 0.66), 0.17), box((0.06, 0.3, 0.2), (0, 0, 0.62)))
    knobs = union(knob.rotate((0, 0, 30)).translate((0.98, 0.5, 0)), knob.rotate((0, 0, -20)).translate((0.98, 0.08, 0)))
    slots = union(*(box((0.44, 0.05, 0.3), (0.98, -0.25 - 0.11 * k, 0.55)) for k in range(5)))
    leg = rod((0.95, -0.8, 0.3), (1.2, -1.55, 0.5), 0.1, 0.05)
    legs = mirrored(mirrored(leg), "z")
    ears = union(mirrored(union(rod((0.05, 0.95, 0), (0.75, 1.75, 0), 0.035), ball(0.065, (0.75, 1.75, 0), segments=24))), ball((0.3, 0.2, 0.22), (0, 0.9, 0)))
    whole = union(case + bezel - recess - slots, glass, knobs, legs, ears)
    return view(whole, 3.4, yaw=-20, pitch=8)


def car() -> Manifold:
    """Small round car with separate wings, running boards and round lamps.

    Size 1 × 1 × 1 m.
    """
    x = np.linspace(-1.62, 1.62, 60)
    top = spline([(-1.62, 0.42), (-1.55, 0.62), (-1.2, 0.82), (-0.7, 0.92), (0.3, 0.95), (1.0, 0.85), (1.45, 0.6), (1.62, 0.38)], 8)
    half = spline([(-1.62, 0.2), (-1.5, 0.38), (-1.0, 0.5), (-0.4, 0.6), (0.6, 0.62), (1.2, 0.5), (1.5, 0.38), (1.62, 0.2)], 8)
    lower = loft([_slice(at, 0.2, np.interp(at, *top.T), np.interp(at, *half.T), 3.2) for at in x])
    roof = spline([(-0.72, 0.75), (-0.6, 0.92), (-0.32, 1.32), (0.05, 1.46), (0.45, 1.42), (0.9, 1.16), (1.3, 0.82), (1.4, 0.7)], 8)
    cabin_at = np.linspace(-0.71, 1.39, 50)
    cabin = loft([_slice(at, 0.4, np.interp(at, *roof.T), 0.56 * (1 - 0.35 * np.clip(at / 1.4, 0, 1) ** 2), 2.8) for at in cabin_at])
    side_panes = union(
        plate(spline([(-0.42, 0.95), (-0.2, 1.27), (0.18, 1.3), (0.18, 0.95)], 1), 3),
        plate(spline([(0.26, 0.95), (0.26, 1.3), (0.5, 1.26), (0.78, 1.05), (0.8, 0.95)], 1), 3),
    )
    front_pane = plate(superellipse(0.42, 0.15, 4) + (0, 1.14), 1.0).rotate((0, 90, 0)).translate((-0.6, 0, 0))
    panes = ((side_panes + front_pane) ^ cabin) - cabin.translate((-0.3, -0.9, 0)).scale((0.93, 0.93, 0.9)).translate((0.3, 0.87, 0))
    wing = union(*(ball((0.5, 0.42, 0.3), (at, 0.4, 0.56)) ^ box((1.2, 0.8, 1), (at, 0.6, 0.5)) for at in (-1.08, 1.08)))
    arch = union(*(rod((at, 0.3, 0.5), (at, 0.3, 1.2), 0.33) for at in (-1.08, 1.08)))
    wheel = union(*(union(torus(0.22, 0.1).rotate((90, 0, 0)), rod((0, 0, -0.06), (0, 0, 0.06), 0.22), ball((0.14, 0.14, 0.1), (0, 0, 0.06))).translate((at, 0.3, 0.68)) for at in (-1.08, 1.08)))
    board = box((1.3, 0.08, 0.3), (0, 0.24, 0.62), rounding=0.03)
    lamp = union(ball((0.16, 0.15, 0.15), (-1.42, 0.62, 0.56)))
    bumpers = union(*(tube(spline([(s * 1.5, 0.32, -0.75), (s * 1.72, 0.32, -0.4), (s * 1.76, 0.32, 0), (s * 1.72, 0.32, 0.4), (s * 1.5, 0.32, 0.75)]), 0.055) for s in (-1, 1)))
    body = union(lower, cabin, mirrored(wing, "z")) - mirrored(arch, "z") - panes
    whole = union(body, mirrored(union(wheel, board, lamp), "z"), bumpers)
    return view(whole.scale((1.05, 1.2, 1.05)), 3.9, yaw=32, pitch=14)


def _slice(x: float, bottom: float, top: float, half_width: float, exponent: float) -> np.ndarray:
    """Cross-section of a body at station x: a superellipse between two heights."""
    outline = superellipse(half_width, (top - bottom) / 2, exponent, 48)
    return np.column_stack([np.full(len(outline), x), outline[:, 1] + (top + bottom) / 2, outline[:, 0]])
