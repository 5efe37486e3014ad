"""RMSE against signal photons: denoisers on histograms of few photons.

Of drawn scenes, which no training saw, beside the best tuned classical estimate of the same counts; or of a Monte Carlo
result with its own backscatter profile, beside the Cramér–Rao bound. SBR: signal-to-background ratio, signal counts
over background counts in the gate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.baselines import MEDIAN_WINDOWS, TUNINGS, classical_depth
from spadwarp.denoise.evaluation_scenes import EvaluationScene, evaluation_scene
from spadwarp.denoise.frames import DepthFrames, depth_frames
from spadwarp.denoise.histograms import features_of_histograms
from spadwarp.denoise.inference import METHODS, denoise_frames
from spadwarp.denoise.network_files import compared
from spadwarp.frames.cramer_rao import crlb_from_histogram
from spadwarp.frames.depth import arrival_time
from spadwarp.frames.response import detector_response
from spadwarp.scene.sight import depth_from_time, port_advance
from spadwarp.values import SEED, SpadwarpError, check_choice, check_integer, check_real, range_from_time
from spadwarp.viz import evaluation as drawing

if TYPE_CHECKING:
    from spadwarp.result.result import Result

__all__ = ["HistogramScores", "PhotonSweep", "draw_photon_sweep", "evaluate_histograms", "photon_sweep"]

_BINS = 256
_WIDTH = 1.0  # deviation of the response [bins]


class Point(NamedTuple):
    """Signal photons per pixel, SBR, "flat" or "decaying" background, and the number of returns in a pixel."""

    photons: float
    sbr: float
    background: str
    returns: int


@dataclass(frozen=True, kw_only=True)
class HistogramScores:
    """RMSE [m] over the pixels that see a target, mean over scenes, by point and method."""

    rmse: dict[Point, dict[str, float]]

    def best(self, point: Point) -> tuple[str, float]:
        """Name and RMSE [m] of the best classical estimate."""
        classical = {name: value for name, value in self.rmse[point].items() if name != "histograms"}
        return min(classical.items(), key=lambda item: item[1])

    def ratios(self) -> NDArray[np.float64]:
        """RMSE of the network over that of the best classical estimate, of each point."""
        return np.array([values["histograms"] / self.best(point)[1] for point, values in self.rmse.items()])

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names, for JSON."""
        return {"points": [{**point._asdict(), "rmse_m": values} for point, values in self.rmse.items()]}


