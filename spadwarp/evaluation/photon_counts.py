"""RMSE against signal photons: denoisers on histograms of few photons.

Of fresh scenes beside the best tuned classical estimate of the same counts; or of a Monte Carlo result with its own
backscatter profile, beside the Cramér–Rao bound. SBR: signal counts over background counts in the gate.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.baselines import FROM_COUNTS, MEDIAN_WINDOWS, compared
from spadwarp.denoise.frames import DepthFrames, depth_frames
from spadwarp.denoise.histograms import CountFrames, count_frames
from spadwarp.denoise.inference import estimate, estimate_frames, estimate_histograms, target_threshold
from spadwarp.frames.cramer_rao import crlb_from_histogram
from spadwarp.frames.depth import arrival_time
from spadwarp.frames.response import detector_response
from spadwarp.scene.sight import depth_from_time, port_advance
from spadwarp.values import SEED, SpadwarpError, check_integer, check_real, count, range_from_time
from spadwarp.viz import evaluation as drawing

if TYPE_CHECKING:
    from spadwarp.evaluation.fresh_scenes import FreshScene
    from spadwarp.result.result import Result

__all__ = ["FreshScores", "PhotonSweep", "draw_photon_sweep", "evaluate_fresh", "photon_sweep"]


class FreshScore(NamedTuple):
    """What methods make of one fresh scene."""

    text: str  # of the scene
    rmse: dict[str, float]
    """[m] over the pixels that see a target, by "METHOD" or "METHOD TUNING"; "histograms": the network with the true
    background, as all others, "histograms, own background": with the one estimated from the counts."""
    invented: float  # part of the pixels of open water that the network gives a target; NaN without such pixels
    invented_own: float  # the same with the estimated background
    missed: float  # part of the pixels of the target that it leaves out

    @property
    def classical(self) -> dict[str, float]:
        """RMSE of the classical variants alone."""
        return {name: value for name, value in self.rmse.items() if not name.startswith("histograms")}

    @property
    def ratio(self) -> float:
        """RMSE of the network over that of the classical variant that is best on this very scene."""
        return self.rmse["histograms"] / min(self.classical.values())


@dataclass(frozen=True, kw_only=True)
class FreshScores:
    """Scores of fresh scenes, and the seed that repeats them."""

    seed: int
    scenes: tuple[FreshScore, ...]

    def fixed(self) -> tuple[str, NDArray[np.float64]]:
        """The classical variant that most scenes prefer to the network, and the network's ratios to it."""
        found = {
            name: np.array([one.rmse["histograms"] / one.rmse[name] for one in self.scenes])
            for name in self.scenes[0].classical
        }
        return max(found.items(), key=lambda item: (int((item[1] > 1).sum()), float(np.median(item[1]))))

    def summary(self) -> dict[str, Any]:
        """The figures that count."""
        ratio = np.array([one.ratio for one in self.scenes])
        own = np.array([one.rmse["histograms, own background"] / one.rmse["histograms"] for one in self.scenes])
        name, fixed = self.fixed()
        invented = [[one.invented, one.invented_own] for one in self.scenes if one.invented == one.invented]
        water = np.array(invented or [[np.nan, np.nan]])
        return {
            "seed": self.seed, "scenes": len(ratio), "better_than_tuned": int((ratio < 1).sum()),
            "median_ratio": float(np.median(ratio)), "worst_ratio": float(ratio.max()),
            "best_fixed": name, "better_than_fixed": int((fixed < 1).sum()),
            "median_ratio_fixed": float(np.median(fixed)), "worst_ratio_fixed": float(fixed.max()),
            "own_background_within_1.3": int((own <= 1.3).sum()), "own_background_median": float(np.median(own)),
            "own_background_worst": float(own.max()),
            "invented": float(water[:, 0].mean()), "invented_worst": float(water[:, 0].max()),
            "invented_own_background": float(water[:, 1].mean()),
            "missed": float(np.mean([one.missed for one in self.scenes])),
        }  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names, for JSON."""
        return {**self.summary(), "of_scenes": [one._asdict() for one in self.scenes]}


def evaluate_fresh(
    *,
    scenes: int = 20,
    seed: int | None = None,
    weights: str | Path | None = None,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> FreshScores:
    """Scores the network for histograms against classical variants on scenes that nobody has seen.

    Every tuning of every classical method and of the median competes; the best of them on a scene is known only by its
    truth. Half of the scenes are rendered by transport, a few seconds each on a CPU.

    Args:
        scenes: Their number.
        seed: Repeats a judgement; default: of the clock.
        weights: File of `spadwarp train` with weights of the network for histograms.
        device: torch device; transport runs on the one of its kind.
        progress: Called with ("scenes", done, total).

    Errors are those of `evaluate`.
    """
    from spadwarp.evaluation.fresh_scenes import fresh_scene

    scenes = check_integer("scenes", scenes, "[1, 10000]")
    seed = time.time_ns() % 2**40 if seed is None else check_integer("seed", seed, SEED)
    found = []
    for number in range(scenes):
        found.append(fresh_score(fresh_scene(seed, number, device=device), weights=weights, device=device))
        if progress is not None:
            progress("scenes", number + 1, scenes)
    return FreshScores(seed=seed, scenes=tuple(found))


def fresh_score(scene: FreshScene, *, weights: str | Path | None = None, device: str | None = None) -> FreshScore:
    """The scores of one scene."""
    from spadwarp.denoise.classical import TUNINGS, classical_depth

    seen, (start, stop) = np.isfinite(scene.clean), scene.gate
    frames = count_frames(scene.counts, scene.background, scene.response)
    given: dict[str, Any] = {"response": scene.response, "device": device, "min_significance": 0.0, "weights": weights}
    rmse: dict[str, float] = {}

    def metres(part: NDArray[Any]) -> NDArray[np.float32]:
        return (start + (stop - start) * part).astype(np.float32)

    def judge(name: str, depth: NDArray[np.float32]) -> None:
        rmse[name] = float(np.sqrt(np.mean((np.nan_to_num(depth, nan=stop) - scene.clean)[seen] ** 2)))

    for method, tunings in TUNINGS.items():
        for tuning in tunings:
            depth = metres(classical_depth(frames, method=method, tuning=tuning, device=device)[0])
            judge(f"{method} {tuning:g}", depth)
            if method == "likelihood":
                first = depth
    for window in MEDIAN_WINDOWS:
        filtered = estimate_frames(depth_frames(first, gate=scene.gate), model="median", window=window)
        judge(f"median {window}", filtered.depth[0])
    shares = []
    for name, background in (("histograms", scene.background), ("histograms, own background", "decay")):
        answer = estimate(first, gate=scene.gate, counts=scene.counts, background=background, **given)
        assert answer.significance is not None
        target = (answer.target_probability >= target_threshold("histograms")) & (answer.significance >= 4.0)
        judge(name, answer.depth)
        shares.append((float(target[~seen].mean()) if (~seen).any() else math.nan, float((~target)[seen].mean())))
    return FreshScore(scene.text, rmse, shares[0][0], shares[1][0], shares[0][1])


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
    for name, values in (("photons", photons), ("sbr", sbr)):
        check_integer(f"number of {name}", len(values), "[1, 10000]")
        for value in values:
            check_real(f"{name}: an item", value, "[1e-9, 1e9]")
    frames, seed = check_integer("frames", frames, "[1, 1000000]"), check_integer("seed", seed, SEED)
    methods = compared(models, weights, counts=True)
    shape, truth, done = (len(sbr), len(photons)), result.truth.depth, 0
    squares = {name: np.zeros((len(MEDIAN_WINDOWS) if name == "median" else 1, *shape)) for name in methods}
    bound = np.zeros(shape)
    for row, column in np.ndindex(shape):
        for _ in range(frames):
            point: dict[str, Any] = {"photons": photons[column], "sbr": sbr[row], "seed": seed * 1_000_003 + done}
            noisy, sigma, histograms = photon_frame(result, **point)
            start, stop = noisy.gate
            seen = np.isfinite(truth) & np.isfinite(sigma) & (truth >= start) & (truth < stop)
            guess = (stop - start) / np.sqrt(12.0)
            bound[row, column] += float(np.mean(np.minimum(sigma[seen], guess) ** 2)) / frames
            for name, sums in squares.items():  # a median of each window is tried; the others have one variant
                for total, window in zip(sums, MEDIAN_WINDOWS, strict=False):
                    if methods[name]["model"] in FROM_COUNTS:
                        found = estimate_histograms(noisy.depth, **histograms, device=device, **methods[name])
                    else:
                        found = estimate_frames(noisy, window=window, device=device, **methods[name])
                    total[row, column] += float(np.mean((found.depth[0][seen] - truth[seen]) ** 2)) / frames
            done += 1
            if progress is not None:
                progress("frames", done, frames * bound.size)
    scene, depth = result.scene, np.nanmedian(truth)
    extinction = scene.medium.extinction
    summary = (
        f"Monte Carlo histograms of {count(result.photons)} photons, water c = {extinction:.3g} 1/m, target at "
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
    result: Result, *, photons: float, sbr: float, seed: int
) -> tuple[DepthFrames, NDArray[np.float64], dict[str, Any]]:
    """One frame of likelihood depth from Poisson counts, the Cramér–Rao bound of each pixel `[H, W]` [m], and the
    counts as `estimate_histograms` takes them."""
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
    arrival = arrival_time(
        counts, gate_start=gate.start, bin_width=gate.bin_width, method="likelihood",
        irf=response, background=background.astype(np.float32),
    )  # fmt: skip
    depth = depth_from_time(arrival.reshape(seen.shape), scene=scene)
    sigma = crlb_from_histogram(signal, background, bin_width=gate.bin_width, pulses=1.0, irf=response)
    index = scene.medium.group_index
    depth_gate = tuple(range_from_time(end, index) + port_advance(scene) for end in (gate.start, gate.stop))

    def to_depth(part: NDArray[np.float32]) -> NDArray[Any]:
        return depth_from_time(gate.start + part.astype(np.float64) * (gate.stop - gate.start), scene=scene)

    histograms = {
        "frames": CountFrames(counts[None], background[0, 0].astype(np.float32), matrix.astype(np.float32)),
        "bins": slice(None), "bin_width": (depth_gate[1] - depth_gate[0]) / gate.bins, "to_depth": to_depth,
    }  # fmt: skip
    return depth_frames(depth, gate=depth_gate, profile=profile), range_from_time(sigma, index), histograms


def draw_photon_sweep(sweep: PhotonSweep, path: str | Path) -> Path:
    """RMSE against photons, a panel for each signal-to-background ratio, beside the bound; returns the path."""
    return drawing.draw_photon_sweep(
        sweep.rmse, sweep.bound, path, photons=sweep.photons, sbr=sweep.sbr, note=sweep.summary
    )
