"""The analytic simulator: depth frames of a scene without tracing photons.

Per pixel, from the truth of the scene: signal detections per pulse (eq 3–7), arrival time, detections per pulse α (eq
8), Fisher information (eq 9) and Cramér–Rao bound; then frames of arrival + noise with background photons in between.
Equation numbers are those of *A Simulation Method for Underwater SPAD Depth Imaging Datasets*, Sensors 24, 3886 (2024).

What the model leaves out: multiple scattering, shadows of a laser beside the lens, range aliasing, pile-up (the
information is that of α ≪ 1 per acquisition) and instrument responses that are not Gaussian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.frames.response import FWHM_PER_SIGMA
from spadwarp.result.result import Result, Truth
from spadwarp.scene import phase_function
from spadwarp.scene.geometry import depth_per_time, gate_deviation, pixel_directions

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["AnalyticResult", "pixel_maps", "response_sigma", "simulate_analytic"]

Map = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class AnalyticResult:
    """Maps of a scene as the analytic model sees it, and depth frames drawn from them.

    Maps are float64 `[H, W]`, NaN where there is no estimate: nothing hit, not lit, or the return outside the gate.

    Attributes:
        scene: The scene.
        truth: Depth, range, normal and reflectance that the maps come from.
        signal: S, expected detections of the return per pulse (eq 7); 0 without a return.
        arrival: μ [s] after the pulse left the laser; NaN where nothing is hit.
        backscatter: Expected backscatter detections per pulse within the gate.
        alpha: α, all expected detections per pulse within the gate (integral of eq 8).
        fisher: F, information on the delay per detected photon [1/s²] (eq 9); 0 where there is no estimate.
        sigma_time: σ* = 1/√(N·F) [s], the Cramér–Rao bound of one depth frame, N being its recorded photons.
        sigma_depth: The bound of planar depth [m].
        background_level: Background detections per pulse and σ of the response, under the return.
        signal_to_backscatter: Both per pulse within the gate; infinite where there is no backscatter.
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
    _stray: _Stray = field(repr=False)

    def sample(
        self, frames: int, *, first: int = 0, seed: int | None = None, device: Any = None
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Frames `first` to `first + frames`: depth float32 `[frames, H, W]` [m] and labels, bool of that shape.

        A frame depends on seed and number alone, so they can be drawn in parts. `seed`: the result's if not given.
        """
        return _sample(self, frames, first=first, seed=self.seed if seed is None else seed, device=device)

    def save(self, path: str | Path, *, frames: int | None = None, device: Any = None) -> Path:
        """Writes everything to one HDF5 file, whole or not at all: see `spadwarp.save_analytic`."""
        import spadwarp

        return spadwarp.save_analytic(self, path, frames=frames, device=device)


@dataclass(frozen=True, eq=False)
class _Stray:
    """When background photons arrive: the part that is flat over the gate, the distribution of the rest over path."""

    flat_share: NDArray[np.float32]
    paths: NDArray[np.float32]
    cumulative: NDArray[np.float32]


def simulate_analytic(
    scene: Scene,
    *,
    truth: Truth | None = None,
    frames: int = 1,
    seed: int = 0,
    device: Any = None,
    backscatter_profile: Result | ArrayLike | None = None,
) -> AnalyticResult:
    """Simulates depth frames of a scene by eq 3–11, without tracing photons.

    Args:
        scene: Its `[analytic]` section says which form, backscatter and count law hold.
        truth: Depth, range, normal and reflectance of every pixel; default: the scene's own targets, ray-cast.
        frames: Depth frames to draw, ≥ 0.
        seed: 64-bit seed of the frames.
        device: Warp device; default: the first GPU, else the CPU.
        backscatter_profile: For `backscatter = "monte_carlo"`: a `Result` of the same scene, or expected backscatter
            detections per pulse and bin over the scene's gate, `[T]` for all pixels or `[H, W, T]`.

    Raises:
        ConfigError: A scene that the model does not cover, or whose gate holds no return.
        ArgumentError: A truth or profile of the wrong shape, or with values that cannot be.

    With `backscatter_fraction` given, that part of the pixels reports a backscatter photon (the paper's BS). Without, a
    pixel reports a background photon with the probability that a maximum-likelihood fit locks on background.
    """
    if truth is None:
        from spadwarp.transport.model import truth_maps

        truth = truth_maps(scene)
    _check_truth(truth, scene)
    if frames < 0:
        raise ArgumentError(f"frames = {frames} is outside [0, inf)")
    shape = truth.depth.shape
    view = pixel_directions(scene.camera)
    maps, table = pixel_maps(
        scene,
        view=view.reshape(-1, 3),
        distance=truth.range.reshape(-1),
        normal=truth.normal.reshape(-1, 3),
        reflectance=truth.reflectance.reshape(-1),
        device=device,
        backscatter_profile=_profile(scene, backscatter_profile),
    )
    _check_gate(scene, maps["signal"], maps["arrival"], maps["fisher"])
    fraction = scene.analytic.backscatter_fraction
    seen = maps["fisher"] > 0
    if fraction is None:
        dark = scene.detector.noise_rate * (scene.gate.stop - scene.gate.start)
        noise = maps["backscatter"] + dark
        stray = np.where(seen, maps["outlier_probability"], 0.0)
        flat = np.divide(dark, noise, out=np.ones_like(noise), where=noise > 0)
    else:
        stray = np.where(seen & (maps["backscatter"] > 0), fraction, 0.0)
        flat = np.zeros_like(stray)
        if scene.analytic.backscatter == "constant":  # then the fraction says all that matters, the rate may be 0
            stray, flat = np.where(seen, fraction, 0.0), np.ones_like(stray)
    result = AnalyticResult(
        scene=scene,
        truth=truth,
        **{name: values.reshape(shape) for name, values in maps.items()},
        background_probability=stray.reshape(shape),
        depth=np.empty((0, *shape), np.float32),
        labels=np.empty((0, *shape), np.bool_),
        seed=seed,
        _stray=_Stray(flat.astype(np.float32), *table),
    )
    depth, labels = result.sample(frames, device=device)
    object.__setattr__(result, "depth", depth)
    object.__setattr__(result, "labels", labels)
    return result


def pixel_maps(
    scene: Scene,
    *,
    view: ArrayLike,
    distance: ArrayLike,
    normal: ArrayLike,
    reflectance: ArrayLike,
    device: Any = None,
    backscatter_profile: NDArray[np.float32] | None = None,
    gate: tuple[float, float] | None = None,
    outliers: bool = True,
) -> tuple[dict[str, Map], tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """The model's maps for any lines of sight, by name as in `AnalyticResult`, and the table of backscatter over path.

    Args:
        scene: The scene.
        view: Unit vectors `[P, 3]`.
        distance: Along them `[P]` [m]; NaN where nothing is hit.
        normal: Unit vectors towards the camera `[P, 3]`.
        reflectance: `[P]`.
        device: Warp device.
        backscatter_profile: float32 `[1 or P, T]`, detections per pulse and bin.
        gate: (start, stop) [s] in place of the scene's.
        outliers: Whether `outlier_probability` is wanted, which takes most of the time; else it is NaN.

    Returns:
        float64 maps `[P]`; edges in path [m] and cumulative distribution of the backscatter, float32 `[1 or P, n]`.
    """
    import warp as wp

    from spadwarp.transport.model import pick_device
    from spadwarp_kernels import analytic as kernels

    device = pick_device(device)
    start, stop = gate or (scene.gate.start, scene.gate.stop)
    lidar = _lidar(scene, start, stop)
    chosen = scene.analytic
    views = np.ascontiguousarray(view, np.float64)
    distances = np.nan_to_num(np.asarray(distance, np.float64), nan=0.0)

    def on_device(values: NDArray[Any], dtype: Any) -> Any:
        return wp.array(np.nan_to_num(np.ascontiguousarray(values)), dtype=dtype, device=device)

    view_d = on_device(views, wp.vec3d)
    distance_d = on_device(distances, wp.float64)
    normal_d = on_device(np.asarray(normal, np.float64), wp.vec3d)
    reflectance_d = on_device(np.asarray(reflectance, np.float64), wp.float64)
    phase_d = on_device(_phase_table(scene), wp.float64)
    signal_d, arrival_d = kernels.signal_map(lidar, view_d, distance_d, normal_d, reflectance_d)

    profile = np.zeros((1, 1), np.float32)
    speed = scene.medium.pulse_speed
    if chosen.backscatter == "single_scatter":
        paths_d, cumulative_d, total_d = kernels.single_scatter_table(lidar, phase_d, view_d, distance_d)
        paths, cumulative = paths_d.numpy(), cumulative_d.numpy()
    elif chosen.backscatter == "monte_carlo":
        if backscatter_profile is None:
            raise ArgumentError("backscatter_profile is missing; analytic.backscatter = 'monte_carlo' needs it")
        profile = backscatter_profile
        sums = np.concatenate([np.zeros((len(profile), 1)), np.cumsum(profile, axis=1, dtype=np.float64)], axis=1)
        total = np.broadcast_to(sums[:, -1], distances.shape).copy()
        paths = (np.linspace(start, stop, profile.shape[1] + 1) * speed).astype(np.float32)[None]
        cumulative = (sums / np.maximum(sums[:, -1:], 1e-300)).astype(np.float32)
        total_d = on_device(total, wp.float64)
    else:
        total_d = on_device(np.full(distances.shape, chosen.backscatter_rate * (stop - start)), wp.float64)
        paths = np.array([[start * speed, stop * speed]], np.float32)
        cumulative = np.array([[0.0, 1.0]], np.float32)

    per_frame = chosen.exposure * scene.laser.repetition_rate
    statistics = kernels.statistics_maps(
        lidar,
        phase_d,
        on_device(profile, wp.float32),
        view_d,
        signal_d,
        arrival_d,
        total_d,
        count_law=chosen.count_law,
        acquisitions=chosen.pulses_per_depth_frame if chosen.count_law == "per_pulse" else chosen.frames,
        pulses_per_frame=per_frame,
        outliers=outliers,
    )
    signal, arrival, backscatter = signal_d.numpy(), arrival_d.numpy(), total_d.numpy()
    alpha, fisher, sigma_time, level, outlier = (one.numpy() for one in statistics)
    if chosen.count_law == "per_frame_lu2024" and alpha.max(initial=0.0) > 1.0:
        raise ConfigError(
            f"analytic.count_law = 'per_frame_lu2024' needs alpha < 1; it reaches {alpha.max():.4g} detections per "
            "pulse here, use 'per_frame'",
            source=_source(scene),
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        signal_to_backscatter = np.where(fisher > 0, signal / backscatter, np.nan)
    maps = {
        "signal": signal,
        "arrival": arrival,
        "backscatter": backscatter,
        "alpha": alpha,
        "fisher": fisher,
        "sigma_time": sigma_time,
        "sigma_depth": sigma_time * depth_per_time(scene, views, distances),
        "signal_to_backscatter": signal_to_backscatter,
        "background_level": level,
        "outlier_probability": outlier,
    }
    return maps, (paths, cumulative)


def response_sigma(scene: Scene) -> float:
    """Standard deviation of the Gaussian response, pulse ⊗ jitter [s]; raises `ConfigError` for other responses."""
    if scene.detector.irf != "gaussian":
        raise ConfigError(
            f"detector.irf = {scene.detector.irf!r}: the analytic model needs 'gaussian'", source=_source(scene)
        )
    fwhm = math.hypot(scene.laser.pulse_fwhm_ps, scene.detector.jitter_fwhm_ps) * 1e-12
    if not fwhm > 0:
        raise ConfigError(
            "laser.pulse_fwhm_ps and detector.jitter_fwhm_ps are both 0: the analytic model needs some width",
            source=_source(scene),
        )
    return fwhm / FWHM_PER_SIGMA


# Parts


def _source(scene: Scene) -> str | None:
    return str(scene.source) if scene.source else None


def _lidar(scene: Scene, start: float, stop: float) -> Any:
    """The kernels' picture of a scene; raises `ConfigError` for what the model does not cover."""
    import warp as wp

    from spadwarp_kernels import BACKSCATTER_SOURCES, LASER_PROFILES, Lidar

    laser, camera, chosen = scene.beam, scene.camera, scene.analytic
    problems = []
    if laser.profile == "measured":
        problems.append("analytic: laser.profile = 'measured' has no closed form; simulate takes any")
    if scene.scan.mode != "none":
        problems.append(f"analytic: scan.mode = {scene.scan.mode!r} is not one beam for all pixels; simulate takes it")
    lu2024 = chosen.form == "lu2024"
    if lu2024 and (laser.profile != "uniform_cone" or laser.half_angle_deg >= 90):
        problems.append(
            f"analytic.form = 'lu2024' needs a uniform_cone laser of half_angle_deg < 90, not {laser.profile!r} "
            f"of {laser.half_angle_deg}"
        )
    if scene.medium.layers:
        problems.append(f"medium.layers: {len(scene.medium.layers)} given; the analytic simulator takes one water")
    if chosen.backscatter == "single_scatter" and laser.profile == "collimated":
        problems.append(
            "analytic.backscatter = 'single_scatter' needs a diverging laser.profile, not 'collimated'; "
            "'monte_carlo' takes any"
        )
    if problems:
        raise ConfigError(problems, source=_source(scene))
    lidar: Any = Lidar()
    lidar.lu2024 = int(lu2024)
    lidar.photons = laser.photons_per_pulse
    lidar.pde = scene.detector.pde
    lidar.extinction = scene.medium.extinction
    lidar.scattering = scene.medium.scattering
    lidar.speed = scene.medium.pulse_speed
    lidar.laser = wp.vec3d(*laser.position)
    lidar.axis = wp.vec3d(*laser.axis)
    lidar.profile = LASER_PROFILES.index(laser.profile)
    lidar.spread = 2.0 * math.sin(0.5 * laser.half_angle) ** 2
    lidar.tan2 = math.tan(min(laser.half_angle, math.radians(89.9))) ** 2
    lidar.radius = laser.beam_radius
    lidar.pixel_tangent = camera.pixel_tangent
    lidar.aperture_area = camera.aperture_area
    lidar.start = start
    lidar.stop = stop
    lidar.sigma = response_sigma(scene)
    lidar.dark = scene.detector.noise_rate
    lidar.source = BACKSCATTER_SOURCES.index(chosen.backscatter)
    lidar.constant = chosen.backscatter_rate
    # Nearer than its own diameter the aperture's solid angle is not area over distance squared.
    lidar.nearest = 2.0 * camera.aperture_radius
    lidar.bin_width = scene.gate.bin_width
    return lidar


def _phase_table(scene: Scene) -> Map:
    """Density [1/sr] at scattering angles uniform on [0, π]; at 0, where it may be infinite, that of 2e-5 rad."""
    return phase_function(scene.medium).density(np.maximum(np.linspace(0.0, np.pi, 4097), 2e-5))


def _profile(scene: Scene, given: Result | ArrayLike | None) -> NDArray[np.float32] | None:
    """Backscatter detections per pulse and bin, `[1 or P, T]`."""
    if given is None:
        return None
    camera, bins = scene.camera, scene.gate.bins
    if isinstance(given, Result):
        values = given.component("backscatter") * (scene.laser.photons_per_pulse * scene.detector.pde)
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
    for name, low, high in (("depth", 0.0, math.inf), ("range", 0.0, math.inf), ("reflectance", 0.0, 1.0)):
        values = getattr(truth, name)[hit]
        wrong = ~(np.isfinite(values) & (values >= low) & (values <= high))
        if name != "reflectance":
            wrong |= values == 0.0
        if wrong.any():
            row, column = np.argwhere(hit)[np.argmax(wrong)]
            interval = "[0, 1]" if name == "reflectance" else "(0, inf)"
            raise ArgumentError(
                f"truth.{name} = {values[np.argmax(wrong)]} at pixel ({row}, {column}) is outside {interval}"
            )
    if not np.isfinite(truth.normal[hit]).all():
        raise ArgumentError("truth.normal is not finite where truth.depth is")


def _check_gate(scene: Scene, signal: Map, arrival: Map, fisher: Map) -> None:
    lit = signal > 0
    if lit.any() and not (fisher > 0).any():
        times = arrival[lit] * 1e9
        raise ConfigError(
            f"gate [{scene.gate.start * 1e9:.4g}, {scene.gate.stop * 1e9:.4g}) ns holds no return; "
            f"the target's arrive from {times.min():.4g} to {times.max():.4g} ns",
            source=_source(scene),
        )


def _sample(
    result: AnalyticResult, frames: int, *, first: int, seed: int, device: Any
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    import warp as wp

    from spadwarp.transport.model import pick_device
    from spadwarp_kernels import analytic as kernels

    device = pick_device(device)
    scene, shape = result.scene, result.truth.depth.shape
    pixels = result.truth.depth.size
    speed = scene.medium.pulse_speed
    to = {"dtype": wp.float32, "device": device}

    def flat(values: NDArray[Any]) -> Any:
        return wp.array(np.ascontiguousarray(values.reshape(-1), np.float32), **to)

    view = pixel_directions(scene.camera)
    # No bound is worse than a guess anywhere in the gate.
    inputs = [
        wp.array(view.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device),
        flat(np.where(np.isnan(result.sigma_depth), np.nan, result.truth.depth)),
        flat(np.minimum(result.sigma_depth, gate_deviation(scene, view))),
        flat(result.background_probability),
        flat(result._stray.flat_share),
        wp.array(result._stray.paths, **to),
        wp.array(result._stray.cumulative, **to),
    ]
    depth = np.empty((frames, *shape), np.float32)
    labels = np.empty((frames, *shape), np.bool_)
    # On the CPU kernels write into the result itself; a GPU works in parts of 1.3 GB.
    part = max(frames, 1) if device.is_cpu else max((1 << 28) // pixels, 2)
    for start in range(0, frames, part):
        stop = min(start + part, frames)
        rows: list[Any] = [
            wp.array(values[start:stop].reshape(stop - start, pixels), dtype=kind, device="cpu", copy=False)
            for values, kind in ((depth, wp.float32), (labels, wp.bool))
        ]
        drawn = kernels.sample_frames(
            *inputs,
            laser=scene.beam.position,
            gate_paths=(scene.gate.start * speed, scene.gate.stop * speed),
            first_frame=first + start,
            frames=stop - start,
            seed=seed,
            out=(rows[0], rows[1]) if device.is_cpu else None,
        )
        if not device.is_cpu:
            for row, array in zip(rows, drawn, strict=True):
                wp.copy(row, array)
            wp.synchronize_device(device)
    return depth, labels