def evaluate_histograms(
    *,
    photons: Sequence[float] = (1, 3, 10, 30, 100),
    sbr: Sequence[float] = (0.05, 0.3, 1.0, 5.0),
    backgrounds: Sequence[str] = ("flat", "decaying"),
    returns: Sequence[int] = (1, 2),
    scenes: Sequence[EvaluationScene] | None = None,
    seed: int = 0,
    weights: str | Path | None = None,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> HistogramScores:
    """Scores the network for histograms and all classical estimates, with their best tuning, at every point.

    Args:
        photons, sbr, backgrounds, returns: See `Point`.
        scenes: Default: stairs, rings and vase before a wall, 64 × 64 pixels.
        seed: Of the counts.
        weights: File of `spadwarp train` with weights of the network for histograms.
        device: torch device.
        progress: Called with ("points", done, total).

    Errors are those of `evaluate`.
    """
    if scenes is None:
        scenes = [evaluation_scene(shape, "wall", size=(64, 64)) for shape in ("stairs", "rings", "vase")]
    points = [Point(*values) for values in product(photons, sbr, backgrounds, returns)]
    rmse: dict[Point, dict[str, float]] = {}
    for done, point in enumerate(points):
        squares: dict[tuple[str, float], list[float]] = {}
        for number, scene in enumerate(scenes):
            for key, depth in _estimates(scene, point, seed + number, weights, device).items():
                seen = np.isfinite(scene.clean)
                squares.setdefault(key, []).append(float(np.mean((depth - scene.clean)[seen] ** 2)))
        means = {key: float(np.sqrt(np.mean(values))) for key, values in squares.items()}
        rmse[point] = {name: min(v for (n, _), v in means.items() if n == name) for name, _ in means}
        if progress is not None:
            progress("points", done + 1, len(points))
    return HistogramScores(rmse=rmse)


def draw_counts(
    scene: EvaluationScene, point: Point, *, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Counts `[H, W, T]`, expected background per bin `[T]`, and the response per bin.

    Of two returns the weaker one has 35 % of the light, 25 cm before the scene, in half of the columns.
    """
    from scipy.special import ndtr

    start, stop = scene.gate
    generator = np.random.Generator(np.random.Philox(seed))
    seen = np.isfinite(scene.clean)
    place = (np.where(seen, scene.clean, start) - start) / (stop - start)
    rows, columns = place.shape
    shade = 1.0 + 0.5 * np.sin(np.arange(columns) / 5.0) * np.sin(np.arange(rows) / 7.0)[:, None]
    signal = point.photons * shade * seen

    def spread(depth: NDArray[Any]) -> NDArray[Any]:
        return np.diff(ndtr((np.arange(_BINS + 1) - (depth * _BINS)[..., None]) / _WIDTH), axis=-1)

    rate = spread(place) * signal[..., None]
    if point.returns == 2:
        veil = 0.35 * (np.arange(columns) % 32 < 16)[None, :, None]
        rate = (1.0 - veil) * rate + veil * spread(place - 0.1) * signal[..., None]
    centres = (np.arange(_BINS) + 0.5) / _BINS
    profile = np.exp(-4.0 * centres) if point.background == "decaying" else np.ones(_BINS)
    background = point.photons / point.sbr * profile / profile.sum() + 1e-6
    response = np.exp(-0.5 * (np.arange(-5, 6) / _WIDTH) ** 2)
    return generator.poisson(rate + background), background, response / response.sum()


def _estimates(
    scene: EvaluationScene, point: Point, seed: int, weights: str | Path | None, device: str | None
) -> dict[tuple[str, float], NDArray[np.float32]]:
    """Depth [m] by method and tuning."""
    counts, background, response = draw_counts(scene, point, seed=seed)
    given: dict[str, Any] = {"background": background, "response": response, "device": device}
    start, stop = scene.gate

    def metres(part: NDArray[Any]) -> NDArray[np.float32]:
        return (start + (stop - start) * part).astype(np.float32)

    found: dict[tuple[str, float], NDArray[np.float32]] = {
        (method, tuning): metres(classical_depth(counts, method=method, tuning=tuning, **given)[0])  # type: ignore[arg-type]
        for method, tunings in TUNINGS.items()
        for tuning in tunings
    }
    features = features_of_histograms(counts, to_depth=metres, **given)
    frames = depth_frames(found["likelihood", 1], gate=scene.gate, profile=background, features=features)
    for window in MEDIAN_WINDOWS:
        found["median", window] = denoise_frames(frames, model="median", window=window)[0][0]
    found["histograms", 0] = denoise_frames(frames, model="histograms", weights=weights, device=device)[0][0]
    return found


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotonSweep:
    """RMSE of methods over photon counts and signal-to-background ratios."""

    summary: str  # scene, water and seed, as text
    photons: tuple[float, ...]  # signal counts of the median pixel, `[P]`
    sbr: tuple[float, ...]  # signal-to-background ratio, `[S]`
    rmse: dict[str, NDArray[np.float64]]  # by method, `[S, P]` [m]; "input" is the likelihood estimate itself
    bound: NDArray[np.float64]
    """Root mean square over pixels of the Cramér–Rao bound, or of a uniform guess over the gate where that is smaller,
    `[S, P]` [m]."""

    def saving(self, method: str) -> NDArray[np.float64]:
        """Factor in photons at which the input reaches the method's RMSE, `[S, P]`; NaN beyond the sweep's counts."""
        out = np.full(self.bound.shape, np.nan)
        counts = np.log(np.array(self.photons))
        for row in range(len(self.sbr)):
            levels = np.minimum.accumulate(np.log(self.rmse["input"][row]))  # decreases with the photons
            for column, wanted in enumerate(np.log(self.rmse[method][row])):
                if levels[-1] <= wanted <= levels[0]:
                    reached = np.interp(-wanted, -levels, counts)
                    out[row, column] = np.exp(reached - counts[column])
        return out

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names, for JSON."""
        return {
            "summary": self.summary,
            "photons": list(self.photons),
            "sbr": list(self.sbr),
            "rmse_m": {name: values.tolist() for name, values in self.rmse.items()},
            "bound_m": self.bound.tolist(),
            "saving": {name: self.saving(name).tolist() for name in self.rmse if name != "input"},
        }


def photon_sweep(
    result: Result,
    *,
    photons: Sequence[float] = (1, 3, 10, 30, 100),
    sbr: Sequence[float] = (0.05, 0.3, 1.0, 5.0),
    models: Sequence[str] = ("median", "usdn", "dncnn", "pyramid", "histograms"),
    frames: int = 1,
    seed: int = 0,
    weights: str | Path | None = None,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> PhotonSweep:
    """Sweeps photon counts and background of a Monte Carlo result.

    Args:
        result: Its ballistic and forward-scattered light is the signal, its backscatter the shape of the background.
        photons: Signal counts within the gate in the median pixel that sees a target, > 0, increasing.
        sbr: Signal-to-background ratios, > 0.
        models: From `spadwarp.denoise.METHODS`; the median has its best window at each point.
        frames: Drawn and averaged for each point.
        seed: Of the counts.
        weights, device, progress: See `evaluate`, as for errors.

    Raises:
        SpadwarpError: The result has no return, no backscatter or no instrument response.
    """
    for model in models:
        check_choice("models: an item", model, METHODS)
    for name, values in (("photons", photons), ("sbr", sbr)):
        check_integer(f"number of {name}", len(values), "[1, 10000]")
        for value in values:
            check_real(f"{name}: an item", value, "[1e-9, 1e9]")
    frames, seed = check_integer("frames", frames, "[1, 1000000]"), check_integer("seed", seed, SEED)
    methods = compared(["input", *models], weights, counts=True)
    shape, truth, done = (len(sbr), len(photons)), result.truth.depth, 0
    squares = {name: np.zeros((len(MEDIAN_WINDOWS) if name == "median" else 1, *shape)) for name in methods}
    bound = np.zeros(shape)
    for row, column in np.ndindex(shape):
        for _ in range(frames):
            point: dict[str, Any] = {"photons": photons[column], "sbr": sbr[row], "seed": seed * 1_000_003 + done}
            noisy, sigma = photon_frame(result, **point, device=device)
            start, stop = noisy.gate
            seen = np.isfinite(truth) & np.isfinite(sigma) & (truth >= start) & (truth < stop)
            guess = (stop - start) / np.sqrt(12.0)
            bound[row, column] += float(np.mean(np.minimum(sigma[seen], guess) ** 2)) / frames
            for name, sums in squares.items():  # a median of each window is tried; the others have one variant
                for total, window in zip(sums, MEDIAN_WINDOWS, strict=False):
                    found, _ = denoise_frames(noisy, window=window, device=device, **methods[name])
                    total[row, column] += float(np.mean((found[0][seen] - truth[seen]) ** 2)) / frames
            done += 1
            if progress is not None:
                progress("frames", done, frames * bound.size)
    scene, depth = result.scene, np.nanmedian(truth)
    extinction = scene.medium.extinction
    summary = (
        f"Monte Carlo histograms of {result.photons:.2g} photons, water c = {extinction:.3g} 1/m, target at "
        f"{depth:.3g} m ({depth * extinction:.2g} attenuation lengths), gate of {scene.gate.bins} bins of "
        f"{1e12 * scene.gate.bin_width:.3g} ps; seed {seed}"
    )
    return PhotonSweep(
        summary=summary + (f"; own weights of {methods['own']['model']}: {weights}" if "own" in methods else ""),
        photons=tuple(map(float, photons)),
        sbr=tuple(map(float, sbr)),
        rmse={name: np.sqrt(sums.min(axis=0)) for name, sums in squares.items()},
        bound=np.sqrt(bound),
    )


def photon_frame(
    result: Result, *, photons: float, sbr: float, seed: int, device: str | None = None
) -> tuple[DepthFrames, NDArray[np.float64]]:
    """One frame of likelihood depth from Poisson counts, and the Cramér–Rao bound of each pixel `[H, W]` [m].

    The frame also has the features of its histograms, computed on the torch device.
    """
    from scipy.ndimage import convolve1d

    scene, gate = result.scene, result.scene.gate
    response = detector_response(scene.detector, scene.laser)
    if not response.is_smooth:
        raise SpadwarpError(
            "the scene has no instrument response: laser.pulse_fwhm_ps and detector.jitter_fwhm_ps are 0"
        )
    matrix = response.per_bin(gate.bin_width)
    signal = result.component("ballistic") + result.component("forward_scattered")
    back = result.component("backscatter")
    seen = np.isfinite(result.truth.depth) & (signal.sum(axis=-1) > 0)
    if not seen.any() or not back.sum() > 0:
        raise SpadwarpError("the result holds no return or no backscatter, so that no frames can be drawn")
    signal = signal * (photons / np.median(signal.sum(axis=-1)[seen]))
    # The same background in all pixels: otherwise the estimator would know its Monte Carlo noise.
    profile = back.reshape(-1, back.shape[-1]).sum(axis=0)
    profile = np.convolve(profile / profile.sum(), matrix, mode="same")
    background = np.broadcast_to(photons / sbr * profile + 1e-6, back.shape)
    smeared = convolve1d(signal, matrix, axis=-1, mode="constant")
    counts = np.random.Generator(np.random.Philox(seed)).poisson(smeared + background).astype(np.float32)
    time = arrival_time(
        counts, gate_start=gate.start, bin_width=gate.bin_width, method="likelihood",
        irf=response, background=background.astype(np.float32),
    )  # fmt: skip
    depth = depth_from_time(time.reshape(seen.shape), scene=scene)
    sigma = crlb_from_histogram(signal, background, bin_width=gate.bin_width, pulses=1.0, irf=response)
    index = scene.medium.group_index
    depth_gate = tuple(range_from_time(end, index) + port_advance(scene) for end in (gate.start, gate.stop))

    def to_depth(part: NDArray[np.float32]) -> NDArray[Any]:
        return depth_from_time(gate.start + part.astype(np.float64) * (gate.stop - gate.start), scene=scene)

    features = features_of_histograms(
        counts, background=background[0, 0], response=matrix, device=device, to_depth=to_depth
    )
    return depth_frames(depth, gate=depth_gate, profile=profile, features=features), range_from_time(sigma, index)


def draw_photon_sweep(sweep: PhotonSweep, path: str | Path) -> Path:
    """RMSE against photons, a panel for each signal-to-background ratio, beside the bound; returns the path."""
    return drawing.draw_photon_sweep(
        sweep.rmse, sweep.bound, path, photons=sweep.photons, sbr=sweep.sbr, note=sweep.summary
    )
