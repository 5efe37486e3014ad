"""The Cramér–Rao bound of the delay from a histogram's own shape, scattered light included."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import spadwarp_kernels as sk
from spadwarp.arrays import Floats, as_warp, real_array
from spadwarp.device import pick_device
from spadwarp.frames.response import InstrumentResponse, detector_response
from spadwarp.result.file import ResultLike, as_result
from spadwarp.result.result import Result
from spadwarp.scene import noise_rate
from spadwarp.values import BIN_WIDTH, ArgumentError, check_choice, check_real, percent, shown

__all__ = ["crlb", "crlb_from_histogram", "information_from_histogram"]

_PART_VOXELS = 1 << 20

MOST_NOISE = 0.5
"""Part of the information that may be noise of the simulation. Of light whose truth is known, photons with weights of
spread exp(1.5), the bound is then 10 to 30 % too large, 40 to 80 % where noise is four fifths, and a factor beyond."""


def crlb_from_histogram(
    signal_cube: ArrayLike, background_cube: ArrayLike, *, bin_width: float, pulses: float, **options: Any
) -> Floats:
    """Cramér–Rao bound of the delay from the shape of expected histograms, pixel by pixel [s].

    F = Σ_k (dλ_k/dμ)²/λ_k with λ = signal + background; the delay μ moves the signal alone. Amplitude and background
    count as known. float64 `[...]`: NaN where the histogram holds no information, inf where its noise makes up all of
    it. `pulses`: of one depth frame, > 0; the others: see `information_from_histogram`.
    """
    pulses = check_real("pulses", pulses, "(0, 1e30]")
    return _deviation(*information_from_histogram(signal_cube, background_cube, bin_width=bin_width, **options), pulses)


def _deviation(information: Floats, noise: Floats, pulses: float) -> Floats:
    with np.errstate(divide="ignore"):
        sigma = 1.0 / np.sqrt(pulses * np.maximum(information - noise, 0.0))
    return np.where(information > 0, sigma, np.nan)


def information_from_histogram(
    signal_cube: ArrayLike,
    background_cube: ArrayLike,
    *,
    bin_width: float,
    irf: InstrumentResponse | None = None,
    law: Literal["poisson", "first_photon"] = "poisson",
    signal_variance: ArrayLike | None = None,
    signal_halves: tuple[ArrayLike, ArrayLike] | None = None,
    device: Any = None,
) -> tuple[Floats, Floats]:
    """Fisher information on the delay per pulse, and its part that is noise of a Monte Carlo estimate: float64 `[...]`
    [1/s²]. The noise is one for all pixels together: in one it may be larger than the information, or negative.

    Args:
        signal_cube: Expected signal detections per pulse and bin, `[..., T]`, ≥ 0.
        background_cube: The same for what does not move with the target: a number, `[T]`, or `signal_cube`'s shape.
        bin_width: [s], > 0.
        irf: Response still to be applied to both cubes; None if they hold it already. A bin's light is spread evenly
            over it.
        law: `"poisson"`: every photon counts. `"first_photon"`: the first of a pulse, pile-up included.
        signal_variance: Square of the standard error of `signal_cube`, of the same shape, where it is a Monte Carlo
            estimate, whose noise would count as information: a slope that is a sum of bins with weights w has Σ w² var
            more in the mean of its square. That is subtracted, for independent bins and to first order: the bound
            comes out too large, by 10 to 30 % where half of the information is noise, by a factor where nearly all is.
        signal_halves: Two independent estimates whose mean is `signal_cube`, in place of `signal_variance`: a product
            of their slopes has no noise in its mean, whatever the bins share.
        device: Warp device; default: the first GPU, else the CPU.

    Raises `ArgumentError`: negative or non-finite cubes, shapes that do not fit, values out of range.
    """
    signal = np.ascontiguousarray(real_array("signal_cube", signal_cube, within="[0, inf)"))
    if signal.size == 0:
        raise ArgumentError(f"signal_cube has shape {signal.shape}: no values")
    bins = signal.shape[-1]
    alike: Any = {"shapes": (signal.shape,), "within": "[0, inf)"}
    either = ((), (bins,), signal.shape)
    background = real_array("background_cube", background_cube, shapes=either, within="[0, inf)")
    bin_width = check_real("bin_width", bin_width, BIN_WIDTH)
    check_choice("law", law, ("poisson", "first_photon"))
    # Response per bin, and the derivative by the delay in bins of what one bin's photons leave in the others.
    taps, slope_taps = np.ones(1), np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0  # of fourth order
    if irf is not None:
        if not isinstance(irf, InstrumentResponse):
            raise ArgumentError(f"irf = {shown(irf)} is not an InstrumentResponse")
        if not irf.is_smooth:
            raise ArgumentError("irf has no width: a step has no derivative")
        taps, slope_taps = irf.per_bin(bin_width), irf.per_bin_slope(bin_width)
    device = pick_device(device)
    rows = np.ascontiguousarray(background.reshape(-1, bins) if background.ndim else background.reshape(1, 1))
    given = {"signal": signal.reshape(-1, bins), "background": rows, "taps": taps, "slope_taps": slope_taps}
    inputs = [as_warp(array, name=name, device=device) for name, array in given.items()]
    information = sk.analytic.histogram_information(*inputs, first_photon=law == "first_photon").numpy()
    noise = np.zeros_like(information)
    total = np.asarray(signal + background, np.float64).reshape(-1, bins)
    if signal_halves is not None:
        halves = [real_array("signal_halves", half, np.float64, **alike) for half in signal_halves]
        # The product of two slopes is the square of their mean less the square of half their difference.
        noise = _information_of_noise(0.5 * (halves[0] - halves[1]).reshape(-1, bins), total, taps, slope_taps, law)
    elif signal_variance is not None:
        variance = real_array("signal_variance", signal_variance, np.float64, **alike)
        noise = _information_of_noise(variance.reshape(-1, bins), total, taps, slope_taps, law, is_variance=True)
    shape = signal.shape[:-1]
    return information.reshape(shape) / bin_width**2, noise.reshape(shape) / bin_width**2


def _information_of_noise(
    noise: Floats, total: Floats, taps: Floats, slope_taps: Floats, law: str, *, is_variance: bool = False
) -> Floats:
    """Noise in the mean Fisher information per pulse, in 1/bins²: of the bins, or the variance of independent ones."""
    from scipy.ndimage import convolve1d

    added, size = np.empty(len(total)), max(1, _PART_VOXELS // total.shape[1])
    for first in range(0, len(total), size):  # cubes are large
        part = slice(first, first + size)
        rate = convolve1d(total[part], taps, axis=1, mode="constant")
        squares = convolve1d(noise[part], slope_taps**2 if is_variance else slope_taps, axis=1, mode="nearest")
        squares = squares if is_variance else np.square(squares)
        if law == "first_photon":
            squares, rate = squares * np.exp(-np.cumsum(rate, axis=1)), -np.expm1(-rate)
        added[part] = np.divide(squares, rate, out=np.zeros_like(rate), where=rate > 0).sum(axis=1)
    return added


class ResultBound(NamedTuple):
    """The bound of a result, and what it is worth.

    `sigma`: of the delay, float64 `[H, W]` [s], see `crlb`; `noise`: part of the information that was noise of the
    simulation and is subtracted, median over the target's pixels, NaN where the result keeps no standard errors or no
    pixel has information; `problem`: why the bound is not to be used, in words, else None.
    """

    sigma: Floats
    noise: float
    problem: str | None


def bound_of_result(
    result: Result,
    *,
    pulses: float | None = None,
    law: Literal["poisson", "first_photon"] = "first_photon",
    device: Any,
) -> ResultBound:
    """`crlb`, also where too few photons were traced."""
    scene = result.scene
    scale = scene.detectable_photons_per_pulse
    signal = (result.expected("ballistic") + result.expected("forward_scattered")) * scale
    background = result.expected("backscatter") * scale + noise_rate(scene, result.truth) * scene.gate.bin_width
    variance = None
    if result.batches > 1:
        # The errors are those of all light: the signal has its part of the variance.
        light = result.expected() * scale
        part = np.divide(signal, light, out=np.zeros_like(light), where=light > 0)
        variance = np.square(result.expected_error * scale) * part
    axis: dict[str, Any] = {"bin_width": scene.gate.bin_width, "irf": detector_response(scene.detector, scene.laser)}
    options: dict[str, Any] = {**axis, "law": law, "signal_variance": variance, "device": device}
    information, noise = information_from_histogram(signal, background, **options)
    pulses = check_real("pulses", scene.pulses_per_depth_frame if pulses is None else pulses, "(0, 1e30]")
    known = (information > 0) & np.isfinite(result.truth.depth)
    problem, part_of_noise = None, np.nan
    if variance is not None and known.any():
        part_of_noise = float(np.median(noise[known] / information[known]))
    if part_of_noise > MOST_NOISE:
        needed = photons_for_noise(result.photons, part_of_noise, 1.0 / 3.0)
        problem = (
            f"{percent(part_of_noise)} % of the information on the delay in the median pixel is noise of the "
            f"simulation, and no bound can be had from what is left; about {needed:.1e} photons instead of "
            f"{result.photons:.1e} would make that a third"
        )
    return ResultBound(_deviation(information, noise, pulses), part_of_noise, problem)


def photons_for_noise(photons: int, noise: float, wanted: float) -> float:
    """Photons that make noise the wanted part of the information: it falls as their number, the rest stays."""
    noise = min(noise, 0.999)
    return photons * noise / (1.0 - noise) * (1.0 - wanted) / wanted


def crlb(
    result: ResultLike,
    *,
    pulses: float | None = None,
    law: Literal["poisson", "first_photon"] = "first_photon",
    device: Any = None,
) -> Floats:
    """Cramér–Rao bound of a Monte Carlo result's delay per pixel, float64 `[H, W]` [s]; NaN for no information.

    The scattered return moves with the target and counts as signal; backscatter, dark counts and ambient light do not.
    The scene's instrument response is applied. Noise of the simulation, which counts as information, is subtracted
    where the result keeps standard errors: inf where it is all there is.

    `result`: of `spadwarp.simulate`, or its path; `pulses`: of one depth frame; default: the scene's,
    `Scene.pulses_per_depth_frame`; `law`, `device`: see `information_from_histogram`. Raises `ArgumentError` where
    noise is more than half of the information in the median pixel of the target; it says how many photons are needed.
    """
    result = as_result(result)
    bound = bound_of_result(result, pulses=pulses, law=law, device=device)
    if bound.problem is not None:
        raise ArgumentError(f"result: {bound.problem}")
    return bound.sigma
