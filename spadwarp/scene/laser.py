"""The section `laser`."""

from __future__ import annotations

import math
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from spadwarp.scene.sections import Section, Vector
from spadwarp.units import PLANCK, SPEED_OF_LIGHT


class Laser(Section):
    """The pulsed source. Photons leave it at the middle of the pulse, time 0."""

    section: ClassVar[str] = "laser"
    preset: str | None = None
    """a named laser, see `spadwarp presets laser`"""
    position: Vector = (0.0, 0.0, 0.0)
    """where the beam begins [m]"""
    direction: Vector = (0.0, 0.0, 1.0)
    """axis of the beam; any length but 0; a scan sets it"""
    frame: Literal["camera", "world"] = "camera"
    """frame of position and direction: a laser moves with the camera, or is fixed in the world"""
    profile: Literal["uniform_cone", "gaussian", "collimated", "measured"] = "uniform_cone"
    """even over a cone; exp(-2 tan²α/tan²θ); parallel; or an image"""
    profile_image: str | None = None
    """irradiance across a measured beam: .npy, .exr or .png (linear), rows downwards"""
    half_angle_deg: float = Field(15.0, gt=0, le=180)
    """half angle θ of the cone, 1/e² half angle of the gaussian, half the image's width [°]"""
    beam_radius: float = Field(0.0, ge=0)
    """radius of the collimated beam [m]; 0 is a pencil beam"""
    wavelength_nm: float = Field(532.0, gt=0)
    """vacuum wavelength [nm]"""
    pulse_energy: float = Field(37.5e-9, gt=0)
    """energy of one pulse [J]"""
    repetition_rate: float = Field(20e6, gt=0)
    """pulses per second [Hz]"""
    pulse_fwhm_ps: float = Field(85.0, ge=0)
    """pulse duration, full width at half maximum [ps]"""

    @model_validator(mode="after")
    def _has_a_beam(self) -> Self:
        if not any(self.direction):
            raise ValueError(f"direction = {list(self.direction)} has no length")
        if self.profile in ("gaussian", "measured") and self.half_angle_deg >= 90:
            raise ValueError(
                f"half_angle_deg = {self.half_angle_deg} is outside (0, 90), the range of a {self.profile} profile"
            )
        if (self.profile == "measured") != (self.profile_image is not None):
            raise ValueError(f"profile_image = {self.profile_image!r} does not go with profile = {self.profile!r}")
        return self

    @property
    def half_angle(self) -> float:
        """θ [rad]."""
        return math.radians(self.half_angle_deg)

    @property
    def axis(self) -> tuple[float, float, float]:
        """`direction` as a unit vector."""
        x, y, z = self.direction
        length = math.hypot(x, y, z)
        return (x / length, y / length, z / length)

    @property
    def is_visible(self) -> bool:
        """Whether its wavelength is one for which the optics of water are known, 400 to 700 nm."""
        return 400.0 <= self.wavelength_nm <= 700.0

    @property
    def photons_per_pulse(self) -> float:
        """E0·λ/(hc)."""
        return self.pulse_energy * self.wavelength_nm * 1e-9 / (PLANCK * SPEED_OF_LIGHT)
