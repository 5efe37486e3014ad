"""Targets from ships, navies and wrecks."""

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


def submarine() -> Manifold:
    """Submarine under way to the left: drop-shaped hull, sail with planes, masts, cross tail, screw.

    Size 1 × 1 × 1 m.
    """
    x = np.linspace(0, 1, 40)
    radius = 0.42 * np.where(x < 0.22, np.sqrt(1 - (1 - x / 0.22) ** 2), (1 - np.clip((x - 0.5) / 0.5, 0, 1) ** 2 * 0.86))
    hull = lathe([(0, 0), *zip(radius, 3.7 * x, strict=True), (0, 3.7)]).rotate((0, 0, -90)).translate((-1.85, 0, 0))
    deck = box((2.2, 0.12, 0.3), (-0.15, 0.41, 0), rounding=0.055)
    sail = _foil(0.95, 0.2, 0.62, taper=0.82).rotate((-90, 0, 0)).translate((-0.85, 0.36, 0))
    sail_planes = _foil(0.34, 0.06, 1.3, taper=1.0).translate((-0.72, 0.72, -0.65))
    masts = union(
        rod((-0.58, 0.9, 0), (-0.58, 1.35, 0), 0.03),
        rod((-0.44, 0.9, 0), (-0.44, 1.22, 0), 0.045),
        capsule((-0.63, 1.35, 0), (-0.52, 1.35, 0), 0.045),
        rod((-0.28, 0.9, 0), (-0.28, 1.1, 0), 0.025),
    )
    fin = _foil(0.42, 0.07, 0.68, taper=0.65).translate((1.2, 0, 0))
    tail = around(fin, 4, axis="x")
    screw = around(_blade(0.42, 0.06, chord=0.16, pitch=0.8, skew=25).rotate((0, 90, 0)), 6, axis="x").translate((1.86, 0, 0))
    ports = union(*(box((0.14, 0.2, 0.022), (-0.5 + 0.25 * k, 0.17, 0.41), rounding=0.01) for k in range(6)))
    whole = union(hull, deck, sail, sail_planes, masts, tail, screw, ball((0.12, 0.08, 0.08), (1.86, 0, 0)), ports)
    return view(whole, 3.9, yaw=-24, pitch=12)


def anchor() -> Manifold:
    """Admiralty anchor with ring and a few links of chain.

    Size 1 × 1 × 1 m.
    """
    shank = tube([(0, -1.3, 0), (0, 1.05, 0)], [0.17, 0.1], sides=8)
    crown = 1.15 * np.stack([np.sin(a := np.radians(np.linspace(-72, 72, 25))), -np.cos(a), 0 * a], axis=1)
    arms = tube(crown + (0, -0.15, 0), 0.17 - 0.1 * np.abs(np.linspace(-1, 1, 25)) ** 1.5, sides=12)
    bill = plate([(-0.06, 0.42), (0.06, 0.42), (0.34, -0.05), (0.1, -0.2), (-0.1, -0.2), (-0.34, -0.05)], 0.09)
    fluke = bill.rotate((0, 90, 0)).rotate((0, 0, -20)).translate((-1.02, -0.42, 0))
    fluke = bill.rotate((0, 62, 0)).rotate((0, 0, 18)).translate((-1.0, -0.4, 0))
    stock = union(rod((-0.95, 0.85, 0), (0, 0.85, 0), 0.06, 0.1), ball(0.13, (-0.95, 0.85, 0)))
    ring = torus(0.26, 0.06).rotate((90, 0, 0)).translate((0, 1.3, 0))
    collar = box((0.34, 0.34, 0.34), (0, 0.85, 0), rounding=0.06)
    tip = rod((0, -1.22, 0), (0, -1.62, 0), 0.2, 0.03, segments=8)
    whole = union(shank, arms, mirrored(fluke), mirrored(stock), ring, collar, tip)
    return view(whole, 3.4, yaw=24, pitch=6)


