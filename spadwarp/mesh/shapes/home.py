"""Targets from land: furniture, a car, a jar."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from spadwarp.mesh.shapes.solids import (
    ball,
    box,
    copies,
    lathe,
    loft,
    mirrored,
    plate,
    rod,
    spline,
    station,
    superellipse,
    torus,
    tube,
    union,
    view,
)


def amphora() -> Manifold:
    """Wine jar with two handles and a pointed foot.

    Size 1.83 × 3.40 × 1.80 m.
    """
    outer = spline(
        [(0.02, -1.75), (0.13, -1.7), (0.16, -1.55), (0.17, -1.4), (0.42, -1.0), (0.72, -0.45), (0.9, 0.1),
         (0.92, 0.45), (0.75, 0.78), (0.42, 0.98), (0.27, 1.12), (0.24, 1.4), (0.26, 1.6)], 6,
    )  # fmt: skip
    lip = [(0.3, 1.62), (0.36, 1.68), (0.36, 1.78), (0.3, 1.82), (0.21, 1.8), (0.17, 1.4), (0.17, 1.0), (0, 1.0)]
    body = lathe([(0, -1.75), *outer, *lip])
    grooves = union(*(torus(r, 0.028).translate((0, y, 0)) for r, y in ((0.925, 0.3), (0.91, 0.15), (0.255, 1.22))))
    handle = spline(
        [(0.2, 1.5, 0), (0.45, 1.62, 0), (0.68, 1.5, 0), (0.76, 1.2, 0), (0.74, 0.95, 0), (0.64, 0.72, 0)], 6
    )
    whole = union(body, grooves, mirrored(tube(handle, 0.085).scale((1, 1, 1.3))))
    return view(whole, 3.4, yaw=-18, pitch=14)


def chair() -> Manifold:
    """Wooden chair with turned legs and a spindle back.

    Size 2.00 × 3.40 × 1.99 m.
    """
    profile = [
        (0, 0), (0.06, 0), (0.07, 0.15), (0.095, 0.4), (0.065, 0.5), (0.1, 0.58), (0.065, 0.66), (0.1, 1.0),
        (0.085, 1.4), (0, 1.4),
    ]  # fmt: skip
    leg = lathe(profile, segments=32).rotate((-5, 0, 5)).translate((0.68, -1.7, 0.62))
    legs = mirrored(mirrored(leg), "z")
    seat = box((1.65, 0.17, 1.5), (0, -0.3, 0), rounding=0.08)
    rungs = union(
        *(rod((x, -1.15, -0.6), (x, -1.15, 0.6), 0.055) for x in (-0.65, 0.65)),
        rod((-0.65, -1.15, 0), (0.65, -1.15, 0), 0.055),
        rod((-0.65, -0.95, 0.59), (0.65, -0.95, 0.59), 0.055),
    )
    post = tube(spline([(0.7, -0.3, -0.62), (0.714, 0.5, -0.7), (0.735, 1.6, -0.95)]), 0.085)
    finial = ball(0.12, (0.735, 1.63, -0.955), segments=24)
    spindle = tube(spline([(0, -0.3, -0.63), (0, 0.5, -0.7), (0, 1.35, -0.88)]), 0.045, sides=12)
    spindles = copies(spindle, [(x, 0, 0) for x in np.linspace(-0.45, 0.45, 5)])
    bow = spline([(-0.72, 1.5), (-0.4, 1.6), (0, 1.66), (0.4, 1.6), (0.72, 1.5)])
    crest = plate([(-0.72, 1.2), (0, 1.25), (0.72, 1.2), *bow[::-1]], 0.12).translate((0, 0, -0.87))
    return view(union(legs, seat, rungs, mirrored(union(post, finial)), spindles, crest), 3.4, yaw=30, pitch=16)


def sofa() -> Manifold:
    """Two-seat sofa with loose cushions and round arms.

    Size 3.80 × 2.41 × 2.77 m.
    """
    base = box((3.0, 0.5, 1.3), (0, -0.55, 0), rounding=0.08)
    back = box((3.0, 1.3, 0.4), (0, 0.05, -0.6), rounding=0.16)
    seat = box((1.24, 0.32, 1.12), (0.62, -0.17, 0.14), rounding=0.13)
    cushion = box((1.2, 0.8, 0.36), rounding=0.16).rotate((-10, 0, 0)).translate((0.62, 0.33, -0.3))
    arm = union(
        box((0.36, 0.8, 1.4), (1.46, -0.4, 0.02), rounding=0.06),
        rod((1.46, 0.08, -0.7), (1.46, 0.08, 0.74), 0.27),
        rod((1.46, 0.08, 0.6), (1.46, 0.08, 0.77), 0.1),
    )
    foot = copies(rod((1.4, -0.7, 0), (1.43, -1.02, 0), 0.1, 0.06), [(0, 0, -0.5), (0, 0, 0.55)])
    pillow = ball((0.42, 0.42, 0.16)).rotate((-24, 12, 0)).translate((0.85, 0.28, 0.05))
    return view(union(base, back, mirrored(union(seat, cushion, arm, foot)), pillow), 3.8, yaw=22, pitch=20)


def television() -> Manifold:
    """Old television set with a curved tube, knobs, splayed legs and a rabbit-ear aerial.

    Size 2.77 × 3.40 × 2.16 m.
    """
    case = box((2.7, 1.75, 1.1), rounding=0.12)
    opening, tube_edge, bezel = (superellipse(0.9 + d, 0.7 + d, 5, 64, at=(-0.32, 0)) for d in (0, 0.02, 0.08))
    front = plate(bezel, 0.12).translate((0, 0, 0.55))
    hollow = plate(opening, 0.3).translate((0, 0, 0.55))
    screen = ball((1.5, 1.2, 0.42), (-0.32, 0, 0.16), segments=96) ^ plate(tube_edge, 1.2)
    knob = union(rod((0, 0, 0.5), (0, 0, 0.66), 0.17), box((0.06, 0.3, 0.2), (0, 0, 0.62)))
    knobs = union(*(knob.rotate((0, 0, turn)).translate((0.98, y, 0)) for y, turn in ((0.5, 30), (0.08, -20))))
    slots = copies(box((0.44, 0.05, 0.3)), [(0.98, -0.25 - 0.11 * k, 0.55) for k in range(5)])
    leg = rod((0.95, -0.8, 0.3), (1.2, -1.55, 0.5), 0.1, 0.05)
    legs = mirrored(mirrored(leg), "z")
    ear = union(rod((0.05, 0.95, 0), (0.75, 1.75, 0), 0.035), ball(0.065, (0.75, 1.75, 0), segments=24))
    aerial = union(mirrored(ear), ball((0.3, 0.2, 0.22), (0, 0.9, 0)))
    return view(union(case + front - hollow - slots, screen, knobs, legs, aerial), 3.4, yaw=-20, pitch=8)


def car() -> Manifold:
    """Small round car with separate wings, running boards and round lamps.

    Size 3.90 × 2.20 × 3.04 m.
    """
    top = spline(
        [(-1.62, 0.42), (-1.55, 0.62), (-1.2, 0.82), (-0.7, 0.92), (0.3, 0.95), (1, 0.85), (1.45, 0.6), (1.62, 0.38)]
    )
    half = spline(
        [(-1.62, 0.2), (-1.5, 0.38), (-1, 0.5), (-0.4, 0.6), (0.6, 0.62), (1.2, 0.5), (1.5, 0.38), (1.62, 0.2)]
    )
    roof = spline(
        [(-0.72, 0.75), (-0.6, 0.92), (-0.32, 1.32), (0.05, 1.46), (0.45, 1.42), (0.9, 1.16), (1.3, 0.82), (1.4, 0.7)]
    )
    lower = loft(
        [station(x, 0.2, np.interp(x, *top.T), np.interp(x, *half.T), 3.2) for x in np.linspace(-1.62, 1.62, 60)]
    )

    def cabin(inset: float) -> Manifold:
        rings = []
        for x in np.linspace(-0.71 + inset, 1.39 - inset, 50):
            height = np.interp(x - inset if x < 0 else x, *roof.T) - inset
            half_width = 0.56 * (1 - 0.35 * max(x / 1.4, 0) ** 2) - inset
            rings.append(station(x, 0.4, height, half_width, np.interp(x, [-0.5, 0.6], [6.0, 2.8])))
        return loft(rings)

    windows = union(
        plate([(-0.4, 0.97), (-0.2, 1.25), (0.16, 1.29), (0.16, 0.97)], 3),
        plate([(0.26, 0.97), (0.26, 1.29), (0.5, 1.25), (0.76, 1.07), (0.8, 0.97)], 3),
        plate(superellipse(0.4, 0.14, 5, at=(0, 1.12)), 1.0).rotate((0, 90, 0)).translate((-0.72, 0, 0)),
    )
    panes = windows - cabin(0.08)
    wheels = [(x, 0.3, 0) for x in (-1.08, 1.08)]
    wing = copies(ball((0.5, 0.42, 0.3), (0, 0.1, 0.56)) ^ box((1.2, 0.8, 1), (0, 0.3, 0.5)), wheels)
    arch = copies(rod((0, 0, 0.5), (0, 0, 1.2), 0.33), wheels)
    tyre = union(
        torus(0.22, 0.1, axis="z"), rod((0, 0, -0.06), (0, 0, 0.06), 0.22), ball((0.14, 0.14, 0.1), (0, 0, 0.06))
    )
    tyres = copies(tyre.translate((0, 0, 0.68)), wheels)
    axles = copies(rod((0, 0, -0.7), (0, 0, 0.7), 0.08), wheels)
    board = box((1.3, 0.08, 0.3), (0, 0.24, 0.62), rounding=0.03)
    lamp = ball((0.16, 0.15, 0.15), (-1.42, 0.62, 0.56))
    bumper = spline([(1.5, 0.32, -0.75), (1.72, 0.32, -0.4), (1.76, 0.32, 0), (1.72, 0.32, 0.4), (1.5, 0.32, 0.75)])
    body = union(lower, cabin(0), mirrored(wing, "z")) - mirrored(arch, "z") - panes
    whole = union(body, mirrored(union(tyres, board, lamp), "z"), axles, mirrored(tube(bumper, 0.055)))
    return view(whole.scale((1.05, 1.2, 1.05)), 3.9, yaw=28, pitch=14)
