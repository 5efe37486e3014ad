"""The section `laser`."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from spadwarp.scene.load import ENERGIES
from spadwarp.scene.port import Port
from spadwarp.scene.sections import Section, Vector
from spadwarp.units import PLANCK, SPEED_OF_LIGHT

_GAUSSIAN_AREA = math.sqrt(math.pi / (4.0 * math.log(2.0)))  # of a Gaussian of unit height, over its FWHM


class Laser(Section):
    """The pulsed source. Photons leave it at the middle of the pulse, time 0."""

    section: ClassVar[str] = "laser"
    preset: str | None = None
    """a named laser, see `spadwarp list presets laser`"""
    position: Vector = (0.0, 0.0, 0.0)
    """where the beam begins [m]"""
    direction: Vector = (0.0, 0.0, 1.0)
    """axis of the beam; any length but 0; a scan sets it"""
    frame: Literal["camera", "world"] = "camera"
    """frame of position and direction: a laser moves with the camera, or is fixed in the world"""
    port: Port | Literal["camera"] | None = None
    """what it shines through: a port of its own, whose lengths start at `position`, or that of the camera"""
    profile: Literal["uniform_cone", "gaussian", "collimated", "measured"] = "uniform_cone"
    """even over a cone; exp(-2 tan²α/tan²θ); parallel; or an image"""
    profile_image: str | None = None
    """irradiance across a measured beam: .npy, .exr or .png (linear), rows downwards"""
    half_angle_deg: float = Field(15.0, ge=1e-6, le=180)
    """half angle θ of the cone, 1/e² half angle of the gaussian, half the image's width [°]"""
    beam_radius: float = Field(0.0, ge=0, le=1e6)
    """radius of the collimated beam [m]; 0 is a pencil beam"""
    wavelength_nm: float = Field(532.0, ge=1e-9, le=1e6)
    """vacuum wavelength [nm]; with a spectrum that at which photons and water are counted"""
    linewidth_nm: float = Field(0.0, ge=0, le=1e5)
    """full width at half maximum of a Gaussian spectrum about wavelength_nm [nm]; 0: one line"""
    spectrum: str | None = None
    """a measured spectrum in place of linewidth_nm: .csv file of wavelength [nm] and power per nm of any scale"""
    polarisation: Literal["none", "linear", "right_circular", "left_circular"] = "none"
    """of the light; right is clockwise for who looks towards the laser"""
    polarisation_angle_deg: float = Field(0.0, ge=-180, le=180)
    """linear: direction of the field, from the beam's right towards its down, in the image from +x towards +y [°]"""
    pulse_energy: float = Field(37.5e-9, ge=1e-30, le=1e6)
    """energy of one pulse [J]"""
    average_power: float = Field(0.0, ge=1e-30, le=1e15)
    """mean power, in place of pulse_energy: pulse_energy times repetition_rate [W]"""
    peak_power: float = Field(0.0, ge=1e-30, le=1e21)
    """power at the peak of the pulse, in place of pulse_energy: for a Gaussian pulse pulse_energy/(1.0645 FWHM) [W]"""
    repetition_rate: float = Field(20e6, ge=1e-6, le=1e15)
    """pulses per second [Hz]"""
    pulse_fwhm_ps: float = Field(85.0, ge=0, le=1e12)
    """pulse duration, full width at half maximum [ps]"""

    @model_validator(mode="after")
    def _has_a_beam(self) -> Self:
        if math.hypot(*self.direction) < 1e-9:
            raise ValueError(f"direction = {list(self.direction)} has no length")
        if self.profile in ("gaussian", "measured") and self.half_angle_deg >= 90:
            raise ValueError(
                f"half_angle_deg = {self.half_angle_deg} is outside (0, 90), the range of a {self.profile} profile"
            )
        if (self.profile == "measured") != (self.profile_image is not None):
            if self.profile_image is None:
                raise ValueError("needs profile_image with profile = 'measured': the path of an image of the beam")
            raise ValueError(f"profile_image = {self.profile_image!r} does not go with profile = {self.profile!r}")
        if self.linewidth_nm > 0.2 * self.wavelength_nm:
            raise ValueError(
                f"linewidth_nm = {self.linewidth_nm} is outside [0, {0.2 * self.wavelength_nm:g}], a fifth of "
                "wavelength_nm; a broader source needs spectrum"
            )
        if self.spectrum is not None and self.linewidth_nm > 0.0:
            raise ValueError(f"linewidth_nm = {self.linewidth_nm} goes without spectrum")
        return self

    @model_validator(mode="after")
    def _has_one_energy(self) -> Self:
        # What was given stays in model_fields_set, from where to_dict() knows it.
        if len(self.given) > 1:
            raise ValueError(f"needs one of {', '.join(ENERGIES)}; given: {', '.join(self.given)}")
        duration, rate = _GAUSSIAN_AREA * self.pulse_fwhm_ps * 1e-12, self.repetition_rate
        if "peak_power" in self.given and duration == 0.0:
            raise ValueError(f"peak_power = {self.peak_power} needs pulse_fwhm_ps > 0, from which the energy follows")
        energy = self.pulse_energy
        if "average_power" in self.given:
            energy = self.average_power / rate
        elif "peak_power" in self.given:
            energy = self.peak_power * duration
        if not 1e-30 <= energy <= 1e6:
            raise ValueError(
                f"{self.given[0]} = {getattr(self, self.given[0])} makes pulses of {energy:.3g} J, outside [1e-30, 1e6]"
            )
        powers = {"average_power": energy * rate, "peak_power": energy / duration if duration else math.inf}
        derived = {"pulse_energy": energy} | powers
        self.__dict__.update({name: value for name, value in derived.items() if name not in self.given})
        return self

    @property
    def given(self) -> tuple[str, ...]:
        """Which of pulse_energy, average_power and peak_power was given; the others follow from it."""
        return tuple(name for name in ENERGIES if name in self.model_fields_set)

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal section again: of energy and powers the given one."""
        hidden = set(ENERGIES) - set(self.given or ("pulse_energy",))
        return {name: value for name, value in super().to_dict().items() if name not in hidden}

    @field_validator("spectrum")
    @classmethod
    def _table_of_a_spectrum(cls, value: str | None) -> str | None:
        if value is not None and not value.lower().endswith(".csv"):
            raise ValueError("is not the path of a .csv file")
        return value

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