def cannon() -> Manifold:
    """Ship's cannon on a truck carriage, its muzzle towards the lower right.

    Size 1 × 1 × 1 m.
    """
    profile = [
        (0, -0.34), (0.07, -0.33), (0.12, -0.26), (0.12, -0.2), (0.07, -0.13), (0.08, -0.08), (0.25, 0), (0.36, 0.04),
        (0.36, 0.12), (0.33, 0.15), (0.32, 0.6), (0.35, 0.61), (0.35, 0.69), (0.31, 0.7), (0.27, 1.3), (0.3, 1.31),
        (0.3, 1.39), (0.26, 1.4), (0.21, 2.35), (0.24, 2.36), (0.24, 2.42), (0.21, 2.44), (0.21, 2.5), (0.3, 2.72),
        (0.3, 2.8), (0.27, 2.84), (0.14, 2.84), (0.14, 1.8), (0, 1.8),
    ]  # fmt: skip
    barrel = lathe(profile).rotate((0, 0, -87)).translate((-1.3, 0.32, 0))
    cheek = plate(
        [(-1.35, -0.55), (-1.35, -0.15), (-0.95, -0.15), (-0.95, 0.02), (-0.55, 0.02), (-0.55, 0.18), (-0.15, 0.18),
         (-0.15, 0.36), (0.5, 0.36), (0.5, -0.55), (0.2, -0.55), (0, -0.4), (-0.7, -0.4), (-0.9, -0.55)], 0.14,
    ).translate((0, 0, 0.4))  # fmt: skip
    wheel = union(rod((0, 0, 0), (0, 0, 0.16), 0.3), rod((0, 0, -0.1), (0, 0, 0.24), 0.09))
    wheels = union(*(wheel.translate((x, -0.62, 0.47)) for x in (-1.08, 0.3)))
    axles = union(*(box((0.22, 0.2, 1.1), (x, -0.62, 0)) for x in (-1.08, 0.3)))
    bed = box((1.75, 0.1, 0.8), (-0.42, -0.5, 0))
    trunnion = rod((0.05, 0.3, -0.52), (0.05, 0.3, 0.52), 0.1)
    cap = box((0.32, 0.06, 0.16), (0.05, 0.42, 0.4))
    quoin = box((0.5, 0.3, 0.3), (-1.0, -0.2, 0))
    whole = union(barrel, mirrored(union(cheek, wheels, cap), "z"), axles, bed, trunnion, quoin)
    return view(whole, 3.6, yaw=-32, pitch=12)


def propeller() -> Manifold:
    """Ship's screw with four broad blades, seen from astern.

    Size 1 × 1 × 1 m.
    """
    blade = _blade(1.55, 0.25, chord=1.15, pitch=2.3, skew=14)
    hub = lathe([(0, -0.55), (0.34, -0.5), (0.36, 0.1), (0.3, 0.4), (0.24, 0.45), (0.24, 0.55), (0.12, 0.8), (0, 0.85)])
    return view(union(around(blade, 4, axis="z", first=20), hub.rotate((90, 0, 0))), 3.3, yaw=14, pitch=8)


