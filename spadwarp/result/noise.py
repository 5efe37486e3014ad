"""Noise of a simulation against that of the camera: by how much a frame's photons outweigh what too few traced photons
leave in the expected light."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats
from spadwarp.io.text import duration
from spadwarp.scene import Detector, Laser, Scene, noise_rate
from spadwarp.values import check_real, count

if TYPE_CHECKING:
    from spadwarp.result.result import Result

__all__ = ["NOISE_GOAL", "PhotonsNeeded", "noise_problem", "photons_needed", "unclear_pixels"]

NOISE_GOAL = 0.1
"""`Result.target_noise_ratio` up to which a result's noise does not show beside that of a frame's photons: it adds 5 %
to their standard deviation."""

UNKNOWN_NOISE = "the noise of the simulation is not known: the result keeps no standard errors; more photons give them"

_FWHM_PER_SIGMA = math.sqrt(8.0 * math.log(2.0))
_NARROW = 0.2  # standard deviation [bins] of a response that leaves light in its bin
_PART_VOXELS = 1 << 22
_KNOWN = 1.0 / 3.0  # relative standard error of a bin that means something
_SAMPLE = 1024  # pixels whose median stands for the target


def noise_ratios(result: Result, pixels: NDArray[np.intp]) -> Floats:
    """`Result.noise_ratio` of pixels, by their numbers in the image; `[P]`."""
    components, _, _, bins = result.tallies.shape
    tallies, moments = result.tallies.reshape(components, -1, bins), result.known_moment.reshape(2, -1, bins)
    size = max(1, _PART_VOXELS // bins)
    scene, value, better = result.scene, result.tally_value.reshape(-1), result.reconstruction
    target = np.isfinite(result.truth.depth).reshape(-1)
    noise = np.broadcast_to(noise_rate(scene, result.truth), (*result.truth.depth.shape, 1)).reshape(-1)
    ratios = np.full(len(pixels), np.nan)
    for first in range(0, len(pixels), size):
        part = pixels[first : first + size]
        mine = tallies[:, part]
        scale = (value[part] * (scene.laser.photons_per_pulse * scene.detections_per_photon))[:, None]
        if better is None:
            error = result.batch_error(mine, moments[:, part]) * scale
        else:
            scale = np.full((1, 1), scene.laser.photons_per_pulse * scene.detections_per_photon)
            mine = better.histogram.reshape(components, -1, bins)[:, part].astype(np.float64)
            error = better.error.reshape(-1, bins)[part] * scale
        light = mine.sum(axis=0) * scale
        # The return is the light of the target, where there is one.
        signal = np.where(target[part, None], mine[:2].sum(axis=0) * scale, light)
        background = noise[part, None] * scene.gate.bin_width
        ratios[first : first + size] = _ratios(scene, signal, light, background, error)
    return ratios


def _ratios(scene: Scene, signal: Floats, light: Floats, background: Floats, error: Floats) -> Floats:
    """From detections per pulse `[P, T]`: of the return, of all light, of ambient light and dark counts, and the
    standard errors of all light.

    The matched filter adds up counts c_k with weights w_k, the return after the instrument's response h. Errors σ_j of
    the light move it by M² Σ_j σ_j² (Σ_k h_kj w_k S_k)², the photons of M pulses by M (Σ w_k² p_k - (Σ w_k p_k)²) in a
    first-photon detector, with p_k the probability of a count and S_k that of none until the end of the bin, else by
    M Σ w_k² λ_k with S_k = 1.
    """
    weight, rate = _blurred(scene, signal), _blurred(scene, light) + background
    if scene.detector.mode == "first_photon":
        before = np.cumsum(rate, axis=1) - rate
        counted, none = np.exp(-before) * -np.expm1(-rate), np.exp(-before - rate)
        variance = (np.square(weight) * counted).sum(axis=1) - np.square((weight * counted).sum(axis=1))
        moved = weight * none
    else:
        variance, moved = (np.square(weight) * rate).sum(axis=1), weight
    moved = np.square(error * _blurred(scene, moved)).sum(axis=1) * scene.pulses_per_depth_frame
    return np.divide(moved, variance, out=np.full(len(moved), np.nan), where=variance > 0)


def _blurred(scene: Scene, values: Floats) -> Floats:
    """By a Gaussian response of the width of pulse and jitter, along the bins."""
    fwhm = math.hypot(scene.laser.pulse_fwhm_ps, scene.detector.jitter_fwhm_ps)
    sigma = fwhm / (_FWHM_PER_SIGMA * scene.gate.bin_width_ps)
    if sigma < _NARROW:
        return values
    reach = round(3.0 * sigma)  # not `gaussian_filter1d`: SciPy takes longer to load than most commands to run
    weights = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / sigma))
    padded, bins = np.pad(values, ((0, 0), (reach, reach))), values.shape[1]
    return sum(weight * padded[:, k : k + bins] for k, weight in enumerate(weights / weights.sum()))


def with_frames(result: Result, pulses: int, detector: Detector | None = None, laser: Laser | None = None) -> Result:
    """The result for frames of so many pulses, also of another detector or laser: their noise is that of its ratios."""
    scene, of_frame = result.scene, {"pulses_per_frame": pulses}
    changed: dict[str, Any] = {"detector": (detector or scene.detector).model_copy(update=of_frame)}
    changed["analytic"] = scene.analytic.model_copy(update={"pulses_per_depth_frame": None})
    return replace(result, scene=scene.model_copy(update={**changed, "laser": laser or scene.laser}))


def unclear_pixels(result: Result) -> NDArray[np.bool_]:
    """Pixels with light whose brightest bin is not known to a third: pictures of them show noise of the simulation.
    bool `[H, W]`; none where the result has no errors."""
    if result.batches < 2:
        return np.zeros(result.truth.depth.shape, bool)
    light = result.expected()
    peak = light.argmax(axis=2)[..., None]
    value, error = (np.take_along_axis(cube, peak, axis=2)[..., 0] for cube in (light, result.expected_error))
    return (value > 0) & (error > _KNOWN * value)


def target_noise_ratio(result: Result) -> float:
    """`Result.target_noise_ratio`."""
    target = np.isfinite(result.truth.depth)
    returned = result.tallies.any(axis=(0, 3)) & (target | ~target.any())
    pixels = np.flatnonzero(returned)
    pixels = pixels[np.linspace(0, len(pixels) - 1, min(len(pixels), _SAMPLE)).astype(np.intp)]
    ratios = noise_ratios(result, pixels)
    ratios = ratios[np.isfinite(ratios)]
    return float(np.median(ratios)) if ratios.size else math.inf


class PhotonsNeeded(NamedTuple):
    """That would bring a result's noise to a goal."""

    photons: float  # in all; infinite where nothing returned yet
    seconds: float  # that they would take on the devices of the result; NaN where its time is not known


