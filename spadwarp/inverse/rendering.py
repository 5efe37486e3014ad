"""Expected detections of a scene and their derivatives by its unknowns, from independent groups of photons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.device import pick_device
from spadwarp.frames import InstrumentResponse, Receiver, detector_response
from spadwarp.frames.window import Window
from spadwarp.inverse.derivatives import DepthDifference
from spadwarp.inverse.shifting import shifted
from spadwarp.inverse.unknowns import BACKGROUND, DEPTH, Unknown, moved, with_values
from spadwarp.scene import noise_rate
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport import ExpectedLight, LightTracer

if TYPE_CHECKING:
    from spadwarp.inverse.exposure import Exposure
    from spadwarp.result import Truth
    from spadwarp.scene import Scene

__all__ = ["Half", "Renderer", "Values"]

Rows = NDArray[np.float32]
_WIDEST_BIN = 0.5  # least width of the response in bins, for a histogram that follows the depth smoothly
Values = Mapping[str, Any]
"""By name a number, or for an unknown of each pixel `[pixel]`; depth as a shift from the scene's [m]."""


@dataclass(frozen=True, eq=False)
class Half:
    """What one group of photons says.

    Attributes:
        rates: λ, expected detections per pulse, float32 `[pixel, bin]`.
        slopes: dλ/d(unknown), float32 `[unknown, pixel, bin]`, of the first batch of the group.
        first: λ of that batch.
        limits: Largest |dλ|/λ that a weight takes, `[unknown]`. A scored derivative is λ times a mean of what its
            photons scored, and needs none; a difference of two places is noise alone where λ is hardly known.
        batches: λ of each batch; their mean is `rates`.
    """

    rates: Rows
    slopes: Rows
    first: Rows
    limits: Rows
    batches: list[Rows]


