"""The camera before it counts: its time window; light through the response, wrapping, noise and crosstalk.

Expected detections per pulse, `[H, W, T]`, in unwrapped time → hazard λ per detector bin, and derivatives of both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ArgumentError
from spadwarp.frames.response import InstrumentResponse, SparseResponse, detector_response, response_matrix
from spadwarp.limits import TIME, check_integer, check_real, shown
from spadwarp.scene import Detector, Laser

__all__ = ["Receiver"]


class Window(NamedTuple):
    """Bins in which the detector is on; the first `recorded` of them are histogrammed.

    Attributes:
        start: [s].
        edges: From the start [s].
        recorded: Bins of the histograms.
        period: From one window to the next [s].
    """

    start: float
    edges: NDArray[np.float64]
    recorded: int
    period: float


def _window(
    detector: Detector, laser: Laser | None, window: tuple[float, int], bin_width: float, tdc_widths: ArrayLike | None
) -> Window:
    """The window of (start [s], bins); arguments as in `spadwarp.detect`. Raises `ArgumentError`."""
    if not (isinstance(window, tuple | list) and len(window) == 2):
        raise ArgumentError(f"window = {shown(window)} is not (start [s], bins)")
    start = check_real("start of window", window[0], TIME)
    bins = check_integer("bins of window", window[1], "[1, 1000000]")
    wrap, period = detector.wrap, math.inf if laser is None else 1.0 / laser.repetition_rate
    if wrap:
        # The detector knows no time beyond that from one pulse to the next.
        bins = min(bins, math.floor(period / bin_width * (1 + 1e-12)))
        if bins < 1:
            raise ArgumentError(f"bin_width = {bin_width} s is longer than the pulse period, {period} s")
    widths = np.ones(bins) if tdc_widths is None else np.asarray(tdc_widths, np.float64)
    if widths.shape != (bins,):
        raise ArgumentError(f"tdc_widths has shape {widths.shape}; ({bins},), the window's bins, is needed")
    if not (np.isfinite(widths).all() and (widths > 0).all()):
        raise ArgumentError(f"tdc_widths = {widths.min()} … {widths.max()} is outside (0, inf)")
    edges = np.append(0.0, np.cumsum(widths / widths.mean())) * bin_width
    period = period if wrap else max(period, edges[-1])
    rest = period - edges[-1]
    if detector.mode == "free_running" and rest > 1e-9 * period:
        # Between two windows the detector goes on detecting, unrecorded; where time does not wrap, noise alone.
        extra = math.ceil(rest / bin_width) if wrap else 1
        edges = np.append(edges, edges[-1] + rest * np.arange(1, extra + 1) / extra)
    return Window(start, edges, bins, period)


def missing_light(window: Window, gate_start: float) -> tuple[str, ...]:
    """A note if light from before the source's first bin would fall into the window, one or more periods later."""
    wrap = math.ceil((gate_start - window.start) / window.period - 1e-9) - 1
    if gate_start <= 0 or window.start + wrap * window.period + window.edges[-1] <= 0:
        return ()
    return (
        f"the source begins at {gate_start * 1e9:.6g} ns: earlier light of later pulses, near-range backscatter above "
        "all, is missing in the window (start the source at 0 and give `window`)",
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Receiver:
    """Expected detections of a detector, from expected light.

    Attributes:
        detector: The section of a scene.
        window: Its bins in time.
        image: (height, width).
        noise: Dark counts and ambient light of each pixel [1/s], Warp float32 `[pixel]`; where it lies, the others lie.
        matrix: Fraction of the light of each source bin that is detected in each detector bin.
        equal_bins: Whether all bins of the window are equally wide.
    """

    detector: Detector
    window: Window
    image: tuple[int, int]
    noise: Any
    matrix: SparseResponse
    equal_bins: bool = True

    @classmethod
    def of(
        cls,
        detector: Detector,
        laser: Laser | None,
        *,
        shape: tuple[int, ...],
        axis: tuple[float, float],
        device: Any,
        irf: InstrumentResponse | None = None,
        window: tuple[float, int] | None = None,
        tdc_widths: ArrayLike | None = None,
        ambient: ArrayLike | None = None,
        camera_seed: int = 0,
    ) -> Self:
        """The receiver of a source of `shape` `[H, W, T]` whose time axis is (start, bin width) [s].

        `device` is a Warp device; the others are arguments of `spadwarp.detect`. Raises `ArgumentError`.
        """
        from spadwarp_kernels import detection as kernels

        time_window = _window(detector, laser, window or (axis[0], shape[2]), axis[1], tdc_widths)
        noise = kernels.dark_count_rates(
            shape[0] * shape[1],
            median=detector.dark_count_rate,
            spread=detector.dark_count_spread,
            hot_fraction=detector.hot_pixel_fraction,
            hot_rate=detector.hot_pixel_rate,
            offset=detector.ambient_rate,
            seed=camera_seed,
            device=device,
        )
        return cls(
            detector=detector,
            window=time_window,
            image=(shape[0], shape[1]),
            noise=noise if ambient is None else _with_ambient(noise, ambient, shape),
            matrix=response_matrix(
                detector_response(detector, laser) if irf is None else irf,
                source_start=axis[0],
                source_width=axis[1],
                source_bins=shape[2],
                edges=time_window.start + time_window.edges,
                period=time_window.period if detector.wrap else None,
            ),
            equal_bins=tdc_widths is None,
        )

    def light(self, rows: Any) -> Any:
        """Light and noise in the detector's bins without crosstalk, Warp float32 `[pixel, bin]`, of source rows."""
        return self._through(rows, self.noise)

    def hazard(self, rows: Any) -> Any:
        """λ: expected detections per pulse and bin of a detector that is always ready, Warp float32 `[pixel, bin]`."""
        from spadwarp_kernels import detection as kernels

        hazard = self.light(rows)
        probability = self.detector.crosstalk_probability
        if probability > 0:
            if self.detector.mode == "free_running":
                fired = kernels.free_running_probabilities(
                    hazard, dead_time=self.detector.dead_time_ns * 1e-9, period=self.window.period
                )
            else:
                fired = kernels.first_photon_probabilities(hazard)
            kernels.add_crosstalk(hazard, fired, image_width=self.image[1], probability=probability)
        return hazard

    def slope(self, rows: Any) -> Any:
        """Derivative of λ by what changes the source by `rows` `[pixel, source bin]`, which may be negative.

        Crosstalk follows as if the neighbours' pile-up stayed as it is.
        """
        import warp as wp

        from spadwarp_kernels import detection as kernels

        slope = self._through(rows, wp.zeros(rows.shape[0], dtype=wp.float32, device=rows.device))
        if self.detector.crosstalk_probability > 0:
            probability = self.detector.crosstalk_probability
            kernels.add_crosstalk(slope, wp.clone(slope), image_width=self.image[1], probability=probability)
        return slope

    def noise_alone(self) -> Any:
        """Dark counts and ambient light per pulse, `[pixel, T]`, or `[pixel, 1]` where all bins are equally wide."""
        import warp as wp

        widths = np.diff(self.window.edges[: 2 if self.equal_bins else self.window.recorded + 1])
        return wp.array((self.noise.numpy()[:, None] * widths).astype(np.float32), device=self.noise.device)

    def _through(self, rows: Any, noise: Any) -> Any:
        from spadwarp_kernels import detection as kernels

        widths = np.diff(self.window.edges)
        return kernels.expected_detections(rows, **self.matrix._asdict(), width=widths, noise_rate=noise)


def _with_ambient(noise: Any, ambient: ArrayLike, shape: tuple[int, ...]) -> Any:
    """Rates of the pixels with ambient light on top [1/s]."""
    import warp as wp

    values: NDArray[np.float64] = np.asarray(ambient, np.float64)
    if values.shape not in ((), shape[:2]):
        raise ArgumentError(f"ambient has shape {values.shape}; a number or {shape[:2]} is needed")
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise ArgumentError("ambient holds a value outside [0, inf)")
    rates = noise.numpy() + np.broadcast_to(values, shape[:2]).reshape(-1)
    return wp.array(rates.astype(np.float32), dtype=wp.float32, device=noise.device)
