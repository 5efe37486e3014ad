"""The analytic simulator: depth frames of a scene without tracing photons.

Maps of the model (`spadwarp.analytic.model`), then frames of arrival + noise with background photons in between.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.analytic.model import Map, pixel_maps, source_name, warn_of_model
from spadwarp.analytic.result import AnalyticResult, background_photons
from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.limits import SEED, check_integer
from spadwarp.result.file import as_result
from spadwarp.result.result import Result, Truth
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.sight import pixel_directions
from spadwarp.transport import truth_maps

__all__ = ["simulate_analytic"]


def simulate_analytic(
    scene: SceneLike,
    *,
    truth: Truth | None = None,
    frames: int = 1,
    seed: int = 0,
    device: Any = None,
    backscatter_profile: Result | str | os.PathLike[str] | ArrayLike | None = None,
) -> AnalyticResult:
    """Simulates depth frames of a scene by eq 3–11, without tracing photons.

    With `analytic.backscatter_fraction` given, that part of the pixels reports a backscatter photon. Without, a pixel
    reports a background photon with the probability of a false peak in a maximum-likelihood fit.

    Args:
        scene: Its `[analytic]` section selects form, backscatter and count law.
        truth: Depth, range, normal and reflectance of every pixel; default: the scene's own targets, ray-cast. Behind a
            port, range is the length of the bent ray.
        frames: Depth frames to draw, ≥ 0.
        seed: 64-bit seed of the frames.
        device: Warp device; default: the first GPU, else the CPU.
        backscatter_profile: For `backscatter = "monte_carlo"`: a `Result` of the same scene, its path, or expected
            backscatter detections per pulse and bin over the scene's gate, `[T]` for all pixels or `[H, W, T]`.

    A warning says where a scene's light is polarised, which the model leaves out.

    Raises:
        ConfigError: A scene that the model does not cover, or whose gate holds no return.
        ArgumentError: A truth or profile of the wrong shape, or with impossible values.
    """
    scene = as_scene(scene)
    frames, seed = check_integer("frames", frames, "[0, 2147483647]"), check_integer("seed", seed, SEED)
    warn_of_model(scene)
    truth = truth_maps(scene) if truth is None else truth
    _check_truth(truth, scene)
    shape = truth.depth.shape
    maps, table = pixel_maps(
        scene,
        view=pixel_directions(scene.camera).reshape(-1, 3),
        distance=truth.range.reshape(-1),
        normal=truth.normal.reshape(-1, 3),
        reflectance=truth.reflectance.reshape(-1),
        device=device,
        backscatter_profile=_profile(scene, backscatter_profile),
    )
    _check_gate(scene, maps)
    probability, flat = _background(scene, maps)
    result = AnalyticResult(
        scene=scene,
        truth=truth,
        **{name: values.reshape(shape) for name, values in maps.items()},
        background_probability=probability.reshape(shape),
        depth=np.empty((0, *shape), np.float32),
        labels=np.empty((0, *shape), np.bool_),
        seed=seed,
        _flat_share=flat.astype(np.float32),
        _table=table,
    )
    depth, labels = result.sample(frames, device=device)
    return replace(result, depth=depth, labels=labels)


def _background(scene: Scene, maps: dict[str, Map]) -> tuple[Map, Map]:
    """Probability that a pixel reports a background photon, and the part of these that is flat over the gate."""
    fraction, estimated = scene.analytic.backscatter_fraction, maps["fisher"] > 0
    if fraction is None:
        return np.where(estimated, maps["outlier_probability"], 0.0), background_photons(scene, maps)[1]
    if scene.analytic.backscatter == "constant":  # the fraction alone matters, the rate may be 0
        return np.where(estimated, fraction, 0.0), np.ones(estimated.shape)
    return np.where(estimated & (maps["backscatter"] > 0), fraction, 0.0), np.zeros(estimated.shape)


def _profile(scene: Scene, given: Any) -> NDArray[np.float32] | None:
    """Backscatter detections per pulse and bin, `[1 or P, T]`."""
    if given is None:
        return None
    camera, bins = scene.camera, scene.gate.bins
    if isinstance(given, str | os.PathLike | Result):
        given = as_result(given, "backscatter_profile")
        values = given.component("backscatter") * (scene.laser.photons_per_pulse * scene.detections_per_photon)
    else:
        values = np.asarray(given, np.float64)
    shape = (camera.height, camera.width, bins)
    if values.shape not in ((bins,), shape):
        raise ArgumentError(f"backscatter_profile has shape {values.shape}; ({bins},) or {shape} is needed")
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise ArgumentError("backscatter_profile holds a value outside [0, inf)")
    return np.ascontiguousarray(values.reshape(-1, bins), np.float32)


def _check_truth(truth: Truth, scene: Scene) -> None:
    shape = (scene.camera.height, scene.camera.width)
    if truth.depth.shape != shape:
        raise ArgumentError(f"truth.depth has shape {truth.depth.shape}; the camera's {shape} is needed")
    hit = ~np.isnan(truth.depth)
    if not hit.any():
        raise ArgumentError("truth.depth is NaN in every pixel: nothing is in view")
    for name, interval in (("depth", "(0, inf)"), ("range", "(0, inf)"), ("reflectance", "[0, 1]")):
        values = getattr(truth, name)[hit]
        possible = (values >= 0) & (values <= 1) if name == "reflectance" else (values > 0) & np.isfinite(values)
        if not possible.all():
            wrong = int(np.argmin(possible))
            row, column = np.argwhere(hit)[wrong]
            raise ArgumentError(f"truth.{name} = {values[wrong]} at pixel ({row}, {column}) is outside {interval}")
    if not np.isfinite(truth.normal[hit]).all():
        raise ArgumentError("truth.normal is not finite where truth.depth is")


def _check_gate(scene: Scene, maps: dict[str, Map]) -> None:
    illuminated = maps["signal"] > 0
    if illuminated.any() and not (maps["fisher"] > 0).any():
        times = maps["arrival"][illuminated] * 1e9
        raise ConfigError(
            f"gate [{scene.gate.start * 1e9:.4g}, {scene.gate.stop * 1e9:.4g}) ns holds no return; "
            f"the target's arrive from {times.min():.4g} to {times.max():.4g} ns",
            source=source_name(scene),
        )
