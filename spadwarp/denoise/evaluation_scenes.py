"""Scenes on which denoisers are compared by scene type, and a noise generator that no training uses.

The shapes are unlike those of the training (`spadwarp.denoise.shapes`): stairs, rings, stars, letters, a spiral, a
lattice, a vase. They are drawn from formulas with NumPy; the noise is that of the paper (Sensors 24, 3886, 2024): a
part of the pixels, the backscatter fraction, reports backscatter instead of the target.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.values import ArgumentError

__all__ = [
    "GATE",
    "LEVELS",
    "SETTINGS",
    "SHAPES",
    "WATERS",
    "EvaluationScene",
    "evaluation_scene",
    "noisy_depth",
    "water_profile",
]

GATE = (13.5, 16.0)
"""Gate of the scenes, in depth [m]."""

LEVELS = (0.042, 0.183, 0.264, 0.337, 0.394, 0.480)
"""The paper's backscatter fractions."""

SETTINGS = ("wall", "open water", "floor")
"""Surfaces behind the shapes."""

WATERS = ("front", "uniform", "near-range")
"""Where backscatter comes from: uniformly from in front of the target; uniformly from the whole gate; mostly from the
start of the gate."""

_Image = NDArray[np.float64]
_DECAY = 8.0  # of near-range backscatter [1 / gate]


class EvaluationScene(NamedTuple):
    """True depth float32 `[H, W]` [m], NaN where there is only water; the shape's name; one of `SETTINGS`; the gate."""

    clean: NDArray[np.float32]
    shape: str
    setting: str
    gate: tuple[float, float] = GATE


def evaluation_scene(shape: str, setting: str, *, size: tuple[int, int] = (192, 256)) -> EvaluationScene:
    """A scene of `SHAPES` before one of `SETTINGS`, rows × columns `size`.

    Raises `ArgumentError` for a name that is in neither.
    """
    if shape not in SHAPES or setting not in SETTINGS:
        raise ArgumentError(f"({shape!r}, {setting!r}) is not one of {', '.join(SHAPES)} and one of {SETTINGS}")
    rows, columns = size
    unit = min(rows, columns) / 2.0
    y, x = np.meshgrid(
        (np.arange(rows) - rows / 2 + 0.5) / unit, (np.arange(columns) - columns / 2 + 0.5) / unit, indexing="ij"
    )
    depth = SHAPES[shape](y, x)
    if setting == "wall":
        depth = np.fmin(depth, 15.42 + 0.03 * x - 0.02 * y + 0.01 * np.sin(5 * x) * np.sin(4 * y))
    elif setting == "floor":  # seen from above, nearer towards the bottom
        floor = 1.0 / (0.0625 + 0.0075 * y)
        depth = np.fmin(depth, np.where(floor < GATE[1], floor, np.nan))
    return EvaluationScene(depth.astype(np.float32), shape, setting)


def water_profile(water: str, bins: int = 100) -> NDArray[np.float64]:
    """Backscatter of one of `WATERS` over the gate, `[bins]`, mean 1. Raises `ArgumentError` for another name."""
    if water not in WATERS:
        raise ArgumentError(f"water = {water!r} is not one of {', '.join(map(repr, WATERS))}")
    centres = (np.arange(bins) + 0.5) / bins
    profile = np.exp(-_DECAY * centres) if water == "near-range" else np.ones(bins)
    return profile / profile.mean()


def noisy_depth(
    scene: EvaluationScene, *, water: str, level: float, seed: int, jitter: float = 0.004
) -> NDArray[np.float32]:
    """A frame `[H, W]` [m] that a SPAD camera reports of the scene; NaN where it reports nothing.

    Args:
        scene: Its true depth.
        water: One of `WATERS`.
        level: Backscatter fraction: part of the pixels that report backscatter, whether they see a target or not.
        seed: Of the noise.
        jitter: Deviation of a reported depth of the target [m].
    """
    generator = np.random.Generator(np.random.Philox(seed))
    start, stop = scene.gate
    seen = np.isfinite(scene.clean)
    reach = (np.where(seen, scene.clean, stop) - start) / (stop - start)
    u = generator.random(reach.shape)
    if water == "front":
        place = u * reach
    elif water == "uniform":
        place = u
    else:
        water_profile(water)  # refuses unknown names
        place = -np.log1p(-u * -np.expm1(-_DECAY * reach)) / _DECAY
    depth = scene.clean + jitter * generator.standard_normal(reach.shape)
    replaced = generator.random(reach.shape) < level
    return np.where(replaced, start + (stop - start) * place, depth).astype(np.float32)


# Shapes: depth [m] at image coordinates y, x (±1 along the shorter side), NaN beside the shape.


def _nearest(*surfaces: tuple[NDArray[np.bool_], _Image]) -> _Image:
    depth = np.full(surfaces[0][0].shape, np.nan)
    for inside, surface in surfaces:
        depth = np.where(inside, np.fmin(depth, surface), depth)
    return depth


