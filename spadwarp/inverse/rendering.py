"""Expected detections of a scene and their derivatives by its unknowns, from independent groups of photons."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.device import pick_device
from spadwarp.frames import Receiver, detector_response
from spadwarp.frames.spad import Window
from spadwarp.inverse.exposure import Exposure
from spadwarp.inverse.unknowns import BACKGROUND, DEPTH, Unknown, moved, with_values
from spadwarp.result import Truth
from spadwarp.scene import Scene, noise_rate
from spadwarp.scene.medium import NOTABLE_UNSEEN
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport import ExpectedLight, LightTracer

Rows = NDArray[np.float32]
_WIDEST_BIN = 0.5  # least width of the response in bins, for a histogram that follows the depth smoothly
Values = Mapping[str, Any]
"""By name a number, or for an unknown of each pixel `[pixel]`; depth as a shift from the scene's [m]."""


class Half(NamedTuple):
    """Rates and derivatives by one group of photons."""

    rates: Rows  # λ, expected detections per pulse, float32 [pixel, bin]: the mean of the batches
    slopes: list[Rows]  # dλ/d(unknown), float32 [unknown, pixel, bin], of the first batches
    batches: list[Rows]  # λ of each batch


@dataclass(eq=False)
class Renderer:
    """Renders a scene at values of its unknowns; every call takes photons that no other call has taken."""

    scene: Scene  # with the values that are known
    unknowns: tuple[Unknown, ...]  # in the order of the slopes
    exposure: Exposure  # time axis and response of the counts
    device: str | None = None
    seed: int = 0
    depth_step: float = 0.0  # half of the distance between the two places of central differences [m]
    truth: Truth | None = None  # truth maps of the scene at the values rendered last
    photons: int = 0  # emitted so far
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
        """Sentences on what the linear model of the bins, and the photons, do not cover."""
        width, bin_width, sentences = self._response_width, self.scene.gate.bin_width, []
        if width < _WIDEST_BIN * bin_width and any(unknown.name == DEPTH for unknown in self.unknowns):
            sentences.append(
                f"depth: the instrument response, {width * 1e12:.3g} ps, is much shorter than a bin, "
                f"{bin_width * 1e12:.4g} ps: where in its bin a return lies is hardly known, "
                "and the standard error of the depth is too small"
            )
        angle, unseen = self.scene.unseen_peak(self.photons, () if self.truth is None else self.truth.range)
        if unseen > NOTABLE_UNSEEN:
            sentences.append(self.scene.unseen_warning(self.photons, angle, unseen))
        return sentences

    @property
    def window(self) -> Window:
        """The detector's bins in time."""
        return self._receiver(self.scene, {}).window

    @property
    def limits(self) -> NDArray[np.float32]:
        """Largest |dλ|/λ that a weight takes, `[unknown]`.

        A scored derivative is λ times a mean of what its photons scored, and needs none; a difference of two places is
        noise alone where λ is hardly known.
        """
        return np.array([1.0 / self.depth_step if one.name == DEPTH else 1e30 for one in self.unknowns], np.float32)

    def __call__(
        self, values: Values, *, photons: int, halves: int = 2, batches: int = 1, scored: int = 1
    ) -> list[Half]:
        """Groups of `photons` · `batches` photons each, which are independent of each other; of the first batches so
        many are `scored`: have slopes."""
        scene = self._at(values)
        names = [unknown.name for unknown in self.unknowns if unknown.is_light]
        tracer = self._tracer(scene, photons, names)
        plain = tracer if batches == scored or not names else self._tracer(scene, photons, ())
        depth = None
        if any(unknown.name == DEPTH for unknown in self.unknowns):
            depth = self._depth_difference(scene, self.depth_step, photons)
        self.truth = tracer.truth
        receiver = self._placed(scene, values)
        groups = []
        for _ in range(halves):
            group, by_unknowns = list[Rows](), list[Rows]()
            for batch in range(batches):
                number = self._take(photons)
                light, slopes = (tracer if batch < scored else plain)(number, photons)
                group.append(receiver.rates(light))
                if batch < scored:
                    if depth is not None:
                        slopes[DEPTH] = depth(number)
                    by_unknowns.append(receiver.slopes(slopes, self.unknowns))
            rates: Rows = group[0] if batches == 1 else np.asarray(np.mean(group, axis=0, dtype=np.float32))
            groups.append(Half(rates, by_unknowns, group))
        return groups

    def light(self, values: Values, *, photons: int, batches: int) -> tuple[list[Rows], list[Rows]]:
        """λ of batches of so many photons each, and the parts of their mean: light of targets, of the water, noise."""
        scene = self._at(values)
        tracer = self._tracer(scene, photons, (), separate_targets=True)
        self.truth = tracer.truth
        receiver = self._placed(scene, values)
        lights = [tracer(self._take(photons), photons)[0] for _ in range(batches)]
        rates, target = [receiver.rates(light) for light in lights], receiver.target(lights[0]) / batches
        for light in lights[1:]:
            target += receiver.target(light) / batches
        noise = receiver.noise()
        mean: Rows = np.asarray(np.mean(rates, axis=0, dtype=np.float32))
        return rates, [target, np.maximum(mean - target - noise, 0.0), noise]

    def depth_slopes(self, values: Values, *, shift: float, step: float, photons: int, batches: int) -> list[Rows]:
        """dλ/d(depth) `[pixel, bin]` by differences over `shift` ± `step` [m], each of so many photons of its own."""
        scene = self._at(values)
        difference = self._depth_difference(moved(scene, shift), step, photons)
        receiver = self._placed(scene, values)
        depth = [unknown for unknown in self.unknowns if unknown.name == DEPTH]
        lights = (difference(self._take(photons)) for _ in range(batches))
        return [receiver.slopes({DEPTH: light}, depth)[0] for light in lights]

    def _at(self, values: Values) -> Scene:
        """The scene with one number for each unknown.

        The lens keeps the focus that it has in the scene as it is given, wherever the targets are moved, and so does
        the view: with a focus in metres, the distance of the sensor would follow it.
        """
        from spadwarp.mesh import build_mesh, focus_distance

        scene = with_values(self.scene, {name: float(np.mean(value)) for name, value in values.items()})
        if "focus" not in self._kept:
            self._kept["focus"] = focus_distance(self.scene, build_mesh(self.scene))
        focus, camera = self._kept["focus"], scene.camera
        if focus is None or camera.focus_distance != "target":
            return scene
        changes: dict[str, Any] = {"focus_distance": focus}
        if camera.pixel_pitch_um is not None:
            changes |= {"fx": camera.focal_pixels[0], "pixel_pitch_um": None}
        return scene.model_copy(update={"camera": camera.model_copy(update=changes)})

    def _take(self, photons: int) -> int:
        """The first of photons that were not traced before."""
        first, self.photons = self.photons, self.photons + photons
        return first

    def _tracer(self, scene: Scene, photons: int, names: Sequence[str], **choices: Any) -> LightTracer:
        kept = self._kept.setdefault("scored" if names else "plain", {})
        choices = {**self._choices, **choices}
        tracer = LightTracer(scene, photons=photons, derivatives=names, mesh_cache=kept, **choices)
        self._tally = tracer.tally
        return tracer

    def _depth_difference(self, scene: Scene, step: float, photons: int) -> Callable[[int], ExpectedLight]:
        """Derivative by the depth of the targets [1/m] from a first photon on: of two runs with the same photons and
        the targets at ± `step` [m]."""
        import warp as wp

        tracers = [
            LightTracer(
                moved(scene, shift), mesh_cache=self._kept.setdefault(name, {}), photons=photons, **self._choices
            )
            for name, shift in (("far", step), ("near", -step))
        ]

        def slope(far: Any, near: Any) -> Any:
            if far is None:
                return None
            return wp.array((far.numpy() - near.numpy()) * (0.5 / step), dtype=wp.float32, device=far.device)

        def difference(first: int) -> ExpectedLight:
            far, near = (tracer(first, photons)[0] for tracer in tracers)
            return ExpectedLight(slope(far.total, near.total), slope(far.target, near.target))

        return difference

    @property
    def _choices(self) -> dict[str, Any]:
        """Of all tracers; one tally serves them in turn. Light of the targets is apart where each pixel places it."""
        separate = any(unknown.per_pixel and unknown.name != BACKGROUND for unknown in self.unknowns)
        return {"seed": self.seed, "device": self.device, "separate_targets": separate, "tally": self._tally}

    def _receiver(self, scene: Scene, values: Values) -> Receiver:
        gate, camera, detector = scene.gate, scene.camera, scene.detector
        ambient = None
        if scene.daylight is not None and self.truth is not None:
            ambient = noise_rate(scene, self.truth)[..., 0] - scene.detector.noise_rate
        background = np.asarray(values.get(BACKGROUND, 0.0))
        if background.ndim:
            rates = np.reshape(background, (camera.height, camera.width))
            detector = detector.model_copy(update={"ambient_rate": 0.0})
            ambient = rates if ambient is None else ambient + rates
        return Receiver.of(
            detector,
            scene.laser,
            shape=(camera.height, camera.width, gate.bins),
            axis=(gate.start, gate.bin_width),
            irf=self.exposure.irf,
            window=self.exposure.window,
            tdc_widths=self.exposure.tdc_widths,
            ambient=ambient,
            device=pick_device(self.device),
        )

    def _placed(self, scene: Scene, values: Values) -> _PlacedReceiver:
        receiver = self._receiver(scene, values)
        moving = [unknown for unknown in self.unknowns if unknown.per_pixel and unknown.name != BACKGROUND]
        if not moving:
            return _PlacedReceiver(receiver)
        delay, factor = np.zeros(scene.camera.width * scene.camera.height), np.ones(1)
        for unknown in moving:
            value = np.asarray(values[unknown.name])
            if unknown.name == DEPTH:
                delay = (value - float(np.mean(value))) * _bins_per_metre(scene).reshape(-1)
            else:
                factor = factor * (value / float(np.mean(value)))
        return _PlacedReceiver(receiver, delay, np.broadcast_to(factor, delay.shape).astype(np.float32))


