"""Reconstruction: the light that few photons left noisy, from what is known of the scene without noise.

1. Truth rays within each pixel, with the laser's footprint, shadows, cosines and attenuation, give the ballistic light
   up to a factor. Light that scattered forward on its way is this light, or that of surfaces lit from all around the
   laser, later and blurred, and none comes before the shortest way by any surface; backscatter ends at the first one.
   Non-negative least squares of such terms predict each component.
2. The ratio of the tallies to the prediction is smooth. It is averaged over windows of pixels and rows of bins, counted
   from the pixel's own true path and wider far from it, and the windows are blended by their squared errors.
3. These come from two independent halves of the photons: the product of the halves' residuals has the squared bias as
   its expectation, and the squares of their differences the variance (dual buffers: Rousselle et al. 2012; regression
   on noise-free features: Bitterli et al. 2016; kernels in time: Jarabo et al. 2014).
"""

from __future__ import annotations

import bisect
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.device import pick_device
from spadwarp.mesh import TriangleMesh, build_mesh
from spadwarp.result import Reconstruction, Result
from spadwarp.scene import Scene
from spadwarp.scene.camera import image_tangents
from spadwarp.scene.scene import camera_port
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport.model import build_model, trace_rays
from spadwarp.transport.simulation import DEFAULT_TIME
from spadwarp.values import ConfigError, check_real

__all__ = ["known_light", "reconstruct", "tracing_time"]

Cube = NDArray[np.float32]

# Truth rays of a pixel, 8 x 8, each of another column and another row of a finer grid, in an order that leaves columns
# and rows without correlation (correlated multi-jittered sampling: Kensler 2013).
_ORDER = np.array([4, 2, 6, 0, 7, 1, 5, 3])
_LENS = 4  # times as many rays where they meet the lens at different points
_STEPS = np.array([0.7548776662, 0.5698402910])  # additive sequence in two dimensions (Roberts 2018)
_RAYS = 1 << 16  # at a time
_FINE = 4  # parts of a bin: light that is less than a bin late moves to the next
# Delays of direct light [fine bins], and of light blurred [bins] by boxes of these radii [pixels] or the whole image.
_DELAYS = ((0, 1), (1, 2), (2, 4), (4, 8), (8, 16), (16, 64))
_BLURRED_DELAYS = ((0, 1), (1, 3), (3, 8), (8, 20), (20, 50), (50, 150))
_BLURS = (0, 2, 8, None)
_DEEPEST = 80.0  # optical depth whose exponential float32 holds
_ROW = 8  # a row of bins is as wide as this part of its distance from the true path
# Radii of the windows, in pixels and rows, and of the one over which their errors are averaged.
_WINDOWS = ((0, 0), (1, 0), (2, 0), (4, 0), (8, 0), (16, 0), (32, 0), (4, 1), (8, 2), (32, 4))
_AROUND = ((3, 1), (16, 1))
_ROW_WINDOWS, _ROW_AROUND = tuple((0, reach) for reach in (0, 1, 2, 4, 8, 16)), ((0, 8),)  # of sums over all pixels
_COST = 1e-6, 5e-8  # seconds that a bin takes on two cores, on a GPU
_FLOOR, _SMOOTH = 0.02, 15  # forward-scattered light where none is predicted, of the mean over pixels and these bins


def tracing_time(scene: Scene, time: float | None, device: str | None = None) -> float:
    """Seconds for the photons of a run of so many [s], by default 60, that `reconstruct` ends; at least half."""
    seconds = DEFAULT_TIME if time is None else check_real("time", time, "(0, 1e9] s")
    bins = scene.camera.height * scene.camera.width * scene.gate.bins
    return max(seconds - bins * _COST[pick_device(device).is_cuda], 0.5 * seconds)


class KnownLight(NamedTuple):
    """What truth rays know, arrays of the device by pixel: light up to a factor, in fine bins."""

    direct: Any  # ballistic light
    scattered: Any  # the same times the scattering on its way, as light that scattered forward has
    even: Any  # surfaces in light from all around the laser
    span: Any  # first and last fine bin with light
    covered: Any  # the part of a pixel whose surface has light of a bin or of an earlier one, by bin
    first: int  # the first bin that light of any surface can reach


