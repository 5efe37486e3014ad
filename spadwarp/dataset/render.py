"""One scene of a dataset rendered by the analytic model or by photon transport: its maps, and its frames as they are
stored."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.model import pixel_maps, scene_optics
from spadwarp.arrays import Floats
from spadwarp.dataset.plan import Plan, SceneDraw
from spadwarp.device import pick_device
from spadwarp.frames import Frames, detect
from spadwarp.frames.cramer_rao import bound_of_result
from spadwarp.result import Result, Truth, analyser_channel, degree_of_polarisation
from spadwarp.scene import Scene
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.sight import depth_from_time, depth_per_time, gate_deviation, lines_of_sight
from spadwarp.transport import RunOptions, reconstruct, simulate, tracing_time, truth_maps
from spadwarp.values import ConfigError, SpadwarpWarning, path_from_time

PROFILE_BINS = 64
"""Bins of `backscatter_profile`."""

_MOST_PULSES = 2**40
_MOST_COUNTED_PULSES = 2**31 - 1  # the camera counts in 32 bits
_PILOT_PHOTONS = 1 << 18
_COARSE = 8  # every eighth pixel of every eighth row decides the exposure


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderedScene:
    """A scene's maps and its frames."""

    draw: SceneDraw  # what was drawn for it
    scene: Scene  # the scene with its final number of pulses
    truth: Truth  # what the camera would see through clear water
    bound: NDArray[np.float32]  # Cramér–Rao bound of the depth in one frame, float32 `[H, W]` [m]; NaN for no estimate
    density: NDArray[np.float32]  # of the water's backscatter over depth on the axis [1/m], `[PROFILE_BINS]`
    edges: NDArray[np.float32]  # of its bins [m]
    photons: int = 0  # that were traced; 0: analytic
    noise_ratio: float = math.nan  # `Result.target_noise_ratio` of one frame; NaN: analytic, or not known
    signal: float  # expected detections of the return per pulse, median over the target's pixels
    backscatter: float  # expected detections of backscatter per pulse, median over all pixels
    depth: NDArray[np.uint16]  # of the frames as they are stored: codes `[K, H, W]`
    label: NDArray[np.uint8]  # packed bits, uint8 `[K, H, ceil(W/8)]`
    intensity: NDArray[np.uint8]  # codes `[K, H, W]`
    intensity_step: float  # recorded photons per unit of intensity
    counts: NDArray[np.int32] | None = None  # of a traced scene, int32 `[K, H, W, T]`
    expected: NDArray[np.float16] | None = None  # likewise, counts of a frame before pile-up, `[H, W, T]`
    polarisation: NDArray[np.float16] | None = None  # its degree in each bin `[H, W, T]`; None: it is not recorded


def intensity_step(brightest: float) -> float:
    """Photons per unit with which the brightest pixel, fluctuations included, fits into 8 bits; a whole number."""
    return max(1.0, math.ceil((brightest + 6.0 * math.sqrt(brightest)) / 255.0))


def _profile(scene: Scene, paths: NDArray[Any], cumulative: NDArray[Any]) -> dict[str, Any]:
    """Density over depth on the axis [1/m] from a distribution over path [m], and the edges of its bins [m]."""
    axis = lines_of_sight(scene, np.array([0.0, 0.0, 1.0]))
    gate = path_from_time(np.array([scene.gate.start, scene.gate.stop]), scene.medium.group_index)
    start, stop = axis.depth_from_range(axis.range_from_path(gate))
    edges = np.linspace(start, stop, PROFILE_BINS + 1)
    below = np.interp(edges, axis.depth_from_range(axis.range_from_path(paths)), cumulative)
    return {"density": (np.diff(below) / np.diff(edges)).astype(np.float32), "edges": edges.astype(np.float32)}


def with_exposure(scene: Scene, draw: SceneDraw, detections: Floats, *, most: int) -> Scene:
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


