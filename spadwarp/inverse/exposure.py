"""Counts to fit, on the time axis and in the image of a scene; and what their backscatter says of the water."""

from __future__ import annotations

import math
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.frames import Frames, FramesFile, Histograms, InstrumentResponse, is_frames_file, read_histograms
from spadwarp.frames.spad import Window
from spadwarp.io.paths import file_within
from spadwarp.result import NOISE_GOAL
from spadwarp.scene import Detector, Scene, phase_function
from spadwarp.transport import truth_maps
from spadwarp.values import ArgumentError, SpadwarpWarning, check_integer, shown

__all__ = ["Exposure", "lidar_initial_guess", "read_exposure"]

# Of backscatter from which absorption and scattering are guessed.
_LEAST_COUNTS, _LEAST_BINS = 200, 12
_LEAST_SPAN = 1.3  # last over first range, for a slope that says something of the water
_NEARER = 0.95  # of the range of the nearest target
_MOST = 2**53  # counts: beyond it float64 is not exact
_SHARE = 0.2  # of the scattering that the slope contains: most of it goes on forward


@dataclass(frozen=True, eq=False, kw_only=True)
class Exposure:
    """Counts of a number of pulses."""

    counts: NDArray[np.int64] | None
    """`[pixel, bin]`, added up over frames; None where there is only a plan of an exposure."""
    pulses: int  # in all
    window: tuple[float, int]  # start [s] and bins of the detector's window
    tdc_widths: NDArray[np.float64] | None = None  # relative widths of its bins; None: equal
    irf: InstrumentResponse | None = None  # the response that the counts contain; None: that of the scene
    noise_ratio: float | None = None
    """Of simulated counts `Result.target_noise_ratio` for all pulses; None: not known, or measured."""

    def left(self) -> NDArray[np.float32]:
        """Pulses without a count before each bin, `[pixel, bin]`: those that first-photon counting has left there."""
        assert self.counts is not None
        before = np.cumsum(self.counts, axis=1)
        before -= self.counts
        return np.maximum(self.pulses - before, 0).astype(np.float32)

    def warnings(self) -> list[str]:
        """Sentences on simulated counts that hold more noise than their photons have."""
        if self.noise_ratio is None or not NOISE_GOAL < self.noise_ratio < math.inf:  # infinite: no light at all
            return []
        return [
            f"the counts are simulated, and the simulation traced too few photons for {self.pulses} pulses: its noise, "
            f"the same in every frame, is {self.noise_ratio:.2g} times the variance of the counts in the median pixel; "
            f"the standard errors do not contain it. {self.noise_ratio / NOISE_GOAL:.2g} times the photons would make "
            f"it {NOISE_GOAL:g} times"
        ]


