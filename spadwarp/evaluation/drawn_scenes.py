"""Scores by scene type: wall, floor or open water, and where the backscatter comes from.

The shapes are unlike those of the training (`spadwarp.denoise.synthetic_noise`): stairs, rings, stars, letters, a
spiral, a lattice, a vase. They are drawn from formulas with NumPy; the noise, which no training uses, is that of the
paper (Sensors 24, 3886, 2024): a part of the pixels, the backscatter fraction, reports backscatter instead of the
target. All pixels count: those that see a target by the error of their depth, apart near a rim and inside; those of
open water by whether a target was invented there. A pixel without an answer counts as one at the end of the gate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.baselines import MEDIAN_WINDOWS, compared
from spadwarp.denoise.frames import DepthFrames, depth_frames
from spadwarp.denoise.inference import Estimate, estimate_frames, target_threshold
from spadwarp.denoise.recipe import LEVELS
from spadwarp.evaluation.datasets import Steps, near_jumps, staircase_steps
from spadwarp.values import ArgumentError

__all__ = ["SceneScores", "evaluate_scenes"]


GATE = (13.5, 16.0)
"""Gate of the scenes, in depth [m]."""

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

    `level`: part of the pixels that report backscatter, whether they see a target or not; `jitter`: deviation of a
    reported depth of the target [m].
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


SHAPES: dict[str, Callable[[_Image, _Image], _Image]] = {
    "stairs": _stairs,
    "rings": _rings,
    "stars": _stars,
    "letters": _letters,
    "spiral": _spiral,
    "lattice": _lattice,
    "vase": _vase,
    "nothing": lambda y, x: np.full(y.shape, np.nan),
}
"""Shapes by name."""


# Scores.

_JUMP = 0.02  # of depth between neighbours, near which pixels belong to the rim [gate widths]


@dataclass(frozen=True, kw_only=True)
class FrameScores:
    """Scores of one frame; NaN where a frame has no such pixels."""

    psnr: float  # over the pixels that see a target, of depth over the gate [dB]
    gain: float  # over the input [dB]
    rmse_mm: float  # root mean square error of the target [mm]
    rim_mm: float  # the same near its rims
    inside_mm: float  # and elsewhere
    missed: float  # part of the target's pixels that are said to see none
    invented: float  # part of the open water's pixels that are said to see a target
    unanswered: float  # part of the target's pixels without a depth
    steps: int  # of 10 cm
    resolved: int  # of these, to 3 cm


@dataclass(frozen=True, kw_only=True)
class SceneScores:
    """Scores of methods on frames of `spadwarp.evaluation.drawn_scenes`, or of scenes of one's own."""

    methods: tuple[str, ...]  # in the order of the tables; "input" is the first
    rows: dict[tuple[str, str, str, float, str], FrameScores]  # scores by (method, setting, water, level, shape)
    windows: dict[tuple[str, str, float], int]  # side of the best median by (setting, water, level) [pixels]
    reliability: dict[tuple[str, str], NDArray[np.int64]]
    """By method and "target" or "confidence": pixels and those of which it was true, by tenths of the probability,
    `[10, 2]`; of methods that estimate probabilities."""

    def mean(self, field: str, method: str, **where: Any) -> float:
        """Mean of a field of `FrameScores` over the frames of a method.

        `where`: `setting`, `water`, `level` or `shape`; NaN is left out.
        """
        names = ("setting", "water", "level", "shape")
        values = [
            getattr(scores, field)
            for (name, *key), scores in self.rows.items()
            if name == method and all(key[names.index(item)] == value for item, value in where.items())
        ]
        finite = [value for value in values if math.isfinite(value)]
        return float(np.mean(finite)) if finite else math.nan

    def types(self) -> list[tuple[str, str]]:
        """The scene types: pairs of setting and water."""
        return list(dict.fromkeys((setting, water) for _, setting, water, _, _ in self.rows))

    def levels(self) -> list[float]:
        """The backscatter fractions."""
        return sorted({level for _, _, _, level, _ in self.rows})

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names, for JSON."""
        keys = ("method", "setting", "water", "level", "shape")
        return {
            "scores": [{**dict(zip(keys, key, strict=True)), **vars(scores)} for key, scores in self.rows.items()],
            "median_windows": [
                {**dict(zip(keys[1:4], key, strict=True)), "window": window} for key, window in self.windows.items()
            ],
            "reliability": [
                {"method": method, "of": kind, "pixels": table[:, 0].tolist(), "true": table[:, 1].tolist()}
                for (method, kind), table in self.reliability.items()
            ],
        }


def evaluate_scenes(
    *,
    models: Sequence[str] = ("median", "dncnn", "pyramid"),
    scenes: Iterable[EvaluationScene] | None = None,
    waters: Sequence[str] = WATERS,
    levels: Sequence[float] = LEVELS,
    seed: int = 0,
    weights: str | Path | None = None,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> SceneScores:
    """Scores denoisers on scenes that no training saw, by scene type.

    Args:
        models: From `spadwarp.denoise.METHODS`; the median has its best window for each scene type and level.
        scenes: Default: every shape of `evaluation_scenes.SHAPES` in every setting.
        waters: From `evaluation_scenes.WATERS`.
        levels: Backscatter fractions.
        seed: Of the noise.
        weights, device, progress: See `evaluate`, as for errors.
    """
    if scenes is None:
        scenes = [evaluation_scene(shape, setting) for setting in SETTINGS for shape in SHAPES]
    chosen, methods = list(scenes), compared(models, weights)
    rows: dict[tuple[str, str, str, float, str], FrameScores] = {}
    best: dict[tuple[str, str, float], int] = {}
    reliability: dict[tuple[str, str], NDArray[np.int64]] = {}
    done, total = 0, len(chosen) * len(waters) * len(levels)
    settings = dict.fromkeys(scene.setting for scene in chosen)
    for setting, water, level in product(settings, waters, levels):
        alike, profile = [scene for scene in chosen if scene.setting == setting], water_profile(water)
        drawn = [noisy_depth(scene, water=water, level=level, seed=seed + n) for n, scene in enumerate(alike)]
        frames = [depth_frames(one, gate=scene.gate, profile=profile) for one, scene in zip(drawn, alike, strict=True)]
        window = best[setting, water, level] = _best_window(alike, frames)
        for scene, noisy in zip(alike, frames, strict=True):
            for method, named in methods.items():
                found = estimate_frames(noisy, window=window, device=device, **named)
                least = target_threshold(named["model"])
                rows[method, setting, water, level, scene.shape] = score_frame(scene, noisy, found, least)
                _count_reliability(reliability, method, scene, found)
            done += 1
            if progress is not None:
                progress("frames", done, total)
    return SceneScores(methods=tuple(methods), rows=rows, windows=best, reliability=reliability)


def score_frame(scene: EvaluationScene, noisy: DepthFrames, estimated: Estimate, threshold: float = 0.5) -> FrameScores:
    """Scores of the first frame; `threshold`: probability from which on a pixel is said to see a target."""
    found, seen = estimated.depth[0], estimated.target_probability[0] >= threshold
    start, stop = scene.gate
    target = np.isfinite(scene.clean)
    rim = near_jumps(scene.clean, target, _JUMP * (stop - start))

    def error(depth: NDArray[Any], where: NDArray[np.bool_]) -> float:
        """Root mean square [m]; NaN counts as the gate's end."""
        if not where.any():
            return math.nan
        return float(np.sqrt(np.mean((np.nan_to_num(depth, nan=stop)[where].astype(float) - scene.clean[where]) ** 2)))

    after, before = error(found, target), error(noisy.depth[0], target)
    psnr = -20.0 * math.log10(max(after / (stop - start), 1e-5)) if target.any() else math.nan
    gain = psnr + 20.0 * math.log10(max(before / (stop - start), 1e-5)) if target.any() else math.nan
    steps = staircase_steps(scene.clean, found) if scene.shape == "stairs" else Steps()
    return FrameScores(
        psnr=psnr,
        gain=gain,
        rmse_mm=1e3 * after,
        rim_mm=1e3 * error(found, rim),
        inside_mm=1e3 * error(found, target & ~rim),
        missed=float(1.0 - seen[target].mean()) if target.any() else math.nan,
        invented=float(seen[~target].mean()) if not target.all() else math.nan,
        unanswered=float(np.isnan(found[target]).mean()) if target.any() else math.nan,
        steps=steps.total,
        resolved=steps.resolved,
    )


