"""Scores by scene type: wall, floor or open water, and where the backscatter comes from.

All pixels count: those that see a target by the error of their depth, apart near a rim and inside; those of open water
by whether a target was invented there. A pixel without an answer counts as one at the end of the gate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.baselines import CLASSICAL, MEDIAN_WINDOWS
from spadwarp.denoise.evaluation_scenes import (
    LEVELS,
    SETTINGS,
    SHAPES,
    WATERS,
    EvaluationScene,
    evaluation_scene,
    noisy_depth,
    water_profile,
)
from spadwarp.denoise.frames import DepthFrames, depth_frames
from spadwarp.denoise.inference import METHODS, Estimate, denoise_frames, estimate_frames, target_threshold
from spadwarp.denoise.metrics import staircase_steps
from spadwarp.denoise.network_files import own_weights
from spadwarp.values import ArgumentError

__all__ = ["FrameScores", "SceneScores", "evaluate_scenes", "score_frame"]

_RIM = 2  # pixels of the target this near open water or a jump belong to the rim
_JUMP = 0.02  # of depth between neighbours [gate widths]


@dataclass(frozen=True, kw_only=True)
class FrameScores:
    """Scores of one frame; NaN where a frame has no such pixels.

    Attributes:
        psnr: Over the pixels that see a target, of depth over the gate [dB].
        gain: What is gained over the input [dB].
        rmse_mm, rim_mm, inside_mm: Root mean square error of the target, near its rims, and elsewhere [mm].
        missed: Part of the target's pixels that are said to see none.
        invented: Part of the open water's pixels that are said to see a target.
        unanswered: Part of the target's pixels without a depth.
        steps, resolved: Steps of 10 cm, and how many are resolved to 3 cm.
    """

    psnr: float
    gain: float
    rmse_mm: float
    rim_mm: float
    inside_mm: float
    missed: float
    invented: float
    unanswered: float
    steps: int
    resolved: int


@dataclass(frozen=True, kw_only=True)
class SceneScores:
    """Scores of methods on frames of `spadwarp.denoise.evaluation_scenes`, or of scenes of one's own.

    Attributes:
        methods: In the order of the tables; "input" is the first.
        rows: Scores by (method, setting, water, level, shape).
        windows: Side of the best median by (setting, water, level) [pixels].
        reliability: By method and "target" or "confidence": pixels and those of which it was true, by tenths of the
            probability, `[10, 2]`; of methods that estimate probabilities.
    """

    methods: tuple[str, ...]
    rows: dict[tuple[str, str, str, float, str], FrameScores]
    windows: dict[tuple[str, str, float], int]
    reliability: dict[tuple[str, str], NDArray[np.int64]]

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

    def worse_than_input(self, method: str) -> int:
        """Number of frames whose PSNR is below the input's."""
        return sum(scores.gain < 0 for (name, *_), scores in self.rows.items() if name == method)

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names, for JSON."""
        keys = ("method", "setting", "water", "level", "shape")
        return {
            "scores": [{**dict(zip(keys, key, strict=True)), **vars(scores)} for key, scores in self.rows.items()],
            "median_windows": [
                {"setting": setting, "water": water, "level": level, "window": window}
                for (setting, water, level), window in self.windows.items()
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
    windows: Sequence[int] = MEDIAN_WINDOWS,
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
        windows: Sides of the median that are tried [pixels].
        seed: Of the noise.
        weights: File of `spadwarp train`, replacing the package's weights of the network that it names.
        device: torch device of the networks.
        progress: Called with ("frames", done, total).

    Raises:
        ArgumentError: An argument out of range; weights of a network that is not among the models.
        FileError: Weights that cannot be read.
        SpadwarpError: A package of the extra `denoise` is missing.
    """
    if unknown := [name for name in models if name not in METHODS or name in ("histograms", *CLASSICAL)]:
        raise ArgumentError(f"models: {unknown[0]!r} is not a method for depth frames")
    if scenes is None:
        scenes = [evaluation_scene(shape, setting) for setting in SETTINGS for shape in SHAPES]
    chosen, own = list(scenes), own_weights(models, weights)
    rows: dict[tuple[str, str, str, float, str], FrameScores] = {}
    best: dict[tuple[str, str, float], int] = {}
    reliability: dict[tuple[str, str], NDArray[np.int64]] = {}
    done, total = 0, len(chosen) * len(waters) * len(levels)
    for setting in dict.fromkeys(scene.setting for scene in chosen):
        alike = [scene for scene in chosen if scene.setting == setting]
        for water in waters:
            for level in levels:
                frames = [_frame(scene, water, level, seed + number) for number, scene in enumerate(alike)]
                window = best[setting, water, level] = _best_window(alike, frames, windows)
                for scene, noisy in zip(alike, frames, strict=True):
                    for method in ("input", *models):
                        found = estimate_frames(
                            noisy, model=method, window=window, weights=own.get(method), device=device
                        )
                        seen = found.target_probability[0] >= target_threshold(method)
                        scores = score_frame(scene, noisy, found.depth[0], seen)
                        rows[method, setting, water, level, scene.shape] = scores
                        _count_reliability(reliability, method, scene, found)
                    done += 1
                    if progress is not None:
                        progress("frames", done, total)
    return SceneScores(methods=("input", *models), rows=rows, windows=best, reliability=reliability)


