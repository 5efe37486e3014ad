"""One scene of a dataset by photon transport: expected histograms, counts of the camera, depth frames from counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.rendered import (
    Histograms,
    RenderedScene,
    StoredFrames,
    backscatter_profile,
    intensity_step,
    with_exposure,
)
from spadwarp.dataset.sampling import Plan, SceneDraw
from spadwarp.frames import Frames, crlb, detect
from spadwarp.result import analyser_channel, degree_of_polarisation
from spadwarp.scene import Scene
from spadwarp.scene.sight import depth_from_time, depth_per_time
from spadwarp.transport import RunOptions, simulate

__all__ = ["render_transport"]

_MOST_PULSES = 2**31 - 1  # the camera counts in 32 bits


def render_transport(plan: Plan, draw: SceneDraw, *, device: str | None, threads: int | None) -> RenderedScene:
    """Traces the scene's photons, exposes the camera for each frame and finds its depth."""
    assert draw.photons is not None
    scene = draw.scene
    result = simulate(scene, photons=draw.photons, seed=draw.seed, device=device, run=RunOptions(threads=threads))
    if result.partial:
        raise KeyboardInterrupt
    polarisation = degree_of_polarisation(result).astype(np.float16) if result.channels else None
    result = analyser_channel(result, plan.recipe.monte_carlo.channel)
    scale = scene.laser.photons_per_pulse * scene.detections_per_photon
    water = result.component("backscatter")
    returned = (result.histogram.sum(axis=-1) - water.sum(axis=-1)) * scale
    seen = (returned > 0) & np.isfinite(result.truth.depth)
    scene = with_exposure(scene, draw, returned[seen], most=_MOST_PULSES)
    pulses = min(scene.pulses_per_depth_frame, _MOST_PULSES)
    frames = detect(result, pulses=pulses, frames=len(draw.fractions), seed=draw.seed, device=device)
    time_bound = crlb(result, pulses=pulses, device=device)
    per_time = depth_per_time(scene, np.nan_to_num(result.truth.range.astype(np.float64)))
    profile = np.concatenate([[0.0], np.cumsum(water.sum(axis=(0, 1)))])
    return RenderedScene(
        draw=draw,
        scene=scene,
        truth=result.truth,
        bound=np.where(seen, time_bound * per_time, np.nan).astype(np.float32),
        profile=backscatter_profile(scene, result.path_edges, profile / max(profile[-1], 1e-300)),
        signal=float(np.median(returned[seen])) if seen.any() else 0.0,
        backscatter=float(np.median(water.sum(axis=-1))) * scale,
        frames=_stored(plan, scene, frames, device=device),
        histograms=Histograms(
            expected=np.minimum(frames.expected * np.float32(pulses), 65504.0).astype(np.float16),
            counts=frames.counts,
            polarisation=polarisation,
        ),
    )


def _stored(plan: Plan, scene: Scene, frames: Frames, *, device: str | None) -> StoredFrames:
    """Codes of the depth and the intensity of the counts; labels of the pixels that most likely report background."""
    time = frames.arrival_time(plan.recipe.monte_carlo.depth_method, device=device)
    start, stop = frames.gate_start, frames.gate_start + frames.expected.shape[-1] * frames.bin_width
    depth = depth_from_time(np.clip(time, start, stop), scene=scene)
    code = np.rint((depth - plan.depth_offset) / plan.depth_step)
    codes = np.where(np.isnan(depth), 0, np.clip(code, 1, 65535)).astype(np.uint16)
    counts = frames.counts.sum(axis=-1, dtype=np.int64)
    step = intensity_step(float((frames.expected.sum(axis=-1) * frames.pulses).max()))
    return StoredFrames(
        depth=codes,
        intensity=np.minimum(np.rint(counts / step), 255).astype(np.uint8),
        labels=np.packbits(_reports_background(frames, time), axis=-1),
        intensity_step=step,
    )


def _reports_background(frames: Frames, time: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether background is more likely than the target at the time that a pixel reports, `[K, H, W]`."""
    bins = frames.expected.shape[-1]
    at = np.nan_to_num((time - frames.gate_start) / frames.bin_width).astype(np.int64).clip(0, bins - 1)
    expected = np.take_along_axis(frames.expected[None], at[..., None], axis=-1)[..., 0]
    known = np.broadcast_to(frames.background, frames.expected.shape)
    background = np.take_along_axis(known[None], at[..., None], axis=-1)[..., 0]
    return (background > 0.5 * expected) & ~np.isnan(time)
