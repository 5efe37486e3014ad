"""An experiment from the depth error that is asked for: gate, pulses, laser power, largest range, what limits it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from spadwarp.analytic.exposure_proposal import Exposure, Progress, Question, propose_exposure
from spadwarp.analytic.gate_proposal import propose_gate, target_span
from spadwarp.analytic.largest_range import largest_range as find_largest_range
from spadwarp.analytic.largest_range import with_plane
from spadwarp.analytic.optics import beam_axis_fluence
from spadwarp.analytic.photon_budget import axis_line
from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.frames import METHODS, Method
from spadwarp.limits import SEED, check_choice, check_integer, check_real, shown
from spadwarp.result import CHANNELS, Channel
from spadwarp.scene import SceneLike, as_scene
from spadwarp.scene.sight import port_advance
from spadwarp.units import quantity, range_from_time

__all__ = ["Proposal", "plan"]


@dataclass(frozen=True, kw_only=True, repr=False)
class Proposal(Exposure):
    """A proposed experiment: an `Exposure`, and

    Attributes:
        depth_error: Asked for [m].
        time: Longest time for a depth frame [s].
        method: Estimator whose floor counts.
        target_range: Least and largest range of the target [m].
        optical_depth: Of the water before the nearest of it, one way, along the axis.
        gate_range: Ranges at the ends of the gate, laser at the lens and behind its port [m].
        unambiguous_range: At the proposed repetition rate [m].
        largest_rate: Repetition rate up to which the gate ends before the next pulse [Hz].
        irradiance: On the beam's axis at the nearest range of the target, unscattered light, mean over time [W/m²].
        largest_range: For a plane square to the axis, depth error and time as asked for [m]; NaN: not sought, 0: none.
        range_limit: What limits it.
    """

    depth_error: float
    time: float
    method: str
    target_range: tuple[float, float]
    optical_depth: float
    gate_range: tuple[float, float]
    unambiguous_range: float
    largest_rate: float
    irradiance: float
    largest_range: float
    range_limit: str

    def __repr__(self) -> str:
        error, pulses = 1e3 * self.terms["total"], self.pulses
        return f"Proposal({error:.3g} mm with {pulses} pulses, {self.frame_time:.3g} s; limit: {self.limit})"

    def _repr_html_(self) -> str:
        import spadwarp

        return spadwarp.viz.html(self)

    @property
    def values(self) -> dict[str, float | int]:
        """The proposed values by the names of the scene's fields."""
        scene = self.scene
        return {
            "gate.start_ns": scene.gate.start_ns,
            "gate.bin_width_ps": scene.gate.bin_width_ps,
            "gate.bins": scene.gate.bins,
            "laser.repetition_rate": scene.laser.repetition_rate,
            "laser.pulse_energy": scene.laser.pulse_energy,
            "detector.pulses_per_frame": scene.detector.pulses_per_frame,
        }

    def to_dict(self) -> dict[str, Any]:
        """Everything but the scene, in numbers and text that JSON can hold."""
        fields = {
            name: value for name, value in vars(self).items() if name not in ("scene", "eye", "pilot", "channels")
        }
        return {
            "values": self.values,
            **fields,
            "eye": dataclasses.asdict(self.eye),
            "pilot": dataclasses.asdict(self.pilot),
            "channels": {name: dataclasses.asdict(pilot) for name, pilot in self.channels.items()},
        }


def _number(name: str, value: Any, unit: str) -> float:
    """An argument that may be text with a unit, as a number of another."""
    try:
        found: float = quantity(value, unit) if isinstance(value, str) else value
        return found
    except ValueError as error:
        raise ArgumentError(f"{name} = {shown(value)} {error}") from None


