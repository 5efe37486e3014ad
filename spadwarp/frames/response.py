"""The instrument response: laser pulse ⊗ detector jitter, with exact integrals over time bins."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import Floats, real_array
from spadwarp.io.arrays import read_npy
from spadwarp.io.text import read_columns, read_text
from spadwarp.scene import Detector, Laser
from spadwarp.values import BIN_WIDTH, TIME, ArgumentError, ConfigError, FileError, check_integer, check_real

__all__ = ["InstrumentResponse", "detector_response", "instrument_response", "read_response", "response_matrix"]

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
_SUPPORT_SIGMAS = 6.0  # 1e-9 of a Gaussian lies beyond on either side
_SUPPORT_TAILS = 16.0  # 1e-7 of an exponential lies beyond
_MOST_BINS = 1e7  # of a response on one side


@dataclass(frozen=True, eq=False, kw_only=True)
class InstrumentResponse:
    """Probability density of the delay between a photon's arrival and its time tag, of unit area.

    A Gaussian convolved with an exponential tail, or a measured curve, linear between its points. Everything is in
    closed form: integrals over bins are exact however narrow the response is. With `sigma` and `tail` 0 it is a delta.
    """

    sigma: float = 0.0  # standard deviation of the Gaussian [s]; time 0 is its centre
    tail: float = 0.0  # time constant of the exponential [s], 0: none
    times: ArrayLike | None = None  # of a measured curve instead: ascending [s]
    values: ArrayLike | None = None  # the curve at these times, ≥ 0, of any scale

    def __post_init__(self) -> None:
        for name in ("sigma", "tail"):
            check_real(name, getattr(self, name), "[0, 1e6] s")
        if (self.times is None) != (self.values is None):
            raise ArgumentError("times and values of a measured response go together")
        if self.times is None:
            return
        times, values = np.array(self.times, np.float64), np.array(self.values, np.float64)
        if times.ndim != 1 or times.size < 2 or values.shape != times.shape:
            raise ArgumentError(f"times {times.shape} and values {values.shape} are not two equal lists of two or more")
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise ArgumentError("times of a measured response must be finite and ascending")
        if not (np.isfinite(values).all() and (values >= 0).all() and values.any()):
            span = f"{values.min()} … {values.max()}"
            raise ArgumentError(f"values of a measured response ({span}) must be finite, not negative and not all 0")
        values = _near_1(values)
        area = float(np.trapezoid(values, times))
        if not 1e-300 < area < 1e300:
            raise ArgumentError(f"times of a measured response ({times[0]} … {times[-1]} s) have no usable length")
        values /= area
        vars(self).update(times=times, values=values)

    # The curve

    def density(self, time: ArrayLike) -> Floats:
        """Probability density [1/s]; a delta has none (ValueError)."""
        t = np.asarray(time, np.float64)
        if self.times is not None:
            return np.interp(t, self._curve[0], self._curve[1], left=0.0, right=0.0)
        if self.tail > 0:
            return self._tail_density(t)
        if self.sigma == 0:
            raise ArgumentError("a response without width has no density")
        return np.exp(-0.5 * (t / self.sigma) ** 2) / (self.sigma * math.sqrt(2 * math.pi))

    def cumulative(self, time: ArrayLike) -> Floats:
        """Integral of the density up to `time`."""
        t = np.asarray(time, np.float64)
        if self.times is not None:
            x, height, slope, before, _ = self._piece(t)
            return before + x * (height + 0.5 * x * slope)
        gaussian = _gaussian_cumulative(t, self.sigma)
        return gaussian if self.tail == 0 else gaussian - self.tail * self._tail_density(t)

    def cumulative_integral(self, time: ArrayLike) -> Floats:
        """Integral of `cumulative` up to `time` [s]."""
        t = np.asarray(time, np.float64)
        if self.times is not None:
            x, height, slope, before, integral = self._piece(t)
            inside = x * (before + x * (0.5 * height + x * slope / 6.0))
            return integral + inside + np.maximum(t - self._curve[0][-1], 0.0)
        if self.sigma == 0:
            gaussian = np.maximum(t, 0.0)
        else:
            peak = np.exp(-0.5 * (t / self.sigma) ** 2) * (self.sigma / math.sqrt(2 * math.pi))
            gaussian = t * _gaussian_cumulative(t, self.sigma) + peak
        return gaussian if self.tail == 0 else gaussian - self.tail * self.cumulative(t)

    def per_bin(self, bin_width: float) -> Floats:
        """Fractions of a return in the bins about its own, `[2 r + 1]`, for returns spread evenly over a bin."""
        return np.diff(self.cumulative_integral(self._edges_about(bin_width)), 2) / bin_width

    def per_bin_slope(self, bin_width: float) -> Floats:
        """Derivative of `per_bin` by the delay in bins, `[2 r + 1]`."""
        return -np.diff(self.cumulative(self._edges_about(bin_width)), 2)

    def _edges_about(self, bin_width: float) -> Floats:
        bin_width, longest = check_real("bin_width", bin_width, BIN_WIDTH), max(map(abs, self.support))
        if longest > _MOST_BINS * bin_width:
            raise ArgumentError(
                f"a response of {longest:.3g} s on a side is longer than {_MOST_BINS:g} bins of {bin_width:g} s"
            )
        reach = math.ceil(max(map(abs, self.support)) / bin_width) + 2
        return np.arange(-reach - 1, reach + 2) * np.float64(bin_width)

    # Moments and widths

    @property
    def is_smooth(self) -> bool:
        """Whether there is a density without a step; a delta has none, and a bare exponential begins with a step."""
        return self.times is not None or self.sigma > 0

    @property
    def support(self) -> tuple[float, float]:
        """(lower, upper) [s]: all but 1e-7 of the response lies between."""
        if self.times is not None:
            return float(self._curve[0][0]), float(self._curve[0][-1])
        side = _SUPPORT_SIGMAS * self.sigma
        return -side, side + _SUPPORT_TAILS * self.tail

    @cached_property
    def mean(self) -> float:
        """Mean delay [s]."""
        return self.tail if self.times is None else float(self._curve[0][-1] - self._curve[4][-1])

    @cached_property
    def mode(self) -> float:
        """Delay at which the density is largest [s]."""
        if self.times is not None:
            return float(self._curve[0][self._curve[1].argmax()])
        return 0.0 if self.tail == 0 or self.sigma == 0 else self._peak[0]

    @cached_property
    def fwhm(self) -> float:
        """Full width at half of the largest density [s]."""
        return FWHM_PER_SIGMA * self.sigma if self.times is None and self.tail == 0 else self._peak[1]

    @cached_property
    def _peak(self) -> tuple[float, float]:
        """Mode and FWHM on a fine grid."""
        time = np.linspace(*self.support, 20_001)
        density = self.density(time)
        above = np.flatnonzero(density >= 0.5 * density.max())
        return float(time[density.argmax()]), float(time[above[-1]] - time[above[0]])

    # The exponential tail

    def _tail_density(self, t: Floats) -> Floats:
        """Exponentially modified Gaussian: exp(σ²/2τ² − t/τ) · erfc(z) / 2τ, z = (σ/τ − t/σ)/√2."""
        if self.sigma == 0:
            return np.where(t >= 0, np.exp(-np.maximum(t, 0.0) / self.tail) / self.tail, 0.0)
        from scipy.special import erfc, erfcx

        z = (self.sigma / self.tail - t / self.sigma) / math.sqrt(2.0)
        gaussian = -0.5 * (t / self.sigma) ** 2
        # exp(σ²/2τ² − t/τ) = exp(z² + gaussian): huge times tiny where z > 0, hence erfcx = exp(z²) erfc there.
        direct = np.exp(np.minimum(z, 0.0) ** 2 + gaussian) * erfc(z)
        scaled = np.exp(gaussian) * erfcx(np.maximum(z, 0.0))
        return np.where(z < 0, direct, scaled) / (2.0 * self.tail)

    # The measured curve

    @cached_property
    def _curve(self) -> tuple[Floats, ...]:
        """At its points: times, density, slope of the density behind them, its integral, and the integral of that."""
        times, density = np.asarray(self.times, np.float64), np.asarray(self.values, np.float64)
        width = np.diff(times)
        cumulative = np.append(0.0, np.cumsum(0.5 * width * (density[1:] + density[:-1])))
        pieces = width * (cumulative[:-1] + width * (2 * density[:-1] + density[1:]) / 6.0)
        return times, density, np.append(np.diff(density) / width, 0.0), cumulative, np.append(0.0, np.cumsum(pieces))

    def _piece(self, t: Floats) -> tuple[Floats, ...]:
        """Time since the start of the piece that holds `t`, outside all of the nearer end, and `_curve` there."""
        knots = self._curve[0]
        clipped = np.clip(t, knots[0], knots[-1])
        i = np.clip(np.searchsorted(knots, clipped, side="right") - 1, 0, knots.size - 2)
        return clipped - knots[i], *(part[i] for part in self._curve[1:])


def _gaussian_cumulative(t: Floats, sigma: float) -> Floats:
    if sigma == 0:
        return np.where(t >= 0, 1.0, 0.0)
    from scipy.special import ndtr

    return ndtr(t / sigma)


def instrument_response(*, pulse_fwhm: float, jitter_fwhm: float, tail: float = 0.0) -> InstrumentResponse:
    """Pulse ⊗ jitter. Raises `ArgumentError`, which names the argument.

    `pulse_fwhm`, `jitter_fwhm`: of laser pulse and detector [s], ≥ 0; as Gaussians their squares add. `tail`: time
    constant of the exponential diffusion tail [s], 0: none.
    """
    for name, value in {"pulse_fwhm": pulse_fwhm, "jitter_fwhm": jitter_fwhm, "tail": tail}.items():
        check_real(name, value, "[0, 1e6] s")
    return InstrumentResponse(sigma=math.hypot(pulse_fwhm, jitter_fwhm) / FWHM_PER_SIGMA, tail=tail)


def detector_response(detector: Detector, laser: Laser | None = None) -> InstrumentResponse:
    """The instrument response of a scene's detector and laser pulse; that of a file is of both. No laser: no pulse."""
    if detector.irf.lower().endswith(".csv"):
        return read_response(detector.irf)
    return instrument_response(
        pulse_fwhm=0.0 if laser is None else laser.pulse_fwhm_ps * 1e-12,
        jitter_fwhm=detector.jitter_fwhm_ps * 1e-12,
        tail=0.0 if detector.irf == "gaussian" else detector.irf_tail_ps * 1e-12,
    )


