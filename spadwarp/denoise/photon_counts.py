"""RMSE against signal photons: denoisers on the frames of a camera that counts few of them.

Histograms are drawn from a Monte Carlo result with its own backscatter profile, at given signal counts and
signal-to-background ratios (SBR). Depth is the maximum-likelihood estimate of each pixel with known background; it is
compared with its Cramér–Rao bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.baselines import MEDIAN_WINDOWS
from spadwarp.denoise.frames import DepthFrames, depth_frames
from spadwarp.denoise.histogram_inputs import features_of_histograms
from spadwarp.denoise.inference import METHODS, denoise_frames
from spadwarp.denoise.network_files import own_weights
from spadwarp.frames.cramer_rao import crlb_from_histogram
from spadwarp.frames.depth import arrival_time
from spadwarp.frames.response import detector_response
from spadwarp.scene.sight import depth_from_time, port_advance
from spadwarp.values import SEED, SpadwarpError, check_choice, check_integer, check_real, range_from_time
from spadwarp.viz import evaluation as drawing

if TYPE_CHECKING:
    from spadwarp.result.result import Result

__all__ = ["PhotonSweep", "draw_photon_sweep", "photon_frame", "photon_sweep"]


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotonSweep:
    """RMSE of methods over photon counts and signal-to-background ratios.

    Attributes:
        summary: Scene, water and seed, as text.
        photons: Signal counts of the median pixel, `[P]`.
        sbr: Signal-to-background ratio, signal counts over background counts in the gate, `[S]`.
        rmse: By method, `[S, P]` [m]; "input" is the likelihood estimate itself.
        bound: Root mean square over pixels of the Cramér–Rao bound, or of a uniform guess over the gate where that is
            smaller, `[S, P]` [m].
        windows: Side of the median with the smallest RMSE, `[S, P]` [pixels].
    """

    summary: str
    photons: tuple[float, ...]
    sbr: tuple[float, ...]
    rmse: dict[str, NDArray[np.float64]]
    bound: NDArray[np.float64]
    windows: NDArray[np.int64]

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
        sbr: Signal-to-background ratios: signal counts over background counts within the gate, > 0.
        models: From `spadwarp.denoise.METHODS`; the median has its best window at each point.
        frames: Drawn and averaged for each point.
        seed: Of the counts.
        weights: File of `spadwarp train`, replacing the package's weights of the network that it names.
        device: torch device of the networks.
        progress: Called with ("frames", done, total).

    Raises:
        ArgumentError: An argument out of range; weights of a network that is not among the models.
        FileError: Weights that cannot be read.
        SpadwarpError: The result has no return, no backscatter or no instrument response.
    """
    for model in models:
        check_choice("models: an item", model, METHODS)
    for name, values in (("photons", photons), ("sbr", sbr)):
        check_integer(f"number of {name}", len(values), "[1, 10000]")
        for value in values:
            check_real(f"{name}: an item", value, "[1e-9, 1e9]")
    frames, seed = check_integer("frames", frames, "[1, 1000000]"), check_integer("seed", seed, SEED)
    own = own_weights(models, weights)
    # A median of each window is tried; the other methods have one variant.
    variants = [("input", 5)]
    for name in models:
        variants += [(name, window) for window in (MEDIAN_WINDOWS if name == "median" else (5,))]
    shape = (len(sbr), len(photons))
    squares = {variant: np.zeros(shape) for variant in variants}
    bound = np.zeros(shape)
    truth = result.truth.depth
    done, total = 0, frames * bound.size
    for row, column in np.ndindex(shape):
        for _ in range(frames):
            point: dict[str, Any] = {"photons": photons[column], "sbr": sbr[row], "seed": seed * 1_000_003 + done}
            noisy, sigma = photon_frame(result, **point, device=device)
            start, stop = noisy.gate
            seen = np.isfinite(truth) & np.isfinite(sigma) & (truth >= start) & (truth < stop)
            guess = (stop - start) / np.sqrt(12.0)
            bound[row, column] += float(np.mean(np.minimum(sigma[seen], guess) ** 2)) / frames
            for name, window in variants:
                found, _ = denoise_frames(noisy, model=name, window=window, weights=own.get(name), device=device)
                squares[name, window][row, column] += float(np.mean((found[0][seen] - truth[seen]) ** 2)) / frames
            done += 1
            if progress is not None:
                progress("frames", done, total)
    medians = [squares.get(("median", window), np.zeros(shape)) for window in MEDIAN_WINDOWS]
    smallest = {name: np.min([squares[v] for v in variants if v[0] == name], axis=0) for name in ("input", *models)}
    return PhotonSweep(
        summary=_summary(result, seed) + "".join(f"; {name} with weights {path}" for name, path in own.items()),
        photons=tuple(map(float, photons)),
        sbr=tuple(map(float, sbr)),
        rmse={name: np.sqrt(values) for name, values in smallest.items()},
        bound=np.sqrt(bound),
        windows=np.array(MEDIAN_WINDOWS)[np.argmin(medians, axis=0)],
    )


def _summary(result: Result, seed: int) -> str:
    scene, depth = result.scene, np.nanmedian(result.truth.depth)
    extinction, bins, width = scene.medium.extinction, scene.gate.bins, 1e12 * scene.gate.bin_width
    return (
        f"Monte Carlo histograms of {result.photons:.2g} photons, water c = {extinction:.3g} 1/m, target at "
        f"{depth:.3g} m ({depth * extinction:.2g} attenuation lengths), gate of {bins} bins of {width:.3g} ps; "
        f"seed {seed}"
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
    scale = photons / np.median(signal.sum(axis=-1)[seen])
    # The same background in all pixels: otherwise the estimator would know its Monte Carlo noise.
    profile = back.reshape(-1, back.shape[-1]).sum(axis=0)
    profile = np.convolve(profile / profile.sum(), matrix, mode="same")
    background = np.broadcast_to(photons / sbr * profile + 1e-6, back.shape)
    smeared = convolve1d(signal * scale, matrix, axis=-1, mode="constant")
    counts = np.random.Generator(np.random.Philox(seed)).poisson(smeared + background).astype(np.float32)
    time = arrival_time(
        counts, gate_start=gate.start, bin_width=gate.bin_width, method="likelihood",
        irf=response, background=background.astype(np.float32),
    )  # fmt: skip
    depth = depth_from_time(time.reshape(seen.shape), scene=scene)
    sigma = crlb_from_histogram(signal * scale, background, bin_width=gate.bin_width, pulses=1.0, irf=response)
    index = scene.medium.group_index
    depth_gate = tuple(range_from_time(end, index) + port_advance(scene) for end in (gate.start, gate.stop))
    features = features_of_histograms(
        counts,
        background=background[0, 0],
        response=matrix,
        device=device,
        to_depth=lambda part: depth_from_time(
            gate.start + part.astype(np.float64) * (gate.stop - gate.start), scene=scene
        ),
    )
    return depth_frames(depth, gate=depth_gate, profile=profile, features=features), range_from_time(sigma, index)


def draw_photon_sweep(sweep: PhotonSweep, path: str | Path) -> Path:
    """RMSE against photons, a panel for each signal-to-background ratio, beside the bound; returns the path."""
    return drawing.draw_photon_sweep(
        sweep.rmse, sweep.bound, path, photons=sweep.photons, sbr=sweep.sbr, note=sweep.summary
    )
