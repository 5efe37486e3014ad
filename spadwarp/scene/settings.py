"""Sections of settings: `gate`, `scan`, `transport`, `analytic` and `output`."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from pydantic import Field

from spadwarp.limits import SEED, bounds
from spadwarp.scene.sections import Section, Whole

__all__ = ["Analytic", "Gate", "Output", "Scan", "Transport"]


class Gate(Section):
    """The time bins after the pulse leaves the laser."""

    section: ClassVar[str] = "gate"
    preset: str | None = None
    """named electronics, see `spadwarp list presets gate`"""
    start_ns: float = Field(0.0, ge=0, le=1e12)
    """begin of the first bin [ns]"""
    bin_width_ps: float = Field(..., ge=1e-12, le=1e15)
    """width of a bin [ps]"""
    bins: Whole = Field(..., ge=1, le=1_000_000)
    """number of bins"""

    @property
    def start(self) -> float:
        """Begin of the first bin [s]."""
        return self.start_ns * 1e-9

    @property
    def bin_width(self) -> float:
        """[s]."""
        return self.bin_width_ps * 1e-12

    @property
    def stop(self) -> float:
        """End of the last bin [s]."""
        return self.start + self.bins * self.bin_width


class Scan(Section):
    """How the beam moves over the scene."""

    section: ClassVar[str] = "scan"
    mode: Literal["none", "confocal"] = "none"
    """confocal: the beam visits the pixels in turn and each sees its own light alone"""
    distance: float = Field(math.inf, ge=1e-6, le=math.inf, allow_inf_nan=True)
    """range at which a confocal beam crosses its pixel's line of sight [m]; inf is parallel"""


class Transport(Section):
    """How photons are traced."""

    section: ClassVar[str] = "transport"
    photons: Whole = Field(1_000_000, ge=1, le=10**12)
    """photons to emit"""
    seed: Whole = Field(0, **bounds(SEED))
    """key of the random numbers; one seed gives the same bits"""
    estimator: Literal["analog", "next_event", "guided"] = "guided"
    """what scores: the photon itself, every event, or guided flights; `none` of the kernel library is not offered here;
    `spadwarp.transport.trace` uses it"""
    points_per_flight: Whole = Field(1, ge=1, le=3)
    """points at which `guided` scores a flight; more leave less noise in the bins of a pixel and take longer"""
    termination: Literal["cutoff", "roulette"] = "cutoff"
    """drop light photons (biased), or Russian roulette"""
    weight_cutoff: float = Field(2e-4, ge=0, lt=1)
    """analog weight below which a photon ends; 0 is never"""
    max_collisions: Whole = Field(64, ge=1, le=2**31 - 1)
    """events of one photon at most, surfaces included; the light of the last one still counts"""
    max_path: float | None = Field(None, gt=0, le=1e12)
    """longest geometric path [m]; the gate's end if not given"""
    lateral_limit: float = Field(math.inf, gt=0, le=math.inf, allow_inf_nan=True)
    """photons end where |x| or |y| in the camera frame reaches this [m]; inf is no limit"""
    axis_threshold: float = Field(0.9998, gt=0, le=1)
    """|u_z| from which the near-axis rule acts; 1 turns it off (exact)"""


class Analytic(Section):
    """Settings of the analytic simulator; transport does not read them."""

    section: ClassVar[str] = "analytic"
    form: Literal["radiometric", "lu2024"] = "radiometric"
    """constants of the lidar equation: radiometry, or eq 7 as printed"""
    backscatter: Literal["constant", "single_scatter", "monte_carlo"] = "single_scatter"
    """time course of the backscatter"""
    backscatter_rate: float = Field(0.0, ge=0, le=1e15)
    """constant backscatter, detections per second in the gate [1/s]"""
    backscatter_fraction: float | None = Field(None, ge=0, le=1)
    """part of the pixels that report backscatter (BS); from the rates if not given"""
    count_law: Literal["per_pulse", "per_frame_lu2024", "per_frame"] = "per_pulse"
    """at most one count a pulse, or a frame"""
    pulses_per_depth_frame: Whole | None = Field(None, ge=1, le=2**63 - 1)
    """pulses of one depth frame, for per_pulse; if not given those of one frame of the detector, pulses_per_frame"""
    frames: Whole = Field(1000, ge=1, le=2**63 - 1)
    """detector frames of one depth frame, for per_frame"""
    exposure: float = Field(1e-5, ge=1e-15, le=1e6)
    """exposure of one detector frame [s]"""


class Output(Section):
    """Files that a run writes into its directory."""

    section: ClassVar[str] = "output"
    result: bool = True
    """everything, as HDF5"""
    exr: bool = True
    """truth and depth, as EXR"""
    png: bool = True
    """pictures for a first look"""
    pdf: bool = False
    """the same pictures as vectors, for print"""
    depth_method: Literal["peak", "centroid", "matched", "likelihood"] = "centroid"
    """how the depth frame is made"""
