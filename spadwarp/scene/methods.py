"""The sections `transport`, `output` and `analytic`: how a scene is computed, and what is written."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from pydantic import Field

from spadwarp.scene.sections import Section, Whole


class Transport(Section):
    """How photons are traced."""

    section: ClassVar[str] = "transport"
    photons: Whole = Field(1_000_000, ge=1, le=10**12, description="photons to emit")
    seed: Whole = Field(0, ge=0, le=2**64 - 1, description="key of the random numbers; one seed gives the same bits")
    estimator: Literal["analog", "next_event", "guided"] = Field(
        "guided", description="what scores: the photon itself, every event, or guided flights"
    )
    termination: Literal["cutoff", "roulette"] = Field(
        "cutoff", description="drop light photons (biased), or Russian roulette"
    )
    weight_cutoff: float = Field(2e-4, ge=0, lt=1, description="analog weight below which a photon ends; 0 is never")
    max_collisions: Whole = Field(64, ge=1, le=2**31 - 1, description="events of one photon, surfaces included")
    max_path: float | None = Field(None, gt=0, description="longest geometric path [m]; the gate's end if not given")
    lateral_limit: float = Field(
        math.inf,
        gt=0,
        allow_inf_nan=True,
        description="photons end where |x| or |y| in the camera frame reaches this [m]; inf is no limit",
    )
    axis_threshold: float = Field(
        0.9998, gt=0, le=1, description="|u_z| from which the near-axis rule acts; 1 turns it off (exact)"
    )


class Output(Section):
    """What a run writes into its directory."""

    section: ClassVar[str] = "output"
    result: bool = Field(True, description="everything, as HDF5")
    exr: bool = Field(True, description="truth and depth, as EXR")
    png: bool = Field(True, description="pictures for a first look")
    pdf: bool = Field(False, description="the same pictures as vectors, for print")
    depth_method: Literal["peak", "centroid", "matched"] = Field("centroid", description="how the depth frame is made")


class Analytic(Section):
    """Settings of the analytic simulator; transport does not read them."""

    section: ClassVar[str] = "analytic"
    form: Literal["radiometric", "paper"] = Field(
        "radiometric", description="constants of the lidar equation: radiometry, or eq 7 as printed"
    )
    backscatter: Literal["constant", "single_scatter", "monte_carlo"] = Field(
        "single_scatter", description="time course of the backscatter"
    )
    backscatter_rate: float = Field(
        0.0, ge=0, description="constant backscatter, detections per second in the gate [1/s]"
    )
    backscatter_fraction: float | None = Field(
        None, ge=0, le=1, description="part of the pixels that report backscatter (BS); from the rates if not given"
    )
    count_law: Literal["per_pulse", "per_frame_paper", "per_frame"] = Field(
        "per_pulse", description="at most one count a pulse, or a frame"
    )
    pulses: Whole = Field(20_000, ge=1, le=2**63 - 1, description="pulses of one depth frame, for per_pulse")
    frames: Whole = Field(1000, ge=1, le=2**63 - 1, description="detector frames of one depth frame, for per_frame")
    exposure: float = Field(1e-5, gt=0, description="exposure of one detector frame [s]")
