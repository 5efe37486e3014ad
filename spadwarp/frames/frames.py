"""Frames of a SPAD camera in memory: counts, what they were drawn from, time tags; and the law of their pile-up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import histogram_rows, in_torch_order, is_torch, on_host, tensor_of
from spadwarp.errors import ArgumentError
from spadwarp.frames.depth import Method, arrival_time
from spadwarp.frames.response import InstrumentResponse
from spadwarp.interop import Variable, labelled
from spadwarp.io.hdf5 import PIXELS, image_coordinates
from spadwarp.limits import check_integer

if TYPE_CHECKING:
    import xarray

__all__ = ["Frames", "TimeTags", "coates", "first_photon_probabilities", "to_xarray"]


def first_photon_probabilities(hazard: Any, *, device: Any = None) -> NDArray[np.float64]:
    """Law of first-photon counting, with pile-up: P(k) = exp(−Σ_{j<k} λ_j)·(1 − exp(−λ_k)); same shape as `hazard` (λ).

    `hazard`: expected detections per pulse and bin `[..., T]`, not negative; NumPy, torch or Warp; `device`: of Warp.
    """
    import warp as wp

    from spadwarp_kernels import detection as kernels

    with in_torch_order(hazard):
        rows, shape = histogram_rows(hazard, name="hazard", device=device)
        if rows.dtype not in (wp.float32, wp.float64):
            rows = wp.array(rows.numpy().astype(np.float64), device=rows.device)
        law = kernels.first_photon_probabilities(rows)
        values: Any = tensor_of(law).double() if is_torch(hazard) else law.numpy().astype(np.float64)
    return values.reshape(shape)


def coates(counts: Any, *, pulses: int, device: Any = None) -> NDArray[np.float64]:
    """Coates' correction of first-photon counts: λ̂_k = −ln(1 − n_k / (pulses − Σ_{j<k} n_j)), same shape as `counts`.

    NaN from the bin on that takes the last pulse. Source: P. B. Coates, J. Phys. E 1, 878 (1968).

    `counts`: integers `[..., T]`, not negative; NumPy, torch or Warp; `pulses`: of each histogram, which may hold no
    more counts than that; `device`: of Warp.
    """
    import warp as wp

    from spadwarp_kernels import detection as kernels

    with in_torch_order(counts):
        rows, shape = histogram_rows(counts, name="counts", device=device)
        if rows.dtype not in (wp.int32, wp.int64):
            raise ArgumentError(f"counts are {rows.dtype.__name__}; integers are needed")
        values = rows.numpy()
        if values.max() > 2**31 - 1:
            raise ArgumentError(f"counts = {values.max()} is above {2**31 - 1}")
        pulses = check_integer("pulses", pulses, "[1, 9007199254740992]")
        if (most := int(values.sum(axis=1, dtype=np.int64).max())) > pulses:
            raise ArgumentError(
                f"pulses = {pulses} is below the {most} counts of a histogram: it has seen more than one a pulse"
            )
        if rows.dtype != wp.int32:
            rows = wp.array(values.astype(np.int32), dtype=wp.int32, device=rows.device)
        corrected = kernels.coates(rows, pulses=pulses)
        result: Any = tensor_of(corrected) if is_torch(counts) else corrected.numpy()
    return result.reshape(shape)


# Frames


class TimeTags(NamedTuple):
    """Detections one by one, in the order of frame, pixel and time; `bin` counts from the window's start."""

    frame: NDArray[np.int64]
    y: NDArray[np.int64]
    x: NDArray[np.int64]
    pulse: NDArray[np.int64]
    bin: NDArray[np.int32]


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Frames:
    """Counts that the camera records; `counts`, `expected` and `background` are torch tensors if the source was one.

    Attributes:
        counts: int32 `[frames, H, W, T]`, or `[H, W, T]` for the sum of the frames.
        pulses: Laser pulses per frame; frames: how many; first_frame: number of the first.
        gate_start: Start of the detector's window [s]. Where time wraps, a count at time t stands for light at t plus
            any number of periods.
        bin_width: Nominal [s].
        edges: `[T + 1]`, actual bin edges from `gate_start` [s] (differential non-linearity).
        period: Of the pulses [s], where time wraps; else None.
        irf: The response that was applied.
        expected: float32 `[H, W, T]`, expected detections per pulse and bin before pile-up, from which the counts were
            drawn: light through the response, dark counts, ambient light, crosstalk.
        background: float32 `[H, W, 1 or T]`, expected background detections per pulse and bin before pile-up: dark
            counts, ambient light and, where the source has it apart, backscatter.
        seed: Of the random numbers.
        tags: Every detection, where it was asked for.
        monte_carlo_noise: Standard error of the simulation over the shot noise of a frame, at the 95th percentile of
            the pixels; None where nobody knows it. Above 0.5 `expected` is not smooth where few photons were traced,
            and no more are the counts that are drawn from it.
        notes: What the source could not give, in words.
    """

    counts: NDArray[np.int32]
    pulses: int
    frames: int
    first_frame: int
    gate_start: float
    bin_width: float
    edges: NDArray[np.float64]
    period: float | None
    irf: InstrumentResponse
    expected: NDArray[np.float32]
    background: NDArray[np.float32]
    seed: int
    tags: TimeTags | None = None
    monte_carlo_noise: float | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        height, width, bins = self.counts.shape[-3:]
        frames = f"{self.frames} frame" + "s" * (self.frames != 1) + (" added up" if self.summed else "")
        return f"Frames({frames} of {self.pulses} pulses, seed {self.seed}, {width} x {height} pixels x {bins} bins)"

    def plot(self, frame: int = 0, **options: Any) -> Any:
        """A figure of one frame: time of the fullest bin, intensity, the counts of a pixel; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(self, frame=frame, **options)

    def _repr_html_(self) -> str:
        import spadwarp

        return spadwarp.viz.html(self)

    def to_xarray(self) -> Any:
        """Counts and what they were drawn from, with coordinates and units: see `spadwarp.frames.to_xarray`."""
        import spadwarp

        return spadwarp.frames.to_xarray(self)

    @property
    def summed(self) -> bool:
        """Whether the frames have been added up."""
        return self.counts.ndim == 3

    @property
    def exposure(self) -> int:
        """Pulses of each histogram of `counts`."""
        return self.pulses * self.frames if self.summed else self.pulses

    @property
    def intensity(self) -> NDArray[np.int64]:
        """Counts of each pixel over all bins: `[frames, H, W]` or `[H, W]`."""
        return self.counts.sum(-1) if is_torch(self.counts) else self.counts.sum(axis=-1, dtype=np.int64)

    def coates(self) -> NDArray[np.float64]:
        """Detections per pulse and bin without pile-up; see `coates`."""
        return coates(self.counts, pulses=self.exposure)

    def arrival_time(
        self,
        method: Method = "centroid",
        *,
        irf: Any = None,
        undo_pile_up: bool = False,
        gate: tuple[float, float] | None = None,
        device: Any = None,
    ) -> NDArray[np.float64]:
        """Arrival time of the return [s]: `[frames, H, W]` or `[H, W]`, NaN where nothing returned.

        All bins count as equally wide, as in a camera without calibration. The estimator knows the background.
        `method`, `gate` (start, stop) [s], `device`: as of `spadwarp.arrival_time`; `irf`: that the estimator assumes;
        default: the one that was applied; `undo_pile_up`: estimate from Coates' correction of the counts.
        """
        histogram: Any = self.counts
        if undo_pile_up:
            corrected: Any = self.coates()
            histogram = (corrected.nan_to_num() if is_torch(corrected) else np.nan_to_num(corrected)) * self.exposure
        axis: dict[str, Any] = {"gate_start": self.gate_start, "bin_width": self.bin_width, "gate": gate}
        known, irf = self.background * float(self.exposure), self.irf if irf is None else irf
        return arrival_time(histogram, **axis, method=method, irf=irf, background=known, device=device)


def to_xarray(frames: Frames) -> xarray.Dataset:
    """Counts, and the expectation that they were drawn from, as an xarray data set with coordinates and units.

    `counts` has the dimensions (frame, y, x, time), without frame where they are added up; `expected` and `background`
    are detections per pulse and bin before pile-up. Torch tensors are copied to the host. Raises `FileError` without
    xarray.
    """
    counts, expected = on_host(frames.counts), on_host(frames.expected)
    background = np.broadcast_to(on_host(frames.background), expected.shape)
    height, width, _ = expected.shape
    cube = ("y", "x", "time")
    variables: dict[str, Variable] = {
        "counts": (cube if frames.summed else ("frame", *cube), counts, "1", "detections in the bin"),
        "expected": (cube, expected, "1", "expected detections per pulse and bin before pile-up"),
        "background": (cube, background, "1", "the part of `expected` that is not target"),
    }
    edges = frames.gate_start + frames.edges
    coordinates: dict[str, Variable] = {
        "time": (("time",), 0.5 * (edges[:-1] + edges[1:]), "s", "time of flight at the centre of the bin"),
        "bin_width": (("time",), np.diff(edges), "s", "width of the bin"),
        **{name: ((name,), *image_coordinates(height, width)[name]) for name in PIXELS},
    }
    if not frames.summed:
        numbers = np.arange(frames.first_frame, frames.first_frame + frames.frames)
        coordinates["frame"] = (("frame",), numbers, "1", "number of the frame")
    attributes = {
        "pulses": frames.exposure,
        "seed": str(frames.seed),
        "period": np.inf if frames.period is None else frames.period,
        "response_fwhm": frames.irf.fwhm,
        "notes": list(frames.notes),
    }
    return labelled(variables, coordinates, attributes)