def photons_needed(result: Result, noise_ratio: float = NOISE_GOAL) -> PhotonsNeeded:
    """Photons that would bring `Result.target_noise_ratio` to a goal: it falls as their number.

    `noise_ratio`: the goal, > 0. Where few heavy photons decide, the estimate is too low. Raises `ConfigError` as
    `Result.noise_ratio` does.
    """
    goal = check_real("noise_ratio", noise_ratio, "(0, inf)")
    photons = result.photons * result.target_noise_ratio / goal
    return PhotonsNeeded(photons, photons * result.timing.get("trace", math.nan) / result.photons)


def noise_problem(result: Result) -> str:
    """A sentence for the user where the noise of the simulation shows beside that of the photons; else empty."""
    if result.batches < 2:
        return UNKNOWN_NOISE
    ratio = result.target_noise_ratio
    if ratio <= NOISE_GOAL:
        return ""
    if ratio == math.inf:
        return f"not enough photons: none of {result.photons:.3g} brought light back"
    photons, seconds = photons_needed(result)
    time = f", {duration(seconds)} here" if math.isfinite(seconds) else ""
    return (
        f"not enough photons: the simulation's noise shows, {ratio:.2g} times the variance of a frame's "
        f"photons in the median pixel; about {photons:.1e} photons instead of {result.photons:.1e} would make it "
        f"{NOISE_GOAL:g} times{time}"
    )


def noise_caption(ratio: float | None) -> str:
    """For the caption of a picture of frames that show the noise of the simulation; else empty."""
    if ratio is None or ratio <= NOISE_GOAL:
        return ""
    times = f"{ratio:.2g}" if ratio < 100.0 else count(float(f"{ratio:.2g}"))
    return f"; too few photons traced: noise of the simulation is {times} times the variance of the photons"