class _PlacedReceiver(NamedTuple):
    """The receiver, and how each pixel changes the light of the targets: a delay in bins and a factor, `[pixel]`."""

    receiver: Receiver
    delay: NDArray[np.float64] | None = None
    factor: Rows | None = None

    def rates(self, light: ExpectedLight) -> Rows:
        """λ of light."""
        rows = self.receiver.hazard(light.total).numpy()
        return np.maximum(self._with_change(rows, light), 0.0)  # the cubic of a shift swings below 0

    def slopes(self, slopes: Mapping[str, ExpectedLight], unknowns: Sequence[Unknown]) -> Rows:
        """Derivatives of λ, `[unknown, pixel, bin]`."""
        height, width = self.receiver.image
        bins = self.receiver.window.edges.size - 1
        result = np.empty((len(unknowns), height * width, bins), np.float32)
        for row, unknown in zip(result, unknowns, strict=True):
            if unknown.name == BACKGROUND:
                row[:] = self.receiver.noise_slope().numpy()
            else:
                light = slopes[unknown.name]
                row[:] = self._with_change(self.receiver.slope(light.total).numpy(), light)
        return result

    def target(self, light: ExpectedLight) -> Rows:
        """The part of λ that is light of the targets."""
        target: Rows = self.receiver.slope(light.target).numpy()
        return target if self.delay is None else subbin_shift(target, self.delay) * self.factor[:, None]  # type: ignore[index]

    def noise(self) -> Rows:
        """The part of λ that is dark counts and ambient light, `[pixel, bin]`."""
        return np.multiply.outer(self.receiver.noise.numpy(), np.diff(self.receiver.window.edges)).astype(np.float32)

    def _with_change(self, rows: Rows, light: ExpectedLight) -> Rows:
        """With the light of the targets in its new place, less that in the old."""
        return rows if self.delay is None else rows + (self.target(light) - self.receiver.slope(light.target).numpy())