def render_analytic(plan: Plan, draw: SceneDraw, *, device: str | None) -> RenderedScene:
    """Truth, bound and frames of a drawn scene. Raises `ConfigError` for one without a return."""
    scene = draw.scene
    truth = truth_maps(scene, device=device) if draw.source.export is None else draw.source.truth(scene.camera)
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
        for part in ((middle, middle), ...):  # thin things lie between the coarse pixels
            coarse = maps_of(scene, part)[0]
            if (coarse["fisher"] > 0).any():
                break
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
        signal=float(np.median(maps["signal"][seen])) if seen.any() else 0.0,
        backscatter=float(np.median(maps["backscatter"])),
        **_profile(scene, paths[0], cumulative[0]),
        **_draw_frames(plan, draw, scene, truth, maps, table, bound, device=device),
    )


def _draw_frames(
    plan: Plan,
    draw: SceneDraw,
    scene: Scene,
    truth: Truth,
    maps: dict[str, Floats],
    table: tuple[Any, Any],
    bound: Floats,
    *,
    device: str | None,
) -> dict[str, Any]:
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
    coding.seed = wp.uint64(draw.split_seed)
    coding.first_sample = wp.int64(int(draw.samples[0]))
    coding.depth_offset, coding.depth_step = plan.depth_offset, plan.depth_step
    coding.pulses = float(pulses)
    coding.intensity_step = intensity_step(float((pulses * -np.expm1(-maps["alpha"])).max()))
    coding.counted = int(math.isnan(draw.fractions[0]))
    depth, intensity, labels = draw_frames(
        coding,
        put(view, wp.vec3),
        put(np.where(np.isnan(bound), np.nan, truth.depth.reshape(-1))),
        *map(put, (bound, maps["alpha"], probability, flat, *table, fractions)),
        optics=optics,
        ports=ports,
    )
    count = len(draw.fractions)
    images = {"depth": depth, "label": labels, "intensity": intensity}
    frames = {name: image.numpy().reshape(count, shape[0], -1) for name, image in images.items()}
    return {**frames, "intensity_step": coding.intensity_step}


def _background(scene: Scene, draw: SceneDraw, maps: dict[str, Floats]) -> tuple[Floats, Floats, Floats]:
    """Per pixel the probability to report background and the share of it that is even over the gate; factors of the
    frames."""
    backscatter = maps["backscatter"]
    if not math.isnan(draw.fractions[0]):
        # The backscatter fraction counts all pixels, those that look into open water as well.
        return np.where(backscatter > 0, 1.0, 0.0), np.zeros_like(backscatter), np.array(draw.fractions)
    dark = (scene.detector.noise_rate + maps["daylight"]) * (scene.gate.stop - scene.gate.start)
    noise = backscatter + dark
    # Open water has nothing else to report; whether it reports at all is whether a photon was recorded.
    probability = np.where(maps["fisher"] > 0, np.nan_to_num(maps["outlier_probability"]), 1.0)
    flat = np.divide(dark, noise, out=np.ones_like(noise), where=noise > 0)
    return probability, flat, np.ones(len(draw.fractions))


