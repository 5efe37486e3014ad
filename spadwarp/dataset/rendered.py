"""A rendered scene of a dataset and its frames, and what both ways to render it share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.sampling import SceneDraw
from spadwarp.errors import ConfigError
from spadwarp.result import Truth
from spadwarp.scene import Scene
from spadwarp.scene.sight import lines_of_sight
from spadwarp.units import path_from_time

__all__ = ["PROFILE_BINS", "Histograms", "RenderedScene", "StoredFrames", "backscatter_profile", "intensity_step"]
__all__ += ["with_exposure"]

PROFILE_BINS = 64
"""Bins of `backscatter_profile`."""

Profile = tuple[NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class StoredFrames:
    """Frames as they are stored.

    Attributes:
        depth, intensity: Codes, uint16 and uint8 `[K, H, W]`.
        labels: uint8 `[K, H, ceil(W/8)]`.
        intensity_step: Recorded photons per unit of intensity.
    """

    depth: NDArray[np.uint16]
    intensity: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    intensity_step: float


@dataclass(frozen=True, eq=False)
class Histograms:
    """Histograms of a scene that was traced.

    Attributes:
        expected: Expected counts of a frame before pile-up, float16 `[H, W, T]`.
        counts: Of the frames, int32 `[K, H, W, T]`.
        polarisation: Degree of polarisation of each bin, float16 `[H, W, T]`; None: the camera does not record it.
    """

    expected: NDArray[np.float16]
    counts: NDArray[np.int32]
    polarisation: NDArray[np.float16] | None = None


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """A scene's maps and its frames.

    Attributes:
        draw: What was drawn for it.
        scene: The scene with its final number of pulses.
        truth: What the camera would see through clear water.
        bound: Cramér–Rao bound of the depth in one frame, float32 `[H, W]` [m]; NaN for no estimate.
        profile: Density of the water's backscatter over depth on the axis [1/m], `[PROFILE_BINS]`, and the edges of its
            bins [m].
        signal, backscatter: Expected detections per pulse, median over the target's pixels and over all.
        frames: Codes of depth and intensity, labels.
        histograms: Of a scene that was traced photon by photon, else None.
    """

    draw: SceneDraw
    scene: Scene
    truth: Truth
    bound: NDArray[np.float32]
    profile: Profile
    signal: float
    backscatter: float
    frames: StoredFrames
    histograms: Histograms | None = None


def intensity_step(brightest: float) -> float:
    """Photons per unit with which the brightest pixel, fluctuations included, fits into 8 bits; a whole number."""
    return max(1.0, math.ceil((brightest + 6.0 * math.sqrt(brightest)) / 255.0))


def backscatter_profile(scene: Scene, paths: NDArray[Any], cumulative: NDArray[Any]) -> Profile:
    """Density over depth on the axis [1/m] from a distribution over path [m], and the edges of its bins [m]."""
    axis = lines_of_sight(scene, np.array([0.0, 0.0, 1.0]))
    gate = path_from_time(np.array([scene.gate.start, scene.gate.stop]), scene.medium.group_index)
    ends = axis.depth_from_range(axis.range_from_path(gate))
    edges = np.linspace(ends[0], ends[1], PROFILE_BINS + 1)
    below = np.interp(edges, axis.depth_from_range(axis.range_from_path(paths)), cumulative)
    return (np.diff(below) / np.diff(edges)).astype(np.float32), edges.astype(np.float32)


def with_exposure(scene: Scene, draw: SceneDraw, detections: NDArray[np.float64], *, most: int) -> Scene:
    """The scene with as many pulses, at most `most`, as give the median pixel the signal photons that were drawn.

    `detections`: of the return per pulse, in the pixels that see it. None drawn: the scene as it is. Raises
    `ConfigError` where nothing returns.
    """
    if draw.signal_photons is None:
        return scene
    if not detections.size:
        raise ConfigError(
            f"scene {draw.index}: no return within the gate; the target's distance is {draw.distance:.4g} m"
        )
    pulses = min(max(1, round(draw.signal_photons / float(np.median(detections)))), most)
    return scene.with_overrides({"analytic.pulses_per_depth_frame": pulses})