def reconstruct(result: Result, *, device: str | None = None) -> Result:
    """The result with `Result.reconstruction`: its light without most of its noise; tallies stay as they are.

    Of the histogram by component; derivatives and polarised channels are left as they are. Takes about 400 bytes a bin.

    Args:
        result: With two halves, `Result.halves`, and a scene whose files are still there.
        device: "cpu" or "cuda:0"; by default as `simulate` picks it.

    Raises `ConfigError`: fewer than two batches of photons, the surface of the sea, a moving scan; what `simulate`
    raises of the scene's files.
    """
    from scipy.ndimage import distance_transform_edt, uniform_filter

    halves, scene, gate = result.halves, result.scene, result.scene.gate
    if not scene.has_straight_sight:
        raise ConfigError("reconstruct knows neither [surface] nor scan.mode = 'trajectory'", source=scene.source)
    if (focus := result.focus_distance) is not None:  # lens points matter where a point's image is half a pixel wide
        blur = scene.camera.aperture_radius * np.abs(1.0 / focus - 1.0 / result.truth.depth)
        focus = focus if np.nanmax(blur, initial=0.0) > 0.25 * scene.camera.pixel_tangent else None
    chosen = pick_device(device)
    known = known_light(scene, focus, chosen)
    # Scattered light of a pixel without a target is that of the nearest target.
    start = (result.true_path() / scene.medium.pulse_speed - gate.start) / gate.bin_width
    nearest = distance_transform_edt(np.isnan(start), return_distances=False, return_indices=True)
    aligned = np.clip(np.nan_to_num(np.rint(start[tuple(nearest)])), 0, gate.bins).astype(np.int64)
    bins = _Rows(np.zeros_like(aligned), np.arange(gate.bins + 1), gate.bins, chosen)
    rows = _Rows(aligned, _edges(-int(aligned.max()), gate.bins - int(aligned.min())), gate.bins, chosen)
    plain = _Rows(np.zeros_like(aligned), _edges(0, gate.bins), gate.bins, chosen)
    ballistic = bins.delayed(known.direct, known.span, (0, 1), _FINE).numpy().reshape(bins.shape)
    share = halves[0].photons / result.photons
    found = np.zeros((3, *bins.shape), np.float32)

    def smooth(k: int) -> Cube:
        parts = [(half.tallies[k] * half.tally_value[..., None]).astype(np.float32) for half in halves]
        mean = np.float32(share) * parts[0] + np.float32(1.0 - share) * parts[1]
        if not mean.any():
            return mean
        if k == 1:
            predicted = _forward(known, ballistic, rows, bins, mean)
        else:
            predicted = _backscatter(known.covered.numpy().reshape(mean.shape), mean) if k else ballistic
        predicted = predicted * np.float32(mean.sum(dtype=np.float64) / max(predicted.sum(dtype=np.float64), 1e-300))
        if k < 2:
            predicted += np.float32(k * _FLOOR) * uniform_filter(mean.mean(axis=(0, 1)), _SMOOTH)
            predicted[..., : known.first] = 0.0
        found[k], square = _smoothed(parts, mean, predicted, rows if k < 2 else plain, scattered=k > 0)
        return square

    with ThreadPoolExecutor(1 if chosen.is_cuda else 2) as threads:
        squares = sum(threads.map(smooth, (1, 0, 2)))
    return replace(result, reconstruction=Reconstruction(histogram=found, error=np.sqrt(squares)))