def _stairs(y: _Image, x: _Image) -> _Image:
    """Seven steps of 10 cm."""
    step = np.floor((x + 0.98) / 0.28)
    return _nearest(((np.abs(x) < 0.98) & (np.abs(y) < 0.7), 15.1 - 0.1 * step))


def _rings(y: _Image, x: _Image) -> _Image:
    """Three tori, side by side and at different depths."""
    surfaces = []
    tori = (-0.55, -0.1, 0.42, 0.10, 14.4), (0.5, 0.25, 0.36, 0.05, 14.8), (0.1, -0.45, 0.3, 0.02, 15.1)
    for x0, y0, radius, tube, z in tori:
        distance = np.abs(np.hypot(x - x0, y - y0) - radius)
        bulge = np.sqrt(np.maximum(tube**2 - distance**2, 0.0))
        surfaces.append((distance < tube, z - bulge))
    return _nearest(*surfaces)


def _stars(y: _Image, x: _Image) -> _Image:
    """Stars with thin points."""
    surfaces = []
    for x0, y0, size, z, points in ((-0.5, 0.0, 0.75, 14.6, 5), (0.55, -0.3, 0.5, 15.0, 7), (0.65, 0.5, 0.35, 14.3, 4)):
        angle, radius = np.arctan2(y - y0, x - x0), np.hypot(x - x0, y - y0)
        reach = size * (0.25 + 0.75 * np.abs(np.cos(0.5 * points * angle)) ** 3)
        surfaces.append((radius < reach, z + 0.2 * radius))
    return _nearest(*surfaces)


def _letters(y: _Image, x: _Image) -> _Image:
    """SPAD in letters of 5 × 7 blocks, each letter at a depth of its own."""
    glyphs = {
        "S": (0b01111, 0b10000, 0b10000, 0b01110, 0b00001, 0b00001, 0b11110),
        "P": (0b11110, 0b10001, 0b10001, 0b11110, 0b10000, 0b10000, 0b10000),
        "A": (0b01110, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001),
        "D": (0b11100, 0b10010, 0b10001, 0b10001, 0b10001, 0b10010, 0b11100),
    }
    depth = np.full(y.shape, np.nan)
    block = 0.095
    for number, rows in enumerate(glyphs.values()):
        column = np.floor((x + 1.16) / block - 6.2 * number).astype(int)
        row = np.floor((y + 3.5 * block) / block).astype(int)
        inside = (row >= 0) & (row < 7) & (column >= 0) & (column < 5)
        bits = np.array(rows)[np.clip(row, 0, 6)]
        inside &= (bits >> (4 - np.clip(column, 0, 4))) & 1 == 1
        depth = np.where(inside, 14.2 + 0.25 * number, depth)
    return depth


def _spiral(y: _Image, x: _Image) -> _Image:
    """A rope two to three pixels wide, on a spiral that leads away."""
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    turn = np.round((radius - 0.1) / 0.16 - angle / (2 * np.pi))
    curve = 0.1 + 0.16 * (turn + angle / (2 * np.pi))
    return _nearest(((np.abs(radius - curve) < 0.013) & (turn >= 0) & (curve < 0.9), 14.2 + 0.9 * curve))


def _lattice(y: _Image, x: _Image) -> _Image:
    """A fence of crossing slats, before a board."""
    first, second = (x + y) / np.sqrt(2), (x - y) / np.sqrt(2)
    slats = (np.abs(first - 0.25 * np.round(first / 0.25)) < 0.035) & (np.abs(x) < 0.9) & (np.abs(y) < 0.7)
    cross = (np.abs(second - 0.25 * np.round(second / 0.25)) < 0.02) & (np.abs(x) < 0.9) & (np.abs(y) < 0.7)
    board = (x > 0.1) & (x < 1.2) & (np.abs(y) < 0.5)
    return _nearest((slats, 14.5 + 0.1 * x), (cross, 14.53 + 0.1 * x), (board, 14.95 + 0.05 * y))


def _vase(y: _Image, x: _Image) -> _Image:
    """A body of revolution with two handles."""
    radius = 0.34 + 0.16 * np.sin(3.2 * y + 0.6) + 0.05 * np.cos(9 * y)
    body = (np.abs(x) < radius) & (np.abs(y) < 0.85)
    handle = np.abs(np.hypot(np.abs(x) - 0.52, y + 0.25) - 0.2) < 0.025
    return _nearest((body, 14.8 - np.sqrt(np.maximum(radius**2 - x**2, 0.0))), (handle, 14.8 + 0.0 * x))


def _nothing(y: _Image, x: _Image) -> _Image:
    """No shape at all."""
    return np.full(y.shape, np.nan)


SHAPES: dict[str, Callable[[_Image, _Image], _Image]] = {
    "stairs": _stairs,
    "rings": _rings,
    "stars": _stars,
    "letters": _letters,
    "spiral": _spiral,
    "lattice": _lattice,
    "vase": _vase,
    "nothing": _nothing,
}
"""Shapes by name."""
