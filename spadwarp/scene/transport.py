"""The section `transport`."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from pydantic import Field

from spadwarp.scene.sections import Section, Whole


class Transport(Section):
    """How photons are traced."""

    section: ClassVar[str] = "transport"
    photons: Whole = Field(1_000_000, ge=1, le=10**12)
    """photons to emit"""
    seed: Whole = Field(0, ge=0, le=2**64 - 1)
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
