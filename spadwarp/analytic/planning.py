"""An experiment from the depth error that is asked for: gate, pulses, laser power, largest range, what limits it.

A short Monte Carlo run on a window of the image measures counts, background and the error that scattering leaves, see
`spadwarp.analytic.pilot`. Numbers that both ends of their uncertainty judge differently are not judged.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from spadwarp.analytic.budgets import OUTLIERS, axis_line, face_reflectance
from spadwarp.analytic.eye_safety import EyeLimit, axis_fluence, eye_limit, safe_distance_in_water
from spadwarp.analytic.model import false_peaks
from spadwarp.analytic.pilot import (
    RUNS,
    Mask,
    NoLight,
    Pilot,
    Progress,
    measure,
    response_deviation,
    trace,
    typical_pixels,
    window,
)
from spadwarp.frames import METHODS, Method, detector_response
from spadwarp.result import CHANNELS, POLARISED, Channel, Result
from spadwarp.scene import Scene, SceneLike, Transport, as_scene
from spadwarp.scene.camera import to_world
from spadwarp.scene.sections import field_range
from spadwarp.scene.sight import lines_of_sight, port_advance
from spadwarp.transport import truth_maps
from spadwarp.values import (
    SEED,
    ArgumentError,
    ConfigError,
    Shown,
    check_choice,
    check_integer,
    range_from_time,
    read_real,
    time_from_path,
    time_from_range,
    with_prefix,
)

__all__ = ["PILE_UP", "Proposal", "plan"]

PILE_UP = 0.05
"""Detections per pulse of the brightest pixels up to which pile-up is small: the usual rule of 1 to 5 % (O'Connor &
Phillips, Time-correlated single photon counting, 1984)."""

_PROPOSED = (
    "gate.start_ns",
    "gate.bin_width_ps",
    "gate.bins",
    "laser.repetition_rate",
    "laser.pulse_energy",
    "detector.pulses_per_frame",
)
_MANY_PHOTONS = 100.0  # of the return, from which on the width of the response is the cheaper thing to improve
_MOST_PULSES = 2**31 - 1
_MOST_BINS = 1_000_000
_LEAST = 1e-6  # beyond a port [m]
_SCATTER = 1.6  # half-width of an interval over the standard deviation of four parts: 3.2/√4, of Student's t, 95 %
_LIGHT_NOISE = 0.5  # of the target's light in a pixel, from which on rare heavy photons may be missing in the median
_SECONDS, _FEWEST, _MOST = 60.0, 400_000, 2**40  # of a run that is as long as it takes; its photons
_PART = 1.0 / 12.0  # of these seconds for one range of the search
_LONGER = 4.0  # times as long where that would judge it
_UNKNOWN = 1e6  # ratio that stands for what parts of the runs do not know
_WIDE, _NARROW = 4.0, 1.2  # ratios of pulses: from which on their number is not known; which is worth a short time
_SHORT = 10.0  # of it [s]
_SHARE = 8  # part of a number of photons, for one range of the search
_FARTHEST = 200.0  # of the search for the largest range [m]
_STEP, _RESOLUTION = 1.35, 1.03  # of the search, as ratios


@dataclass(frozen=True, kw_only=True, repr=False)
class Proposal:
    """A proposed experiment."""

    scene: Scene  # the scene with the proposed gate, pulses, repetition rate and pulse energy, ready to simulate
    depth_error: float  # asked for [m]
    time: float  # longest for a depth frame [s]
    method: str  # estimator whose noise and floor count
    target_range: tuple[float, float]  # least and largest range of the target [m]
    optical_depth: float  # of the water before the nearest of it, one way, along the axis
    gate_range: tuple[float, float]  # ranges at the ends of the gate, laser at the lens and behind its port [m]
    unambiguous_range: float  # at the proposed repetition rate [m]
    largest_rate: float  # repetition rate up to which the gate ends before the next pulse [Hz]
    pile_up_energy: float  # pulse energy at which the brightest pixels detect `PILE_UP` photons a pulse [J]
    eye: EyeLimit  # limit of laser power for the eye
    energy_limit: str  # what sets the pulse energy: "" (the scene's own), "pile-up" or "eye"
    irradiance: float  # on the beam's axis at the nearest range of the target, unscattered light, mean over time [W/m²]
    pulses: int  # of a depth frame: for the depth error if it can be reached, else those after which more gain little
    pulses_for: str
    """What sets them: "depth error"; "false peaks", fewer than 1 % of them; "floor", where the depth error is out of
    reach; "out of reach", where 2³¹ pulses are too few; "not judged"."""
    pulses_range: tuple[int, int]  # least and most by what the traced photons leave open
    frame_time: float  # for these pulses [s], at all positions of a scan
    reached: bool | None  # whether the depth error is reached, within the time; None: not judged
    terms: dict[str, float]  # name → part of the depth error at these pulses [m], "total" last; squares add up
    limit: str  # the largest of them; "a or b" where the traced photons leave it open
    advice: str  # what would help
    pilot: Pilot  # what was measured by Monte Carlo
    photons_needed: float  # photons of it that would judge, or those traced; infinite: more than 10⁴ times as many
    seconds_needed: float  # that they take here
    largest_range: float = math.nan
    """Of a plane square to the axis [m]: the farthest at which the depth error is known to be reached; 0: at none;
    NaN: not sought, or not judged."""
    range_limit: str = ""  # what limits it
    unjudged_ranges: tuple[float, float] | None = None  # beyond it, where the photons do not tell [m]

    @property
    def judged(self) -> bool:
        """Whether the traced photons tell; if not, pulses, terms and limit are those of a run of noise."""
        return self.pulses_for != "not judged"

    @property
    def more_photons(self) -> str:
        """How many would judge, in words."""
        if math.isfinite(self.photons_needed):
            return f"about {self.photons_needed:.1e} photons would do, {with_prefix(self.seconds_needed, 's')} here"
        return f"more than {1e4 * self.pilot.photons:.0e} would be needed: the answer lies between two"

    def __repr__(self) -> str:
        if not self.judged:
            return f"Proposal(not enough photons to judge: {self.pilot.photons:.1e} of {self.photons_needed:.1e})"
        error, pulses = 1e3 * self.terms["total"], self.pulses
        return f"Proposal({error:.3g} mm with {pulses} pulses, {self.frame_time:.3g} s; limit: {self.limit})"

    _repr_html_ = Shown._repr_html_

    @property
    def values(self) -> dict[str, float | int]:
        """The proposed values by the names of the scene's fields."""
        return {name: operator.attrgetter(name)(self.scene) for name in _PROPOSED}

    def to_dict(self) -> dict[str, Any]:
        """Everything but the scene, in numbers and text that JSON can hold."""
        fields = dataclasses.asdict(dataclasses.replace(self, scene=None))  # type: ignore[arg-type]
        return {"values": self.values, **{name: value for name, value in fields.items() if name != "scene"}}


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
    photons: int | Literal["auto"] = "auto",
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
        method: Estimator whose noise and floor count.
        full_power: Take the largest pulse energy within the limits, not only the scene's if it is within them.
        eye_distance: An eye at this distance from the laser limits the pulse energy [m]; default: reported for 0.1 m,
            and no limit.
        eye_exposure: For which it looks into the beam [s].
        photons: Of the Monte Carlo run; "auto": until they judge, or traced for 60 s. Numbers that the photons do not
            tell are not judged.
        seed: Of it.
        largest_range: Whether to look for the largest range, which takes several shorter runs.
        channel: Light that counts, of a camera with an analyser; see `spadwarp.result.analyser_channel`.
        device: "cpu", "cuda:0"; default: the first GPU, else the CPU.
        progress: Called with ("trace", photons done, photons asked for) and the like.

    Raises `ConfigError`: no target in view, or no light from it, or before a photon is traced less than one detection
    of it in all pulses, even without scattering; `ArgumentError`: an argument out of range.
    """
    scene = as_scene(scene)
    number = None if photons == "auto" else check_integer("photons", photons, field_range(Transport, "photons"))
    check_choice("method", method, METHODS)
    check_choice("channel", channel, CHANNELS)
    planner = _Planner(
        depth_error=read_real("depth_error", depth_error, "[1e-9, 1e9] m"),
        time=read_real("time", time, "[1e-9, 1e9] s"),
        margin=read_real("margin", margin, "[0, 1e6] m"),
        method=method,
        full_power=full_power,
        eye_distance=None if eye_distance is None else read_real("eye_distance", eye_distance, "[0, 1e9] m"),
        eye_exposure=read_real("eye_exposure", eye_exposure, "[1e-6, 3e4] s"),
        seed=check_integer("seed", seed, SEED),
        device=device,
        channel=channel,
        progress=progress,
    )
    problem = ""
    if channel != "I" and not (scene.camera.channels if channel in POLARISED else channel in scene.tallied_channels):
        problem = f"channel = {channel!r} needs camera.polarisation = 'analyser' or 'stokes', or medium.inelastic"
    elif scene.scan.mode == "trajectory":
        problem = "plan knows no scan.mode = 'trajectory'; simulate and detect do"
    elif ranges is None:
        distance = truth_maps(scene, device=device).range
        if np.isnan(distance).all():
            problem = "no target is in view: give one in [[targets]], or the ranges where it may be"
        else:
            span = float(np.nanmin(distance)), float(np.nanmax(distance))
    else:
        least, largest = ranges
        span = read_real("ranges", least, "(-inf, inf) m"), read_real("ranges", largest, "(-inf, inf) m")
        if not 0 < span[0] <= span[1] < math.inf:
            raise ArgumentError(f"ranges = {span} m: 0 < least <= largest < inf is needed")
        scene = with_plane(scene, span[1])
    if problem:
        raise ConfigError(problem, source=scene.source)
    if planner.depth_error > span[0]:
        nearest = f"the range of the target, {span[0]:.3g} m; numbers are in m"
        raise ArgumentError(f"depth_error = {planner.depth_error:g} m is more than {nearest}")
    proposal = planner.propose(with_gate(scene, span, planner.margin), span, number)
    if eye_distance is not None and not isinstance(scene.medium.albedo, str):
        water = safe_distance_in_water(proposal.scene, exposure=planner.eye_exposure, seed=seed, device=device)
        proposal = dataclasses.replace(proposal, eye=dataclasses.replace(proposal.eye, water_distance=water))
    if not largest_range or not proposal.judged:
        return proposal
    sought = planner.largest_range(proposal.scene, 0.5 * sum(span), number and max(number // _SHARE, 1))
    return dataclasses.replace(proposal, largest_range=sought[0], range_limit=sought[1], unjudged_ranges=sought[2])


class _Outcome(NamedTuple):
    """Of a pilot: pulses and what they are for, as in `Proposal`, parts of the depth error, the largest, time [s]."""

    pulses: int
    purpose: str
    terms: dict[str, float]
    limit: str
    time: float


_ENOUGH = ("depth error", "false peaks")


class _Sample(NamedTuple):
    """What all runs measure, and what quarters of them do, each at the pulse energy that it allows."""

    centre: Pilot
    parts: list[Pilot]

    def ends(self, factor: float) -> tuple[Pilot, Pilot, Pilot]:
        """The best and the worst pilot, the one measured between them, that `factor` times the photons would leave.

        Four parts scatter about a mean that is off the centre where few photons move it: by as much as the centre is
        off the truth, if the error falls with the root of the photons.
        """
        centre, shrunk = self.centre, 1.0 / math.sqrt(factor)

        def ends(found: list[float], *, ratio: bool) -> tuple[float, float]:
            values = np.array(found)
            if ratio:
                with np.errstate(divide="ignore"):
                    values = np.log(values)
            if not np.isfinite(values).all():
                middle = found[0] if np.isfinite(values[0]) else 1.0
                return middle * _UNKNOWN**-shrunk, middle * _UNKNOWN**shrunk
            parts = values[1:]
            half = shrunk * (_SCATTER * float(parts.std(ddof=1)) + abs(float(values[0] - parts.mean())))
            low, high = float(values[0]) - half, float(values[0]) + half
            return (math.exp(low), math.exp(min(high, 700.0))) if ratio else (max(low, 0.0), high)

        every, best, worst = (centre, *self.parts), dict[str, Any](), dict[str, Any]()
        for name in ("bound", "shot_noise", "peak"):
            best[name], worst[name] = ends([getattr(one, name) for one in every], ratio=True)
        worst["peak"], best["peak"] = best["peak"], worst["peak"]
        noise = [ends([float(_noise(one, n)) * math.sqrt(n) for one in every], ratio=True) for n, _ in centre.excess]
        for i, side in enumerate((best, worst)):
            ratios = [max(pair[i] / side["bound"], 1.0) for pair in noise]
            side["excess"] = tuple((n, ratio) for (n, _), ratio in zip(centre.excess, ratios, strict=True))
        best["level"], worst["level"] = ends([one.level for one in every], ratio=False)
        for name in ("floor", "pile_up"):
            pairs = {key: ends([abs(getattr(one, name)[key]) for one in every], ratio=False) for key in METHODS}
            best[name], worst[name] = ({key: pair[i] for key, pair in pairs.items()} for i in (0, 1))
        return dataclasses.replace(centre, **best), centre, dataclasses.replace(centre, **worst)


@dataclass(frozen=True, kw_only=True)
class _Planner:
    """The question: arguments of `plan`."""

    depth_error: float
    time: float
    margin: float
    method: Method
    full_power: bool
    eye_distance: float | None
    eye_exposure: float
    seed: int
    device: str | None
    channel: Channel
    progress: Progress | None

    def propose(self, scene: Scene, span: tuple[float, float], photons: int | None, *, even: bool = False) -> Proposal:
        """The experiment with a target at these ranges: light, pulse energy, pulses, error; `even` as in `measure`.

        `photons`: None: as many as judge.
        """
        rate, largest_rate = scene.laser.repetition_rate, 1.0 / scene.gate.stop
        if scene.detector.wrap and rate > largest_rate:
            rate = _rounded_down(largest_rate)
            scene = scene.with_overrides(laser={"repetition_rate": rate})
        _refuse_hopeless(scene, span[0], self.time)
        small, asked = window(scene, self.device), scene
        typical = typical_pixels(small, self.device)
        budget = _SECONDS * (_PART if even else 1.0)
        longest = budget * (_LONGER if even else 1.0)
        runs: tuple[Result, ...] = ()
        while True:
            report = None if even else self.progress
            runs = trace(
                small, photons or max(_FEWEST, sum(run.photons for run in runs)), self.seed, self.device, report, runs
            )
            traced = sum(run.photons for run in runs)
            elapsed = sum(run.timing.get("trace", 0.0) for run in runs)  # not what compiles, or judges
            last = photons is not None or traced > _MOST
            try:
                scene, energy_limit, piled, pilot = self._settle(asked, runs, typical, even)
                parts = [self._settle(asked, runs[i : i + 2], typical, even)[-1] for i in range(0, RUNS, 2)]
                # Noise of the runs moves a median of moduli away from 0, in quarters of the photons about twice as far.
                twice = {key: float(np.mean([one.floor[key] for one in parts])) for key in pilot.floor}
                floor = {key: max(value - (twice[key] - value), 0.0) for key, value in pilot.floor.items()}
                found = _Sample(dataclasses.replace(pilot, floor=floor), parts)
            except NoLight:
                if last or 2.0 * elapsed > budget:
                    raise
                continue
            factor = self._missing(scene, found)
            least = even or 2.0 * elapsed > _SHORT or self._missing(scene, found, _NARROW) <= 1.0
            if last or (least if factor <= 1.0 else 2.0 * elapsed > max(budget, min(factor * elapsed, longest))):
                break
        low, pilot, high = found.ends(1.0)
        ends = [self._outcome(scene, one) for one in (low, pilot, high)]
        pulses, purpose, terms, _, frame_time = ends[1]
        limits = list(dict.fromkeys(one.limit for one in (ends[1], ends[0], ends[2])))
        if factor > 1.0:
            purpose, pulses, frame_time = "not judged", scene.detector.pulses_per_frame, math.nan
        # Given on its own, the analytic model's number would hold against a later change of the detector's.
        depth_pulses = None if scene.analytic.pulses_per_depth_frame is None else pulses
        scene = scene.with_overrides(
            detector={"pulses_per_frame": pulses}, analytic={"pulses_per_depth_frame": depth_pulses}
        )
        line = axis_line(scene)
        optical_depth = scene.optical_depth(line.start[0].tolist(), line.points(span[0])[0].tolist())
        fluence = axis_fluence(scene, span[0]) * math.exp(-optical_depth)
        index, advance = scene.medium.group_index, port_advance(scene)
        return Proposal(
            scene=scene,
            depth_error=self.depth_error,
            time=self.time,
            method=self.method,
            target_range=span,
            optical_depth=optical_depth,
            gate_range=tuple(range_from_time(end, index) + advance for end in (scene.gate.start, scene.gate.stop)),
            unambiguous_range=range_from_time(1.0 / rate, index) + advance,
            largest_rate=largest_rate,
            pile_up_energy=piled,
            eye=self._eye(scene),
            energy_limit=energy_limit,
            irradiance=fluence * scene.laser.pulse_energy * scene.laser.repetition_rate,
            pulses=pulses,
            pulses_for=purpose,
            pulses_range=(min(ends[0].pulses, ends[2].pulses), max(ends[0].pulses, ends[2].pulses)),
            frame_time=frame_time,
            reached=None if factor > 1.0 else purpose in _ENOUGH and frame_time <= self.time,
            terms=terms,
            limit=" or ".join(limits),
            advice=self._advice(ends[1]._replace(purpose=purpose, time=frame_time), pilot.floor, rate, largest_rate),
            pilot=pilot,
            photons_needed=traced * factor,
            seconds_needed=sum(run.timing.get("trace", math.nan) for run in runs) * factor,
        )

    def _settle(
        self, scene: Scene, runs: Sequence[Result], typical: Mask, even: bool
    ) -> tuple[Scene, str, float, Pilot]:
        """The scene with its pulse energy, what sets it, that of pile-up; and what an even number of runs measured."""
        options: Any = {"even": even, "channel": self.channel, "depth_error": self.depth_error, "method": self.method}
        found = measure(runs, scene, typical, self.device, **options)
        piled = scene.laser.pulse_energy * max(PILE_UP - found.noise, 0.0) / found.brightest
        allowed = {"pile-up": piled} | ({} if self.eye_distance is None else {"eye": self._eye(scene).pulse_energy})
        energy_limit = min(allowed, key=allowed.__getitem__)
        lowest = allowed[energy_limit]
        if not (lowest > 0 and ((self.full_power and not even) or scene.laser.pulse_energy > lowest)):
            return scene, "", piled, found
        scene = scene.with_overrides(laser={"pulse_energy": _rounded_down(lowest)})
        return scene, energy_limit, piled, measure(runs, scene, typical, self.device, **options)

    def _eye(self, scene: Scene) -> EyeLimit:
        return eye_limit(scene, distance=self.eye_distance or 0.1, exposure=self.eye_exposure)

    def _outcome(self, scene: Scene, pilot: Pilot) -> _Outcome:
        pulses, purpose = self._pulses(scene, pilot)
        terms = _terms(pilot, pulses, self.method)
        limit = _limit(scene, pilot, terms, pulses, self.method)
        return _Outcome(pulses, purpose, terms, limit, pulses * scene.scan_positions / scene.laser.repetition_rate)

    def _missing(self, scene: Scene, found: _Sample, wide: float = _WIDE) -> float:
        """Times as many photons that would know the pulses to a ratio, and all else; infinite: not even 10⁴ times."""
        factor = max(1.0, (found.centre.light_noise / _LIGHT_NOISE) ** 2)
        while factor < 1e4:
            ends = [self._outcome(scene, pilot) for pilot in found.ends(factor)]
            kinds = {(one.purpose in _ENOUGH, one.purpose in _ENOUGH and one.time <= self.time) for one in ends}
            if len(kinds) == 1 and (ends[0].purpose not in _ENOUGH or ends[2].pulses <= wide * ends[0].pulses):
                return factor
            factor *= 2.0
        return math.inf

    def _pulses(self, scene: Scene, pilot: Pilot) -> tuple[int, str]:
        """Pulses of a depth frame, and what they are for.

        For the depth error that the floor leaves, but at least as many as bring false peaks below `OUTLIERS`; where the
        floor is too high, until the bound is a third of it: then the error is within 6 % of the floor.
        """
        fixed = math.hypot(pilot.floor[self.method], pilot.pile_up[self.method])
        left = math.sqrt(max(self.depth_error**2 - fixed**2, 0.0))
        purpose = "depth error" if left > 0 else "floor"
        noise = left or fixed / 3.0
        wanted = (pilot.bound / noise) ** 2
        if pilot.excess:
            tried = max(wanted, 1.0) * np.geomspace(1.0, 1e9, 1200)
            wanted = min(tried[_noise(pilot, tried) <= noise], default=math.inf)
        peaks = _pulses_without_false_peaks(scene, pilot, self.device)
        if peaks > wanted:
            wanted, purpose = peaks, "false peaks" if left > 0 else "floor"
        if not wanted <= _MOST_PULSES:
            return _MOST_PULSES, "out of reach"
        digits = 10.0 ** max(0, math.floor(math.log10(max(wanted, 1.0))) - 1)
        return int(min(max(1.0, math.ceil(wanted / digits) * digits), _MOST_PULSES)), purpose

    def _advice(self, found: _Outcome, floor: dict[str, float], rate: float, largest: float) -> str:
        """What would help: time, where the pulses reach the depth error but take too long."""
        _, purpose, _, limit, frame_time = found
        advice, best = _ADVICE[limit], min(floor, key=floor.__getitem__)
        if limit == "estimator" and floor["likelihood"] < self.depth_error:
            advice += f", or --method likelihood, which reaches the bound and leaves {1e3 * floor['likelihood']:.3g} mm"
        if limit == "forward scattering" and floor[best] < 0.7 * floor[self.method]:
            advice += (
                f", or --method {best}, whose floor is {with_prefix(floor[best], 'm')}: plan with it, for its noise"
            )
        if purpose not in _ENOUGH:
            return advice + ("; more pulses do not help" if limit == "forward scattering" else "")
        if frame_time <= self.time:
            return advice
        faster = f"; this gate allows up to {with_prefix(largest, 'Hz')}" if largest > rate else ""
        if limit == "shot noise":
            return (
                f"more light per pulse (energy, aperture, reflectance), a longer time (--time) or a higher repetition "
                f"rate: these pulses take {with_prefix(frame_time, 's')} at {with_prefix(rate, 'Hz')}{faster}"
            )
        return (
            f"a longer time (--time): these pulses reach the depth error, but take {with_prefix(frame_time, 's')} at a "
            f"repetition rate of {with_prefix(rate, 'Hz')}{faster}; fewer pulses are needed with {advice}"
        )

    def largest_range(
        self, scene: Scene, start: float, photons: int | None
    ) -> tuple[float, str, tuple[float, float] | None]:
        """`largest_range`, `range_limit` and `unjudged_ranges` of a `Proposal`, sought from `start` on.

        The repetition rate and the pulse energy are the scene's, the gate follows the plane.
        """
        reasons, needed = dict[float, str](), dict[float, float]()

        def judge(distance: float) -> bool | None:
            if distance <= axis_line(scene).lead[0]:
                reasons[distance] = "the port"
                return False
            if self.progress is not None:
                self.progress(f"a plane at {distance:.3g} m", 0, 0)
            span = (distance, distance)
            try:
                gated = with_gate(with_plane(scene, distance), span, self.margin)
                if scene.detector.wrap and 1.0 / gated.gate.stop < scene.laser.repetition_rate:
                    reasons[distance] = "repetition rate"
                    return False
                proposal = self.propose(gated, span, photons, even=True)
            except NoLight:  # a plane that light reaches, since none is named hopeless: more photons would see it
                return None
            except ConfigError as error:
                reasons[distance] = "the gate is too long" if "bin_width" in str(error) else "no light of the target"
                return False
            reasons[distance], needed[distance] = proposal.limit, proposal.photons_needed
            return proposal.reached

        air = float(axis_line(scene).lead[0]) if scene.surface is not None else 0.0
        near, far, unjudged = bracket(lambda below: judge(air + below), start - air)
        near, far, unjudged = near and air + near, air + far, unjudged and (air + unjudged[0], air + unjudged[1])
        limit = reasons[far] if far < math.inf else f"not sought beyond {_FARTHEST:g} m"
        if unjudged is None:
            return near, limit, None
        would = _SHARE * needed.get(unjudged[0], math.inf)
        told = f"about {would:.1e} photons would tell" if would < math.inf else "more photons would tell"
        beyond = f"; from {far:.3g} m on it is not reached: {limit}" if far < math.inf else ""
        ends = list(dict.fromkeys(f"{one:.3g}" for one in unjudged))
        where = f"{'from' if ends[1:] else 'at'} {' to '.join(ends)} m"
        return near or math.nan, f"not judged {where}: {told}{beyond}", unjudged


def bracket(judge: Callable[[float], bool | None], start: float) -> tuple[float, float, tuple[float, float] | None]:
    """The farthest range known to be reached, 0: none; the nearest beyond known not to be, inf: none; and between them
    the nearest and the farthest that are not judged, `None`: none. Steps of `_STEP`, then halves to `_RESOLUTION`.

    Args:
        judge: Of a range: True: reached, False: not reached, None: not judged.
        start: First range that is judged.
    """
    found = {start: judge(start)}
    distance = start
    while found[distance] is not False and distance * _STEP <= _FARTHEST:
        distance *= _STEP
        found[distance] = judge(distance)
    distance = start
    while True not in found.values() and distance / _STEP >= start / 40.0:
        distance /= _STEP
        found[distance] = judge(distance)
    while True:
        near = max((one for one, reached in found.items() if reached), default=0.0)
        far = min((one for one, reached in found.items() if reached is False and one > near), default=math.inf)
        gap = [one for one, reached in found.items() if reached is None and near < one < far]
        for low, high in ((near, min(gap, default=far)), (max(gap, default=near), far)):
            if low > 0.0 and high < math.inf and high / low > _RESOLUTION:
                middle = math.sqrt(low * high)
                found[middle] = judge(middle)
                break
        else:
            return near, far, (min(gap), max(gap)) if gap else None


# Targets and gates


def with_gate(scene: Scene, span: tuple[float, float], margin: float) -> Scene:
    """The scene with a gate for returns from a span of ranges [m], with `margin` [m] and the instrument response on
    both sides. Its end is the least time between pulses.

    The bins keep their width. Raises `ConfigError` for a gate of more than a million bins.
    """
    lines, index = lines_of_sight(scene), scene.medium.group_index
    # A pixel whose light does not get through the port has no time; one that is still in the port has that of its end.
    times = [time_from_path(lines.path_from_range(np.maximum(r, lines.lead + _LEAST)), index) for r in span]
    spread, width = time_from_range(margin, index), scene.gate.bin_width
    before, after = detector_response(scene.detector, scene.laser).support
    start = max(0.0, math.floor((np.nanmin(times[0]) + before - spread) / width) * width)
    start_ns = round(start * 1e9, 6)
    bins = math.ceil((np.nanmax(times[1]) + after + spread - start_ns * 1e-9) / width)
    if bins > _MOST_BINS:
        raise ConfigError(
            f"gate.bin_width_ps = {scene.gate.bin_width_ps:g}: a gate for {span[0]:.4g} to {span[1]:.4g} m takes "
            f"{bins} bins, more than {_MOST_BINS}",
            source=scene.source,
        )
    return scene.with_overrides(gate={"start_ns": start_ns, "bins": bins}, transport={"max_path": None})


def with_plane(scene: Scene, distance: float) -> Scene:
    """The scene with a plane square to the optical axis as its only target, larger than the view and the beam, at a
    range on the axis."""
    camera = scene.camera
    widest = max(abs(edge) for edge in camera.view_box)
    if scene.laser.profile != "collimated":
        widest = max(widest, math.tan(min(scene.laser.half_angle, math.radians(80.0))))
    offset = max(map(abs, scene.beam.position)) + scene.laser.beam_radius
    side = 2.4 * (distance * widest + offset)
    point = axis_line(scene).points(distance)[0]  # A tilted port bends the axis.
    side += 2.0 * float(np.abs(point[:2]).max())
    place = to_world(camera, point) if camera.is_posed else point
    plane = {
        "builtin": "plane",
        "size": [side, side],
        "translation": [float(x) for x in place],
        "rotation_deg": list(camera.rotation_deg),
        "reflectance": face_reflectance(scene),
    }
    return scene.with_overrides({"targets": [plane]})


# What is known before, and from the run


def _refuse_hopeless(scene: Scene, nearest: float, time: float) -> None:
    """Raises `ConfigError` where a pixel detects less than one photon of the target in all pulses of a time [s],
    however much of the light is forward-scattered.

    Light of a pixel whose last face is the target is ρ/π ∫ E I dA: E is the irradiance of the target by all light, I
    that which the pixel would cast on it before any other face, by reciprocity (Veach 1997). Energy bounds ∫ I dA by
    the étendue of the pixel, less what water absorbs on the shortest way. E is at most 2/(1 − ρω) times that on the
    axis of the beam in clear water that absorbs. Light that comes to a plane for the first time is in an even wide beam
    at most as dense as in clear water, by energy; a cone has at most the light of a source of its intensity in all
    directions, whose densest first hits go from 1 time (straight) to 2 times (diffusion, 1/(2π z²): the harmonic
    measure of a half-space). Of what the target reflects, ρ, at most ω, the albedo, comes back: it has to scatter.
    There is no bound where walls reflect.
    """
    camera, laser, water = scene.camera, scene.laser, scene.medium.range
    known = (1.0 if isinstance(one.reflectance, str) else one.reflectance for one in scene.targets)
    reflectance = max(known, default=1.0)
    sight = nearest - float(axis_line(scene).lead[0])
    way = min(nearest, sight) - math.hypot(*scene.beam.position)  # of the laser's light, at least
    if way <= 0.0 or reflectance * water.albedo >= 1.0 or scene.domain.reflecting:
        return
    etendue = camera.aperture_area * camera.pixel_tangent**2
    passed = math.exp(-water.absorption * (sight + way))
    returns = 2.0 / (1.0 - reflectance * water.albedo)
    light = returns * reflectance / math.pi * axis_fluence(scene, way) * etendue * passed
    pulses = min(time * laser.repetition_rate / scene.scan_positions, _MOST_PULSES)
    most = light * scene.detectable_photons_per_pulse * pulses
    if most < 1.0:
        raise ConfigError(
            f"no depth is within reach: of a target at {nearest:.3g} m a pixel detects {most:.2g} photons at most in "
            f"all {pulses:.3g} pulses of {with_prefix(time, 's')}, even if scattering took no light away (absorption "
            f"alone leaves {passed:.2g}, optical depth {scene.medium.range.extinction * nearest:.3g}); what helps: "
            "a shorter distance, clearer water, more pulse energy, a larger aperture, a longer time",
            source=scene.source,
        )


def _rounded_down(value: float) -> float:
    """With three digits, not above the value."""
    nearest = f"{value:.2e}"
    step = 10.0 ** (int(nearest.partition("e")[2]) - 2) * (float(nearest) > value)
    return float(f"{float(nearest) - step:.3g}")


def _pulses_without_false_peaks(scene: Scene, pilot: Pilot, device: str | None) -> float:
    """Pulses after which a fit takes background for the return with a probability of `OUTLIERS`; inf beyond 1e12."""
    pulses = np.geomspace(1.0, 1e12, 481)
    lengths = np.full_like(pulses, (scene.gate.stop - scene.gate.start) / response_deviation(scene))
    few = np.flatnonzero(false_peaks(pulses * pilot.peak, pulses * pilot.level, lengths, device) <= OUTLIERS)
    return float(pulses[few[0]]) if few.size else math.inf


def _noise(pilot: Pilot, pulses: Any) -> Any:
    """Noise of the estimator [m]."""
    excess = np.interp(np.log(pulses), *np.log(pilot.excess).T) if pilot.excess else 0.0
    return pilot.bound / np.sqrt(pulses) * np.exp(excess)


def _terms(pilot: Pilot, pulses: int, method: str) -> dict[str, float]:
    """Parts of the depth error [m]; squares add up."""
    noise = float(_noise(pilot, pulses))
    bound, shot = pilot.bound / math.sqrt(pulses), pilot.shot_noise / math.sqrt(pulses)
    floor, piled = pilot.floor[method], abs(pilot.pile_up[method])
    return {
        "shot noise": min(shot, bound),
        "background": math.sqrt(max(bound**2 - shot**2, 0.0)),
        "Cramér–Rao bound": bound,
        "estimator": math.sqrt(max(noise**2 - bound**2, 0.0)),
        "forward scattering": floor,
        "pile-up": piled,
        "total": math.hypot(noise, floor, piled),
    }


def _limit(scene: Scene, pilot: Pilot, terms: dict[str, float], pulses: int, method: str) -> str:
    """What the depth error is made of for the most part."""
    parts = "shot noise", "background", "estimator", "forward scattering", "pile-up"
    largest = max(parts, key=terms.__getitem__)
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


_WIDTH = "the error is proportional to the width of the response, while photons act only by their root"
_ADVICE = {
    "shot noise": "more pulses, energy, aperture or reflectance; the error falls with the root of the photons",
    "jitter": f"a detector with less jitter: {_WIDTH}",
    "pulse duration": f"a shorter pulse: {_WIDTH}",
    "bin width": "narrower bins, gate.bin_width_ps: where light is within a bin is not known",
    "backscatter": "a gate that begins closer to the target, more distance between laser and lens, a narrower view",
    "dark counts and ambient light": "a shorter gate, a narrower spectral filter, a cooler or quieter detector",
    "estimator": "more pulses",
    "forward scattering": "a shorter distance, clearer water, a narrower beam or view",
    "pixel size": "smaller pixels: slopes and edges of the target within one pixel, also without scattered light",
    "pile-up": "less pulse energy, or Coates' correction (`spadwarp detect --coates`)",
}