def known_light(scene: Scene, focus: float | None, device: wp.Device) -> KnownLight:
    """From truth rays, also of a lens with this focus [m]."""
    camera, gate, mesh = scene.camera, scene.gate, build_mesh(scene)
    model, pixels = build_model(scene, device, mesh, camera=False), camera.height * camera.width
    light: Any = wp.zeros((pixels, 3, gate.bins * _FINE), dtype=float, device=device)  # strides are 32-bit
    covered = wp.zeros((pixels, gate.bins), dtype=float, device=device)
    span: Any = wp.zeros(pixels, dtype=wp.vec2i, device=device)
    known = KnownLight(light[:, 0], light[:, 1], light[:, 2], span, covered, _first_bin(scene, mesh))
    radius = 0.0 if camera.pinhole or camera.port is not None or focus is None else camera.aperture_radius
    places, lens = (part[:, None, None] for part in _places(radius))
    height = max(1, _RAYS // (len(places) * camera.width))

    def add(first: int) -> None:
        """Rays of rows of the image from this one on."""
        corners = np.stack(
            np.meshgrid(np.arange(camera.width), np.arange(first, min(first + height, camera.height))), -1
        )
        rays = _trace(scene, model, corners + places, lens, focus)
        shape = (len(places), corners.shape[0] * camera.width)
        inputs: list[Any] = [
            wp.array(part.reshape(*shape, *part.shape[3:]), dtype=dtype, device=device)
            for part, dtype in zip(rays, (wp.float64, wp.vec2d, wp.vec3), strict=True)
        ]
        outputs = [first * camera.width, light, known.span, known.covered]
        wp.launch(sk.deposit_kernel, dim=shape[1], inputs=inputs, outputs=outputs, device=device)

    starts = range(0, camera.height, height) if model.mesh is not None else ()
    for start in starts[:1]:
        add(start)  # which loads the kernels
    with ThreadPoolExecutor(1 if device.is_cuda else 2) as threads:
        list(threads.map(add, starts[1:]))
    return known


def _trace(scene: Scene, model: sk.Model, places: Any, lens: Any, focus: float | None) -> tuple[Any, Any, Any]:
    """Of rays through places of the image and points of the lens `[ray, H, W]`: time [fine bin], NaN for none, its
    widths along both axes of the image, and three kinds of light as in `KnownLight`."""
    camera, gate, shape = scene.camera, scene.gate, places.shape[:-1]
    view = np.concatenate([image_tangents(camera, places), np.ones((*shape, 1))], axis=-1)
    view -= lens / (focus or math.inf)
    slant = np.linalg.norm(view, axis=-1, keepdims=True)
    lines, flat = lines_of_sight(scene, view / slant), (shape[0] * shape[1], shape[2])
    start = lines.start + lens

    def trace(origins: Any, directions: Any) -> list[Any]:
        found = trace_rays(model, origins.reshape(*flat, 3), directions.reshape(*flat, 3), flat)[1:]
        return [part.reshape(*shape, *part.shape[2:]) for part in found]

    along, normal, reflectance = trace(start, lines.direction)
    point = start + along[..., None] * lines.direction
    direction, way, path = lines.light_at(point)
    begin = point - direction * way[..., None]
    free = trace(begin, direction)[0]
    lit = ~(free < way * (1.0 - 1e-4) - 1e-3) * _footprint(scene, direction)
    cosine = -(direction * normal).sum(axis=-1)
    lit *= np.maximum(cosine, 0.0) / way**2
    depth = scene.optical_depth(start, point) + scene.optical_depth(begin, point)
    # Light that scattered on its way comes from around the laser: a radiance like the cosine to its direction.
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    surface = reflectance * np.exp(-depth) / slant[..., 0] ** 4
    even = surface * (np.sin(angle) + (math.pi - angle) * np.cos(angle)) / math.pi
    ballistic = surface * lit
    scattered = ballistic * np.expm1(np.minimum(depth * scene.medium.range.albedo, _DEEPEST))
    fine = _FINE / (scene.medium.pulse_speed * gate.bin_width)
    time = (path + along + lines.delay) * fine - gate.start / gate.bin_width * _FINE
    # Each ray stands for the part of the surface around it, whose times differ along both axes of the image.
    towards = (normal * lines.direction).sum(axis=-1)[..., None]
    slopes = []
    for unit in np.eye(3)[:2]:
        axis = unit * camera.pixel_tangent / (slant * len(_ORDER))
        moved = axis - lines.direction * (normal * axis).sum(axis=-1, keepdims=True) / np.minimum(towards, -1e-3)
        slopes.append(along * (moved * (lines.direction + direction)).sum(axis=-1) * fine)
    wide, narrow = np.maximum(*np.abs(slopes)), np.minimum(*np.abs(slopes))
    time[~np.isfinite(even + lit + wide)] = np.nan
    return time, np.stack([np.maximum(wide, 1e-3), narrow], axis=-1), np.stack([ballistic, scattered, even], axis=-1)


def _places(radius: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Places within a pixel, and points of a lens of this radius [m] that is not behind a port [m]; `[ray, 2 or 3]`."""
    side = len(_ORDER)
    k = np.arange(side**2 * (_LENS if radius else 1))
    cell = np.stack([k % side, k // side % side], axis=-1)
    u, v = ((k[:, None] + 0.5) * _STEPS % 1.0).T
    r, angle = radius * np.sqrt(u), 2.0 * math.pi * v
    lens = np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros_like(r)], axis=-1)
    return (cell + (_ORDER[cell[:, ::-1]] + 0.5) / side) / side, lens


def _footprint(scene: Scene, direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiant intensity of the laser towards unit vectors, up to a factor; of beams that are no cones 1."""
    beam = scene.beam
    cosine = np.maximum((direction * np.asarray(beam.axis)).sum(axis=-1), 1e-6)
    if scene.scan.mode != "none" or beam.profile not in ("uniform_cone", "gaussian"):
        return np.ones(cosine.shape)
    if beam.profile == "uniform_cone":
        return (cosine >= math.cos(beam.half_angle)).astype(np.float64)
    return np.exp(-2.0 * (cosine**-2 - 1.0) / math.tan(beam.half_angle) ** 2) / cosine**3


def _first_bin(scene: Scene, mesh: TriangleMesh | None) -> int:
    """The first bin that light of any surface, in view or not, can reach: no way by a point is faster than the
    unscattered one (Fermat). Triangles that may hold the fastest are divided."""
    beam, camera, gate = scene.beam, scene.camera, scene.gate
    if mesh is None:
        return gate.bins
    light = lines_of_sight(scene)
    ways = light, replace(light, laser=np.zeros(3), laser_port=camera_port(scene))
    begin = beam.beam_radius if beam.profile == "collimated" else 0.0
    lens = 0.0 if camera.pinhole else camera.aperture_radius
    corners, enough = mesh.vertices.astype(np.float64)[mesh.faces], 0.1 * scene.medium.pulse_speed * gate.bin_width
    while True:
        middle = corners.mean(axis=1)
        reach = np.linalg.norm(corners - middle[:, None], axis=-1).max(axis=1)
        away = np.maximum(np.linalg.norm(middle, axis=-1), 1e-30)  # a face may go through the lens
        path = -lens * np.linalg.norm(middle[:, :2], axis=-1) / away - begin
        for way in ways:  # behind a port as in its air, whose index is about 1
            straight = np.linalg.norm(middle - way.laser, axis=-1) / scene.medium.group_index
            path += np.fmax(way.light_at(middle)[2], straight)
        least = path - (2.0 + lens / away) * reach
        near, shortest = least <= path.min(), least.min()
        if reach[near].max() < enough or near.sum() > _RAYS:
            break
        a, b, c = corners[near].swapaxes(0, 1)
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3, 3)
    first = (shortest / scene.medium.pulse_speed - gate.start) / gate.bin_width
    return int(np.clip(math.floor(first), 0, gate.bins))


def _edges(low: int, high: int) -> NDArray[np.int64]:
    """Edges of rows of bins around 0, from at most `low` to at least `high`."""
    ends = [0]
    while ends[-1] < max(-low, high):
        ends.append(ends[-1] + max(1, ends[-1] // _ROW))
    before, after = (ends[: bisect.bisect_left(ends, limit) + 1] for limit in (-low, high))
    return np.array([*(-end for end in before[:0:-1]), *after])


class _Rows:
    """Rows of bins, which count from a bin of each pixel."""

    def __init__(self, start: NDArray[np.int64], edges: NDArray[np.int64], bins: int, device: wp.Device) -> None:
        self.shape, self.device, self.count = (*start.shape, bins), device, len(edges) - 1
        self._start, self._edges = start, edges
        self._on_device: list[Any] = [wp.array(part.ravel(), dtype=int, device=device) for part in (start, edges)]
        self.every: Any = wp.full(start.size, wp.vec2i(0, bins), dtype=wp.vec2i, device=device)

    def delayed(self, light: Any, span: Any, delay: tuple[int, int], per_bin: int, factor: float = 1.0, to: Any = None):
        """Light `[pixel, fine bin]` by a delay of so many fine bins, times a factor, `[pixel, row]`; added to `to`."""
        to = wp.zeros((light.shape[0], self.count), dtype=float, device=self.device) if to is None else to
        inputs = [light, span, wp.vec2i(*delay), per_bin, *self._on_device, factor, to]
        wp.launch(sk.delay_kernel, dim=light.shape[0], inputs=inputs, device=self.device)
        return to

    def summed(self, cube: NDArray[Any]) -> Cube:
        """Of bins `[H, W, T]` the sums in rows `[H, W, R]`."""
        light: Any = wp.array(cube.reshape(-1, cube.shape[-1]), dtype=float, device=self.device)
        return self.delayed(light, self.every, (0, 1), 1).numpy().reshape(*cube.shape[:2], -1)

    def spread(self, values: NDArray[Any]) -> NDArray[Any]:
        """Of rows `[H, W, R]` the value of each bin `[H, W, T]`."""
        row_of = np.repeat(np.arange(self.count), np.diff(self._edges))
        index = row_of[np.arange(self.shape[-1]) - self._start[..., None] - self._edges[0]]
        return np.take_along_axis(values, index, axis=-1)


def _forward(known: KnownLight, ballistic: Cube, rows: _Rows, bins: _Rows, light: Cube) -> Cube:
    """Prediction of forward-scattered light from its tallies."""
    from scipy.ndimage import uniform_filter
    from scipy.optimize import nnls

    device, flat = rows.device, (known.direct.shape[0], ballistic.shape[-1])
    terms: list[Any] = [
        (fine, known.span, delay, _FINE) for fine in (known.direct, known.scattered) for delay in _DELAYS
    ]
    even = bins.delayed(known.even, known.span, (0, 1), _FINE).numpy().reshape(bins.shape)
    for sharp, radii in ((ballistic, _BLURS[1:]), (even, _BLURS)):
        for radius in radii:
            size = (1, 1, 1) if radius is None else (2 * radius + 1, 2 * radius + 1, 1)
            blurred = uniform_filter(uniform_filter(sharp, size, mode="constant"), size, mode="constant")
            if radius is None:
                blurred[:] = blurred.mean(axis=(0, 1))
            pixels: Any = wp.array(blurred.reshape(flat), dtype=float, device=device)
            terms += [(pixels, bins.every, delay, 1) for delay in _BLURRED_DELAYS]
    columns = np.stack([rows.delayed(*term).numpy().ravel() for term in terms])
    columns /= (sums := np.maximum(columns.sum(axis=1), 1e-30))[:, None]
    light = rows.summed(light)
    # Weights: the variance of light is about proportional to it.
    level = uniform_filter(light, (7, 7, 5), mode="constant").ravel()
    root = 1.0 / np.sqrt(level + 0.02 * level.max() + 1e-300)
    columns *= root
    # Least squares by the products of the terms, of which float32 leaves no more than its rounding.
    values, vectors = np.linalg.eigh((columns @ columns.T).astype(np.float64))
    scale = np.sqrt(np.maximum(values, np.finfo(np.float32).eps * values[-1]))[:, None]
    factors, _ = nnls(scale * vectors.T, (vectors.T / scale) @ (columns @ (light.ravel() * root)))
    total = wp.zeros(flat, dtype=float, device=device)
    for (pixels, span, delay, per_bin), factor in zip(terms, factors / sums, strict=True):
        if factor > 0.0:
            bins.delayed(pixels, span, delay, per_bin, factor, total)
    return total.numpy().reshape(ballistic.shape)


def _backscatter(covered: Cube, light: Cube) -> Cube:
    """Prediction of backscatter: of each bin the mean of pixels before their surface, and of those behind it."""
    open_ = 1.0 - np.minimum(covered, 1.0)
    parts = [(part, (part * light).sum(axis=(0, 1)), part.sum(axis=(0, 1))) for part in (open_, 1.0 - open_)]
    return sum(part * (total / np.maximum(pixels, 1e-6)) for part, total, pixels in parts)  # type: ignore[return-value]


def _smoothed(halves: list[Cube], mean: Cube, predicted: Cube, rows: _Rows, *, scattered: bool) -> tuple[Cube, Cube]:
    """Light of a component and its squared error `[H, W, T]`."""
    scale, known = predicted.max() or np.float32(1.0), predicted > 0.0  # float32 holds the squares of what is near 1
    first, second = (half / scale for half in halves)
    noise = 0.25 * (first - second) ** 2
    values = np.stack([rows.summed(cube * known) for cube in (first, second, noise, predicted / scale)], axis=-1)
    light, square = _blended(values, _WINDOWS, _AROUND, rows.device)
    # Windows are chosen by the same noise, which loses rare light: rows get their own light back, with its noise.
    total = values.sum(axis=(0, 1), dtype=np.float64, keepdims=True)
    total /= max(float(total[..., 3].max()), 1e-30)
    total[..., 2] = 0.25 * (total[..., 0] - total[..., 1]) ** 2
    whole, its = _blended(total.astype(np.float32), _ROW_WINDOWS[: None if scattered else 1], _ROW_AROUND, rows.device)
    kept = light.sum(axis=(0, 1), dtype=np.float64, keepdims=True)
    whole = np.where(kept > 0.0, whole, 0.0)  # what was smoothed into rows that hold no light would be lost
    kept *= scale * max(float(whole.sum()), 1e-30) / max((mean * known).sum(dtype=np.float64), 1e-300)
    light *= np.divide(whole, kept, out=np.zeros_like(kept), where=kept > 0.0)
    square += light**2 * np.divide(its, whole**2, out=np.zeros_like(kept), where=whole > 0.0)
    ratio, its = (rows.spread(part / np.maximum(values[..., 3], 1e-30)) for part in (light, np.sqrt(square)))
    return np.where(known, predicted * ratio, mean), np.where(known, (predicted * its) ** 2, noise * scale**2)


def _blended(cube: Cube, windows: Any, arounds: Any, device: wp.Device) -> tuple[Cube, Cube]:
    """Estimates from windows and their squared errors `[H, W, R]`; the cube: two halves, noise, prediction by row."""
    values: Any = wp.array(cube, dtype=wp.vec4, device=device)
    sums, work, risk, near, blended = (wp.zeros(values.shape, dtype=wp.vec4, device=device) for _ in range(5))
    for window in windows:
        sk.window_sums(values, window, work, sums)
        wp.launch(sk.estimate_kernel, dim=values.shape, inputs=[values, sums, risk], device=device)
        sk.window_sums(risk, arounds[0], work, near)
        wp.launch(sk.blend_kernel, dim=values.shape, inputs=[values, sums, near, blended], device=device)
    wp.launch(sk.combine_kernel, dim=values.shape, inputs=[values, blended, risk], device=device)
    found, own = blended.numpy(), risk.numpy()
    bias = np.zeros_like(own[..., 0])
    for reach in arounds:
        sk.window_sums(risk, reach, work, near)
        mean = near.numpy()
        # One standard error more than the halves show. A window holds its own voxel; rounding may leave less.
        more = np.maximum(mean[..., 0] + np.sqrt(np.maximum(mean[..., 3], 0.0)), 0.0)
        bias = np.maximum(bias, more * own[..., 2] / np.maximum(np.maximum(mean[..., 2], own[..., 2]), 1e-30))
    return 0.5 * np.maximum(found[..., 0] + found[..., 1], 0.0), own[..., 1] + bias  # rounding may end below 0
