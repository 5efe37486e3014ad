"""RMSE against photons: what denoisers do with the frames of a camera that counts few of them.

Histograms are drawn from a Monte Carlo result, its own backscatter profile included, with the signal counts and the
signal-to-background ratio that are asked for. Depth is the maximum-likelihood estimate of each pixel with the
background known; beside it stands its Cramér–Rao bound.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.denoise.baselines import MEDIAN_WINDOWS
from spadwarp.denoise.frames import POOLED, DepthFrames, depth_frames
from spadwarp.denoise.inference import METHODS, clues_of, denoise_frames, own_weights
from spadwarp.errors import ArgumentError, SpadwarpError
from spadwarp.frames.arrival_time import arrival_time
from spadwarp.frames.cramer_rao import crlb_from_histogram
from spadwarp.frames.response import detector_response
from spadwarp.io.atomic import atomic_path
from spadwarp.scene.geometry import depth_from_time
from spadwarp.units import range_from_time

if TYPE_CHECKING:
    from spadwarp.result.result import Result

__all__ = ["PhotonSweep", "draw_photon_sweep", "photon_frame", "photon_sweep"]


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotonSweep:
    """RMSE of methods over photon counts and signal-to-background ratios.

    Attributes:
        about: Scene, water and seed, in words.
        photons: Signal counts of the median pixel, `[P]`. sbr: Signal counts over background counts in the gate, `[S]`.
        rmse: By method, `[S, P]` [m]; "input" is the likelihood estimate itself.
        bound: Root mean square over pixels of the Cramér–Rao bound, no worse than a guess, `[S, P]` [m].
        windows: Best side of the median, `[S, P]` [pixels].
    """

    about: str
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
            levels = np.minimum.accumulate(np.log(self.rmse["input"][row]))  # falls with the photons
            for column, wanted in enumerate(np.log(self.rmse[method][row])):
                if levels[-1] <= wanted <= levels[0]:
                    reached = np.interp(-wanted, -levels, counts)
                    out[row, column] = np.exp(reached - counts[column])
        return out

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names, for JSON."""
        return {
            "about": self.about,
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
        photons: Signal counts within the gate in the median pixel that sees a target, > 0, rising.
        sbr: Signal counts over background counts within the gate, > 0.
        models: From `spadwarp.denoise.inference.METHODS`; the median has its best window everywhere.
        frames: Drawn and averaged for each point.
        seed: Of the counts.
        weights: File of `spadwarp train`, in place of the package's for the network that it names.
        device: torch device of the networks.
        progress: Called with ("frames", done, total).

    Raises:
        ArgumentError: An argument out of range; weights of a network that is not among the models.
        FileError: Weights that cannot be read.
        SpadwarpError: The result has no return, no backscatter or no instrument response.
    """
    if unknown := [name for name in models if name not in METHODS]:
        raise ArgumentError(f"models: {unknown[0]!r} is not one of {', '.join(map(repr, METHODS))}")
    for name, values in (("photons", photons), ("sbr", sbr)):
        if not values or min(values) <= 0:
            raise ArgumentError(f"{name} = {list(values)} needs numbers in (0, inf)")
    own = own_weights(models, weights)
    shape = (len(sbr), len(photons))
    squares = {name: np.zeros(shape) for name in ("input", *models)}
    tried = {window: np.zeros(shape) for window in MEDIAN_WINDOWS}
    bound = np.zeros(shape)
    truth = result.truth.depth
    done, total = 0, frames * len(sbr) * len(photons)
    for row, ratio in enumerate(sbr):
        for column, count in enumerate(photons):
            for _ in range(frames):
                noisy, sigma = photon_frame(
                    result, photons=count, sbr=ratio, seed=seed * 1_000_003 + done, device=device
                )
                start, stop = noisy.gate
                seen = np.isfinite(truth) & np.isfinite(sigma) & (truth >= start) & (truth < stop)
                guess = (stop - start) / np.sqrt(12.0)
                bound[row, column] += float(np.mean(np.minimum(sigma[seen], guess) ** 2)) / frames

                def square(image: NDArray[Any], seen: NDArray[np.bool_] = seen) -> float:
                    return float(np.mean((image[seen] - truth[seen]) ** 2)) / frames

                squares["input"][row, column] += square(np.nan_to_num(noisy.depth[0], nan=0.5 * (start + stop)))
                for name in models:
                    if name == "median":
                        for window in MEDIAN_WINDOWS:
                            found, _ = denoise_frames(noisy, model="median", window=window)
                            tried[window][row, column] += square(found[0])
                    else:
                        found, _ = denoise_frames(noisy, model=name, weights=own.get(name), device=device)
                        squares[name][row, column] += square(found[0])
                done += 1
                if progress is not None:
                    progress("frames", done, total)
    stacked = np.stack(list(tried.values()))
    if "median" in models:
        squares["median"] = stacked.min(axis=0)
    scene = result.scene
    return PhotonSweep(
        about=(
            f"Monte Carlo histograms of {result.photons:.2g} photons, water c = {scene.medium.extinction:.3g} 1/m, "
            f"target at {np.nanmedian(truth):.3g} m ({np.nanmedian(truth) * scene.medium.extinction:.2g} attenuation "
            f"lengths), gate of {scene.gate.bins} bins of {scene.gate.bin_width * 1e12:.3g} ps; seed {seed}"
            + "".join(f"; {name} with weights {path}" for name, path in own.items())
        ),
        photons=tuple(map(float, photons)),
        sbr=tuple(map(float, sbr)),
        rmse={name: np.sqrt(values) for name, values in squares.items()},
        bound=np.sqrt(bound),
        windows=np.array(MEDIAN_WINDOWS)[stacked.argmin(axis=0)],
    )


def photon_frame(
    result: Result, *, photons: float, sbr: float, seed: int, device: str | None = None
) -> tuple[DepthFrames, NDArray[np.float64]]:
    """One frame of likelihood depth from Poisson counts, and the Cramér–Rao bound of each pixel `[H, W]` [m].

    The frame also has the clues of its histograms, worked out on the torch device.
    """
    from scipy.ndimage import convolve1d

    scene = result.scene
    response = detector_response(scene.detector, scene.laser)
    if not response.is_smooth:
        raise SpadwarpError(
            "the scene has no instrument response: laser.pulse_fwhm_ps and detector.jitter_fwhm_ps are 0"
        )
    matrix = response.per_bin(scene.gate.bin_width)
    signal = result.component("ballistic") + result.component("forward_scattered")
    back = result.component("backscatter")
    seen = np.isfinite(result.truth.depth) & (signal.sum(axis=-1) > 0)
    if not seen.any() or not back.sum() > 0:
        raise SpadwarpError("the result holds no return, or no backscatter: there is nothing to sweep")
    scale = photons / np.median(signal.sum(axis=-1)[seen])
    # The same background in all pixels: its noise from the simulation would otherwise be known to the estimator.
    profile = back.reshape(-1, back.shape[-1]).sum(axis=0)
    profile = np.convolve(profile / profile.sum(), matrix, mode="same")
    background = np.broadcast_to(photons / sbr * profile + 1e-6, back.shape)
    smeared = convolve1d(signal * scale, matrix, axis=-1, mode="constant")
    counts = np.random.Generator(np.random.Philox(seed)).poisson(smeared + background).astype(np.float32)
    time = arrival_time(
        counts,
        gate_start=scene.gate.start,
        bin_width=scene.gate.bin_width,
        method="likelihood",
        irf=response,
        background=background.astype(np.float32),
    )
    depth = depth_from_time(time.reshape(seen.shape), scene=scene)
    sigma = crlb_from_histogram(signal * scale, background, bin_width=scene.gate.bin_width, pulses=1.0, irf=response)
    index = scene.medium.group_index
    gate = (range_from_time(scene.gate.start, index), range_from_time(scene.gate.stop, index))
    clues = clues_of(counts[None], background=background[0, 0], response=matrix, device=device)
    for channel in range(POOLED):
        time = scene.gate.start + clues[0, channel].astype(np.float64) * (scene.gate.stop - scene.gate.start)
        clues[0, channel] = depth_from_time(time, scene=scene)
    return depth_frames(depth, gate=gate, profile=profile, clues=clues), range_from_time(sigma, index)


def draw_photon_sweep(sweep: PhotonSweep, path: str | Path) -> Path:
    """RMSE against photons, a panel for each signal-to-background ratio, the bound beside it; returns the path."""
    from matplotlib.figure import Figure

    from spadwarp.viz.evaluation import COLOURS, TITLES

    columns = len(sweep.sbr)
    figure = Figure(figsize=(3.3 * columns + 0.4, 3.9), layout="constrained", facecolor="white")
    axes = figure.subplots(1, columns, sharey=True, squeeze=False)[0]
    for row, (axis, ratio) in enumerate(zip(axes, sweep.sbr, strict=True)):
        for name, values in sweep.rmse.items():
            axis.plot(
                sweep.photons, 1e3 * values[row], color=COLOURS[name], marker="o", markersize=3.5,
                linewidth=2.2 if name == "histograms" else 1.2, linestyle="--" if name == "input" else "-",
                label="likelihood of each pixel" if name == "input" else TITLES[name],
            )  # fmt: skip
        axis.plot(
            sweep.photons, 1e3 * sweep.bound[row], color="black", linestyle=":", label="Cramér–Rao bound of a pixel"
        )
        axis.set(xscale="log", yscale="log", xlabel="signal photons a pixel", title=f"SBR {ratio:g}")
        axis.grid(color="0.92", which="both")
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("RMSE of depth [mm]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=8.5)
    figure.supxlabel(textwrap.fill(sweep.about, 30 + 30 * columns), fontsize=8, color="0.35")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format="png")
    return Path(path)
