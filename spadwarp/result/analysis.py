"""What follows from a result: the light of one channel, whether its noise shows, apparent optical properties."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats
from spadwarp.io.text import duration
from spadwarp.result.result import (
    CHANNELS,
    NOISE_GOAL,
    POLARISED,
    Channel,
    Result,
    cubes_of,
    degree_of,
    photons_needed,
    sums_of,
)
from spadwarp.scene import Detector, Laser, Scene
from spadwarp.values import ConfigError, check_choice, count

__all__ = ["Apparent", "analyser_channel", "apparent", "degree_of_polarisation", "noise_problem", "unclear_pixels"]

UNKNOWN_NOISE = "the noise of the simulation is not known: the result keeps no standard errors; more photons give them"

_CAMERAS = "simulate with camera.polarisation = 'analyser' or 'stokes'"
_KNOWN = 1.0 / 3.0  # relative standard error of a bin that means something


def off_edges(depth: NDArray[Any]) -> tuple[NDArray[np.bool_], float]:
    """The half of the pixels with a depth `[H, W]` whose neighbours are the nearest to it, on one surface with them;
    and the median difference of depth among a pixel and its neighbours [m]."""
    from scipy.ndimage import maximum_filter, minimum_filter

    target, known = np.isfinite(depth), np.nan_to_num(depth, nan=1e9)
    step = maximum_filter(known, 3) - minimum_filter(known, 3)
    median = float(np.median(step[target])) if target.any() else 0.0
    return target & (step <= median), median


# Channels of polarised light


def analyser_channel(result: Result, channel: Channel) -> Result:
    """The result with the light of one channel alone, for all that takes a result: counts, depth, bounds, pictures.

    "raman" and "fluorescence" are light of other wavelengths, for a receiver with a filter that passes them alone; the
    detector is taken as it is given, so that its efficiency is to be that at their wavelength.

    "I" is the result itself, without an analyser; "co" passes an analyser at `camera.analyser_angle_deg` of the
    camera's `analyser_extinction_ratio`, "cross" one across it. A camera of four Stokes cubes has both. Ambient light
    counts as unpolarised: ½(1 + 1/E) of it passes, of `detector.ambient_rate` and of daylight.

    The energy balance and the counters stay those of all light; from Stokes cubes the channel has no standard errors.

    Raises `ArgumentError`: no such channel; `ConfigError`: the result was simulated without channels.
    """
    if check_choice("channel", channel, CHANNELS) == "I":
        return result
    of_polarisation = channel in POLARISED
    if not (result.scene.camera.channels if of_polarisation else channel in result.channels):
        own, lines = result.provenance.get("channel"), f"give medium.inelastic with process = {channel!r}"
        problem = f"the result has none; {_CAMERAS if of_polarisation else lines}"
        problem = f"the result holds {own!r} alone; take that of the run" if own else problem
        raise ConfigError(f"channel = {channel!r}: {problem}", source=result.scene.source)
    tallies, unit = _channel_tallies(result, channel)
    lines_left_out = result.scene.with_overrides({"medium.inelastic": []})  # light of another wavelength alone comes
    cube = cubes_of(result, "channels").get(channel)
    moments = None if cube is None or cube.second_moment is None else cube.second_moment.copy()
    return replace(
        result,
        scene=_behind_analyser(result.scene) if of_polarisation else lines_left_out,
        tallies=tallies,
        unit=unit,
        half=None,
        second_moment=moments,
        batch_size=0 if moments is None else result.batch_size,
        batches=0 if moments is None else result.batches,
        batch_moments={},
        reconstruction=None,
        signed_tallies=None,
        provenance={**result.provenance, "channel": channel},
    )


def pixel_channel(result: Result, channel: Channel, row: int, column: int) -> Floats:
    """`analyser_channel` of one pixel, by component: fraction of the emitted photons, float64 `[3, T]`."""
    tallies, unit = _channel_tallies(result, channel, (slice(None), row, column))
    return tallies * (result.tally_value[row, column] * unit / result.unit)


def _channel_tallies(result: Result, channel: Channel, at: tuple[Any, ...] = ()) -> tuple[NDArray[np.int64], float]:
    """Tallies of co- or cross-polarised light, or a part of them, and their unit."""
    cubes, camera = cubes_of(result, "channels"), result.scene.camera
    if channel in cubes:
        return np.maximum(cubes[channel].tallies[at], 0), cubes[channel].unit
    leak, angle = 1.0 / camera.analyser_extinction_ratio, 2.0 * math.radians(camera.analyser_angle_deg)
    sign = 1.0 if channel == "co" else -1.0
    light = (1.0 + leak) * result.tallies[at]
    for name, share in {"Q": math.cos(angle), "U": math.sin(angle)}.items():
        light += sign * (1.0 - leak) * share * (cubes[name].unit / result.unit) * cubes[name].tallies[at]
    # In halves of a unit.
    return np.rint(np.maximum(light, 0.0)).astype(np.int64), 0.5 * result.unit


def _behind_analyser(scene: Scene) -> Scene:
    """The scene whose camera has no analyser, and as much ambient light as it would pass."""
    passed = 0.5 * (1.0 + 1.0 / scene.camera.analyser_extinction_ratio)
    changed = {"camera.polarisation": "none", "detector.ambient_rate": passed * scene.detector.ambient_rate}
    if scene.daylight is not None:
        changed["daylight.cloud_factor"] = passed * scene.daylight.cloud_factor
    return scene.with_overrides(changed)


def degree_of_polarisation(result: Result, *, gated: bool = False) -> Floats:
    """Part of the light of each pixel and bin that is polarised, float64 `[H, W, T]`; NaN where nothing arrives.

    From four Stokes cubes √(Q² + U² + V²)/I; from co- and cross-polarised light their difference over their sum, which
    is negative where light across the analyser's angle prevails, without the analyser's own leak. `gated`: of all light
    in the gate, `[H, W]`. What rounding and noise put beyond 1 is 1.

    Raises `ConfigError` where the result was simulated without channels.
    """
    if not result.scene.camera.channels:
        raise ConfigError(f"the degree of polarisation needs channels; {_CAMERAS}")
    return degree_of(result, sums_of(result, (0, 3) if gated else (0,)))


# Noise


def pixel_standard_error(result: Result, row: int, column: int) -> Floats:
    """`Result.standard_error` of one pixel, float64 `[T]`, without that of the others."""
    error = result.batch_error(result.tallies[:, row, column], result.known_moment[:, row, column])
    return np.asarray(error * result.tally_value[row, column])


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


def noise_problem(result: Result) -> str:
    """A sentence for the user where the noise of the simulation shows beside that of the photons; else empty."""
    if result.batches < 2:
        return UNKNOWN_NOISE
    ratio = result.target_noise_ratio
    if ratio <= NOISE_GOAL:
        return ""
    if ratio == math.inf:
        seen = float(np.median(result.detections.sum(axis=2))) if result.scene.detector.mode == "first_photon" else 0.0
        if seen > 0.0:
            text = "the first of them alone is recorded, and the target's are lost: less laser.pulse_energy"
            return f"pile-up: {seen:.2g} photons of a pulse would be detected in the median pixel; {text}"
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
    if ratio == math.inf:
        return "; no light of the target is left"
    times = f"{ratio:.2g}" if ratio < 100.0 else count(float(f"{ratio:.2g}"))
    return f"; too few photons traced: noise of the simulation is {times} times the variance of the photons"


# Apparent optical properties


@dataclass(frozen=True, eq=False, kw_only=True)
class Apparent:
    """Apparent optical properties of the light through planes, of N positions; each with its standard error, which
    takes the tallies of two as independent: too large where the same photons cross both."""

    position: Floats  # of the planes along their axis [m], `[N]`
    irradiance: Floats  # downward, upward, scalar downward and scalar upward, `[N, 4]`
    reflectance: Floats  # R = E_u/E_d, `[N]`
    mean_cosine_downward: Floats  # E_d over the scalar downward irradiance, `[N]`
    mean_cosine_upward: Floats  # likewise, `[N]`
    mean_cosine: Floats  # (E_d - E_u) over the scalar irradiance, `[N]`
    middle: Floats  # between the planes [m], `[N - 1]`
    attenuation: Floats  # K_d = -d ln E_d/dz between the planes [1/m], `[N - 1]`
    errors: Mapping[str, Floats]  # standard error of each of those above but position and middle, by name


def apparent(result: Result, section: str | None = None) -> Apparent:
    """Diffuse attenuation, irradiance reflectance and mean cosines at the planes of a section of `[[flux]]`.

    `section`: its name; by default that of the first section with planes.

    Raises `ConfigError`: the result has no planes, or no errors; `ArgumentError` for another name.
    """
    names = [one.name for one in result.scene.flux if one.positions is not None]
    if not names:
        raise ConfigError("apparent: the result has no [[flux]] with positions of planes", source=result.scene.source)
    found = result.flux[names[0] if section is None else check_choice("section", section, names)]["irradiance"]
    if found.errors is None:
        raise ConfigError("apparent: the result has no errors; simulate with more photons", source=result.scene.source)
    position, light, error = np.asarray(found.dimensions["position"][0]), found.values, found.errors
    down, up, scalar_down, scalar_up = light.T
    with np.errstate(divide="ignore", invalid="ignore"):
        share = error / light
        pairs = {"reflectance": (1, 0), "mean_cosine_downward": (0, 2), "mean_cosine_upward": (1, 3)}
        values = {name: light[:, a] / light[:, b] for name, (a, b) in pairs.items()}
        errors = {name: values[name] * np.hypot(share[:, a], share[:, b]) for name, (a, b) in pairs.items()}
        scalar = scalar_down + scalar_up
        values["mean_cosine"] = (down - up) / scalar
        # Of the difference, and of the sum below it.
        above, below = np.hypot(error[:, 0], error[:, 1]) / scalar, np.hypot(error[:, 2], error[:, 3]) / scalar
        errors["mean_cosine"] = np.hypot(above, values["mean_cosine"] * below)
        values["attenuation"] = -np.diff(np.log(down)) / np.diff(position)
        errors["attenuation"] = np.hypot(share[1:, 0], share[:-1, 0]) / np.diff(position)
    middle, errors["irradiance"] = 0.5 * (position[1:] + position[:-1]), error
    return Apparent(position=position, irradiance=light, middle=middle, errors=errors, **values)