def score_frame(
    scene: EvaluationScene, noisy: DepthFrames, found: NDArray[np.float32], seen: NDArray[np.bool_]
) -> FrameScores:
    """Scores of one frame.

    Args:
        scene: The true depth.
        noisy: The frame that was denoised.
        found: Depth `[H, W]` [m]; NaN where there is no answer.
        seen: Where a target is said to be seen, `[H, W]`.
    """
    start, stop = scene.gate
    target = np.isfinite(scene.clean)
    rim = _rim(scene) & target

    def error(depth: NDArray[Any], where: NDArray[np.bool_]) -> float:
        """Root mean square [m]; NaN counts as the gate's end."""
        if not where.any():
            return math.nan
        return float(np.sqrt(np.mean((np.nan_to_num(depth, nan=stop)[where].astype(float) - scene.clean[where]) ** 2)))

    after, before = error(found, target), error(noisy.depth[0], target)
    psnr = -20.0 * math.log10(max(after / (stop - start), 1e-5)) if target.any() else math.nan
    gain = psnr + 20.0 * math.log10(max(before / (stop - start), 1e-5)) if target.any() else math.nan
    steps = staircase_steps(scene.clean, found) if scene.shape == "stairs" else None
    return FrameScores(
        psnr=psnr,
        gain=gain,
        rmse_mm=1e3 * after,
        rim_mm=1e3 * error(found, rim),
        inside_mm=1e3 * error(found, target & ~rim),
        missed=float(1.0 - seen[target].mean()) if target.any() else math.nan,
        invented=float(seen[~target].mean()) if not target.all() else math.nan,
        unanswered=float(np.isnan(found[target]).mean()) if target.any() else math.nan,
        steps=0 if steps is None else steps.total,
        resolved=0 if steps is None else steps.resolved,
    )


def _frame(scene: EvaluationScene, water: str, level: float, seed: int) -> DepthFrames:
    noisy = noisy_depth(scene, water=water, level=level, seed=seed)
    return depth_frames(noisy, gate=scene.gate, profile=water_profile(water))


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


def _best_window(scenes: Sequence[EvaluationScene], frames: Sequence[DepthFrames], windows: Sequence[int]) -> int:
    """The median's window with the highest mean PSNR."""

    def quality(window: int) -> float:
        values = []
        for scene, noisy in zip(scenes, frames, strict=True):
            found, seen = denoise_frames(noisy, model="median", window=window)
            values.append(score_frame(scene, noisy, found[0], seen[0]).psnr)
        return float(np.nanmean(values))

    return windows[0] if len(windows) == 1 else max(windows, key=quality)


def _rim(scene: EvaluationScene) -> NDArray[np.bool_]:
    """Pixels within `_RIM` of open water or of a jump of depth."""
    from scipy.ndimage import binary_dilation

    filled = np.where(np.isfinite(scene.clean), scene.clean, np.float32(1e3))
    jump = np.zeros(filled.shape, bool)
    for values, rows in ((filled, jump), (filled.T, jump.T)):
        step = np.abs(np.diff(values, axis=0)) > _JUMP * (scene.gate[1] - scene.gate[0])
        rows[:-1] |= step
        rows[1:] |= step
    return binary_dilation(jump, iterations=_RIM - 1)
