"""One scene of a dataset by the analytic model: truth, maps, and the frames drawn from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.model import pixel_maps
from spadwarp.dataset.sampling import Plan, SceneDraw
from spadwarp.errors import ConfigError
from spadwarp.result.result import Truth
from spadwarp.scene import Scene
from spadwarp.scene.geometry import gate_deviation, pixel_directions, range_from_path
from spadwarp.transport.model import truth_maps
from spadwarp.units import path_from_time

__all__ = ["PROFILE_BINS", "Histograms", "RenderedScene", "StoredFrames", "intensity_step", "render_scene"]

PROFILE_BINS = 64
"""Bins of `backscatter_profile`."""

_MOST_PULSES = 2**40
_COARSE = 8  # every how many pixels the light that comes back is looked at, to find the exposure

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
    """

    expected: NDArray[np.float16]
    counts: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """A scene's maps and its frames.

    Attributes:
        draw: What it was made from.
        scene: With the exposure that was found.
        truth: What the camera would see through clear water.
        bound: Cramér–Rao bound of the depth in one frame, float32 `[H, W]` [m]; NaN for no estimate.
        profile: Density of the water's backscatter over depth on the axis [1/m], `[PROFILE_BINS]`, and the edges of its
            bins [m].
        signal, backscatter: Expected detections per pulse, median over the target's pixels and over all.
        frames: Of the scene.
        histograms: Where photons were traced.
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


def render_scene(plan: Plan, index: int, *, device: str | None = None, threads: int | None = None) -> RenderedScene:
    """Draws the scene `index` and renders it on a device. Raises `ConfigError` for one that shows nothing."""
    draw = plan.scene(index)
    if draw.photons is not None:
        from spadwarp.dataset.render_transport import render_traced

        return render_traced(plan, draw, device=device, threads=threads)
    return _render_analytic(plan, draw, device=device)


def intensity_step(brightest: float) -> float:
    """Photons per unit with which the brightest pixel, fluctuations included, fits into 8 bits; a whole number."""
    return max(1.0, math.ceil((brightest + 6.0 * math.sqrt(brightest)) / 255.0))


def water_profile(scene: Scene, paths: NDArray[Any], cumulative: NDArray[Any]) -> Profile:
    """Density over depth on the axis [1/m] from a distribution over path [m], and the edges of its bins [m]."""
    axis = np.array([0.0, 0.0, 1.0])
    gate = path_from_time(np.array([scene.gate.start, scene.gate.stop]), scene.medium.group_index)
    ends = range_from_path(gate, axis, scene.beam.position)
    edges = np.linspace(ends[0], ends[1], PROFILE_BINS + 1)
    below = np.interp(edges, range_from_path(paths, axis, scene.beam.position), cumulative)
    return (np.diff(below) / np.diff(edges)).astype(np.float32), edges.astype(np.float32)


def exposed(scene: Scene, draw: SceneDraw, detections: NDArray[np.float64], *, most: int = _MOST_PULSES) -> Scene:
    """The scene with the pulses after which the median of the pixels has the signal photons that were drawn.

    `detections`: of the return per pulse, in the pixels that see it.
    """
    assert draw.signal_photons is not None
    if not detections.size:
        where = f"its target lies at {draw.distance:.4g} m"
        raise ConfigError(f"scene {draw.index}: no return within the gate; {where}")
    pulses = min(max(1, round(draw.signal_photons / float(np.median(detections)))), most)
    return scene.with_overrides({"analytic.pulses_per_depth_frame": pulses})


def _render_analytic(plan: Plan, draw: SceneDraw, *, device: str | None) -> RenderedScene:
    scene = draw.scene
    origin = plan.targets[draw.target]
    if origin.export is None:
        truth = truth_maps(scene, device=device)
    else:
        truth = origin.truth(scene.camera, plan.recipe.targets.export_preset)
    view = pixel_directions(scene.camera)
    by_rates = math.isnan(draw.fractions[0])

    def maps_of(scene: Scene, part: Any, *, outliers: bool = False) -> Any:
        return pixel_maps(
            scene,
            view=view[part].reshape(-1, 3),
            distance=truth.range[part].reshape(-1),
            normal=truth.normal[part].reshape(-1, 3),
            reflectance=truth.reflectance[part].reshape(-1),
            device=device,
            outliers=outliers,
        )

    if draw.signal_photons is not None:
        middle = slice(_COARSE // 2, None, _COARSE)
        coarse = maps_of(scene, (middle, middle))[0]
        seen = coarse["fisher"] > 0
        # Of the recorded photons, the share signal / alpha comes from the target.
        signal = coarse["signal"] / coarse["alpha"] * -np.expm1(-coarse["alpha"])
        scene = exposed(scene, draw, signal[seen])
    maps, table = maps_of(scene, ..., outliers=by_rates)
    seen = maps["fisher"] > 0
    # No bound is worse than a guess anywhere in the gate.
    guess = gate_deviation(scene, view.reshape(-1, 3))
    bound = np.where(seen, np.minimum(maps["sigma_depth"], guess), np.nan)
    axis = np.array([[0.0, 0.0, 1.0]])
    paths, cumulative = pixel_maps(
        scene, view=axis, distance=[np.nan], normal=axis, reflectance=[0.0], device=device, outliers=False
    )[1]
    return RenderedScene(
        draw=draw,
        scene=scene,
        truth=truth,
        bound=bound.reshape(truth.depth.shape).astype(np.float32),
        profile=water_profile(scene, paths[0], cumulative[0]),
        signal=float(np.median(maps["signal"][seen])) if seen.any() else 0.0,
        backscatter=float(np.median(maps["backscatter"])),
        frames=_draw_frames(plan, draw, scene, truth, maps, table, bound, device=device),
    )


def _draw_frames(
    plan: Plan,
    draw: SceneDraw,
    scene: Scene,
    truth: Truth,
    maps: dict[str, NDArray[np.float64]],
    table: Profile,
    bound: NDArray[np.float64],
    *,
    device: str | None,
) -> StoredFrames:
    import warp as wp

    from spadwarp.device import pick_device
    from spadwarp_kernels.analytic import FrameCoding, draw_frames

    on = pick_device(device)
    shape, view = truth.depth.shape, pixel_directions(scene.camera).reshape(-1, 3)
    probability, flat, fractions = _stray(scene, draw, maps)
    speed, pulses = scene.medium.pulse_speed, scene.analytic.pulses_per_depth_frame

    def put(values: NDArray[Any], kind: Any = wp.float32) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=kind, device=on)

    coding: Any = FrameCoding()
    coding.laser = wp.vec3(*scene.beam.position)
    coding.nearest, coding.farthest = scene.gate.start * speed, scene.gate.stop * speed
    coding.width, coding.pixels = shape[1], truth.depth.size
    coding.seed = wp.uint64(plan.split_seeds[plan.split_of(draw.index)])
    coding.first_sample = wp.int64(draw.index * plan.frames_per_scene)
    coding.depth_offset, coding.depth_step = plan.depth_offset, plan.depth_step
    coding.pulses = float(pulses)
    coding.intensity_step = intensity_step(float((pulses * -np.expm1(-maps["alpha"])).max()))
    depth, intensity, labels = draw_frames(
        coding,
        put(view, wp.vec3),
        put(np.where(np.isnan(bound), np.nan, truth.depth.reshape(-1))),
        put(bound),
        put(maps["alpha"]),
        put(probability),
        put(flat),
        put(table[0]),
        put(table[1]),
        put(fractions),
    )
    count = len(draw.fractions)
    return StoredFrames(
        depth=depth.numpy().reshape(count, *shape),
        intensity=intensity.numpy().reshape(count, *shape),
        labels=labels.numpy().reshape(count, shape[0], -1),
        intensity_step=coding.intensity_step,
    )


def _stray(
    scene: Scene, draw: SceneDraw, maps: dict[str, NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Probability and flat share of background photons per pixel, and the factor of each frame."""
    backscatter = maps["backscatter"]
    if not math.isnan(draw.fractions[0]):
        # BS is the part of the pixels that report backscatter: also of those that look into open water.
        return np.where(backscatter > 0, 1.0, 0.0), np.zeros_like(backscatter), np.array(draw.fractions)
    dark = scene.detector.noise_rate * (scene.gate.stop - scene.gate.start)
    noise = backscatter + dark
    # Open water has nothing else to report; whether it reports at all is whether a photon was recorded.
    alone = -np.expm1(-scene.analytic.pulses_per_depth_frame * noise)
    probability = np.where(maps["fisher"] > 0, np.nan_to_num(maps["outlier_probability"]), alone)
    flat = np.divide(dark, noise, out=np.ones_like(noise), where=noise > 0)
    return probability, flat, np.ones(len(draw.fractions))
