"""The section `analytic`."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from spadwarp.scene.sections import Section, Whole


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