def read_exposure(counts: Any, scene: Scene, *, pulses: int | None = None, **facts: Any) -> Exposure:
    """Counts of a frames file, of `Frames`, of `Histograms` or an array, for a scene of the same image.

    Args:
        counts: The path of frames or of measured histograms; `Frames`, `Histograms`; or integers `[H, W, T]` or
            `[frames, H, W, T]` on the scene's gate.
        scene: Camera and gate.
        pulses: Of one frame; by default those that the frames name, else the scene's `detector.pulses_per_frame`.
        facts: Of a measured file, as `spadwarp.frames.read_histograms` takes them.

    Raises:
        ArgumentError: Counts that do not fit the scene, are no counts, or more than its detector can count.
        FileError: A file that cannot be read.
    """
    name, gate = "counts", scene.gate
    if isinstance(counts, str | os.PathLike):
        path = file_within(Path(counts), ("frames.h5",))
        name = str(path)
        is_frames = path.suffix.lower() in (".h5", ".hdf5") and is_frames_file(path)
        counts = FramesFile.load(path) if is_frames else read_histograms(path, **facts)
    values, start, width, irf, widths, noise = counts, gate.start, gate.bin_width, None, None, None
    if isinstance(counts, Frames | FramesFile):
        start, width, irf, noise = counts.gate_start, counts.bin_width, counts.irf, counts.target_noise_ratio
        steps = np.diff(counts.edges)
        widths = None if np.allclose(steps, steps[0], rtol=1e-9) else steps
        if pulses not in (None, counts.pulses):
            raise ArgumentError(f"{name}: pulses = {pulses}; its frames are of {counts.pulses}: leave it out")
        pulses = counts.pulses
        if isinstance(counts, Frames) and counts.summed:
            pulses *= counts.frames
            noise = None if noise is None else noise * counts.frames
        values = counts.counts() if isinstance(counts, FramesFile) else counts.counts
    elif isinstance(counts, Histograms):
        start, irf, values = counts.gate_start, counts.irf, counts.values
        width = width if counts.bin_width is None else counts.bin_width
    cube, frames = _added_up(values, scene, name)
    if pulses is None and (assumed := scene.detector.pulses_per_frame) == Detector().pulses_per_frame:
        text = f"{name}: pulses are not given: {assumed} a frame are assumed, and all light is in proportion to them"
        warnings.warn(text, SpadwarpWarning, stacklevel=2)
    pulses = scene.detector.pulses_per_frame if pulses is None else check_integer("pulses", pulses, "[1, 1e15]")
    if abs(width / gate.bin_width - 1.0) > 1e-6:
        raise ArgumentError(
            f"{name}: bins of {width * 1e12:g} ps; the scene's gate.bin_width_ps, {gate.bin_width_ps:g}, has to be that"
        )
    window = Window.of(scene.detector, scene.laser, (start, cube.shape[1]), gate.bin_width, widths)
    _check_countable(cube, pulses * frames, scene.detector, window, name)
    if not isinstance(counts, Frames | FramesFile | Histograms):
        gated = Window.of(scene.detector, scene.laser, (start, gate.bins), gate.bin_width, None).recorded
        if cube.shape[1] != gated:
            raise ArgumentError(f"{name}: {cube.shape[1]} bins; the detector has {gated} in the scene's gate")
    return Exposure(
        counts=cube,
        pulses=pulses * frames,
        window=(start, cube.shape[1]),
        tdc_widths=widths,
        irf=irf,
        noise_ratio=None if noise is None else noise * frames,
    )


def _added_up(values: Any, scene: Scene, name: str) -> tuple[NDArray[np.int64], int]:
    """Counts `[pixel, bin]` over all frames, and the number of these; `name`: of the counts, for messages."""
    array, image = np.asarray(values), (scene.camera.height, scene.camera.width)
    if array.ndim not in (3, 4) or array.size == 0 or array.dtype.kind not in "biuf":
        given = shown(values) if array.ndim == 0 else f"{array.dtype} {array.shape}"
        raise ArgumentError(f"{name}: {given}; [H, W, T] or [frames, H, W, T] is needed, as `detect` draws it")
    if array.shape[-3:-1] != image:
        raise ArgumentError(f"{name}: an image of {array.shape[-3:-1]}; that of the scene, {image}, is needed")
    if array.dtype.kind == "f" and not np.array_equal(array, np.rint(array)):
        raise ArgumentError(f"{name}: rates, not whole counts; how sure they are is not known")
    if array.min() < 0:
        raise ArgumentError(f"{name}: {array.min()} is outside [0, inf)")
    if (most := array.sum(dtype=np.float64)) > _MOST:
        raise ArgumentError(f"{name}: {most:g} counts in all are outside [0, {_MOST}]")
    total = array.sum(axis=0, dtype=np.int64) if array.ndim == 4 else array.astype(np.int64)
    return total.reshape(-1, total.shape[-1]), len(array) if array.ndim == 4 else 1


