"""The detector's time window: its bins, and the time between two windows."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ArgumentError
from spadwarp.limits import TIME, check_integer, check_real, shown
from spadwarp.scene import Gate
from spadwarp.scene.sections import field_range

__all__ = ["Window", "detector_window", "missing_light"]


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


def detector_window(
    window: tuple[float, int],
    bin_width: float,
    tdc_widths: ArrayLike | None,
    *,
    period: float,
    wrap: bool,
    free_running: bool,
) -> Window:
    """The window of (start [s], bins); arguments as in `spadwarp.detect`. Raises `ArgumentError`."""
    if not (isinstance(window, tuple | list) and len(window) == 2):
        raise ArgumentError(f"window = {shown(window)} is not (start [s], bins)")
    start = check_real("start of window", window[0], TIME)
    bins = check_integer("bins of window", window[1], field_range(Gate, "bins"))
    if wrap:
        # The detector knows no time beyond that from one pulse to the next.
        bins = min(bins, math.floor(period / bin_width * (1 + 1e-12)))
        if bins < 1:
            raise ArgumentError(f"bin_width = {bin_width} s is longer than the pulse period, {period} s")
    widths = np.full(bins, 1.0)
    if tdc_widths is not None:
        widths = np.asarray(tdc_widths, np.float64)
        if widths.shape != (bins,):
            raise ArgumentError(f"tdc_widths has shape {widths.shape}; ({bins},), the window's bins, is needed")
        if not (np.isfinite(widths).all() and (widths > 0).all()):
            raise ArgumentError(f"tdc_widths = {widths.min()} … {widths.max()} is outside (0, inf)")
        widths = widths / widths.mean()
    edges = np.append(0.0, np.cumsum(widths)) * bin_width
    if not wrap:
        period = max(period, edges[-1])
    left = period - edges[-1]
    if free_running and left > 1e-9 * period:
        # Between two windows the detector goes on detecting, unrecorded; where time does not wrap, noise alone.
        more = math.ceil(left / bin_width) if wrap else 1
        edges = np.append(edges, edges[-1] + left * np.arange(1, more + 1) / more)
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
