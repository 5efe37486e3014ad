"""The built-in targets: watertight procedural meshes of things that lie, or might lie, under water.

Each is 3.3 to 3.9 m in its larger side, so that it fills the height or most of the width that a camera of 20° sees at
15 m, and shows its good side to a camera that looks along +z. The local frame is the camera's: +x right, +y down (the
top of an upright object is at −y), metres, the bounding box centred at the origin. Sizes in the docstrings are width ×
height × depth (x, y, z). No randomness and no files: the same bits come out of every call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from manifold3d import Manifold

from spadwarp.mesh.solids import (
    around,
    ball,
    box,
    capsule,
    copies,
    implicit,
    lathe,
    loft,
    mirrored,
    plate,
    rod,
    smooth_union,
    spline,
    station,
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


# Targets from ships, navies and wrecks.


def submarine() -> Manifold:
    """Submarine under way to the left: drop-shaped hull, sail with planes, masts, portholes, cross tail, screw.

    Size 3.90 × 2.59 × 2.05 m.
    """
    s = np.linspace(0, 1, 49)
    radius = 0.5 * np.where(
        s < 0.25, np.sqrt(1 - np.maximum(1 - s / 0.25, 0) ** 2), 1 - np.maximum(s / 0.45 - 11 / 9, 0) ** 2 * 0.88
    )
    hull = lathe([*zip(radius, 3.7 * s, strict=True), (0, 3.7)], axis="x").translate((-1.85, 0, 0))
    deck = box((2.1, 0.14, 0.34), (-0.25, 0.48, 0), rounding=0.06)
    sail = _foil(1.0, 0.26, 0.68, taper=0.8).rotate((-90, 0, 0)).translate((-0.6, 0.4, 0))
    sail_plane = _foil(0.36, 0.07, 0.66, taper=0.8).translate((-0.52, 0.8, 0))
    masts = union(
        rod((-0.62, 0.9, 0), (-0.62, 1.55, 0), 0.035),
        capsule((-0.72, 1.55, 0), (-0.6, 1.55, 0), 0.055),
        rod((-0.45, 0.9, 0), (-0.45, 1.4, 0), 0.05),
        rod((-0.31, 0.9, 0), (-0.31, 1.22, 0), 0.03),
    )
    frames = union(*(rod((x, 0.12, -0.52), (x, 0.12, 0.52), 0.13) for x in np.linspace(-1.05, 0.15, 5)))
    panes = union(*(rod((x, 0.12, 0.45), (x, 0.12, 1), 0.09) for x in np.linspace(-1.05, 0.15, 5)))
    tail = around(_foil(0.46, 0.08, 0.78, taper=0.65).translate((1.15, 0, 0)), 4, axis="x")
    screw = _screw(5, 0.48, chord=0.22, pitch=0.9, skew=25).translate((1.87, 0, 0))
    hub = capsule((1.7, 0, 0), (1.95, 0, 0), 0.08, 0.05)
    body = union(hull, frames) - mirrored(panes, "z")
    return view(union(body, deck, sail, mirrored(sail_plane, "z"), masts, tail, screw, hub), 3.9, yaw=-18, pitch=12)


def anchor() -> Manifold:
    """Admiralty anchor with stock and ring.

    Size 2.44 × 3.40 × 1.34 m.
    """
    shank = tube([(0, -1.3, 0), (0, 1.05, 0)], [0.18, 0.11], sides=8)
    sweep = np.radians(np.linspace(-72, 72, 25))
    arm = np.stack([1.15 * np.sin(sweep), -1.15 * np.cos(sweep) - 0.15, 0 * sweep], axis=1)
    arms = tube(arm, 0.18 - 0.1 * np.abs(np.linspace(-1, 1, 25)) ** 1.5, sides=12)
    palm = plate([(-0.06, 0.44), (0.06, 0.44), (0.36, -0.05), (0.1, -0.2), (-0.1, -0.2), (-0.36, -0.05)], 0.1)
    palm = palm.rotate((0, 60, 0)).rotate((0, 0, 18)).translate((-1.0, -0.4, 0))
    stock = union(rod((-0.98, 0.85, 0), (0, 0.85, 0), 0.065, 0.11), ball(0.14, (-0.98, 0.85, 0)))
    ring = torus(0.28, 0.065, axis="z").translate((0, 1.32, 0))
    collar = box((0.36, 0.36, 0.36), (0, 0.85, 0), rounding=0.06)
    crown = rod((0, -1.22, 0), (0, -1.62, 0), 0.2, 0.03, segments=8)
    return view(union(shank, arms, mirrored(palm), mirrored(stock), ring, collar, crown), 3.4, yaw=20, pitch=6)


def cannon() -> Manifold:
    """Ship's cannon on a truck carriage, its muzzle towards the lower right.

    Size 3.60 × 2.13 × 2.50 m.
    """
    profile = [
        (0, -0.34), (0.07, -0.33), (0.12, -0.26), (0.12, -0.2), (0.07, -0.13), (0.08, -0.08), (0.25, 0), (0.36, 0.04),
        (0.36, 0.12), (0.33, 0.15), (0.32, 0.6), (0.35, 0.61), (0.35, 0.69), (0.31, 0.7), (0.27, 1.3), (0.3, 1.31),
        (0.3, 1.39), (0.26, 1.4), (0.21, 2.35), (0.24, 2.36), (0.24, 2.42), (0.21, 2.44), (0.21, 2.5), (0.3, 2.72),
        (0.3, 2.8), (0.27, 2.84), (0.14, 2.84), (0.14, 1.8), (0, 1.8),
    ]  # fmt: skip
    barrel = lathe(profile, axis="x").rotate((0, 0, 3)).translate((-1.3, 0.32, 0))
    cheek = plate(
        [(-1.35, -0.55), (-1.35, -0.15), (-0.95, -0.15), (-0.95, 0.02), (-0.55, 0.02), (-0.55, 0.18), (-0.15, 0.18),
         (-0.15, 0.36), (0.5, 0.36), (0.5, -0.55), (0.2, -0.55), (0, -0.4), (-0.7, -0.4), (-0.9, -0.55)], 0.14,
    ).translate((0, 0, 0.4))  # fmt: skip
    wheel = union(rod((0, 0, 0), (0, 0, 0.16), 0.3), rod((0, 0, -0.1), (0, 0, 0.24), 0.09))
    wheels = union(*(wheel.translate((x, -0.62, 0.45)) for x in (-1.08, 0.3)))
    axles = union(*(box((0.22, 0.2, 1.1), (x, -0.62, 0)) for x in (-1.08, 0.3)))
    bed = box((1.75, 0.1, 0.78), (-0.42, -0.485, 0))
    trunnion = rod((0.05, 0.3, -0.52), (0.05, 0.3, 0.52), 0.1)
    cap = box((0.32, 0.06, 0.16), (0.05, 0.42, 0.4))
    quoin = box((0.5, 0.46, 0.3), (-1.0, -0.26, 0))
    whole = union(barrel, mirrored(union(cheek, wheels, cap), "z"), axles, bed, trunnion, quoin)
    return view(whole, 3.6, yaw=-22, pitch=12)


def propeller() -> Manifold:
    """Ship's screw with four broad blades, seen from astern.

    Size 3.24 × 3.30 × 1.50 m.
    """
    blade = _blade(1.55, 0.25, chord=1.15, pitch=2.3, skew=14)
    profile = [(0, -0.55), (0.34, -0.5), (0.36, 0.1), (0.3, 0.4), (0.24, 0.45), (0.24, 0.55), (0.12, 0.8), (0, 0.85)]
    return view(union(around(blade, 4, axis="z", first=20), lathe(profile, axis="z")), 3.3, yaw=14, pitch=8)


def naval_mine() -> Manifold:
    """Moored contact mine: horned sphere, chain, sinker.

    Size 2.69 × 3.40 × 2.60 m.
    """
    horn = union(
        rod((0, 0.93, 0), (0, 1.05, 0), 0.15, 0.11),
        capsule((0, 1.0, 0), (0, 1.3, 0), 0.065, 0.055),
    )
    upper = around(horn.rotate((0, 0, 52)), 5, first=18)
    middle = around(horn.rotate((0, 0, 95)), 7, first=0)
    lower = around(horn.rotate((0, 0, 138)), 4, first=45)
    band = lathe([(0.9, -0.07), (1.02, -0.07), (1.02, 0.07), (0.9, 0.07)])
    bolts = around(ball(0.035, (0.98, 0.14, 0), segments=12), 28)
    lid = lathe([(0, 0.9), (0.3, 0.9), (0.3, 1.02), (0.24, 1.05), (0, 1.05)])
    eye = torus(0.13, 0.04, axis="z").translate((0, 1.13, 0))
    link = torus(0.13, 0.045, segments=32, axis="z").scale((0.7, 1, 1))
    chain = union(*(link.rotate((0, 35 + 90 * k, 0)).translate((0, -1.06 - 0.19 * k, 0)) for k in range(4)))
    sinker = union(
        box((1.1, 0.3, 0.8), (0, -1.86, 0), rounding=0.05), box((0.5, 0.16, 0.4), (0, -1.68, 0), rounding=0.04)
    )
    whole = union(ball(0.96, segments=96), upper, middle, lower, band, bolts, lid, eye, chain, sinker)
    return view(whole, 3.4, yaw=10, pitch=12)


def shipwreck() -> Manifold:
    """Ribs of a wooden wreck on their keel, some of them broken, seen from the bow quarter.

    Size 3.80 × 2.08 × 2.31 m.
    """
    stations = np.linspace(-1.5, 1.5, 10)
    port = [1.0, 0.93, 1.0, 0.6, 0.97, 0.85, 1.0, 0.66, 0.98, 0.8]  # part of each rib that still stands
    starboard = [0.97, 1.0, 0.78, 1.0, 0.92, 0.6, 1.0, 0.95, 0.7, 1.0]

    def curve(x: float, s: np.ndarray) -> np.ndarray:
        beam = 0.82 * (1 - (x / 1.95) ** 2) ** 0.7
        rise = 0.5 * (x / 1.9) ** 2
        return np.stack([0 * s + x, rise + 1.35 * s**2.2, beam * np.sin(np.pi / 2 * s) ** 0.75], axis=1)

    ribs = []
    for side, standing in ((1, port), (-1, starboard)):
        for x, part in zip(stations, standing, strict=True):
            path = curve(x, np.linspace(0.02, part, 14)) * (1, 1, side)
            ribs.append(tube(path, np.linspace(0.11, 0.075, 14), sides=4))
    keel_x = np.linspace(-1.9, 1.7, 25)
    keel = tube(np.stack([keel_x, 0.5 * (keel_x / 1.9) ** 2 - 0.04, 0 * keel_x], axis=1), 0.13, sides=4)
    stem = tube(spline([(-1.6, 0.3, 0), (-1.85, 0.5, 0), (-2.05, 1.0, 0), (-2.1, 1.7, 0)]), 0.12, sides=4)
    post = tube([(1.6, 0.3, 0), (1.85, 1.35, 0)], 0.11, sides=4)
    strakes = []
    for s, start, stop, side in (
        (0.4, -1.6, 0.7, 1),
        (0.5, -1.6, 1.6, -1),
        (0.66, -1.6, 0.9, -1),
        (0.82, 0.1, 1.6, -1),
    ):
        path = np.concatenate([curve(x, np.array([s])) for x in np.linspace(start, stop, 24)]) * (1, 1, side)
        strakes.append(tube(path, 0.07, sides=4))
    return view(union(*ribs, keel, stem, post, *strakes), 3.8, yaw=24, pitch=18)


def torpedo() -> Manifold:
    """Torpedo with its warhead up to the left, tail fins and two screws.

    Size 3.90 × 2.39 × 1.61 m.
    """
    nose = [(0.3 * np.sqrt(np.sin(np.pi / 2 * s)), 0.5 * s**1.4) for s in np.linspace(0.02, 1, 16)]
    profile = [(0, 0), *nose, (0.3, 0.98), (0.285, 0.99), (0.285, 1.03), (0.3, 1.04), (0.3, 2.0), (0.285, 2.01),
               (0.285, 2.05), (0.3, 2.06), (0.3, 2.4), (0.1, 3.1), (0, 3.1)]  # fmt: skip
    body = lathe(profile, axis="x").translate((-1.95, 0, 0))
    fin = plate([(0.45, 0), (0.65, 0.48), (1.02, 0.48), (1.12, 0)], 0.05)
    screws = [_screw(4, 0.36, chord=0.24, pitch=p).translate((x, 0, 0)) for x, p in ((1.18, 0.9), (1.42, -0.9))]
    spinner = lathe([(0, 1.05), (0.1, 1.05), (0.11, 1.45), (0.05, 1.6), (0, 1.61)], axis="x")
    tip = rod((-2.1, 0, 0), (-1.9, 0, 0), 0.06)
    whiskers = around(rod((-2.04, 0, 0), (-1.98, 0.17, 0), 0.025, segments=12), 4, axis="x", first=45)
    lug = box((0.2, 0.1, 0.08), (0.1, 0.31, 0), rounding=0.03)
    whole = union(body, around(fin, 4, axis="x", first=45), *screws, spinner, tip, whiskers, lug)
    return view(whole, 3.9, yaw=-14, pitch=14, roll=-24)


def _foil(chord: float, thickness: float, span: float, *, taper: float) -> Manifold:
    """Wing along +z from the origin, leading edge at −x, chord and thickness shrinking to `taper` at the tip."""
    s = np.linspace(0, 1, 13) ** 1.5
    # NACA four-digit thickness
    half = thickness / 2 * (2.97 * np.sqrt(s) - 1.26 * s - 3.52 * s**2 + 2.84 * s**3 - 1.03 * s**4)
    section = np.concatenate([np.stack([chord * (s - 0.5), half], 1), np.stack([chord * (s - 0.5), -half], 1)[-2:0:-1]])
    sections = [np.column_stack([section * k, np.full(len(section), span * f)]) for f, k in ((0, 1.0), (1, taper))]
    return loft(sections)


def _screw(count: int, radius: float, *, chord: float, pitch: float, skew: float = 0.0) -> Manifold:
    """Small screw about the x axis."""
    return around(_blade(radius, 0.05, chord=chord, pitch=pitch, skew=skew), count, axis="z").rotate((0, 90, 0))


def _blade(tip: float, root: float, *, chord: float, pitch: float, skew: float) -> Manifold:
    """Screw blade along +y, turning about z: `pitch` [m] per turn, `skew` [degrees] of sweep at the tip."""
    rings = []
    for f in np.linspace(0, 1, 22):
        r = root + f * (tip - root)
        width = chord * (0.42 + 0.58 * np.sin(np.pi * min(f, 0.62) / 1.24)) * np.sqrt(1 - max(f - 0.5, 0) ** 2 * 3.9)
        advance = np.arctan2(pitch, 2 * np.pi * r)
        section = superellipse(width / 2, max(0.02, 0.05 * tip * (1 - 0.75 * f)), 2.0, 28)
        along = section[:, 0] * np.cos(advance) - section[:, 1] * np.sin(advance)
        axial = section[:, 0] * np.sin(advance) + section[:, 1] * np.cos(advance)
        angle = along / r + np.radians(skew) * f**2
        rings.append(np.stack([r * np.sin(angle), r * np.cos(angle), axial], axis=1))
    return loft(rings)


# Organic targets: a fish, a starfish, mushrooms, a bust.


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


# Targets from land: furniture, a car, a jar.


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


SHAPES: dict[str, Callable[[], Manifold]] = {
    model.__name__: model
    for model in (
        submarine,
        anchor,
        amphora,
        chair,
        sofa,
        television,
        camera,
        cannon,
        car,
        mushroom,
        propeller,
        pipe_valve,
        naval_mine,
        fish,
        starfish,
        diver_helmet,
        shipwreck,
        torpedo,
        bust,
    )
}
"""Every object by name: functions without arguments that build the solid anew; their docstrings give sizes.

One more is a function here, and its name at the end of this list.
"""
