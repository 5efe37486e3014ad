"""The analytic simulator: maps of a scene by the model, depth frames drawn from them, and their file."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

import spadwarp_kernels as sk
from spadwarp.analytic.model import BackscatterTable, pixel_maps, response_sigma, scene_optics, warn_of_model
from spadwarp.arrays import Floats, labelled, real_array
from spadwarp.device import pick_device
from spadwarp.io.hdf5 import PACKED, PIXELS, Coordinate, image_coordinates, name_dimensions, read_hdf5, write_hdf5
from spadwarp.result.file import as_result
from spadwarp.result.result import ARRAYS, Result, Truth
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.sight import gate_deviation, lines_of_sight
from spadwarp.transport import truth_maps
from spadwarp.values import SEED, ArgumentError, ConfigError, Interval, Shown, __version__, check_integer

if TYPE_CHECKING:
    import xarray

__all__ = ["AnalyticFile", "AnalyticResult", "simulate_analytic"]

_FORMAT, _FORMAT_VERSION = "spadwarp analytic", 1
_PART_PIXELS = 1 << 26  # of frames that are drawn at a time: 0.3 GB
_PART_BYTES = 1 << 28  # of frames that are held at a time while a file is written
_READ_ME = (
    "Depth frames [frame, height, width] in metres along z, NaN for no estimate; labels: the pixel reports background "
    "light. maps/: signal, backscatter and alpha are expected detections per pulse within the gate, arrival and "
    "sigma_time are seconds, sigma_depth metres, fisher 1/s^2 per detected photon. "
    "Camera frame: +x right, +y down, +z forward."
)
_MAPS = {
    "signal": "1",
    "arrival": "s",
    "backscatter": "1",
    "alpha": "1",
    "fisher": "s^-2",
    "sigma_time": "s",
    "sigma_depth": "m",
    "signal_to_backscatter": "1",
    "background_level": "1",
    "outlier_probability": "1",
    "background_probability": "1",
}
# Dimensions, unit and meaning of the arrays of a file, by name.
_ARRAYS = {
    **{f"maps/{name}": (PIXELS, unit, name.replace("_", " ")) for name, unit in _MAPS.items()},
    **{name: entry[1:] for name, entry in ARRAYS.items() if name.startswith("truth/")},
    "depth": (("frame", *PIXELS), "m", "planar depth of the frame"),
    "labels": (("frame", *PIXELS), "1", "whether the pixel reports background"),
}
# Names of the labelled arrays, and in the file.
_LABELLED = {name: f"maps/{name}" for name in _MAPS} | {
    "true_depth": "truth/depth",
    "true_range": "truth/range",
    "reflectance": "truth/reflectance",
    "depth": "depth",
    "label": "labels",
}


def _coordinates(frames: int, shape: tuple[int, ...]) -> dict[str, Coordinate]:
    return {"frame": (np.arange(frames), "1", "number of the frame"), **image_coordinates(*shape)}


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class AnalyticResult(Shown):
    """Maps of a scene by the analytic model, and depth frames drawn from them.

    Maps are float64 `[H, W]`, NaN where there is no estimate: nothing hit, not illuminated, or the return outside the
    gate.
    """

    scene: Scene  # the scene
    truth: Truth  # depth, range, normal and reflectance that the maps come from
    signal: Floats  # S, expected detections of the return per pulse (eq 7); 0 without a return
    arrival: Floats  # μ [s] after the pulse left the laser; NaN where nothing is hit
    backscatter: Floats  # expected backscatter detections per pulse within the gate
    daylight: Floats  # detections of daylight [1/s]; 0 without `[daylight]`
    alpha: Floats  # α, all expected detections per pulse within the gate (integral of eq 8)
    fisher: Floats  # F, information on the delay per detected photon [1/s²] (eq 9); 0 where there is no estimate
    sigma_time: Floats  # σ* = 1/√(N·F) [s], the Cramér–Rao bound of one depth frame, N being its recorded photons
    sigma_depth: Floats  # the bound of planar depth [m]
    signal_to_backscatter: Floats  # both per pulse within the gate; infinite where there is no backscatter
    background_level: Floats  # background detections per pulse and σ of the response, under the return
    outlier_probability: Floats  # of a false peak: a fit takes background for the return, `sigma_time` is not reached
    background_probability: Floats  # that a frame's pixel reports a background photon
    depth: NDArray[np.float32]  # frames, float32 `[N, H, W]` [m]; NaN for no estimate
    labels: NDArray[np.bool_]  # bool `[N, H, W]`, where a frame's pixel reports a background photon
    seed: int  # of the frames
    # When background photons arrive: the part that is flat over the gate, and the table of the rest.
    _flat_share: NDArray[np.float32]
    _table: BackscatterTable

    def __repr__(self) -> str:
        name = self.scene.source.stem if self.scene.source else "Python"
        height, width = self.truth.depth.shape
        return f"AnalyticResult({name}: {width} x {height} pixels, {len(self.depth)} depth frames, seed {self.seed})"

    def sample(
        self, frames: int, *, first: int = 0, seed: int | None = None, device: Any = None
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Frames `first` to `first + frames`: depth float32 `[frames, H, W]` [m] and labels, bool of that shape.

        A frame depends on seed and number alone, so they can be drawn in parts. `seed`: the result's if not given.
        """
        device = pick_device(device)
        shape, pixels = self.truth.depth.shape, self.truth.depth.size
        optics, ports = scene_optics(self.scene)
        speed, gate = self.scene.medium.pulse_speed, self.scene.gate
        depth, labels = np.empty((frames, *shape), np.float32), np.empty((frames, *shape), np.bool_)
        view, in_water = pixel_directions(self.scene.camera), lines_of_sight(self.scene).direction
        # No bound is worse than a guess anywhere in the gate.
        sigma = np.minimum(self.sigma_depth, gate_deviation(self.scene, in_water))
        values = (np.where(np.isnan(self.sigma_depth), np.nan, self.truth.depth), sigma, self.background_probability)
        rows = (*(one.reshape(-1) for one in values), self._flat_share, *self._table)
        inputs: list[Any] = [
            wp.array(np.ascontiguousarray(one, np.float32), dtype=kind, device=device)
            for one, kind in ((view.reshape(-1, 3), wp.vec3), *((row, wp.float32) for row in rows))
        ]
        part = max(_PART_PIXELS // pixels, 2)
        for start in range(0, frames, part):
            number = min(part, frames - start)
            drawn = sk.sample_frames(
                *inputs,
                laser=self.scene.beam.position,
                optics=optics,
                ports=ports,
                gate_paths=(gate.start * speed, gate.stop * speed),
                first_frame=first + start,
                frames=number,
                seed=self.seed if seed is None else seed,
            )
            for whole, array in zip((depth, labels), drawn, strict=True):
                whole[start : start + number] = array.numpy().reshape(number, *shape)
        return depth, labels

    def _array(self, stored: str) -> NDArray[Any]:
        """An array of the file by its name."""
        section, _, name = stored.rpartition("/")
        values: NDArray[Any] = getattr(self.truth if section == "truth" else self, name)
        return values

    def to_xarray(self) -> xarray.Dataset:
        """Maps and truth (y, x) and depth frames (frame, y, x) with coordinates and units.

        Raises `FileError`: xarray is not installed.
        """
        variables = {name: (_ARRAYS[at][0], self._array(at), *_ARRAYS[at][1:]) for name, at in _LABELLED.items()}
        axes = _coordinates(len(self.depth), self.truth.depth.shape)
        coordinates = {name: ((name,), *axes[name]) for name in ("frame", *PIXELS)}
        return labelled(variables, coordinates, {"seed": str(self.seed), "scene": self.scene.to_toml()})

    def save(self, path: str | Path, *, frames: int | None = None, device: Any = None) -> Path:
        """Writes maps, truth, frames and scene to one HDF5 file, whole or not at all; returns its path.

        Args:
            path: The file.
            frames: Number of frames to draw and write in parts, however many; default: those that the result holds.
            device: Warp device that draws them.

        Raises `FileError`: the file cannot be written.
        """
        if frames is not None:
            frames = check_integer("frames", frames, "[0, 2147483647]")
        count, shape, scene = len(self.depth) if frames is None else frames, self.truth.depth.shape, self.scene
        attributes = {
            "format": _FORMAT,
            "format_version": _FORMAT_VERSION,
            "read_me": _READ_ME,
            "version": __version__,
            "source": str(scene.source or ""),
            "seed": str(self.seed),
            "form": scene.analytic.form,
            "backscatter": scene.analytic.backscatter,
            "count_law": scene.analytic.count_law,
            "response_sigma": response_sigma(scene),
            "gate_start": scene.gate.start,
            "bin_width": scene.gate.bin_width,
            "bins": scene.gate.bins,
            "group_index": scene.medium.group_index,
        }
        with write_hdf5(path) as file:
            file.attrs.update(attributes)
            file.create_dataset("config", data=scene.to_toml())
            for name, (dimensions, _, _) in _ARRAYS.items():
                if frames is None or "frame" not in dimensions:
                    values = self._array(name)
                    file.create_dataset(name, data=values, **(PACKED if values.size else {}))
            if frames is not None:
                packed = {"chunks": (1, *shape), **PACKED} if frames else {}
                depth = file.create_dataset("depth", (frames, *shape), np.float32, **packed)
                labels = file.create_dataset("labels", (frames, *shape), np.bool_, **packed)
                part = max(1, _PART_BYTES // (5 * self.truth.depth.size))
                for first in range(0, frames, part):
                    stop = min(first + part, frames)
                    depth[first:stop], labels[first:stop] = self.sample(stop - first, first=first, device=device)
            name_dimensions(file, _coordinates(count, shape), _ARRAYS)
        return Path(path)


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

    Raises `ConfigError`: a scene that the model does not cover, or whose gate holds no return; `ArgumentError`: a truth
    or profile of the wrong shape, or with impossible values.
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
    illuminated, arrival = maps["signal"] > 0, 1e9 * maps["arrival"]
    times = arrival[illuminated] if illuminated.any() else arrival[np.isfinite(arrival)]
    within = (times >= 1e9 * scene.gate.start) & (times < 1e9 * scene.gate.stop)
    if times.size and not (maps["fisher"] > 0).any() and (illuminated.any() or not within.any()):
        raise ConfigError(
            f"gate [{scene.gate.start * 1e9:.4g}, {scene.gate.stop * 1e9:.4g}) ns holds no return; "
            f"the target's arrive from {times.min():.4g} to {times.max():.4g} ns",
            source=scene.source,
        )
    maps["background_probability"], flat = _background(scene, maps)
    result = AnalyticResult(
        scene=scene,
        truth=truth,
        **{name: values.reshape(shape) for name, values in maps.items()},
        depth=np.empty((0, *shape), np.float32),
        labels=np.empty((0, *shape), np.bool_),
        seed=seed,
        _flat_share=flat.astype(np.float32),
        _table=table,
    )
    depth, labels = result.sample(frames, device=device)
    return replace(result, depth=depth, labels=labels)


def _background(scene: Scene, maps: dict[str, Floats]) -> tuple[Floats, Floats]:
    """Probability that a pixel reports a background photon, and the part of these that is flat over the gate."""
    fraction, estimated = scene.analytic.backscatter_fraction, maps["fisher"] > 0
    if fraction is None:
        dark = (scene.detector.noise_rate + maps["daylight"]) * (scene.gate.stop - scene.gate.start)
        noise = maps["backscatter"] + dark
        flat = np.divide(dark, noise, out=np.ones_like(noise), where=noise > 0)
        return np.where(estimated, maps["outlier_probability"], 0.0), flat
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
        values = run.component("backscatter") * scene.detectable_photons_per_pulse
    else:
        values = profile
    shapes = ((bins,), (camera.height, camera.width, bins))
    values = real_array("backscatter_profile", values, np.float64, shapes=shapes, within="[0, inf)")
    return np.ascontiguousarray(values.reshape(-1, bins), np.float32)


def _check_truth(truth: Truth, scene: Scene) -> None:
    shape = (scene.camera.height, scene.camera.width)
    if truth.depth.shape != shape:
        raise ArgumentError(f"truth.depth has shape {truth.depth.shape}; the camera's {shape} is needed")
    hit = ~np.isnan(truth.depth)
    if not hit.any():
        raise ArgumentError("truth.depth is NaN in every pixel: nothing is in view")
    for name, interval in (("depth", "(0, inf) m"), ("range", "(0, inf) m"), ("reflectance", "[0, 1]")):
        values = getattr(truth, name)[hit]
        if not (possible := Interval.read(interval).holds(values)).all():
            wrong = int(np.argmin(possible))
            row, column = np.argwhere(hit)[wrong]
            raise ArgumentError(f"truth.{name} = {values[wrong]} at pixel ({row}, {column}) is outside {interval}")
    if not np.isfinite(truth.normal[hit]).all():
        raise ArgumentError("truth.normal is not finite where truth.depth is")


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class AnalyticFile:
    """A file of the analytic simulator; depth frames are read when they are asked for, the rest is in memory."""

    path: Path  # the file
    frames: int  # their number
    seed: int  # of the frames
    scene: Scene  # the scene
    truth: Truth  # depth, range, normal and reflectance
    maps: dict[str, NDArray[np.float64]]  # name → float64 `[H, W]`, as the attributes of `AnalyticResult`

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Opens a file that `AnalyticResult.save` wrote. Raises `FileError`."""
        with read_hdf5(path, _FORMAT, version=_FORMAT_VERSION) as file:
            scene = Scene.from_toml(file.text("config"), source=file.text_attribute("source", "") or None)
            shape = scene.camera.height, scene.camera.width
            sides = dict(zip((*PIXELS, "axis"), (*shape, 3), strict=True))
            arrays: dict[str, dict[str, Any]] = {"maps": {}, "truth": {}}
            for stored, (dimensions, _, _) in _ARRAYS.items():
                section, _, name = stored.rpartition("/")
                if section:
                    kind = np.float64 if section == "maps" else np.float32
                    arrays[section][name] = file.array(stored, kind, tuple(sides[side] for side in dimensions))
            count = len(file.stored("depth", np.float32, (None, *shape)))
            file.stored("labels", np.bool_, (count, *shape))
            return cls(
                path=Path(path),
                frames=count,
                seed=file.integer("seed"),
                scene=scene,
                truth=Truth(**arrays["truth"]),
                maps=arrays["maps"],
            )

    def __repr__(self) -> str:
        height, width = self.truth.depth.shape
        return f"AnalyticFile({self.path}: {self.frames} depth frames, {width} x {height} pixels)"

    def depth(self, frame: int | None = None) -> NDArray[np.float32]:
        """Depth of one frame `[H, W]`, or of all `[frames, H, W]` [m]; NaN for no estimate."""
        return self._read("depth", np.float32, frame)

    def labels(self, frame: int | None = None) -> NDArray[np.bool_]:
        """Whether pixels report a background photon, `[H, W]` or `[frames, H, W]`."""
        return self._read("labels", np.bool_, frame)

    def _read(self, name: str, kind: Any, frame: int | None) -> NDArray[Any]:
        if frame is not None and not 0 <= frame < self.frames:
            raise ArgumentError(f"frame = {frame} is outside [0, {self.frames}), the frames of {self.path}")
        with read_hdf5(self.path, _FORMAT) as file:
            return np.asarray(
                file.stored(name, kind, (self.frames, *self.truth.depth.shape))[... if frame is None else frame]
            )
