"""A result as a receiver with an analyser has it: co- or cross-polarised light alone."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ConfigError
from spadwarp.limits import check_choice

if TYPE_CHECKING:
    from spadwarp.result.result import Result
    from spadwarp.scene import Scene

__all__ = ["CHANNELS", "Channel", "degree_of_polarisation", "polarisation_summary", "received"]
__all__ += ["received_by_pixel"]

Channel = Literal["I", "co", "cross"]
CHANNELS: tuple[Channel, ...] = get_args(Channel)
"""What a camera may record of polarised light: all of it, or what an analyser passes at its angle or across it."""

Floats = NDArray[np.float64]


def received(result: Result, channel: Channel) -> Result:
    """The result with the light of one channel alone, for all that takes a result: counts, depth, bounds, pictures.

    "I" is the result itself, without an analyser; "co" passes an analyser at `camera.analyser_angle_deg` of the
    camera's `analyser_extinction_ratio`, "cross" one across it. A camera of four Stokes cubes has both. Ambient light
    counts as unpolarised: ½(1 + 1/E) of it passes, of `detector.ambient_rate` and of daylight.

    The ledger and the counters stay those of all light; from Stokes cubes the channel has no standard errors.

    Raises:
        ArgumentError: No such channel.
        ConfigError: The result was simulated without channels.
    """
    if check_choice("channel", channel, CHANNELS) == "I":
        return result
    if not result.channels:
        problem = "the result has none; simulate with camera.polarisation = 'analyser' or 'stokes'"
        if own := result.provenance.get("channel"):
            problem = f"the result holds {own!r} alone; take that of the run"
        raise ConfigError(
            f"channel = {channel!r}: {problem}",
            source=None if result.scene.source is None else str(result.scene.source),
        )
    tallies, unit = _tallies(result, channel)
    stored, moments = result.channel_tallies, None
    if stored is not None and stored.second_moment is not None and channel in stored.names:
        moments = stored.second_moment[:, stored.names.index(channel)].copy()
    return replace(
        result,
        scene=_behind_analyser(result.scene),
        tallies=tallies,
        unit=unit,
        second_moment=moments,
        batch_size=0 if moments is None else result.batch_size,
        batch_moments={},
        channel_tallies=None,
        derivative_tallies=None,
        provenance={**result.provenance, "channel": channel},
    )


def received_by_pixel(result: Result, channel: Channel, row: int, column: int) -> Floats:
    """What `received` has in one pixel, by component: fraction of the emitted photons, float64 `[3, T]`."""
    tallies, unit = _tallies(result, channel, (slice(None), row, column))
    return tallies * (result.tally_value[row, column] * unit / result.unit)


def _tallies(result: Result, channel: Channel, at: tuple[Any, ...] = ()) -> tuple[NDArray[np.int64], float]:
    """Tallies of co- or cross-polarised light, or a part of them, and their unit."""
    stored, camera = result.channel_tallies, result.scene.camera
    assert stored is not None
    if channel in stored.names:
        k = stored.names.index(channel)
        return np.maximum(stored.tallies[(k, *at)], 0), stored.units[k]
    leak, angle = 1.0 / camera.analyser_extinction_ratio, 2.0 * math.radians(camera.analyser_angle_deg)
    sign = 1.0 if channel == "co" else -1.0
    light = (1.0 + leak) * result.tallies[at]
    for name, share in {"Q": math.cos(angle), "U": math.sin(angle)}.items():
        k = stored.names.index(name)
        light += sign * (1.0 - leak) * share * (stored.units[k] / result.unit) * stored.tallies[(k, *at)]
    # Halves of a unit are kept.
    return np.rint(np.maximum(light, 0.0)).astype(np.int64), 0.5 * result.unit


def degree_of_polarisation(result: Result, *, gated: bool = False) -> Floats:
    """Part of the light of each pixel and bin that is polarised, float64 `[H, W, T]`; NaN where nothing arrives.

    From four Stokes cubes √(Q² + U² + V²)/I; from co- and cross-polarised light their difference over their sum, which
    is negative where light across the analyser's angle prevails, without the analyser's own leak. `gated`: of all light
    in the gate, `[H, W]`. What rounding and noise put beyond 1 is 1.

    Raises `ConfigError` where the result was simulated without channels.
    """
    if not result.channels:
        raise ConfigError(
            "the degree of polarisation needs channels; simulate with camera.polarisation = 'analyser' or 'stokes'"
        )
    return _degree(_sums(result, (0, 3) if gated else (0,)), 1.0 / result.scene.camera.analyser_extinction_ratio)


def polarisation_summary(result: Result) -> dict[str, Any]:
    """What a summary says of a result's channels: their light, as fractions of the emitted light, and the degree of
    polarisation of all of it; of a result of one channel its name. Empty without polarised light."""
    if "channel" in result.provenance:
        return {"channel": result.provenance["channel"]}
    if not result.channels:
        return {}
    sums = _sums(result, (0, 1, 2, 3))
    degree = float(_degree(sums, 1.0 / result.scene.camera.analyser_extinction_ratio))
    light = {name: float(sums[name]) / result.photons for name in result.channels}
    return {"channels": light, "degree_of_polarisation": degree if math.isfinite(degree) else None}


def _sums(result: Result, axes: tuple[int, ...]) -> dict[str, Floats]:
    """Channel → its light, times the photons."""
    stored = result.channel_tallies
    assert stored is not None
    sums = {"I": result.tallies.sum(axis=axes, dtype=np.float64) * result.unit}
    for name, tallies, unit in zip(stored.names, stored.tallies, stored.units, strict=True):
        sums[name] = tallies.sum(axis=axes, dtype=np.float64) * unit
    return sums


def _degree(sums: dict[str, Floats], leak: float) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        if "Q" in sums:
            return np.minimum(np.sqrt(sums["Q"] ** 2 + sums["U"] ** 2 + sums["V"] ** 2) / sums["I"], 1.0)
        ratio = (sums["co"] - sums["cross"]) / (sums["co"] + sums["cross"])
        degree: Floats = np.clip(ratio * np.divide(1.0 + leak, 1.0 - leak), -1.0, 1.0)
        return degree


def _behind_analyser(scene: Scene) -> Scene:
    """The scene whose camera has no analyser, and as much ambient light as it would pass."""
    passed = 0.5 * (1.0 + 1.0 / scene.camera.analyser_extinction_ratio)
    changed = {"camera.polarisation": "none", "detector.ambient_rate": passed * scene.detector.ambient_rate}
    if scene.daylight is not None:
        changed["daylight.cloud_factor"] = passed * scene.daylight.cloud_factor
    return scene.with_overrides(changed)
