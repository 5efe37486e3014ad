"""What the analytic simulator gives: maps of a scene, and depth frames drawn from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.model import BackscatterTable, Map
from spadwarp.analytic.optics import scene_optics
from spadwarp.device import pick_device
from spadwarp.errors import kernel_errors
from spadwarp.result.result import Truth
from spadwarp.scene import Scene
from spadwarp.scene.sight import gate_deviation, lines_of_sight, pixel_directions

__all__ = ["AnalyticResult", "background_photons"]

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