def _check_countable(counts: NDArray[np.int64], pulses: int, detector: Detector, window: Window, name: str) -> None:
    """Refuses counts `[pixel, bin]` of more bins, or more in so many pulses, than the detector has: `ArgumentError`."""
    if counts.shape[1] > window.recorded:
        raise ArgumentError(
            f"{name}: {counts.shape[1]} bins; the detector starts anew with each pulse, after {window.recorded} bins "
            f"({1e9 * window.period:g} ns): leave out the later ones, or set detector.wrap = false"
        )
    dead_time, edges = 1e-9 * detector.dead_time_ns, window.edges[: window.recorded + 1]
    mode, of_pixel, of_bin = "first-photon counting", 1, np.ones(window.recorded)
    if detector.mode == "free_running":
        if dead_time <= 0.0:
            return
        mode = f"a dead time of {detector.dead_time_ns:g} ns"
        of_pixel, of_bin = 1 + int(edges[-1] / dead_time), 1 + np.floor(np.diff(edges) / dead_time)
    pixel, most = counts.sum(axis=1), counts.max(axis=0)
    for found, limit, part in (
        (pixel.max(), of_pixel, "pixel"),
        (most[(k := np.argmax(most / of_bin))], of_bin[k], "bin"),
    ):
        if found > limit * pulses:
            raise ArgumentError(
                f"{name}: {found} counts of one {part} in {pulses} pulses; {mode} has at most {limit * pulses:.0f}"
            )


def lidar_initial_guess(scene: Scene, exposure: Exposure, *, device: str | None = None) -> dict[str, float]:
    """Absorption and scattering [1/m] from the single-scatter lidar equation; empty where no backscatter is recorded.

    Counts of the whole image before the nearest target, without pile-up (Coates) and noise, times R², fall as
    exp(−2KR), R half the path. Their level is N η (Ω_view/Ω_beam) A b p(π) v Δt/2, from which b follows with the
    scene's phase function. Light that is scattered forward is not lost, so that K is a + 0.2 b rather than a + b.
    It is right within a factor of about 3, which is what a start needs.
    """
    assert exposure.counts is not None
    start, bins = exposure.window
    dt, speed = scene.gate.bin_width, scene.medium.pulse_speed
    distance = 0.5 * speed * (start + dt * (np.arange(bins) + 0.5))
    seen = truth_maps(scene, device=device).range
    nearest = float(np.nanmin(seen)) if np.isfinite(seen).any() else math.inf
    # From where on the beam fills the view.
    baseline = float(np.linalg.norm(scene.beam.position))
    overlap = 2.0 * baseline / math.tan(min(scene.laser.half_angle, 1.5)) if scene.laser.half_angle > 0 else 0.0
    inside = (distance > max(overlap, 5.0 * scene.camera.aperture_radius)) & (distance < _NEARER * nearest)
    counts, left = exposure.counts.sum(axis=0), np.maximum(exposure.left().sum(axis=0), 1.0)
    inside &= left > 0.05 * exposure.pulses * len(exposure.counts)
    rate = -np.log1p(-np.minimum(counts / left, 0.99)) - scene.detector.noise_rate * dt
    inside &= (rate > 0) & (counts > 0)
    x, counted = distance[inside], counts[inside]
    if x.size < _LEAST_BINS or counted.sum() < _LEAST_COUNTS or x[-1] < _LEAST_SPAN * x[0]:
        return {}
    slope, level = np.polyfit(x, np.log(rate[inside] * x**2), 1, w=np.sqrt(counted))
    camera = scene.camera
    view = camera.pixel_tangent**2  # of a pixel [sr]
    beam = 2.0 * math.pi * (1.0 - math.cos(scene.laser.half_angle))
    backward = float(phase_function(scene.medium).density(np.array([math.pi]))[0])
    caught = scene.detectable_photons_per_pulse * min(view / max(beam, 1e-12), 1.0)
    scattering = math.exp(level) / (caught * camera.aperture_area * backward * 0.5 * speed * dt)
    decay = max(-0.5 * slope, 0.02)
    scattering = min(max(scattering, 0.05 * decay), 10.0 * decay)
    return {"medium.absorption": max(decay - _SHARE * scattering, 0.2 * decay), "medium.scattering": scattering}
