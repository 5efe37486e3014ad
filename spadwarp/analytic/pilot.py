"""What a short Monte Carlo run on a window of the image measures: counts, background, bound, errors of scattering.

The window has the pixels of the camera about the target pixel nearest to the optical axis, so that light which is
scattered from other parts of the target into them is all there. Runs of equal length are compared: what differs between
them is noise of the runs.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic.budgets import central_pixel
from spadwarp.analytic.model import pixel_maps
from spadwarp.arrays import Floats
from spadwarp.device import pick_device
from spadwarp.frames import Frames, detect, detector_response, first_photon_probabilities, information_from_histogram
from spadwarp.frames.depth import METHODS, Method, arrival_time
from spadwarp.frames.response import FWHM_PER_SIGMA
from spadwarp.result import Channel, Result, analyser_channel, merge
from spadwarp.result.analysis import off_edges
from spadwarp.scene import Scene, noise_rate
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.sight import depth_from_time, depth_per_time
from spadwarp.transport import Progress, RunOptions, known_light, simulate, truth_maps
from spadwarp.values import ConfigError, SpadwarpWarning, range_from_time

__all__ = ["Pilot"]

Mask = NDArray[np.bool_]

_SIDE = 16  # largest width and height of the window [pixels]
_MOST_NOISE = 0.95  # part of the information that may be noise; a bound from what is left of more would be noise itself
_MOST_DRAWN, _OCTAVES = 1 << 20, 8  # counts that are drawn at a time, for 1 to 4^7 times the pulses
_OFFSETS = 8  # of the bins against the target: nobody knows where in a bin it lies
_MEAN_OF_90 = 0.657  # mean of the smallest 90 % of the moduli of normal errors, over their standard deviation
RUNS = 8  # of a quarter of the photons each two, whose scatter tells the noise of all


class NoLight(ConfigError):
    """No photon of the target has come yet."""


@dataclass(frozen=True, kw_only=True)
class Pilot:
    """Detections in a window of the image: of its typical pixel, the mean over the third of the pixels with a target
    whose known light is nearest to the median, unless said otherwise. Few photons leave a mean unbiased; a median of
    pixels that each have a few heavy photons is too low."""

    pixels: int  # with a target
    surfaces: tuple[float, ...]  # depths in the window, of a twentieth of these pixels each, that edges separate [m]
    unscattered: float  # detections of the target per pulse in the gate, without scattered light
    target: float  # the same with it
    backscatter: float  # of backscatter, and of light that met the surface of a sea alone
    noise: float  # of dark counts and ambient light
    brightest: float  # of light in the brightest twentieth of the pixels, which noise does not choose
    bound: float  # Cramér–Rao bound of depth for one pulse [m]; for N pulses it is bound/√N
    shot_noise: float  # the same without background and pile-up
    information_noise: float  # part of the runs' information on depth that was their noise; both bounds leave it out
    floor: dict[str, float]  # estimator → median |error| of depth that is left after any number of pulses [m]
    bias: dict[str, float]  # estimator → median error, positive if too far [m]
    unscattered_floor: dict[str, float]  # `floor` of unscattered light alone: slopes, edges within a pixel, bins
    pile_up: dict[str, float]  # estimator → median change of depth by pile-up [m]; 0 in free-running mode
    peak: float  # detections per pulse of the return within ±3σ of its peak, σ that of the response
    level: float  # of background per σ under it
    light_noise: float  # relative standard error of the target's light in a pixel
    photons: int  # of all runs
    excess: tuple[tuple[float, float], ...] = ()
    """Pulses, and noise of the planned estimator over the Cramér–Rao bound, ≥ 1; empty for likelihood, which counts as
    one that reaches it."""


def window(scene: Scene, device: str | None = None) -> Scene:
    """The scene with a camera of the pixels about the target pixel nearest to the axis, 16 × 16 at most.

    Raises `ConfigError` where no target is in view.
    """
    camera = scene.camera
    row, column = central_pixel(scene, truth := truth_maps(scene, device=device))
    hit = ~np.isnan(truth.depth)
    width, height = min(_SIDE, camera.width), min(_SIDE, camera.height)
    if (width, height) == (camera.width, camera.height):
        return scene
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    middle = hit[top : top + height, left : left + width]
    centred = (camera.width - width) % 2 == 0 == (camera.height - height) % 2 and middle.mean() > 0.25
    if centred and camera.is_plain:  # the kernels of a plain camera are those of the whole image
        fov = 2.0 * math.atan(0.5 * width * camera.pixel_tangent)
        return scene.with_overrides(camera={"width": width, "height": height, "horizontal_fov_deg": math.degrees(fov)})
    left = int(np.clip(column - width // 2, 0, camera.width - width))
    top = int(np.clip(row - height // 2, 0, camera.height - height))
    (fx, fy), (cx, cy) = camera.focal_pixels, camera.principal_point
    centre = {"cx": cx - 0.5 - left, "cy": cy - 0.5 - top}
    return scene.with_overrides(camera={"width": width, "height": height, "fx": fx, "fy": fy, **centre})


def typical_pixels(scene: Scene, device: str | None = None) -> Mask:
    """The third of the pixels with a target, off its edges, whose unscattered light is nearest to the median: what is
    known of it without a photon does not choose pixels by their noise. bool `[H, W]`."""
    truth = truth_maps(scene, device=device)
    if scene.surface is None:
        light = known_light(scene, None, pick_device(device)).direct.numpy().sum(axis=-1, dtype=np.float64)
        light = light.reshape(truth.depth.shape)
    else:
        view, normal = pixel_directions(scene.camera).reshape(-1, 3), truth.normal.reshape(-1, 3)
        surface: Any = {"distance": truth.range.ravel(), "normal": normal, "reflectance": truth.reflectance.ravel()}
        maps, _ = pixel_maps(scene, view=view, **surface, device=device, outliers=False)
        light = maps["signal"].reshape(truth.depth.shape)
    hit = np.isfinite(truth.depth)
    off = np.where(off_edges(truth.depth)[0], np.abs(light - np.median(light[hit])), np.nan)
    chosen = np.argsort(off, axis=None, kind="stable")[: max(1, hit.sum() // 3)]
    return np.isin(np.arange(light.size), chosen).reshape(light.shape)


def trace(
    scene: Scene,
    photons: int,
    seed: int,
    device: str | None,
    progress: Progress | None = None,
    earlier: Sequence[Result] = (),
) -> tuple[Result, ...]:
    """Runs of an eighth of the photons each, which go on with earlier ones."""
    each, before = max(1, photons // RUNS), sum(run.photons for run in earlier)
    cache: dict[str, Any] = {}

    def run(number: int) -> Result:
        def report(stage: str, done: int, total: int) -> None:
            if progress is not None and (total or not (number or earlier)):
                progress(stage, before + number * each + done if total else done, before + RUNS * each if total else 0)

        options: dict[str, Any] = {"seed": seed, "device": device, "progress": report, "mesh_cache": cache}
        return simulate(scene, photons=each, run=RunOptions(first_photon=before + number * each), **options)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of few photons: `plan` judges what they tell
        runs = [run(number) for number in range(RUNS)]
    return tuple(merge(pair) for pair in zip(earlier, runs, strict=True)) if earlier else tuple(runs)


def measure(
    runs: Sequence[Result],
    scene: Scene,
    typical: Mask,
    device: str | None = None,
    *,
    even: bool = False,
    channel: Channel = "I",
    method: Method = "likelihood",
    depth_error: float = 0.01,
) -> Pilot:
    """Numbers of `scene`, whose laser's energy and detector may differ from those of the runs, in a channel of an
    analyser; `typical`: the runs' `typical_pixels`.

    `even`: the target is the same for all pixels, so that their median error has no noise of the runs; `floor` is then
    its modulus. `method`: of `excess`, for pulses from those on whose bound is a depth error [m].
    """
    # The traced scene with what a detector sees of the wanted one.
    laser = {name: getattr(scene.laser, name) for name in ("pulse_energy", "repetition_rate", "pulse_fwhm_ps")}
    seen_by = runs[0].scene.with_overrides(laser=laser).model_copy(update={"detector": scene.detector})
    halves = (merge(runs[0::2]), merge(runs[1::2])) if len(runs) > 2 else runs
    first, second = (analyser_channel(dataclasses.replace(run, scene=seen_by), channel) for run in halves)
    both = merge([first, second])
    unscattered = np.arange(len(both.tallies)) == 0
    clear = dataclasses.replace(both, tallies=both.tallies * unscattered[:, None, None, None])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SpadwarpWarning)  # the noise of the runs is judged here
        frames, clear_frames = (detect(run, pulses=1, seed=0, device=device) for run in (both, clear))
    light = frames.expected.astype(np.float64)
    background = np.broadcast_to(frames.background, light.shape).astype(np.float64)
    signal = light - background
    seen = np.isfinite(both.truth.depth) & (signal.sum(axis=-1) > 0)
    if not seen.any():
        raise NoLight(
            f"no light of the target reached the pixels near the axis in {both.photons} photons: more may show some, "
            "or `spadwarp check` says why there is none",
            source=scene.source,
        )

    def median(values: Floats, axis: int | None = None) -> Any:
        finite = values[np.isfinite(values).all(axis=-1)]
        return np.median(finite, axis) if len(finite) else math.inf

    def errors(frames: Frames, histogram: Any) -> dict[str, Any]:
        """Depth by each estimator, from a histogram without noise, less the true depth [m], at offsets of the bins
        (last axis): the time within a bin is lost, so that the error moves with the target's place in it."""
        times = {method: _time(frames, histogram, frames.background, method, device) for method in METHODS}
        depths = {name: depth_from_time(time, scene=both.scene) for name, time in times.items()}
        return {name: ((depth - both.truth.depth)[..., None] + moved)[seen] for name, depth in depths.items()}

    pool, offsets = _Pool(both, typical), (np.arange(_OFFSETS) + 0.5) / _OFFSETS
    places = (both.true_path() / both.scene.medium.pulse_speed - scene.gate.start) / scene.gate.bin_width % 1.0
    moved = (places[..., None] - offsets) * pool.slope * scene.gate.bin_width
    error, unscattered = errors(frames, light), errors(clear_frames, clear_frames.expected.astype(np.float64))
    bias = {method: float(median(values)) for method, values in error.items()}
    moduli = {method: np.abs(median(values, 0) if even else values) for method, values in error.items()}
    piled: dict[str, float] = {method: 0.0 for method in METHODS}
    if scene.detector.mode == "first_photon":
        recorded = errors(frames, first_photon_probabilities(light, device=device))
        piled = {method: float(median(recorded[method] - error[method])) for method in METHODS}
    scale = both.scene.detectable_photons_per_pulse
    returned, constant = pool(signal), pool(background)
    peak, level = _return(returned, constant, both.scene)
    bound, shot, information_noise = _bounds(both, (first, second), pool, device)
    excess: Any = ()
    if method != "likelihood" and bound < math.inf:
        first_pulses = max((bound / depth_error) ** 2, 1.0)
        excess = _excess(frames, returned + constant, constant, method, bound / pool.slope, first_pulses, device)
    lights = [run.tallies[:2].sum(axis=(0, 3), dtype=np.float64)[seen] for run in (first, second)]
    return Pilot(
        pixels=int(seen.sum()),
        surfaces=_surfaces(both),
        unscattered=float(both.component("ballistic")[typical].sum(axis=-1).mean() * scale),
        target=float(returned.sum()),
        backscatter=float(_background(both)[typical].sum(axis=-1).mean() * scale),
        noise=float(np.median(noise_rate(both.scene, both.truth))) * (scene.gate.stop - scene.gate.start),
        brightest=_brightest(*(run.detections.sum(axis=-1, dtype=np.float64) for run in (first, second))),
        bound=bound,
        shot_noise=shot,
        information_noise=information_noise,
        floor={name: float(np.median(values) if even else median(values)) for name, values in moduli.items()},
        bias=bias,
        unscattered_floor={name: float(median(np.abs(values))) for name, values in unscattered.items()},
        pile_up=piled,
        peak=float(peak),
        level=float(level),
        light_noise=math.sqrt(np.mean(np.square(lights[0] - lights[1]))) / max(float(np.mean(sum(lights))), 1e-300),
        photons=both.photons,
        excess=excess,
    )