def naval_mine() -> Manifold:
    """Moored contact mine: horned sphere, chain, sinker.

    Size 1 × 1 × 1 m.
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
    eye = torus(0.13, 0.04).rotate((90, 0, 0)).translate((0, 1.13, 0))
    link = torus(0.13, 0.045, segments=32).rotate((90, 0, 0)).scale((0.7, 1, 1))
    chain = union(*(link.rotate((0, 35 + 90 * k, 0)).translate((0, -1.06 - 0.19 * k, 0)) for k in range(4)))
    sinker = union(box((1.1, 0.3, 0.8), (0, -1.86, 0), rounding=0.05), box((0.5, 0.16, 0.4), (0, -1.68, 0), rounding=0.04))
    whole = union(ball(0.96, segments=96), upper, middle, lower, band, bolts, lid, eye, chain, sinker)
    return view(whole, 3.4, yaw=10, pitch=12)


def shipwreck() -> Manifold:
    """Ribs of a wooden wreck on their keel, some of them broken, seen from the bow quarter.

    Size 1 × 1 × 1 m.
    """
    stations = np.linspace(-1.55, 1.55, 12)
    kept = [1.0, 0.93, 1.0, 0.55, 0.97, 1.0, 0.88, 1.0, 0.62, 0.98, 1.0, 0.8]  # part of the rib that still stands, port
    lost = [0.97, 1.0, 0.7, 1.0, 0.92, 0.45, 1.0, 0.95, 1.0, 0.35, 0.9, 1.0]  # the same to starboard

    def curve(x: float, s: np.ndarray) -> np.ndarray:
        beam = 0.95 * (1 - (x / 1.95) ** 2) ** 0.7
        rise = 0.5 * (x / 1.9) ** 2
        return np.stack([0 * s + x, rise + 1.35 * s**2.2, beam * np.sin(np.pi / 2 * s) ** 0.75], axis=1)

    ribs = []
    for x, port, starboard in zip(stations, kept, lost, strict=True):
        for side, part in ((1, port), (-1, starboard)):
            ribs.append(tube(curve(x, np.linspace(0.02, part, 14)) * (1, 1, side), np.linspace(0.085, 0.06, 14), sides=4))
    keel_x = np.linspace(-1.9, 1.7, 25)
    keel = tube(np.stack([keel_x, 0.5 * (keel_x / 1.9) ** 2 - 0.04, 0 * keel_x], axis=1), 0.13, sides=4)
    stem = tube(spline([(-1.6, 0.3, 0), (-1.85, 0.5, 0), (-2.05, 1.0, 0), (-2.1, 1.7, 0)]), 0.12, sides=4)
    post = tube([(1.6, 0.3, 0), (1.85, 1.35, 0)], 0.11, sides=4)
    strakes = []
    for s, start, stop, side in ((0.25, -1.7, 1.6, 1), (0.42, -1.7, 0.6, 1), (0.25, -1.7, 1.7, -1), (0.45, -1.2, 1.7, -1), (0.68, -0.2, 1.7, -1)):
        xs = np.linspace(start, stop, 24)
        path = np.concatenate([curve(x, np.array([s])) for x in xs]) * (1, 1, side)
        strakes.append(tube(path, 0.07, sides=4))
    return view(union(*ribs, keel, stem, post, *strakes), 3.8, yaw=34, pitch=22)


def torpedo() -> Manifold:
    """Torpedo with its warhead up to the left, tail fins and two screws.

    Size 1 × 1 × 1 m.
    """
    nose = [(0.3 * np.sqrt(np.sin(np.pi / 2 * s)), 0.5 * s**1.4) for s in np.linspace(0.02, 1, 16)]
    profile = [(0, 0), *nose, (0.3, 0.98), (0.285, 0.99), (0.285, 1.03), (0.3, 1.04), (0.3, 2.3), (0.285, 2.31),
               (0.285, 2.35), (0.3, 2.36), (0.3, 2.9), (0.1, 3.62), (0, 3.62)]  # fmt: skip
    body = lathe(profile).rotate((0, 0, -90)).translate((-1.95, 0, 0))
    fin = plate([(0.95, 0), (1.15, 0.46), (1.5, 0.46), (1.6, 0)], 0.05)
    screws = [
        around(_blade(0.36, 0.05, chord=0.24, pitch=sign * 0.9, skew=0).rotate((0, 90, 0)), 4, axis="x").translate((x, 0, 0))
        for x, sign in ((1.68, 1), (1.92, -1))
    ]
    spinner = lathe([(0, 0), (0.1, 0), (0.11, 0.4), (0.05, 0.55), (0, 0.56)]).rotate((0, 0, -90)).translate((1.55, 0, 0))
    tip = rod((-2.1, 0, 0), (-1.9, 0, 0), 0.06)
    whiskers = around(rod((-2.04, 0, 0), (-1.98, 0.17, 0), 0.025, segments=12), 4, axis="x", first=45)
    lug = box((0.2, 0.1, 0.08), (0.1, 0.31, 0), rounding=0.03)
    whole = union(body, around(fin, 4, axis="x", first=45), *screws, spinner, tip, whiskers, lug)
    return view(whole, 3.9, yaw=-20, pitch=14, roll=-24)


def _foil(chord: float, thickness: float, span: float, *, taper: float) -> Manifold:
    """Wing along +z from the origin, leading edge at −x, chord and thickness shrinking to `taper` at the tip."""
    s = np.linspace(0, 1, 13) ** 1.5
    half = thickness / 2 * (2.97 * np.sqrt(s) - 1.26 * s - 3.52 * s**2 + 2.84 * s**3 - 1.03 * s**4) / 1.0
    section = np.concatenate([np.stack([chord * (s - 0.5), half], 1), np.stack([chord * (s - 0.5), -half], 1)[-2:0:-1]])
    sections = [np.column_stack([section * k, np.full(len(section), span * f)]) for f, k in ((0, 1.0), (1, taper))]
    return loft(sections)


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