def _count_reliability(
    reliability: dict[tuple[str, str], NDArray[np.int64]], method: str, scene: EvaluationScene, found: Estimate
) -> None:
    """Adds a frame to the tables of `SceneScores.reliability`."""
    confidence, target = found.confidence[0], np.isfinite(scene.clean)
    if np.isnan(confidence).any():
        return
    right = np.abs(found.depth[0] - scene.clean) < 0.01 * (scene.gate[1] - scene.gate[0])
    kinds = ("target", found.target_probability[0], target), ("confidence", confidence[target], right[target])
    for kind, probability, true in kinds:
        tenth = np.clip((10 * probability).astype(int), 0, 9).ravel()
        table = reliability.setdefault((method, kind), np.zeros((10, 2), np.int64))
        table[:, 0] += np.bincount(tenth, minlength=10)
        table[:, 1] += np.bincount(tenth[true.ravel()], minlength=10)


def _best_window(scenes: Sequence[EvaluationScene], frames: Sequence[DepthFrames]) -> int:
    """The median's window with the highest mean PSNR."""

    def quality(window: int) -> float:
        values = []
        for scene, noisy in zip(scenes, frames, strict=True):
            values.append(score_frame(scene, noisy, estimate_frames(noisy, model="median", window=window)).psnr)
        return float(np.nanmean(values))

    return max(MEDIAN_WINDOWS, key=quality)
