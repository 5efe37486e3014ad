"""One scene of a dataset by the analytic model: truth, maps, and the frames drawn from them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.model import pixel_maps, scene_optics
from spadwarp.dataset.rendered import RenderedScene, StoredFrames, backscatter_profile, intensity_step, with_exposure
from spadwarp.dataset.sampling import Plan, SceneDraw
from spadwarp.device import pick_device
from spadwarp.errors import kernel_errors
from spadwarp.result import Truth
from spadwarp.scene import Scene
from spadwarp.scene.geometry import gate_deviation, pixel_directions
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport import truth_maps

__all__ = ["render_analytic"]

_MOST_PULSES = 2**40
_COARSE = 8  # every eighth pixel of every eighth row decides the exposure


def render_analytic(plan: Plan, draw: SceneDraw, *, device: str | None) -> RenderedScene:
    """Truth, bound and frames of a drawn scene. Raises `ConfigError` for one without a return."""
    scene, target = draw.scene, plan.targets[draw.target]
    truth = truth_maps(scene, device=device) if target.export is None else target.truth(scene.camera)
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
        # Of the recorded photons, the share signal / alpha comes from the target.
        signal = coarse["signal"] / coarse["alpha"] * -np.expm1(-coarse["alpha"])
        scene = with_exposure(scene, draw, signal[coarse["fisher"] > 0], most=_MOST_PULSES)
    maps, table = maps_of(scene, ..., outliers=by_rates)
    seen = maps["fisher"] > 0
    # No bound is worse than a guess anywhere in the gate.
    guess = gate_deviation(scene, lines_of_sight(scene).direction.reshape(-1, 3))
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
        profile=backscatter_profile(scene, paths[0], cumulative[0]),
        signal=float(np.median(maps["signal"][seen])) if seen.any() else 0.0,
        backscatter=float(np.median(maps["backscatter"])),
        frames=_draw_frames(plan, draw, scene, truth, maps, table, bound, device=device),
    )


@kernel_errors()
def _draw_frames(
    plan: Plan,
    draw: SceneDraw,
    scene: Scene,
    truth: Truth,
    maps: dict[str, NDArray[np.float64]],
    table: tuple[NDArray[Any], NDArray[Any]],
    bound: NDArray[np.float64],
    *,
    device: str | None,
) -> StoredFrames:
    import warp as wp

    from spadwarp_kernels.analytic import FrameCoding, draw_frames

    on = pick_device(device)
    shape, view = truth.depth.shape, pixel_directions(scene.camera).reshape(-1, 3)
    probability, flat, fractions = _background(scene, draw, maps)
    speed, pulses = scene.medium.pulse_speed, scene.pulses_per_depth_frame

    def put(values: NDArray[Any], kind: Any = wp.float32) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=kind, device=on)

    coding: Any = FrameCoding()
    optics, ports = scene_optics(scene)
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
        *map(put, (bound, maps["alpha"], probability, flat, *table, fractions)),
        optics=optics,
        ports=ports,
    )
    count = len(draw.fractions)
    return StoredFrames(
        depth=depth.numpy().reshape(count, *shape),
        intensity=intensity.numpy().reshape(count, *shape),
        labels=labels.numpy().reshape(count, shape[0], -1),
        intensity_step=coding.intensity_step,
    )


def _background(
    scene: Scene, draw: SceneDraw, maps: dict[str, NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Per pixel the probability to report background and the share of it that is even over the gate; factors of the
    frames."""
    backscatter = maps["backscatter"]
    if not math.isnan(draw.fractions[0]):
        # The backscatter fraction counts all pixels, those that look into open water as well.
        return np.where(backscatter > 0, 1.0, 0.0), np.zeros_like(backscatter), np.array(draw.fractions)
    dark = (scene.detector.noise_rate + maps["daylight"]) * (scene.gate.stop - scene.gate.start)
    noise = backscatter + dark
    # Open water has nothing else to report; whether it reports at all is whether a photon was recorded.
    alone = -np.expm1(-scene.pulses_per_depth_frame * noise)
    probability = np.where(maps["fisher"] > 0, np.nan_to_num(maps["outlier_probability"]), alone)
    flat = np.divide(dark, noise, out=np.ones_like(noise), where=noise > 0)
    return probability, flat, np.ones(len(draw.fractions))
