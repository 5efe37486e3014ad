"""Reconstruction: the light that few photons left noisy, from what is known of the scene without noise.

1. Truth rays within each pixel, with the laser's footprint, shadows, cosines and attenuation, give the ballistic light
   up to a factor. Light that scattered forward on its way is this light later and blurred, or lights the surfaces
   evenly; backscatter ends at the first surface. Non-negative least squares of such terms predict each component.
2. The ratio of the tallies to the prediction is smooth. It is averaged over windows of pixels and bins, the bins
   counted from the pixel's own true path, and the windows are blended by their squared errors.
3. These come from two independent halves of the photons: the product of the halves' residuals has the squared bias as
   its expectation, and the squares of their differences the variance (dual buffers: Rousselle et al. 2012; regression
   on noise-free features: Bitterli et al. 2016; kernels in time: Jarabo et al. 2014).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.result import Reconstruction, Result
from spadwarp.scene import Scene
from spadwarp.scene.camera import image_tangents
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport.model import build_model, trace_rays

__all__ = ["reconstruct"]

Cube = NDArray[np.float32]

_RAYS = 64  # within a pixel
_FINE = 4  # parts of a bin: light that is less than a bin late moves to the next
# Delays [fine bins] of direct light and of surfaces in even light; of blurred light [bins], by the blur's radius.
_DELAYS = ((0, 1), (1, 2), (2, 4), (4, 8), (8, 16), (16, 32), (32, 64), (64, 192))
_EVEN_DELAYS = ((0, 4), (4, 16), (16, 64), (64, 256))
_BLURRED_DELAYS = ((0, 1), (1, 3), (3, 8), (8, 20), (20, 50))
_BLURS = (1, 3, 8, 20)  # of two boxes [pixels]
# Radii of the windows, in pixels and bins, and of the one over which their errors are averaged.
_WINDOWS = ((0, 0), (0, 1), (1, 0), (1, 1), (1, 4), (2, 0), (2, 2), (4, 1), (4, 4), (8, 1), (8, 8), (16, 3), (32, 16))
_AROUND = (3, 2)
_FLOOR = 1e-3  # of the mean: prediction where none is expected


def reconstruct(result: Result, *, device: str | None = None) -> Result:
    """The result with `Result.reconstruction`: its light without most of the noise; tallies stay as they are.

    Of the histogram by component; derivatives and polarised channels are left as they are. Takes about 100 bytes a bin.

    Args:
        result: With two halves, `Result.halves`, and a scene whose files are still there.
        device: "cpu" or "cuda:0"; by default as `simulate` picks it.

    Raises `ConfigError`: fewer than two batches of photons; what `simulate` raises of the scene's files.
    """
    halves = np.stack([half.tallies * half.tally_value[..., None] for half in result.halves], dtype=np.float32)
    return replace(result, reconstruction=reconstructed(result, halves, pick_device(device)))


def reconstructed(result: Result, halves: Cube, device: wp.Device) -> Reconstruction:
    """`reconstruct` of two independent halves, `[2, 3, H, W, T]`, each of which expects the result's histogram."""
    scene, gate = result.scene, result.scene.gate
    bins, height, width = gate.bins, scene.camera.height, scene.camera.width
    direct, even, delay = _known_light(scene, result.focus_distance, device)
    visible = 1.0 - np.minimum(np.cumsum(delay, axis=-1, dtype=np.float32), 1.0)
    fine = [wp.array(part.reshape(height * width, -1), dtype=float, device=device) for part in (direct, even)]
    ballistic = _delayed(fine[0], 0, 1, _FINE, bins).numpy().reshape(height, width, bins)
    path = np.nan_to_num((result.true_path() / scene.medium.pulse_speed - gate.start) / gate.bin_width, nan=bins)
    aligned, absolute = np.clip(np.rint(path).astype(int), 0, bins), np.zeros((height, width), int)
    forward = _forward(fine, ballistic, 0.5 * (halves[0, 1] + halves[1, 1]), device)
    parts = (ballistic, forward, _backscatter(visible, 0.5 * (halves[0, 2] + halves[1, 2])))
    found, squares = np.zeros(halves.shape[1:], np.float32), np.zeros(halves.shape[2:], np.float32)
    for k, (predicted, start) in enumerate(zip(parts, (absolute, aligned, absolute), strict=True)):
        total = 0.5 * (halves[0, k].sum(dtype=np.float64) + halves[1, k].sum(dtype=np.float64))
        if total > 0.0:
            predicted = predicted * (total / max(predicted.sum(dtype=np.float64), 1e-300))
            light, square = _smoothed(halves[0, k], halves[1, k], predicted, start, device)
            raw = result.tallies[k].sum(axis=-1, dtype=np.float64) * result.tally_value
            found[k] = light * (raw.sum() / light.sum(dtype=np.float64))
            squares += square
    return Reconstruction(histogram=found, error=np.sqrt(squares))


