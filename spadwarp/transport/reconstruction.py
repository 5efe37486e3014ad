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
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.result import COMPONENTS, Reconstruction, Result
from spadwarp.scene import Scene
from spadwarp.scene.camera import image_tangents
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport.model import build_model, trace_rays
from spadwarp.values import ConfigError

__all__ = ["known_light", "reconstruct"]

Cube = NDArray[np.float32]

# Truth rays of a pixel, 8 x 8, each of another column and another row of a finer grid, in an order that leaves columns
# and rows without correlation (correlated multi-jittered sampling: Kensler 2013).
_ORDER = np.array([4, 2, 6, 0, 7, 1, 5, 3])
_LENS = 4  # times as many rays where they meet the lens at different points
_STEPS = np.array([0.7548776662, 0.5698402910])  # additive sequence in two dimensions (Roberts 2018)
_FINE = 4  # parts of a bin: light that is less than a bin late moves to the next
# Delays [fine bins] of direct light and of surfaces in even light; of blurred light [bins], by the blur's radius.
_DELAYS = ((0, 1), (1, 2), (2, 4), (4, 8), (8, 16), (16, 32), (32, 64), (64, 192))
_EVEN_DELAYS = ((0, 4), (4, 16), (16, 64), (64, 256))
_BLURRED_DELAYS = ((0, 1), (1, 3), (3, 8), (8, 20), (20, 50))
_BLURS = (1, 3, 8, 20)  # of two boxes [pixels]
# Radii of the windows, in pixels and bins, and of the one over which their errors are averaged.
_WINDOWS = ((0, 0), (1, 0), (2, 0), (4, 0), (8, 0), (16, 0), (32, 0), (4, 1), (8, 2), (32, 4))
_AROUND = (16, 1)
_FLOOR = 1e-3  # of the mean: forward-scattered light where none is predicted
_ROUNDING = 1e-9  # of the most: what sums of rises and falls leave where no ray sees light


def reconstruct(result: Result, *, device: str | None = None) -> Result:
    """The result with `Result.reconstruction`: its light without most of the noise; tallies stay as they are.

    Of the histogram by component; derivatives and polarised channels are left as they are. Takes about 100 bytes a bin.

    Args:
        result: With two halves, `Result.halves`, and a scene whose files are still there.
        device: "cpu" or "cuda:0"; by default as `simulate` picks it.

    Raises `ConfigError`: fewer than two batches of photons, the surface of the sea, a moving scan; what `simulate`
    raises of the scene's files.
    """
    from scipy.ndimage import distance_transform_edt

    halves = np.stack([half.tallies * half.tally_value[..., None] for half in result.halves], dtype=np.float32)
    scene, gate, pixels = result.scene, result.scene.gate, result.truth.depth.size
    if not scene.has_straight_sight:
        raise ConfigError("reconstruct knows neither [surface] nor scan.mode = 'trajectory'", source=scene.source)
    if (focus := result.focus_distance) is not None:  # lens points matter where a point's image is half a pixel wide
        blur = scene.camera.aperture_radius * np.abs(1.0 / focus - 1.0 / result.truth.depth)
        focus = focus if np.nanmax(blur, initial=0.0) > 0.25 * scene.camera.pixel_tangent else None
    chosen = pick_device(device)
    direct, even, covered = known_light(scene, focus, chosen)
    fine: list[Any] = [wp.array(part.reshape(pixels, -1), dtype=float, device=chosen) for part in (direct, even)]
    ballistic = _delayed(fine[0], (0, 1), _FINE).numpy().reshape(covered.shape)
    # Scattered light of a pixel without a target is that of the nearest target.
    start = (result.true_path() / scene.medium.pulse_speed - gate.start) / gate.bin_width
    nearest = distance_transform_edt(np.isnan(start), return_distances=False, return_indices=True)
    aligned = np.clip(np.nan_to_num(np.rint(start[tuple(nearest)])), 0, gate.bins).astype(np.int64)
    mean = halves.mean(axis=0)
    predictions = ballistic, _forward(fine[0], fine[1], ballistic, mean[1]), _backscatter(covered, mean[2])
    found = np.zeros_like(mean)

    def smooth(k: int) -> Cube:
        if not (result.tallies[k].any() and predictions[k].any()):
            found[k] = mean[k]
            return np.zeros_like(mean[k])
        predicted = predictions[k] * np.float32(mean[k].sum(dtype=np.float64) / predictions[k].sum(dtype=np.float64))
        predicted += np.float32(k == 1) * _FLOOR * predicted.mean()
        start = aligned * (k < 2)
        light, square = _smoothed(halves[0, k], halves[1, k], predicted, start, chosen)
        # Windows are chosen by the same noise, which loses rare light: each aligned bin gets its own light back.
        rows = np.arange(gate.bins) + (start.max() - start)[..., None]
        traced, kept = (np.bincount(rows.ravel(), cube.ravel()) for cube in (result.component(COMPONENTS[k]), light))
        found[k] = light * np.divide(traced, kept, out=np.zeros_like(kept), where=kept > 0.0)[rows]
        return square

    with ThreadPoolExecutor(1 if chosen.is_cuda else 2) as threads:
        squares = sum(threads.map(smooth, (1, 0, 2)))
    return replace(result, reconstruction=Reconstruction(histogram=found, error=np.sqrt(squares)))