def _bins_per_metre(scene: Scene) -> NDArray[np.float64]:
    """Delay of a return in bins for each metre that its target is deeper, `[H, W]`."""
    lines, middle = lines_of_sight(scene), 0.5 * scene.medium.pulse_speed * (scene.gate.start + scene.gate.stop) * 0.5
    step = 1e-3 * middle
    ends = [lines.path_from_range(lines.range_from_depth(middle + side * step)) for side in (-1.0, 1.0)]
    return (ends[1] - ends[0]) / (2.0 * step * scene.medium.pulse_speed * scene.gate.bin_width)


def subbin_shift(rows: Rows, delay: NDArray[np.float64]) -> Rows:
    """Rows `[pixel, bin]` later by `delay` `[pixel]` bins, by a cubic through four bins (Lagrange); 0 comes in.

    For histograms that the instrument response has smoothed: of a Gaussian with a standard deviation of 1.5 bins, the
    largest error is 1 % of its height; sum and centroid are exact.
    """
    if not delay.any():
        return rows
    whole = np.floor(delay).astype(np.int64)
    x = (delay - whole)[:, None]
    # Of the values in bins k − whole + 1, + 0, − 1, − 2, for the place x bins before k − whole.
    weights = (
        x * (x - 1) * (x - 2) / -6.0,
        (x + 1) * (x - 1) * (x - 2) / 2.0,
        (x + 1) * x * (x - 2) / -2.0,
        (x + 1) * x * (x - 1) / 6.0,
    )
    bins = np.arange(rows.shape[1])
    result = np.zeros_like(rows)
    for offset, weight in zip((1, 0, -1, -2), weights, strict=True):
        source = bins - whole[:, None] + offset
        inside = (source >= 0) & (source < rows.shape[1])
        taken = np.take_along_axis(rows, np.clip(source, 0, rows.shape[1] - 1), axis=1)
        result += np.where(inside, taken, 0.0) * weight.astype(np.float32)
    return result
