"""RMSE of histogram estimates against the best tuned classical estimate of the same data, point by point.

A point is a number of signal photons per pixel, a signal-to-background ratio (SBR), a flat or decaying background, and
one or two returns in a pixel. The scenes are those of `spadwarp.denoise.evaluation_scenes`, which no training saw.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.baselines import MEDIAN_WINDOWS, TUNINGS, classical_depth
from spadwarp.denoise.evaluation_scenes import GATE, EvaluationScene, evaluation_scene
from spadwarp.denoise.frames import depth_frames
from spadwarp.denoise.histogram_inputs import features_of_histograms
from spadwarp.denoise.inference import denoise_frames

__all__ = ["HistogramScores", "Point", "draw_counts", "evaluate_histograms"]

_BINS = 256
_WIDTH = 1.0  # deviation of the response [bins]


class Point(NamedTuple):
    """Signal photons per pixel, SBR, "flat" or "decaying" background, and the number of returns in a pixel."""

    photons: float
    sbr: float
    background: str
    returns: int


@dataclass(frozen=True, kw_only=True)
class HistogramScores:
    """RMSE [m] over the pixels that see a target, mean over scenes, by point and method.

    `best` is the classical estimate, tuned, with the smallest RMSE of each point.
    """

    rmse: dict[Point, dict[str, float]]

    def best(self, point: Point) -> tuple[str, float]:
        """Name and RMSE [m] of the best classical estimate."""
        classical = {name: value for name, value in self.rmse[point].items() if name != "histograms"}
        return min(classical.items(), key=lambda item: item[1])

    def ratios(self) -> NDArray[np.float64]:
        """RMSE of the network over that of the best classical estimate, of each point."""
        return np.array([values["histograms"] / self.best(point)[1] for point, values in self.rmse.items()])

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names, for JSON."""
        return {"points": [{**point._asdict(), "rmse_m": values} for point, values in self.rmse.items()]}


def evaluate_histograms(
    *,
    photons: Sequence[float] = (1, 3, 10, 30, 100),
    sbr: Sequence[float] = (0.05, 0.3, 1.0, 5.0),
    backgrounds: Sequence[str] = ("flat", "decaying"),
    returns: Sequence[int] = (1, 2),
    scenes: Sequence[EvaluationScene] | None = None,
    seed: int = 0,
    weights: str | Path | None = None,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> HistogramScores:
    """Scores the network for histograms and all classical estimates at every point.

    Args:
        photons, sbr, backgrounds, returns: See `Point`.
        scenes: Default: stairs, rings and vase before a wall, 64 × 64 pixels.
        seed: Of the counts.
        weights: File of `spadwarp train` with weights of the network for histograms.
        device: torch device.
        progress: Called with ("points", done, total).

    Raises:
        FileError: Weights that cannot be read.
        SpadwarpError: A package of the extra `denoise` is missing.
    """
    if scenes is None:
        scenes = [evaluation_scene(shape, "wall", size=(64, 64)) for shape in ("stairs", "rings", "vase")]
    points = [Point(*values) for values in product(photons, sbr, backgrounds, returns)]
    rmse: dict[Point, dict[str, float]] = {}
    for done, point in enumerate(points):
        squares: dict[tuple[str, float], list[float]] = {}
        for number, scene in enumerate(scenes):
            for key, depth in _estimates(scene, point, seed + number, weights, device).items():
                seen = np.isfinite(scene.clean)
                squares.setdefault(key, []).append(float(np.mean((depth - scene.clean)[seen] ** 2)))
        means = {key: float(np.sqrt(np.mean(values))) for key, values in squares.items()}
        rmse[point] = {name: min(v for (n, _), v in means.items() if n == name) for name, _ in means}
        if progress is not None:
            progress("points", done + 1, len(points))
    return HistogramScores(rmse=rmse)


def draw_counts(
    scene: EvaluationScene, point: Point, *, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Counts `[H, W, T]`, expected background per bin `[T]`, and the response per bin.

    Of two returns the weaker one has 35 % of the light, 25 cm before the scene, in half of the columns.
    """
    start, stop = scene.gate
    generator = np.random.Generator(np.random.Philox(seed))
    seen = np.isfinite(scene.clean)
    place = (np.where(seen, scene.clean, start) - start) / (stop - start)
    rows, columns = place.shape
    shade = 1.0 + 0.5 * np.sin(np.arange(columns) / 5.0) * np.sin(np.arange(rows) / 7.0)[:, None]
    signal = point.photons * shade * seen
    edges = np.arange(_BINS + 1)

    def spread(depth: NDArray[Any]) -> NDArray[Any]:
        from scipy.special import ndtr

        return np.diff(ndtr((edges - (depth * _BINS)[..., None]) / _WIDTH), axis=-1)

    rate = spread(place) * signal[..., None]
    if point.returns == 2:
        veil = 0.35 * (np.arange(columns) % 32 < 16)[None, :, None]
        rate = (1.0 - veil) * rate + veil * spread(place - 0.1) * signal[..., None]
    centres = (np.arange(_BINS) + 0.5) / _BINS
    profile = np.exp(-4.0 * centres) if point.background == "decaying" else np.ones(_BINS)
    background = point.photons / point.sbr * profile / profile.sum() + 1e-6
    apart = np.arange(-5, 6)
    response = np.exp(-0.5 * (apart / _WIDTH) ** 2)
    return generator.poisson(rate + background), background, response / response.sum()


def _estimates(
    scene: EvaluationScene, point: Point, seed: int, weights: str | Path | None, device: str | None
) -> dict[tuple[str, float], NDArray[np.float32]]:
    """Depth [m] by method and tuning."""
    counts, background, response = draw_counts(scene, point, seed=seed)
    start, stop = scene.gate
    found: dict[tuple[str, float], NDArray[np.float32]] = {}

    def metres(part: NDArray[Any]) -> NDArray[np.float32]:
        return (start + (stop - start) * part).astype(np.float32)

    for method, tunings in TUNINGS.items():
        for tuning in tunings:
            part = classical_depth(
                counts, background=background, response=response, method=method, tuning=tuning, device=device  # type: ignore[arg-type]
            )  # fmt: skip
            found[method, tuning] = metres(part[0])
    features = features_of_histograms(counts, background=background, response=response, device=device, to_depth=metres)
    frames = depth_frames(found["likelihood", 1], gate=GATE, profile=background, features=features)
    for window in MEDIAN_WINDOWS:
        found["median", window] = denoise_frames(frames, model="median", window=window)[0][0]
    found["histograms", 0] = denoise_frames(frames, model="histograms", weights=weights, device=device)[0][0]
    return found