def known_light(scene: Scene, focus: float | None, device: wp.Device) -> tuple[Cube, Cube, Cube]:
    """From truth rays: ballistic light and surfaces in even light, `[H, W, fine bin]`; the part of each pixel whose
    surface has light of a bin or of an earlier one, `[H, W, T]`."""
    camera, gate, count = scene.camera, scene.gate, scene.gate.bins * _FINE
    model, shape = build_model(scene, device, build_mesh(scene), camera=False), (camera.height, camera.width)
    row = count + 2  # what comes after the gate
    first = np.arange(shape[0] * shape[1]).reshape(shape) * row
    hits, rises = np.zeros(first.size * row), np.zeros((2, first.size * row))
    radius = 0.0 if camera.pinhole or camera.port is not None or focus is None else camera.aperture_radius
    places = list(_places(radius))
    for place, lens in places if model.mesh is not None else ():
        corners = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1)
        view = np.concatenate([image_tangents(camera, corners + place), np.ones((*shape, 1))], axis=-1)
        view = view - lens / (focus or math.inf)
        slant = np.linalg.norm(view, axis=-1, keepdims=True)
        lines = lines_of_sight(scene, view / slant)
        _, along, normal, reflectance = trace_rays(model, lines.start + lens, lines.direction, shape)
        point = lines.start + lens + along[..., None] * lines.direction
        direction, way, path = lines.light_at(point)
        path = path + along + lines.delay
        _, free, _, _ = trace_rays(model, point - direction * way[..., None], direction, shape)
        lit = ~(free < way * (1.0 - 1e-4) - 1e-3) * _footprint(scene, direction)
        lit *= np.maximum(-(direction * normal).sum(axis=-1), 0.0) / way**2
        even = reflectance * np.exp(-scene.medium.extinction * path) / slant[..., 0] ** 4
        at = (path / scene.medium.pulse_speed - gate.start) / scene.gate.bin_width * _FINE
        # Each ray stands for the part of the surface around it, whose times differ along both axes of the image.
        towards = (normal * lines.direction).sum(axis=-1)[..., None]
        slopes = []
        for unit in np.eye(3)[:2]:
            axis = unit * camera.pixel_tangent / (slant * len(_ORDER))
            moved = axis - lines.direction * (normal * axis).sum(axis=-1, keepdims=True) / np.minimum(towards, -1e-3)
            along_sight, along_light = (moved * lines.direction).sum(axis=-1), (moved * direction).sum(axis=-1)
            slopes.append(along * (along_sight + along_light) * _FINE / (scene.medium.pulse_speed * gate.bin_width))
        wide, narrow = np.maximum(*np.abs(slopes)), np.minimum(*np.abs(slopes))
        inside = np.isfinite(even + lit + wide)
        hits += np.bincount(first[inside] + np.clip(at[inside], 0, row - 1).astype(np.int64), minlength=hits.size)
        start, width = at[inside], np.maximum(wide[inside], 1e-3)
        for sign, moved in ((1.0, -0.5), (-1.0, 0.5)):  # evenly over the width: rises at its start, ends at its stop
            for part in (-0.25, 0.25):
                edge = np.clip(start + moved * width + part * narrow[inside], 0.0, count)
                whole = edge.astype(np.int64)
                for step, share in ((0, 1.0 - edge + whole), (1, edge - whole)):
                    for rise, light in zip(rises, (even * lit, even), strict=True):
                        np.add.at(rise, first[inside] + whole + step, (0.5 * sign / width) * share * light[inside])
    covered = np.cumsum(hits.reshape(*shape, row), axis=-1)[..., _FINE - 1 : count : _FINE] / len(places)
    sums = (np.cumsum(rise.reshape(*shape, row), axis=-1)[..., :count] for rise in rises)
    cubes = *(np.where(part > _ROUNDING * part.max(), part, 0.0) for part in sums), covered
    return tuple(cube.astype(np.float32) for cube in cubes)  # type: ignore[return-value]


