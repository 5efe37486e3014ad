"""The section `gate`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from spadwarp.scene.sections import Section, Whole


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