def _near_1(values: Floats) -> Floats:
    """Values times the power of two that brings the largest near 1: no bit of what is normalised later changes."""
    return np.ldexp(values, -int(np.frexp(values.max())[1]))


def read_response(path: str | Path, *, bin_width: float | None = None) -> InstrumentResponse:
    """A measured response from a file.

    `path`: `.csv` of time_ps and value, whose time 0 is the arrival of the photon; or `.csv` or `.npy` of one value for
    each bin of `bin_width` [s], whose mean is taken for that time. Raises `ArgumentError`: no such file, not a
    response, or values of bins without their width.
    """
    place = Path(path)
    try:
        if place.suffix.lower() == ".npy":
            values = read_npy(place, largest=1 << 20).astype(np.float64)
        elif any("," in line for line in read_text(place).splitlines() if not line.lstrip().startswith("#")):
            times, values = read_columns(place, {"time_ps": "[-1e12, 1e12]", "value": "[0, 1e30]"}).T
            return InstrumentResponse(times=times * 1e-12, values=values)
        else:
            values = read_columns(place, {"value": "[0, 1e30]"})[:, 0]
    except (ConfigError, FileError) as error:
        raise ArgumentError(str(error)) from None
    except ArgumentError as error:
        raise ArgumentError(f"{path}: {error}") from None
    if values.ndim != 1 or values.size < 2 or not (np.isfinite(values).all() and values.min() >= 0 and values.any()):
        raise ArgumentError(f"{path}: {values.shape} is not a response: two values or more, not negative, not all 0")
    if bin_width is None:
        raise ArgumentError(f"bin width is missing (bin_width): {path} has a value for each bin")
    values = np.concatenate([[0.0], _near_1(values), [0.0]])  # between its bins linear, to 0 on either side
    centres = np.arange(values.size) - float(values @ np.arange(values.size)) / float(values.sum())
    return InstrumentResponse(times=centres * bin_width, values=values)