def _places(radius: float) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """Places within a pixel, and points of a lens of this radius [m] that is not behind a port [m]."""
    side = len(_ORDER)
    for k in range(side**2 * (_LENS if radius else 1)):
        cell = np.array([k % side, k // side % side])
        u, v = (k + 0.5) * _STEPS % 1.0
        r, angle = radius * math.sqrt(u), 2.0 * math.pi * v
        yield (
            (cell + (_ORDER[cell[::-1]] + 0.5) / side) / side,
            np.array([r * math.cos(angle), r * math.sin(angle), 0.0]),
        )


def _footprint(scene: Scene, direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiant intensity of the laser towards unit vectors, up to a factor; of beams that are no cones 1."""
    beam = scene.beam
    cosine = np.maximum((direction * np.asarray(beam.axis)).sum(axis=-1), 1e-6)
    if scene.scan.mode != "none" or beam.profile not in ("uniform_cone", "gaussian"):
        return np.ones(cosine.shape)
    if beam.profile == "uniform_cone":
        return (cosine >= math.cos(beam.half_angle)).astype(np.float64)
    return np.exp(-2.0 * (cosine**-2 - 1.0) / math.tan(beam.half_angle) ** 2) / cosine**3


def _delayed(fine: wp.array, delay: tuple[int, int], per_bin: int) -> wp.array:
    """Light `[pixel, fine bin]` by a delay of so many fine bins, in bins."""
    late = wp.empty((fine.shape[0], fine.shape[1] // per_bin), dtype=float, device=fine.device)
    wp.launch(sk.delay_kernel, dim=fine.shape[0], inputs=[fine, *delay, per_bin, late], device=fine.device)
    return late


def _forward(direct: Any, even: Any, ballistic: Cube, light: Cube) -> Cube:
    """Prediction of forward-scattered light from its tallies."""
    from scipy.ndimage import uniform_filter
    from scipy.optimize import nnls

    terms = [_delayed(direct, delay, _FINE).numpy() for delay in _DELAYS]
    terms += [_delayed(even, delay, _FINE).numpy() for delay in _EVEN_DELAYS]
    for radius in _BLURS:
        box = {"size": (2 * radius + 1, 2 * radius + 1, 1), "mode": "constant"}
        blurred = uniform_filter(uniform_filter(ballistic, **box), **box)
        pixels: Any = wp.array(blurred.reshape(direct.shape[0], -1), dtype=float, device=direct.device)
        terms += [_delayed(pixels, delay, 1).numpy() for delay in _BLURRED_DELAYS]
    sums = [float(term.sum(dtype=np.float64)) for term in terms]
    rows = np.stack([term.ravel() / total for term, total in zip(terms, sums, strict=True) if total > 0.0])
    # Weights: the variance of light is about proportional to it.
    level = uniform_filter(light, (7, 7, 5), mode="constant").ravel()
    root = 1.0 / np.sqrt(level + 0.02 * level.max() + 1e-300)
    rows *= root
    # Least squares by the products of the terms, of which float32 leaves no more than its rounding.
    values, vectors = np.linalg.eigh((rows @ rows.T).astype(np.float64))
    scale = np.sqrt(np.maximum(values, np.finfo(np.float32).eps * values[-1]))[:, None]
    factors, _ = nnls(scale * vectors.T, (vectors.T / scale) @ (rows @ (light.ravel() * root)))
    return ((factors.astype(np.float32) @ rows) / root).reshape(light.shape)


def _backscatter(covered: Cube, light: Cube) -> Cube:
    """Prediction of backscatter: of each bin the mean of pixels before their surface, and of those behind it."""
    open_ = 1.0 - np.minimum(covered, 1.0)
    parts = [(part, (part * light).sum(axis=(0, 1)), part.sum(axis=(0, 1))) for part in (open_, 1.0 - open_)]
    return sum(part * (total / np.maximum(pixels, 1e-6)) for part, total, pixels in parts)  # type: ignore[return-value]


def _smoothed(first: Cube, second: Cube, predicted: Cube, start: Any, device: wp.Device) -> tuple[Cube, Cube]:
    """Light of a component and its squared error `[H, W, T]`. `start`: bin from which those of a pixel are counted."""
    bins, shift = first.shape[-1], int(start.max()) - start
    rows = np.arange(bins) + shift[..., None]
    cubes = [first, second, 0.25 * (first - second) ** 2, predicted]
    shape = (*first.shape[:2], bins + int(shift.max()))
    aligned = np.zeros((*shape, 4), np.float32)
    for k, cube in enumerate(cubes):
        np.put_along_axis(aligned[..., k], rows, cube, axis=-1)
    scale = float(predicted.max())  # float32 holds the squares of what is near 1
    aligned *= np.array([1.0, 1.0, 1.0 / scale, 1.0], np.float32) / scale
    values: Any = wp.array(aligned, dtype=wp.vec4, device=device)
    sums, work, risk, around, blended = (wp.zeros(shape, dtype=wp.vec4, device=device) for _ in range(5))
    for window in _WINDOWS:
        sk.window_sums(values, window, work, sums)
        wp.launch(sk.estimate_kernel, dim=shape, inputs=[values, sums, risk], device=device)
        sk.window_sums(risk, _AROUND, work, around)
        wp.launch(sk.blend_kernel, dim=shape, inputs=[values, sums, around, blended], device=device)
    wp.launch(sk.combine_kernel, dim=shape, inputs=[values, blended, sums], device=device)
    sk.window_sums(sums, _AROUND, work, around)
    found, own, near = blended.numpy(), sums.numpy()[..., 1:3], around.numpy()
    # One standard error more than the halves show. A window holds its own voxel: differences of float32 leave less.
    bias = np.maximum(near[..., 0] + np.sqrt(np.maximum(near[..., 3], 0.0) * own[..., 1]), 0.0)
    bias *= own[..., 1] / np.maximum(np.maximum(near[..., 2], own[..., 1]), 1e-30)
    light = 0.5 * scale * np.maximum(found[..., 0] + found[..., 1], 0.0)  # differences of float32 end below 0
    square = scale**2 * (own[..., 0] + bias)
    return tuple(np.take_along_axis(cube, rows, axis=-1) for cube in (light, square))  # type: ignore[return-value]
