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

Channel = Literal["I", "co", "cross"]
CHANNELS: tuple[Channel, ...] = get_args(Channel)
"""What a camera may record of polarised light: all of it, or what an analyser passes at its angle or across it."""

Floats = NDArray[np.float64]


def received(result: Result, channel: Channel) -> Result:
    """The result with the light of one channel alone, for all that takes a result: counts, depth, bounds, pictures.

    "I" is the result itself, without an analyser; "co" passes an analyser at `camera.analyser_angle_deg` of the
    camera's `extinction_ratio`, "cross" one across it. A camera of four Stokes cubes has both. Ambient light counts as
    unpolarised: ½(1 + 1/E) of it passes, of `detector.ambient_rate` and of daylight.

    The ledger and the counters stay those of all light; from Stokes cubes the channel has no standard errors.

    Raises:
        ArgumentError: No such channel.
        ConfigError: The result was simulated without channels.
    """
    if check_choice("channel", channel, CHANNELS) == "I":
        return result
    if not result.channels:
        raise ConfigError(
            f"channel = {channel!r}: the result has none; simulate with camera.polarisation = 'analyser' or 'stokes'",
            source=None if result.scene.source is None else str(result.scene.source),
        )
    provenance = {**result.provenance, "channel": channel}
    stored = result.channel_tallies
    assert stored is not None
    common: dict[str, Any] = {"channel_tallies": None, "derivative_tallies": None, "batch_moments": {}}
    common |= {"scene": _behind_analyser(result.scene), "provenance": provenance}
    if channel in stored.names:
        k = stored.names.index(channel)
        moments = None if stored.second_moment is None else stored.second_moment[:, k].copy()
        tallies = np.maximum(stored.tallies[k], 0)
        return replace(result, tallies=tallies, unit=stored.units[k], second_moment=moments, **common)
    camera = result.scene.camera
    leak, angle = 1.0 / camera.extinction_ratio, 2.0 * math.radians(camera.analyser_angle_deg)
    sign = 1.0 if channel == "co" else -1.0
    shares = {"Q": sign * (1.0 - leak) * math.cos(angle), "U": sign * (1.0 - leak) * math.sin(angle)}
    light = (1.0 + leak) * result.tallies
    for name, share in shares.items():
        k = stored.names.index(name)
        light += share * (stored.units[k] / result.unit) * stored.tallies[k]
    # Halves of a unit are kept.
    tallies = np.rint(np.maximum(light, 0.0)).astype(np.int64)
    return replace(result, tallies=tallies, unit=0.5 * result.unit, second_moment=None, batch_size=0, **common)


def degree_of_polarisation(result: Result, *, gated: bool = False) -> Floats:
    """Part of the light of each pixel and bin that is polarised, float64 `[H, W, T]`; NaN where nothing arrives.

    From four Stokes cubes √(Q² + U² + V²)/I; from co- and cross-polarised light their difference over their sum, which
    is negative where light across the analyser's angle prevails, without the analyser's own leak. `gated`: of all light
    in the gate, `[H, W]`. What rounding and noise put beyond 1 is 1.

    Raises `ConfigError` where the result was simulated without channels.
    """
    axes = (0, 3) if gated else 0
    sums = {name: values.sum(axis=axes) for name, values in result.channels.items()}
    with np.errstate(divide="ignore", invalid="ignore"):
        if "Q" in sums:
            polarised = np.sqrt(sums["Q"] ** 2 + sums["U"] ** 2 + sums["V"] ** 2)
            return np.minimum(polarised / sums["I"], 1.0)
        if "co" in sums:
            leak = 1.0 / result.scene.camera.extinction_ratio
            both = sums["co"] + sums["cross"]
            return np.clip((sums["co"] - sums["cross"]) / both * ((1.0 + leak) / (1.0 - leak)), -1.0, 1.0)
    raise ConfigError(
        "the degree of polarisation needs channels; simulate with camera.polarisation = 'analyser' or 'stokes'"
    )


def polarisation_summary(result: Result) -> dict[str, Any]:
    """What a summary says of a result's channels: their light, as fractions of the emitted light, and the degree of
    polarisation of all of it; of a result of one channel its name. Empty without polarised light."""
    if "channel" in result.provenance:
        return {"channel": result.provenance["channel"]}
    if not result.channels:
        return {}
    # In a scan each pixel has photons of its own.
    share = result.unit / result.photons / result.tally_value
    light = {name: float((values.sum(axis=(0, 3)) * share).sum()) for name, values in result.channels.items()}
    if "Q" in light:
        degree = math.hypot(light["Q"], light["U"], light["V"]) / light["I"] if light["I"] else None
    else:
        both, leak = light["co"] + light["cross"], 1.0 / result.scene.camera.extinction_ratio
        degree = (light["co"] - light["cross"]) / both * (1.0 + leak) / (1.0 - leak) if both and leak < 1.0 else None
    return {"channels": light, "degree_of_polarisation": degree}


def _behind_analyser(scene: Scene) -> Scene:
    """The scene whose camera has no analyser, and as much ambient light as it would pass."""
    passed = 0.5 * (1.0 + 1.0 / scene.camera.extinction_ratio)
    changed = {"camera.polarisation": "none", "detector.ambient_rate": passed * scene.detector.ambient_rate}
    if scene.daylight is not None:
        changed["daylight.cloud_factor"] = passed * scene.daylight.cloud_factor
    return scene.with_overrides(changed)
