"""One scene of a dataset: truth, the analytic maps, and the frames drawn from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic_model import dark_rate, pixel_maps
from spadwarp.config import SPEED_OF_LIGHT, Scene
from spadwarp.errors import ConfigError
from spadwarp.model import truth_maps
from spadwarp.result import pixel_directions, range_from_path

from .plan import Plan, SceneDraw

__all__ = ["PROFILE_BINS", "RenderedScene", "render_scene"]

PROFILE_BINS = 64
"""Bins of `backscatter_profile`."""

_MOST_PULSES = 2**40
_COARSE = 8  # every how many pixels the light that comes back is looked at, to find the exposure


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """A scene's maps and its frames, as they are stored.

    Attributes:
        draw: What it was made from, exposure included.
        depth, bound: Planar depth and its Cramér–Rao bound in one frame, float32 `[H, W]` [m]; NaN for none.
        normal: float16 `[H, W, 3]`. albedo: float16 `[H, W]`.
        profile, profile_edges: Density of the water's backscatter over depth on the axis [1/m], `[PROFILE_BINS]`, and
            the edges of its bins [m].
        signal, backscatter: Expected detections per pulse, median over the target's pixels.
        depth_codes, intensity_codes, label_bytes: Of the frames, uint16 and uint8 `[K, H, W]` and uint8
            `[K, H, ceil(W/8)]`.
        intensity_step: Recorded photons per unit of intensity.
    """

    draw: SceneDraw
    scene: Scene
    depth: NDArray[np.float32]
    normal: NDArray[np.float16]
    albedo: NDArray[np.float16]
    bound: NDArray[np.float32]
    profile: NDArray[np.float32]
    profile_edges: NDArray[np.float32]
    signal: float
    backscatter: float
    depth_codes: NDArray[np.uint16]
    intensity_codes: NDArray[np.uint8]
    label_bytes: NDArray[np.uint8]
    intensity_step: float


def render_scene(plan: Plan, draw: SceneDraw, *, device: str | None = None) -> RenderedScene:
    """Truth by rays, maps by the analytic model, frames by draws, all on `device`."""
    import warp as wp

    from spadwarp.hardware import pick_device
    from spadwarp_kernels.frames import FrameCoding, draw_frames

    on = pick_device(device)
    scene = draw.scene
    truth = truth_maps(scene, device=device)
    view = pixel_directions(scene.camera)

    def maps_of(scene: Scene, part: Any) -> Any:
        rows = (truth.range, truth.normal, truth.reflectance)
        distance, normal, reflectance = (np.ascontiguousarray(values[part]) for values in rows)
        return pixel_maps(
            scene,
            view=view[part].reshape(-1, 3),
            distance=distance.reshape(-1),
            normal=normal.reshape(-1, 3),
            reflectance=reflectance.reshape(-1),
            device=device,
        )

    if draw.signal_photons is not None:
        middle = slice(_COARSE // 2, None, _COARSE)
        scene = _exposed(scene, draw, maps_of(scene, (middle, middle))[0])
    maps, (paths, cumulative) = maps_of(scene, ...)
    seen = maps["fisher"] > 0
    shape = truth.depth.shape
    pixels = truth.depth.size
    speed = SPEED_OF_LIGHT / scene.medium.group_index
    z = view.reshape(-1, 3)[:, 2]
    # No bound is worse than a guess anywhere in the gate.
    guess = 0.5 * speed * (scene.gate.stop - scene.gate.start) / math.sqrt(12.0) * z
    bound = np.where(seen, np.minimum(maps["sigma_depth"], guess), np.nan)
    probability, flat, fractions = _stray(scene, draw, maps, seen)

    def put(values: NDArray[Any]) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.float32, device=on)

    pulses = scene.analytic.pulses
    mean = pulses * -np.expm1(-maps["alpha"])
    brightest = float(mean.max())
    coding: Any = FrameCoding()
    coding.laser = wp.vec3(*scene.laser.position)
    coding.nearest, coding.farthest = scene.gate.start * speed, scene.gate.stop * speed
    coding.width, coding.pixels = shape[1], pixels
    coding.seed = wp.uint64(plan.split_seeds[plan.split_of(draw.index)])
    coding.first_sample = wp.int64(draw.index * plan.frames_per_scene)
    coding.depth_offset, coding.depth_step = plan.depth_offset, plan.depth_step
    coding.pulses = float(pulses)
    coding.intensity_step = max(1.0, math.ceil((brightest + 6.0 * math.sqrt(brightest)) / 255.0))
    depth_codes, intensity_codes, labels = draw_frames(
        coding,
        wp.array(view.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=on),
        put(np.where(seen, truth.depth.reshape(-1), np.nan)),
        put(bound),
        put(maps["alpha"]),
        put(probability),
        put(flat),
        put(paths),
        put(cumulative),
        put(fractions),
    )
    profile, edges = _water_profile(scene, device)
    frames = len(draw.fractions)
    return RenderedScene(
        draw=draw,
        scene=scene,
        depth=truth.depth,
        normal=truth.normal.astype(np.float16),
        albedo=truth.reflectance.astype(np.float16),
        bound=bound.reshape(shape).astype(np.float32),
        profile=profile,
        profile_edges=edges,
        signal=float(np.median(maps["signal"][seen])) if seen.any() else 0.0,
        backscatter=float(np.median(maps["backscatter"])),
        depth_codes=depth_codes.numpy().reshape(frames, *shape),
        intensity_codes=intensity_codes.numpy().reshape(frames, *shape),
        label_bytes=labels.numpy().reshape(frames, shape[0], -1),
        intensity_step=coding.intensity_step,
    )


def _exposed(scene: Scene, draw: SceneDraw, maps: dict[str, NDArray[np.float64]]) -> Scene:
    """The scene with as many pulses as its median pixel needs for the signal photons that were drawn."""
    signal, seen = maps["signal"], maps["fisher"] > 0
    if not seen.any():
        raise ConfigError(f"scene {draw.index}: no return within the gate; {_what(draw)}")
    # Of the recorded photons α, a share of signal / α comes from the target.
    rate = np.median((signal / maps["alpha"] * -np.expm1(-maps["alpha"]))[seen])
    assert draw.signal_photons is not None
    pulses = min(max(1, round(draw.signal_photons / rate)), _MOST_PULSES)
    return scene.with_overrides({"analytic.pulses": pulses})


def _what(draw: SceneDraw) -> str:
    target = draw.scene.targets[0]
    return f"target {target.builtin or target.mesh} at {draw.distance:.4g} m"


def _stray(scene: Scene, draw: SceneDraw, maps: dict[str, NDArray[np.float64]], seen: NDArray[np.bool_]) -> Any:
    """Probability and flat share of background photons per pixel, and the factor of each frame."""
    backscatter = maps["backscatter"]
    if not math.isnan(draw.fractions[0]):
        # BS is the part of the pixels that report backscatter: also of those that look into open water.
        return np.where(backscatter > 0, 1.0, 0.0), np.zeros_like(backscatter), np.array(draw.fractions)
    dark = dark_rate(scene) * (scene.gate.stop - scene.gate.start)
    noise = backscatter + dark
    # Open water has nothing else to report; whether it reports at all is whether a photon was recorded.
    alone = -np.expm1(-scene.analytic.pulses * noise)
    probability = np.where(seen, np.nan_to_num(maps["outlier_probability"]), alone)
    flat = np.divide(dark, noise, out=np.ones_like(noise), where=noise > 0)
    return probability, flat, np.ones(len(draw.fractions))


def _water_profile(scene: Scene, device: str | None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Density over depth [1/m] of what the open water on the axis sends back within the gate, and its bins' edges."""
    axis = np.array([[0.0, 0.0, 1.0]])
    _, (paths, cumulative) = pixel_maps(
        scene,
        view=axis,
        distance=np.array([np.nan]),
        normal=axis,
        reflectance=np.array([0.0]),
        device=device,
    )
    speed = SPEED_OF_LIGHT / scene.medium.group_index
    ends = range_from_path(np.array([scene.gate.start, scene.gate.stop]) * speed, axis[0], scene.laser.position)
    edges = np.linspace(ends[0], ends[1], PROFILE_BINS + 1)
    depths = range_from_path(paths[0], axis[0], scene.laser.position)
    inside = np.interp(edges, depths, cumulative[0])
    return (np.diff(inside) / np.diff(edges)).astype(np.float32), edges.astype(np.float32)