def _known_light(scene: Scene, focus: float | None, device: wp.Device) -> tuple[Cube, Cube, Cube]:
    """From truth rays, `[H, W, fine bin]`: ballistic light and surfaces in even light; and the part of each pixel whose
    surface is there, `[H, W, T]`."""
    camera, gate, beam, count = scene.camera, scene.gate, scene.beam, scene.gate.bins * _FINE
    model = build_model(scene, device, build_mesh(scene), camera=False)
    height, width = camera.height, camera.width
    light = np.zeros((2, height * width * count), np.float32)
    if model.mesh is None:
        covered = np.zeros((height, width, gate.bins), np.float32)
        return light[0].reshape(height, width, -1), light[1].reshape(height, width, -1), covered
    corners = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    first = np.arange(height * width).reshape(height, width) * count
    covered = np.zeros(height * width * gate.bins, np.float32)
    for k in range(_RAYS):
        place = (k + 0.5) / _RAYS, (k + 0.5) * 0.6180339887 % 1.0
        view = np.concatenate([image_tangents(camera, corners + place), np.ones((height, width, 1))], axis=-1)
        lens = np.zeros(3)
        if camera.port is None and focus is not None and not camera.pinhole:
            radius, angle = camera.aperture_radius * math.sqrt((k * 0.7548776662) % 1.0), 2.399963 * k * 7.0
            lens = radius * np.array([math.cos(angle), math.sin(angle), 0.0])
            view = view - lens / focus if math.isfinite(focus) else view
        slant = np.linalg.norm(view, axis=-1, keepdims=True)
        lines = lines_of_sight(scene, view / slant)
        along, normal, reflectance = trace_rays(model, lines.start + lens, lines.direction)
        point = lines.start + lens + along[..., None] * lines.direction
        direction, way, path = lines.light_at(point)
        path = path + along + lines.delay
        source = np.nan_to_num(point - direction * way[..., None], nan=1e9)
        lit = trace_rays(model, source, np.nan_to_num(direction, nan=1.0))[0] > way * (1.0 - 1e-4) - 1e-3
        seen = reflectance * np.exp(-scene.medium.extinction * path) / slant[..., 0] ** 4
        strength = np.maximum(-(direction * normal).sum(axis=-1), 0.0) / way**2
        at = (path / scene.medium.pulse_speed - gate.start) / gate.bin_width
        inside = np.isfinite(seen) & np.isfinite(strength) & (at < gate.bins)
        covered += np.bincount(
            ((first // _FINE) + np.maximum(at, 0).astype(np.int64, copy=False))[inside]
            if at.dtype.kind == "i"
            else (first[inside] // _FINE + np.maximum(at[inside], 0.0).astype(np.int64)),
            minlength=covered.size,
        )
        inside &= at >= 0.0
        fine = first[inside] + (at[inside] * _FINE).astype(np.int64)
        even = seen[inside]
        np.add.at(light[0], fine, even * (strength * lit * _beam(beam, direction))[inside])
        np.add.at(light[1], fine, even)
    shape = (height, width, count)
    return light[0].reshape(shape), light[1].reshape(shape), (covered / _RAYS).reshape(height, width, gate.bins)