def plan(
    scene: SceneLike,
    *,
    depth_error: float | str = 0.01,
    time: float | str = 1.0,
    ranges: tuple[float | str, float | str] | None = None,
    margin: float | str = 0.25,
    method: Method = "likelihood",
    full_power: bool = False,
    eye_distance: float | str | None = None,
    eye_exposure: float | str = 100.0,
    photons: int = 2_000_000,
    seed: int = 0,
    largest_range: bool = True,
    channel: Channel = "I",
    device: str | None = None,
    progress: Progress | None = None,
) -> Proposal:
    """Proposes gate, pulses, repetition rate and pulse energy for a depth error, and says what limits it.

    Counts, background and the error that scattering leaves are measured by a Monte Carlo run of a window of the image
    (`spadwarp.analytic.Pilot`); the Cramér–Rao bound is that of its histograms. The bound falls with the pulses; the
    floor, the error of an estimator that takes the scattered light for unscattered, does not. Lengths and times may be
    text with a unit, such as "2 cm".

    Args:
        scene: Water, laser, camera, detector, target; of the gate the bins' width alone.
        depth_error: Asked for [m], of a single pixel, in the median.
        time: Longest time for a depth frame [s].
        ranges: Least and largest range where the target may be [m]; default: that of the scene's targets. If given, the
            target is a plane at the largest, with the reflectance of the scene's first target, else 0.5.
        margin: Range of water that the gate holds before and behind the target [m].
        method: Estimator whose floor counts.
        full_power: Take the largest pulse energy within the limits, not only the scene's if it is within them.
        eye_distance: An eye at this distance from the laser limits the pulse energy [m]; default: reported for 0.1 m,
            and no limit.
        eye_exposure: For which it looks into the beam [s].
        photons: Of the Monte Carlo run.
        seed: Of it.
        largest_range: Whether to look for the largest range, which takes several shorter runs.
        channel: Light that counts, of a camera with an analyser; see `spadwarp.result.analyser_channel`.
        device: "cpu", "cuda:0"; default: the first GPU, else the CPU.
        progress: Called with ("trace", photons done, photons asked for) and the like.

    Raises:
        ConfigError: No target in view, or no light from it.
        ArgumentError: An argument out of range.
    """
    scene = as_scene(scene)
    depth_error, margin = _number("depth_error", depth_error, "m"), _number("margin", margin, "m")
    time, eye_exposure = _number("time", time, "s"), _number("eye_exposure", eye_exposure, "s")
    eye_distance = None if eye_distance is None else _number("eye_distance", eye_distance, "m")
    check_real("depth_error", depth_error, "[1e-9, 1e9] m")
    for name, value in {"time": time, "eye_exposure": eye_exposure}.items():
        check_real(name, value, "[1e-9, 1e9] s")
    photons, seed = check_integer("photons", photons, "[1, 1000000000000]"), check_integer("seed", seed, SEED)
    margin = check_real("margin", margin, "[0, 1e6] m")
    check_choice("method", method, METHODS)
    if ranges is not None:
        if not (isinstance(ranges, tuple | list) and len(ranges) == 2):
            raise ArgumentError(f"ranges = {shown(ranges)} is not (least, largest) [m]")
        span = _number("ranges", ranges[0], "m"), _number("ranges", ranges[1], "m")
        if not 0 < span[0] <= span[1] < math.inf:
            raise ArgumentError(f"ranges = {span} m: 0 < least <= largest < inf is needed")
        scene = with_plane(scene, span[1])
    else:
        span = target_span(scene, device)
    if check_choice("channel", channel, CHANNELS) != "I" and not scene.camera.channels:
        raise ConfigError(
            f"channel = {channel!r} needs camera.polarisation = 'analyser' or 'stokes'",
            source=None if scene.source is None else str(scene.source),
        )
    question = Question(
        depth_error, time, margin, method, full_power, eye_distance, eye_exposure, seed, device, channel
    )
    gate = propose_gate(scene, span, margin)
    exposure = propose_exposure(scene, gate, question, photons, progress)
    line = axis_line(scene)
    begin, end = ([float(x) for x in point[0]] for point in (line.start, line.points(span[0])))
    optical_depth = scene.optical_depth(begin, end)
    farthest = (math.nan, "")
    if largest_range:
        farthest = find_largest_range(exposure.scene, 0.5 * sum(span), question, max(photons // 8, 1), progress)
    index, chosen = scene.medium.group_index, exposure.scene
    fluence = beam_axis_fluence(chosen, span[0]) * math.exp(-optical_depth)
    advance = port_advance(scene)
    return Proposal(
        **vars(exposure),
        depth_error=depth_error,
        time=time,
        method=method,
        target_range=span,
        optical_depth=optical_depth,
        gate_range=tuple(range_from_time(end, index) + advance for end in (chosen.gate.start, chosen.gate.stop)),
        unambiguous_range=range_from_time(1.0 / chosen.laser.repetition_rate, index) + advance,
        largest_rate=gate.largest_rate,
        irradiance=fluence * chosen.laser.pulse_energy * chosen.laser.repetition_rate,
        largest_range=farthest[0],
        range_limit=farthest[1],
    )