def render_transport(plan: Plan, draw: SceneDraw, *, device: str | None, threads: int | None) -> RenderedScene:
    """Traces the scene's photons, exposes the camera for each frame and finds its depth."""
    assert draw.photons is not None
    scene, chosen = draw.scene, plan.recipe.monte_carlo
    automatic = draw.photons == "auto" and chosen.channel == "I" and scene.has_straight_sight
    rebuilt = automatic if chosen.reconstruct is None else chosen.reconstruct
    options: dict[str, Any] = {"seed": draw.seed, "device": device, "run": RunOptions(threads=threads)}
    if draw.photons == "auto":
        # The pulses of the frame, beside whose noise that of the simulation shall be small, follow from the light.
        pilot = simulate(scene, photons=_PILOT_PHOTONS, **options)
        if (found := _returned(pilot)).any():
            scene = with_exposure(scene, draw, found[found > 0], most=_MOST_COUNTED_PULSES)
        options["time"] = tracing_time(scene, chosen.time, device) if rebuilt else chosen.time
    result = simulate(scene, photons=draw.photons, **options)
    photons = result.photons
    if result.partial:
        raise KeyboardInterrupt
    polarisation = degree_of_polarisation(result).astype(np.float16) if result.scene.camera.channels else None
    result = analyser_channel(result, chosen.channel)
    if rebuilt and result.batches > 1:
        result = reconstruct(result, device=device)
    scale = scene.detectable_photons_per_pulse
    water = result.expected("backscatter")
    returned = _returned(result)
    seen = returned > 0
    scene = with_exposure(scene, draw, returned[seen], most=_MOST_COUNTED_PULSES)
    pulses = min(scene.pulses_per_depth_frame, _MOST_COUNTED_PULSES)
    with warnings.catch_warnings(action="ignore", category=SpadwarpWarning):  # of noise, whose ratio is stored
        frames = detect(result, pulses=pulses, frames=len(draw.fractions), seed=draw.seed, device=device)
    time_bound = bound_of_result(result, pulses=pulses, device=device).sigma
    per_time = depth_per_time(scene, np.nan_to_num(result.truth.range.astype(np.float64)))
    profile = np.concatenate([[0.0], np.cumsum(water.sum(axis=(0, 1)))])
    exposed = result.scene.with_overrides({"analytic.pulses_per_depth_frame": pulses})
    return RenderedScene(
        draw=draw,
        scene=scene,
        photons=photons,
        noise_ratio=replace(result, scene=exposed).target_noise_ratio if result.batches > 1 else math.nan,
        truth=result.truth,
        bound=np.where(seen & np.isfinite(time_bound), time_bound * per_time, np.nan).astype(np.float32),
        signal=float(np.median(returned[seen])) if seen.any() else 0.0,
        backscatter=float(np.median(water.sum(axis=-1))) * scale,
        **_profile(scene, result.path_edges, profile / max(profile[-1], 1e-300)),
        **_stored(plan, scene, frames, device=device),
        expected=np.minimum(frames.expected * np.float32(pulses), 65504.0).astype(np.float16),
        polarisation=polarisation,
    )


def _returned(result: Result) -> Floats:
    """Expected detections per pulse of the light of targets, in the pixels that hold one; 0 in the others."""
    light = result.tallies[:2].sum(axis=(0, 3)) * result.tally_value
    scale = result.scene.detectable_photons_per_pulse
    return np.where(np.isfinite(result.truth.depth), light * scale, 0.0)


def _stored(plan: Plan, scene: Scene, frames: Frames, *, device: str | None) -> dict[str, Any]:
    """Codes of the depth and the intensity of the counts; labels of the pixels that most likely report background."""
    time = frames.arrival_time(plan.recipe.monte_carlo.depth_method, device=device)
    start, stop = frames.gate_start, frames.gate_start + frames.expected.shape[-1] * frames.bin_width
    depth = depth_from_time(np.clip(time, start, stop), scene=scene)
    code = np.rint((depth - plan.depth_offset) / plan.depth_step)
    codes = np.where(np.isnan(depth), 0, np.clip(code, 1, 65535)).astype(np.uint16)
    counts = frames.counts.sum(axis=-1, dtype=np.int64)
    step = intensity_step(float((frames.expected.sum(axis=-1) * frames.pulses).max()))
    return {
        "depth": codes,
        "intensity": np.minimum(np.rint(counts / step), 255).astype(np.uint8),
        "label": np.packbits(_reports_background(frames, time), axis=-1),
        "intensity_step": step,
        "counts": frames.counts,
    }


def _reports_background(frames: Frames, time: Floats) -> NDArray[np.bool_]:
    """Whether background is more likely than the target at the time that a pixel reports, `[K, H, W]`."""
    bins = frames.expected.shape[-1]
    at = np.nan_to_num((time - frames.gate_start) / frames.bin_width).astype(np.int64).clip(0, bins - 1)
    expected = np.take_along_axis(frames.expected[None], at[..., None], axis=-1)[..., 0]
    known = np.broadcast_to(frames.background, frames.expected.shape)
    background = np.take_along_axis(known[None], at[..., None], axis=-1)[..., 0]
    return (background > 0.5 * expected) & ~np.isnan(time)