@dataclass(eq=False)
class Renderer:
    """Renders a scene at values of its unknowns; every call takes photons that no other call has taken.

    Attributes:
        scene: With the values that are known.
        unknowns: In the order of the slopes.
        exposure: Time axis and response of the counts.
        device: As in `simulate`.
        seed: Key of the random numbers.
        depth_step: Half of the distance between the two places of central differences [m].
        truth: Truth maps of the scene at the values rendered last.
        photons: Emitted so far.
    """

    scene: Scene
    unknowns: tuple[Unknown, ...]
    exposure: Exposure
    device: str | None = None
    seed: int = 0
    depth_step: float = 0.0
    truth: Truth | None = None
    photons: int = 0
    _kept: dict[str, Any] = field(default_factory=dict)
    _tally: Any = None

    def __post_init__(self) -> None:
        if self.depth_step == 0.0:
            # Half the response, where the slopes are steep and the histogram is still nearly straight between the two.
            sigma = self._response_width / 2.355
            self.depth_step = 0.25 * self.scene.medium.pulse_speed * max(sigma, 0.5 * self.scene.gate.bin_width)

    @property
    def _response_width(self) -> float:
        """Full width at half maximum of the instrument response [s]; 0 of a delta."""
        response = self.exposure.irf or detector_response(self.scene.detector, self.scene.laser)
        return response.fwhm if response.is_smooth else 0.0

    def warnings(self) -> list[str]:
        """Sentences on what the linear model of the bins does not cover."""
        width, bin_width = self._response_width, self.scene.gate.bin_width
        if width >= _WIDEST_BIN * bin_width or all(one.name != DEPTH for one in self.unknowns):
            return []
        return [
            f"depth: the instrument response, {width * 1e12:.3g} ps, is much shorter than a bin, "
            f"{bin_width * 1e12:.4g} ps: where in its bin a return lies is hardly known, "
            "and the standard error of the depth is too small"
        ]

    @property
    def window(self) -> Window:
        """The detector's bins in time."""
        scene = self.scene
        return self._receiver(scene, {}).window

    @property
    def apart(self) -> bool:
        """Whether light of the targets is held apart, because each pixel places it."""
        return any(one.per_pixel and one.name != BACKGROUND for one in self.unknowns)

    def __call__(self, values: Values, *, photons: int, halves: int = 2, batches: int = 1) -> list[Half]:
        """Groups of `photons` · `batches` photons each, which are independent of each other."""
        shared, scene = self._at(values)
        names = [one.name for one in self.unknowns if one.is_light]
        scored = self._tracer(scene, photons, names)
        plain = scored if batches == 1 or not names else self._tracer(scene, photons, ())
        depth = None
        if any(one.name == DEPTH for one in self.unknowns):
            depth = DepthDifference(scene, self.depth_step, photons=photons, mesh_cache=self._kept, **self._choices)
        self.truth = scored.truth
        receiver = self._receiver(scene, values)
        place = _Placement.of(scene, values, shared, self.unknowns, receiver) if self.apart else None
        groups = []
        for _ in range(halves):
            number = self._take(photons)
            light, slopes = scored(number, photons)
            if depth is not None:
                slopes[DEPTH] = depth(number, photons)
            first = _rates(receiver, light, place)
            group = [first]
            for _ in range(batches - 1):
                group.append(_rates(receiver, plain(self._take(photons), photons)[0], place))
            rates: Rows = first if batches == 1 else np.asarray(np.mean(group, axis=0, dtype=np.float32))
            groups.append(Half(rates, _slopes(receiver, slopes, self.unknowns, place), first, self._limits, group))
        return groups

    def depth_slopes(self, values: Values, *, shift: float, step: float, photons: int, batches: int) -> list[Rows]:
        """dλ/d(depth) `[pixel, bin]` by differences over `shift` ± `step` [m], each of so many photons of its own."""
        shared, scene = self._at(values)
        difference = DepthDifference(moved(scene, shift), step, photons=photons, mesh_cache=self._kept, **self._choices)
        receiver = self._receiver(scene, values)
        place = _Placement.of(scene, values, shared, self.unknowns, receiver) if self.apart else None
        depth = [one for one in self.unknowns if one.name == DEPTH]
        lights = (difference(self._take(photons), photons) for _ in range(batches))
        return [_slopes(receiver, {DEPTH: light}, depth, place)[0] for light in lights]

    def _at(self, values: Values) -> tuple[dict[str, float], Scene]:
        """One number for each unknown, and the scene with them."""
        shared = {name: float(np.mean(value)) for name, value in values.items()}
        return shared, self._with_focus(with_values(self.scene, shared))

    @property
    def _limits(self) -> Rows:
        return np.array([1.0 / self.depth_step if one.name == DEPTH else 1e30 for one in self.unknowns], np.float32)

    def _take(self, photons: int) -> int:
        """The first of photons that were not traced before."""
        first, self.photons = self.photons, self.photons + photons
        return first

    def _tracer(self, scene: Scene, photons: int, names: Sequence[str]) -> LightTracer:
        kept = self._kept.setdefault("scored" if names else "plain", {})
        tracer = LightTracer(scene, photons=photons, derivatives=names, mesh_cache=kept, **self._choices)
        self._tally = tracer.tally
        return tracer

    @property
    def _choices(self) -> dict[str, Any]:
        """Of all tracers; one tally serves them in turn."""
        return {"seed": self.seed, "device": self.device, "separate_targets": self.apart, "tally": self._tally}

    def _with_focus(self, scene: Scene) -> Scene:
        """The lens keeps the focus that it has in the scene as it is given, wherever the targets are moved.

        The view stays that of the scene, too: with a focus in metres, the distance of the sensor would follow it.
        """
        from spadwarp.mesh import build_mesh, focus_distance

        if "focus" not in self._kept:
            self._kept["focus"] = focus_distance(self.scene, build_mesh(self.scene))
        focus, camera = self._kept["focus"], scene.camera
        if focus is None or camera.focus_distance != "target":
            return scene
        changes: dict[str, Any] = {"focus_distance": focus}
        if camera.pixel_pitch_um is not None:
            changes |= {"fx": camera.focal_pixels[0], "pixel_pitch_um": None}
        return scene.model_copy(update={"camera": camera.model_copy(update=changes)})

    def _receiver(self, scene: Scene, values: Values) -> Receiver:
        gate, camera, detector = scene.gate, scene.camera, scene.detector
        ambient = None
        if scene.daylight is not None and self.truth is not None:
            ambient = noise_rate(scene, self.truth)[..., 0] - scene.detector.noise_rate
        background = np.asarray(values.get(BACKGROUND, 0.0))
        if background.ndim:
            own = np.reshape(background, (camera.height, camera.width))
            detector = detector.model_copy(update={"ambient_rate": 0.0})
            ambient = own if ambient is None else ambient + own
        response: InstrumentResponse | None = self.exposure.irf
        return Receiver.of(
            detector,
            scene.laser,
            shape=(camera.height, camera.width, gate.bins),
            axis=(gate.start, gate.bin_width),
            irf=response,
            window=self.exposure.window,
            tdc_widths=self.exposure.tdc_widths,
            ambient=ambient,
            device=pick_device(self.device),
        )