class SparseResponse(NamedTuple):
    """Detector bins by source bins in CSR form: entries row_start[k] … row_start[k + 1] belong to detector bin k."""

    row_start: NDArray[np.int32]
    source_bin: NDArray[np.int32]
    weight: NDArray[np.float32]


def response_matrix(
    irf: InstrumentResponse,
    *,
    source_start: float,
    source_width: float,
    source_bins: int,
    edges: ArrayLike,
    period: float | None = None,
) -> SparseResponse:
    """Fraction of the light of each source bin that is detected in each detector bin.

    Light is even over a source bin; response and bins are integrated exactly, so neither needs to be narrow beside the
    other. With a period P the detector sees time modulo P: source time t and detector time t − mP are one, for all m.
    `source_start`, `source_width`, `source_bins`: the axis of the source [s]; `edges`: of the detector bins [s],
    ascending, `[bins + 1]`; `period`: of the pulses [s], None: time does not wrap. Raises `ArgumentError`.
    """
    source_start = check_real("source_start", source_start, TIME)
    source_width = check_real("source_width", source_width, BIN_WIDTH)
    source_bins = check_integer("source_bins", source_bins, "[1, 2147483647]")
    period = None if period is None else check_real("period", period, BIN_WIDTH)
    e = real_array("edges", edges, np.float64)
    if e.ndim != 1 or e.size < 2 or not (np.isfinite(e).all() and (np.diff(e) > 0).all()):
        raise ArgumentError(f"edges of shape {e.shape} are not [bins + 1] finite, ascending times")
    lower, upper = irf.support
    wraps = range(1)
    if period is not None:
        source_stop = source_start + source_bins * source_width
        first = math.ceil((source_start + lower - e[-1]) / period)
        wraps = range(first, math.floor((source_stop + upper - e[0]) / period) + 1)
    rows, columns, weights = [np.zeros(0, np.intp)], [np.zeros(0, np.int32)], [np.zeros(0)]
    for wrap in wraps:
        shifted = e + (wrap * period if period is not None else 0.0)
        begin = np.clip(np.floor((shifted[:-1] - upper - source_start) / source_width), 0, source_bins)
        stop = np.clip(np.ceil((shifted[1:] - lower - source_start) / source_width), 0, source_bins)
        index = begin[:, None] + np.arange(int(np.max(stop - begin)) + 1)
        corner = source_start + index * source_width
        after = irf.cumulative_integral(shifted[1:, None] - corner)
        before = irf.cumulative_integral(shifted[:-1, None] - corner)
        weight = np.diff(before - after, axis=1) / source_width
        keep = (weight > 1e-12) & (index[:, :-1] < source_bins)
        row, tap = np.nonzero(keep)
        rows.append(row)
        columns.append(index[row, tap].astype(np.int32))
        weights.append(weight[keep])
    every_row = np.concatenate(rows)
    order = np.argsort(every_row, kind="stable")
    entries = np.bincount(every_row, minlength=e.size - 1)
    row_start = np.append(0, np.cumsum(entries)).astype(np.int32)
    return SparseResponse(row_start, np.concatenate(columns)[order], np.concatenate(weights)[order].astype(np.float32))