def _time(frames: Frames, histogram: Any, background: Any, method: Method, device: str | None) -> Floats:
    """Arrival time by an estimator that knows the background [s]."""
    axis: Any = {"gate_start": frames.gate_start, "bin_width": frames.bin_width, "irf": frames.irf}
    return arrival_time(histogram, method=method, background=background, device=device, **axis)


def _excess(
    frames: Frames, light: Floats, background: Floats, method: Method, bound: float, first: float, device: str | None
) -> tuple[tuple[float, float], ...]:
    """See `Pilot`: arrival times of counts that are drawn from `light` [T] against that of `light` itself; `bound` for
    one pulse [s]. The largest tenth of the errors, false peaks, are left out."""
    drawn, random, found = int(np.clip(_MOST_DRAWN // len(light), 16, 4096)), np.random.default_rng(0), []
    if frames.detector.mode == "first_photon":
        light = first_photon_probabilities(light[None, None], device=device)[0, 0]
    for pulses in first * 4.0 ** np.arange(_OCTAVES):
        expected = np.tile(pulses * light, (drawn, 1))
        counts = np.concatenate([expected[:1], random.poisson(expected)])
        times = _time(frames, counts, pulses * background, method, device)
        off = np.sort(np.nan_to_num(np.abs(times[1:] - times[0]), nan=math.inf))[: round(0.9 * drawn)]
        excess = float(off.mean()) / _MEAN_OF_90 * math.sqrt(pulses) / bound
        found.append((float(pulses), min(max(excess, 1.0), 1e6)))
    return tuple(found)


def _brightest(first: Floats, second: Floats) -> float:
    """Mean over the brightest twentieth of the pixels of two halves `[H, W]`, each chosen by the other half's averages
    over neighbours; over both halves' brightest pixel where these have no light."""
    from scipy.ndimage import uniform_filter

    count = max(1, first.size // 20)
    pairs = ((first, second), (second, first))
    top = [mine.ravel()[np.argsort(uniform_filter(other, 3), axis=None)[-count:]] for mine, other in pairs]
    return float(np.mean(top)) or float((first + second).max()) / 2.0


def _surfaces(result: Result) -> tuple[float, ...]:
    """See `Pilot`: depths lie farther apart than the returns of two can be told, and than those of a slope do."""
    depth = np.sort(result.truth.depth[np.isfinite(result.truth.depth)])
    resolved = range_from_time(FWHM_PER_SIGMA * response_deviation(result.scene), result.scene.medium.group_index)
    apart = max(resolved, 3.0 * off_edges(result.truth.depth)[1])
    parts = np.split(depth, np.flatnonzero(np.diff(depth) > apart) + 1)
    return tuple(float(np.median(part)) for part in parts if 20 * len(part) >= len(depth))


def response_deviation(scene: Scene) -> float:
    """Standard deviation of the response, or of a bin where it is shorter [s]."""
    return max(detector_response(scene.detector, scene.laser).fwhm, scene.gate.bin_width) / FWHM_PER_SIGMA


def _return(signal: Floats, background: Floats, scene: Scene) -> tuple[Floats, Floats]:
    """Detections per pulse about the return's peak, and of background per σ under it."""
    bins_per_sigma = response_deviation(scene) / scene.gate.bin_width
    reach = max(1, round(3.0 * response_deviation(scene) / scene.gate.bin_width))
    top = signal.argmax(axis=-1)[..., None]
    near = np.clip(top + np.arange(-reach, reach + 1), 0, signal.shape[-1] - 1)
    inside = np.abs(near - top) <= reach
    peak = (np.take_along_axis(signal, near, axis=-1) * inside).sum(axis=-1)
    return peak, np.take_along_axis(background, near, axis=-1).mean(axis=-1) * bins_per_sigma


def _background(result: Result) -> Floats:
    """Light that met no target, `[H, W, T]`."""
    return np.sum([result.component(name) for name in result.scene.components[2:]], axis=0, dtype=np.float64)


class _Pool:
    """The mean over typical pixels of light `[H, W, T]`, whose bins are counted from each pixel's own true path; `[T]`.
    By whole bins: within a bin the run does not know where the light is."""

    def __init__(self, result: Result, typical: Mask) -> None:
        self.typical = typical
        slope = depth_per_time(result.scene, np.nan_to_num(result.truth.range.astype(np.float64)))
        self.slope = float(slope[typical].mean())  # of depth over time [m/s]
        path = result.true_path()[typical] / (result.scene.medium.pulse_speed * result.scene.gate.bin_width)
        shift = np.rint(path - np.median(path)).astype(np.int64)[:, None]
        self.bins = np.arange(result.scene.gate.bins) + shift
        self.inside = (self.bins >= 0) & (self.bins < result.scene.gate.bins)

    def __call__(self, light: NDArray[Any]) -> Floats:
        own = light[self.typical].astype(np.float64)
        return (np.take_along_axis(own, np.clip(self.bins, 0, own.shape[1] - 1), axis=1) * self.inside).mean(axis=0)


def _bounds(result: Result, runs: tuple[Result, Result], pool: _Pool, device: str | None) -> tuple[float, float, float]:
    """Bounds of depth for one pulse [m]: as the detector records it, and without background and pile-up; and the part
    of the information that was noise of the runs, for which the bounds are larger.

    From products of the slopes of both runs, which noise does not change in the mean. Inf where nearly all is noise.
    """
    scene = result.scene
    scale = scene.detectable_photons_per_pulse
    signal, first, second = (
        pool(run.component("ballistic") + run.component("forward_scattered")) * scale for run in (result, *runs)
    )
    light = _background(result) * scale + noise_rate(scene, result.truth) * scene.gate.bin_width
    options: dict[str, Any] = {
        "bin_width": scene.gate.bin_width,
        "irf": detector_response(scene.detector, scene.laser),
        "signal_halves": (first, second),
        "device": device,
    }
    law: Any = "first_photon" if scene.detector.mode == "first_photon" else "poisson"

    def bound(background: Any, law: Any) -> tuple[float, float]:
        information, noise = (float(x) for x in information_from_histogram(signal, background, law=law, **options))
        if information <= 0.0:
            return math.inf, 1.0
        part = noise / information
        left = information - noise if part < _MOST_NOISE else 0.0
        return pool.slope / math.sqrt(left) if left > 0.0 else math.inf, part

    recorded, part = bound(pool(light), law)
    return recorded, bound(0.0, "poisson")[0], part
