"""The analytic simulator: maps of a scene by the model, and depth frames drawn from them, without tracing photons."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.analytic.model import BackscatterTable, Map, pixel_maps, scene_optics, source_name, warn_of_model
from spadwarp.device import pick_device
from spadwarp.errors import ArgumentError, ConfigError, kernel_errors
from spadwarp.limits import SEED, check_integer
from spadwarp.result.file import as_result
from spadwarp.result.result import Result, Truth
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.sight import gate_deviation, lines_of_sight, pixel_directions
from spadwarp.transport import truth_maps

__all__ = ["AnalyticResult", "background_photons", "simulate_analytic"]

_PART_PIXELS = 1 << 28  # of frames that a GPU holds at a time: 1.3 GB


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class AnalyticResult:
    """Maps of a scene by the analytic model, and depth frames drawn from them.

    Maps are float64 `[H, W]`, NaN where there is no estimate: nothing hit, not illuminated, or the return outside the
    gate.

    Attributes:
        scene: The scene.
        truth: Depth, range, normal and reflectance that the maps come from.
        signal: S, expected detections of the return per pulse (eq 7); 0 without a return.
        arrival: μ [s] after the pulse left the laser; NaN where nothing is hit.
        backscatter: Expected backscatter detections per pulse within the gate.
        daylight: Detections of daylight [1/s]; 0 without `[daylight]`.
        alpha: α, all expected detections per pulse within the gate (integral of eq 8).
        fisher: F, information on the delay per detected photon [1/s²] (eq 9); 0 where there is no estimate.
        sigma_time: σ* = 1/√(N·F) [s], the Cramér–Rao bound of one depth frame, N being its recorded photons.
        sigma_depth: The bound of planar depth [m].
        signal_to_backscatter: Both per pulse within the gate; infinite where there is no backscatter.
        background_level: Background detections per pulse and σ of the response, under the return.
        outlier_probability: Of a false peak: a maximum-likelihood fit takes background for the return, and `sigma_time`
            is not reached.
        background_probability: That a frame's pixel reports a background photon.
        depth: Frames, float32 `[N, H, W]` [m]; NaN for no estimate.
        labels: bool `[N, H, W]`, where a frame's pixel reports a background photon.
        seed: Of the frames.
    """

    scene: Scene
    truth: Truth
    signal: Map
    arrival: Map
    backscatter: Map
    daylight: Map
    alpha: Map
    fisher: Map
    sigma_time: Map
    sigma_depth: Map
    signal_to_backscatter: Map
    background_level: Map
    outlier_probability: Map
    background_probability: Map
    depth: NDArray[np.float32]
    labels: NDArray[np.bool_]
    seed: int
    # When background photons arrive: the part that is flat over the gate, and the table of the rest.
    _flat_share: NDArray[np.float32]
    _table: BackscatterTable

    def __repr__(self) -> str:
        name = self.scene.source.stem if self.scene.source else "Python"
        height, width = self.truth.depth.shape
        return f"AnalyticResult({name}: {width} x {height} pixels, {len(self.depth)} depth frames, seed {self.seed})"

    def plot(self, **options: Any) -> Any:
        """A figure of the maps and a frame; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(self, **options)

    def _repr_html_(self) -> str:
        import spadwarp

        return spadwarp.viz.html(self)

    def to_xarray(self) -> Any:
        """Maps, truth and frames with coordinates and units: see `spadwarp.analytic.to_xarray`."""
        import spadwarp

        return spadwarp.analytic.to_xarray(self)

    @kernel_errors()
    def sample(
        self, frames: int, *, first: int = 0, seed: int | None = None, device: Any = None
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Frames `first` to `first + frames`: depth float32 `[frames, H, W]` [m] and labels, bool of that shape.

        A frame depends on seed and number alone, so they can be drawn in parts. `seed`: the result's if not given.
        """
        import warp as wp

        from spadwarp_kernels import analytic as kernels

        device = pick_device(device)
        shape, pixels = self.truth.depth.shape, self.truth.depth.size
        inputs, (optics, ports) = self._inputs(device), scene_optics(self.scene)
        speed, gate = self.scene.medium.pulse_speed, self.scene.gate
        depth = np.empty((frames, *shape), np.float32)
        labels = np.empty((frames, *shape), np.bool_)
        # On the CPU kernels write into the result itself; a GPU works in parts.
        part = max(frames, 1) if device.is_cpu else max(_PART_PIXELS // pixels, 2)
        for start in range(0, frames, part):
            stop = min(start + part, frames)
            rows: list[Any] = [
                wp.array(values[start:stop].reshape(stop - start, pixels), dtype=kind, device="cpu", copy=False)
                for values, kind in ((depth, wp.float32), (labels, wp.bool))
            ]
            drawn = kernels.sample_frames(
                *inputs,
                laser=self.scene.beam.position,
                optics=optics,
                ports=ports,
                gate_paths=(gate.start * speed, gate.stop * speed),
                first_frame=first + start,
                frames=stop - start,
                seed=self.seed if seed is None else seed,
                out=(rows[0], rows[1]) if device.is_cpu else None,
            )
            if not device.is_cpu:
                for row, array in zip(rows, drawn, strict=True):
                    wp.copy(row, array)
                wp.synchronize_device(device)
        return depth, labels

    def _inputs(self, device: Any) -> list[Any]:
        """Arrays of the sampler on the device: a value a pixel, and the table of backscatter."""
        import warp as wp

        def put(values: NDArray[Any], kind: Any = wp.float32) -> Any:
            return wp.array(np.ascontiguousarray(values, np.float32), dtype=kind, device=device)

        view, in_water = pixel_directions(self.scene.camera), lines_of_sight(self.scene).direction
        return [
            put(view.reshape(-1, 3), wp.vec3),
            put(np.where(np.isnan(self.sigma_depth), np.nan, self.truth.depth).reshape(-1)),
            # No bound is worse than a guess anywhere in the gate.
            put(np.minimum(self.sigma_depth, gate_deviation(self.scene, in_water)).reshape(-1)),
            put(self.background_probability.reshape(-1)),
            put(self._flat_share),
            put(self._table.paths),
            put(self._table.cumulative),
        ]

    def save(self, path: str | Path, *, frames: int | None = None, device: Any = None) -> Path:
        """Writes everything to one HDF5 file, whole or not at all: see `spadwarp.analytic.save_analytic`."""
        import spadwarp

        return spadwarp.analytic.save_analytic(self, path, frames=frames, device=device)


def background_photons(scene: Scene, maps: dict[str, Map]) -> tuple[Map, Map]:
    """Expected background photons per pulse within the gate, and the part of them that is flat over the gate, `[P]`."""
    dark = (scene.detector.noise_rate + maps["daylight"]) * (scene.gate.stop - scene.gate.start)
    noise = maps["backscatter"] + dark
    return noise, np.divide(dark, noise, out=np.ones_like(noise), where=noise > 0)


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
    illuminated = maps["signal"] > 0
    if illuminated.any() and not (maps["fisher"] > 0).any():
        times = maps["arrival"][illuminated] * 1e9
        raise ConfigError(
            f"gate [{scene.gate.start * 1e9:.4g}, {scene.gate.stop * 1e9:.4g}) ns holds no return; "
            f"the target's arrive from {times.min():.4g} to {times.max():.4g} ns",
            source=source_name(scene),
        )
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


def _profile(scene: Scene, profile: Any) -> NDArray[np.float32] | None:
    """Backscatter detections per pulse and bin, `[1 or P, T]`."""
    if profile is None:
        return None
    camera, bins = scene.camera, scene.gate.bins
    if isinstance(profile, str | os.PathLike | Result):
        run = as_result(profile, "backscatter_profile")
        values = run.component("backscatter") * (scene.laser.photons_per_pulse * scene.detections_per_photon)
    else:
        values = np.asarray(profile, np.float64)
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