@dataclass(frozen=True, eq=False)
class _Placement:
    """How each pixel changes the light of the targets: a delay in bins and a factor, both `[pixel]`."""

    delay: NDArray[np.float64]
    factor: NDArray[np.float64]

    @classmethod
    def of(
        cls, scene: Scene, values: Values, shared: Mapping[str, float], unknowns: Sequence[Unknown], receiver: Receiver
    ) -> _Placement:
        pixels = scene.camera.width * scene.camera.height
        delay, factor = np.zeros(pixels), np.ones(pixels)
        for one in unknowns:
            if not one.per_pixel or one.name == BACKGROUND:
                continue
            if one.name == DEPTH:
                per_metre = bins_per_metre(scene).reshape(-1)
                delay += (np.asarray(values[DEPTH]) - shared[DEPTH]) * per_metre
            else:
                factor *= np.asarray(values[one.name]) / shared[one.name]
        return cls(delay, factor)

    def change(self, receiver: Receiver, light: ExpectedLight) -> Rows:
        """What it adds to λ, or to its derivative: the light of the targets in its new place, less that in the old."""
        assert light.target is not None
        target = _through(receiver, light.target, with_noise=False)
        return shifted(target, self.delay) * self.factor.astype(np.float32)[:, None] - target


def bins_per_metre(scene: Scene) -> NDArray[np.float64]:
    """Delay of a return in bins for each metre that its target is deeper, `[H, W]`."""
    lines, middle = lines_of_sight(scene), 0.5 * scene.medium.pulse_speed * (scene.gate.start + scene.gate.stop) * 0.5
    step = 1e-3 * middle
    ends = [lines.path_from_range(lines.range_from_depth(middle + side * step)) for side in (-1.0, 1.0)]
    return (ends[1] - ends[0]) / (2.0 * step * scene.medium.pulse_speed * scene.gate.bin_width)


def _through(receiver: Receiver, rows: Any, *, with_noise: bool) -> Rows:
    found: Rows = (receiver.hazard(rows) if with_noise else receiver.slope(rows)).numpy()
    return found


def _rates(receiver: Receiver, light: ExpectedLight, place: _Placement | None) -> Rows:
    """λ of light."""
    rates = _through(receiver, light.total, with_noise=True)
    return rates if place is None else rates + place.change(receiver, light)


def _slopes(
    receiver: Receiver, slopes: Mapping[str, ExpectedLight], unknowns: Sequence[Unknown], place: _Placement | None
) -> Rows:
    """Derivatives of λ, `[unknown, pixel, bin]`."""
    widths = np.diff(receiver.window.edges).astype(np.float32)
    pixels = receiver.image[0] * receiver.image[1]
    found = np.empty((len(unknowns), pixels, widths.size), np.float32)
    for row, one in zip(found, unknowns, strict=True):
        if one.name == BACKGROUND:
            row[:] = widths
            continue
        light = slopes[one.name]
        row[:] = _through(receiver, light.total, with_noise=False)
        if place is not None:
            row += place.change(receiver, light)
    return found
