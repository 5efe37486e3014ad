"""Targets from ships, navies and wrecks."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from spadwarp.mesh.shapes.solids import (
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
