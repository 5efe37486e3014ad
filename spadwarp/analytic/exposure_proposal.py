"""Pulse energy and pulses of a depth frame, the parts of its depth error, and the largest of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.analytic.eye_safety import EyeLimit
from spadwarp.analytic.gate_proposal import GateProposal
from spadwarp.analytic.optics import scene_eye_limit
from spadwarp.analytic.photon_budget import OUTLIERS
from spadwarp.analytic.pilot import Pilot, measure, trace, window
from spadwarp.device import pick_device
from spadwarp.frames import Method, detector_response
from spadwarp.frames.response import FWHM_PER_SIGMA
from spadwarp.result import CHANNELS, Channel
from spadwarp.units import range_from_time, with_prefix

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["PILE_UP", "Exposure", "Progress", "Question", "propose_exposure"]

PILE_UP = 0.05
"""Detections per pulse of the brightest pixels up to which pile-up is small: the usual rule of 1 to 5 % (O'Connor &
Phillips, Time-correlated single photon counting, 1984)."""

_MOST_PULSES = 2**31 - 1
_MANY_PHOTONS = 100.0  # of the return, from which on the width of the response is the cheaper thing to improve

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Question:
    """What is asked for: the arguments of `spadwarp.plan`."""

    depth_error: float
    time: float
    margin: float
    method: Method
    full_power: bool
    eye_distance: float | None
    eye_exposure: float
    seed: int
    device: str | None
    channel: Channel = "I"


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """Pulses and pulse energy, and the depth error they give.

    Attributes:
        scene: The scene with the proposed gate, pulses, repetition rate and pulse energy, ready to simulate.
        pile_up_energy: Pulse energy at which the brightest pixels detect `PILE_UP` photons a pulse [J].
        eye: Limit of laser power for the eye.
        energy_limit: What sets the pulse energy: "" (the scene's own), "pile-up" or "eye".
        pulses: Of a depth frame: for the depth error where it can be reached, else those after which more gain little.
        pulses_for: What sets them: "depth error"; "false peaks", fewer than 1 % of them; "floor", where the depth error
            is out of reach; "out of reach", where 2³¹ pulses are too few.
        frame_time: For these pulses [s], at all positions of a scan.
        reached: Whether the depth error is reached, within the time.
        terms: Name → part of the depth error at these pulses [m], "total" last.
        limit: The largest of them.
        advice: What would help.
        pilot: What was measured by Monte Carlo.
        channels: The same without an analyser ("I"), at its angle ("co") and across it ("cross"); empty for a camera
            without one.
    """

    scene: Scene = field(repr=False)
    pile_up_energy: float
    eye: EyeLimit
    energy_limit: str
    pulses: int
    pulses_for: str
    frame_time: float
    reached: bool
    terms: dict[str, float]
    limit: str
    advice: str
    pilot: Pilot
    channels: dict[str, Pilot] = field(default_factory=dict)


def propose_exposure(
    scene: Scene,
    gate: GateProposal,
    question: Question,
    photons: int,
    progress: Progress | None = None,
    *,
    even: bool = False,
) -> Exposure:
    """The experiment with a gate: light, pulse energy, pulses, error; `even` as in `measure`."""
    laser, positions = scene.laser, scene.scan_positions
    rate = laser.repetition_rate
    if scene.detector.wrap and rate > gate.largest_rate:
        rate = _rounded_down(gate.largest_rate)
    fields = {"start_ns": gate.start_ns, "bins": gate.bins}
    scene = scene.with_overrides(gate=fields, laser={"repetition_rate": rate}, transport={"max_path": None})
    small = window(scene, question.device)
    runs = trace(small, photons, question.seed, question.device, progress)
    pilot = measure(runs, scene, question.device, even=even, channel=question.channel)
    eye = scene_eye_limit(scene, distance=question.eye_distance or 0.1, exposure=question.eye_exposure)
    piled = laser.pulse_energy * max(PILE_UP - pilot.noise, 0.0) / pilot.brightest
    allowed = {"pile-up": piled} | ({} if question.eye_distance is None else {"eye": eye.pulse_energy})
    lowest = min(allowed, key=allowed.__getitem__)
    energy_limit = ""
    if allowed[lowest] > 0 and (question.full_power or laser.pulse_energy > allowed[lowest]):
        energy_limit = lowest
        scene = scene.with_overrides(laser={"pulse_energy": _rounded_down(allowed[lowest])})
        pilot = measure(runs, scene, question.device, even=even, channel=question.channel)
    pulses, purpose = _pulses(scene, pilot, question)
    terms = _terms(pilot, pulses, question.method)
    frame_time = pulses * positions / rate
    limit = _limit(scene, pilot, terms, pulses, question.method)
    # Given on its own, the analytic model's number would hold against a later change of the detector's.
    own = None if scene.analytic.pulses_per_depth_frame is None else pulses
    compared = CHANNELS if small.camera.channels and not even else ()
    return Exposure(
        scene=scene.with_overrides(detector={"pulses_per_frame": pulses}, analytic={"pulses_per_depth_frame": own}),
        pile_up_energy=piled,
        eye=eye,
        energy_limit=energy_limit,
        pulses=pulses,
        frame_time=frame_time,
        pulses_for=purpose,
        reached=purpose in ("depth error", "false peaks") and frame_time <= question.time,
        terms=terms,
        limit=limit,
        advice=_advice(limit, purpose, frame_time, rate, gate.largest_rate, question),
        pilot=pilot,
        channels={name: measure(runs, scene, question.device, channel=name) for name in compared},
    )


def _rounded_down(value: float, digits: int = 3) -> float:
    """With so many digits, not above the value."""
    text = f"{value:.{digits - 1}e}"
    step = 10.0 ** (int(text.partition("e")[2]) - digits + 1)
    return float(f"{float(text) - (step if float(text) > value else 0.0):.{digits}g}")


def _pulses(scene: Scene, pilot: Pilot, question: Question) -> tuple[int, str]:
    """Pulses of a depth frame, and what they are for.

    For the depth error that the floor leaves, but at least as many as bring false peaks below `OUTLIERS`; where the
    floor is too high, until the bound is a third of it: then the error is within 6 % of the floor.
    """
    fixed = math.hypot(pilot.floor[question.method], pilot.pile_up[question.method])
    left = math.sqrt(max(question.depth_error**2 - fixed**2, 0.0))
    purpose = "depth error" if left > 0 else "floor"
    wanted, peaks = (
        (pilot.bound / (left or fixed / 3.0)) ** 2,
        _pulses_without_false_peaks(scene, pilot, question.device),
    )
    if peaks > wanted:
        wanted, purpose = peaks, "false peaks" if left > 0 else "floor"
    if not wanted <= _MOST_PULSES:
        return _MOST_PULSES, "out of reach"
    digits = 10.0 ** max(0, math.floor(math.log10(max(wanted, 1.0))) - 1)
    return int(min(max(1.0, math.ceil(wanted / digits) * digits), _MOST_PULSES)), purpose


def _pulses_without_false_peaks(scene: Scene, pilot: Pilot, device: str | None) -> float:
    """Pulses after which a fit takes background for the return with a probability of `OUTLIERS`; inf beyond 1e12."""
    import warp as wp

    from spadwarp_kernels.analytic import outlier_probabilities

    sigma = max(detector_response(scene.detector, scene.laser).fwhm, scene.gate.bin_width) / FWHM_PER_SIGMA
    pulses = np.geomspace(1.0, 1e12, 481)
    lengths = np.full_like(pulses, (scene.gate.stop - scene.gate.start) / sigma)
    columns = (pulses * pilot.peak, pulses * pilot.level, lengths)
    arrays: list[Any] = [wp.array(column, dtype=wp.float64, device=pick_device(device)) for column in columns]
    few = np.flatnonzero(outlier_probabilities(*arrays).numpy() <= OUTLIERS)
    return float(pulses[few[0]]) if few.size else math.inf


def _terms(pilot: Pilot, pulses: int, method: str) -> dict[str, float]:
    """Parts of the depth error [m]; squares add up."""
    bound, shot = pilot.bound / math.sqrt(pulses), pilot.shot_noise / math.sqrt(pulses)
    floor, piled = pilot.floor[method], abs(pilot.pile_up[method])
    return {
        "shot noise": min(shot, bound),
        "background": math.sqrt(max(bound**2 - shot**2, 0.0)),
        "Cramér–Rao bound": bound,
        "forward scattering": floor,
        "pile-up": piled,
        "total": math.hypot(bound, floor, piled),
    }


def _limit(scene: Scene, pilot: Pilot, terms: dict[str, float], pulses: int, method: str) -> str:
    """What the depth error is made of for the most part."""
    largest = max(("shot noise", "background", "forward scattering", "pile-up"), key=terms.__getitem__)
    if largest == "background":
        return "backscatter" if pilot.backscatter >= pilot.noise else "dark counts and ambient light"
    if largest == "forward scattering" and 0.5 * pilot.floor[method] < pilot.unscattered_floor[method] < math.inf:
        bin_range = range_from_time(scene.gate.bin_width, scene.medium.group_index)
        return "bin width" if pilot.floor[method] <= bin_range else "pixel size"
    if largest == "shot noise" and pulses * pilot.peak > _MANY_PHOTONS:
        widths = {
            "jitter": scene.detector.jitter_fwhm_ps,
            "pulse duration": scene.laser.pulse_fwhm_ps,
            "bin width": scene.gate.bin_width_ps,
        }
        if scene.detector.irf.lower().endswith(".csv"):  # laser and detector measured together
            del widths["pulse duration"]
            widths["jitter"] = 1e12 * detector_response(scene.detector, scene.laser).fwhm
        return max(widths, key=widths.__getitem__)
    return largest


_ADVICE = {
    "shot noise": "more pulses, energy, aperture or reflectance; the error falls with the root of the photons",
    "jitter": "a detector with less jitter: the error is proportional to the width of the response, while photons act "
    "only by their root",
    "pulse duration": "a shorter pulse: the error is proportional to the width of the response, while photons act only "
    "by their root",
    "bin width": "narrower bins, gate.bin_width_ps: where light is within a bin is not known",
    "backscatter": "a gate that begins closer to the target, more distance between laser and lens, a narrower view",
    "dark counts and ambient light": "a shorter gate, a narrower spectral filter, a cooler or quieter detector",
    "forward scattering": "a shorter distance, clearer water, a narrower beam or view",
    "pixel size": "smaller pixels: slopes and edges of the target within one pixel, also without scattered light",
    "pile-up": "less pulse energy, or Coates' correction (`spadwarp detect --coates`)",
}


def _advice(limit: str, purpose: str, frame_time: float, rate: float, largest: float, question: Question) -> str:
    """What would help: time, where the pulses reach the depth error but take too long."""
    advice = _ADVICE[limit]
    if purpose not in ("depth error", "false peaks"):
        return advice + ("; more pulses do not help" if limit == "forward scattering" else "")
    if frame_time <= question.time:
        return advice
    faster = f"; this gate allows up to {with_prefix(largest, 'Hz')}" if largest > rate else ""
    return (
        f"a longer time (--time): these pulses reach the depth error, but take {with_prefix(frame_time, 's')} at a "
        f"repetition rate of {with_prefix(rate, 'Hz')}{faster}; fewer pulses are needed with {advice}"
        if limit != "shot noise"
        else f"more light per pulse (energy, aperture, reflectance), a longer time (--time) or a higher repetition "
        f"rate: these pulses take {with_prefix(frame_time, 's')} at {with_prefix(rate, 'Hz')}{faster}"
    )
