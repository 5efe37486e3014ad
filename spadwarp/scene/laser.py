"""Lasers: the section `laser`, and measured beam profiles."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from spadwarp.errors import FileError, SpadwarpError
from spadwarp.io.arrays import read_exr, read_npy
from spadwarp.io.paths import existing_file
from spadwarp.limits import Interval
from spadwarp.scene.port import Port
from spadwarp.scene.sections import AnyFile, CsvFile, Direction, Section, Vector, field_range, unit_vector
from spadwarp.scene.tables import ENERGIES
from spadwarp.units import PLANCK, SPEED_OF_LIGHT
from spadwarp.water.seawater import RANGES

__all__ = ["Laser"]

_GAUSSIAN_AREA = math.sqrt(math.pi / (4.0 * math.log(2.0)))  # of a Gaussian of unit height, over its FWHM
_LARGEST = 1 << 25  # pixels of a profile: more than cameras for beams have, and little beside a computer's memory


class Laser(Section):
    """The pulsed source. Photons leave it at the middle of the pulse, time 0."""

    section: ClassVar[str] = "laser"
    alternatives: ClassVar[tuple[str, ...]] = ENERGIES
    preset: str | None = None
    """a named laser, see `spadwarp list presets laser`"""
    position: Vector = (0.0, 0.0, 0.0)
    """where the beam begins [m]"""
    direction: Direction = (0.0, 0.0, 1.0)
    """axis of the beam; any length but 0; a scan sets it"""
    frame: Literal["camera", "world"] = "camera"
    """frame of position and direction: a laser moves with the camera, or is fixed in the world"""
    port: Port | Literal["camera"] | None = None
    """what it shines through: a port of its own, whose lengths start at `position`, or that of the camera"""
    profile: Literal["uniform_cone", "gaussian", "collimated", "measured"] = "uniform_cone"
    """even over a cone; exp(-2 tan²α/tan²θ); parallel; or an image"""
    profile_image: AnyFile = None
    """irradiance across a measured beam: .npy, .exr or .png (linear), rows downwards"""
    half_angle_deg: float = Field(15.0, ge=1e-6, le=180)
    """half angle θ of the cone, 1/e² half angle of the gaussian, half the image's width [°]"""
    beam_radius: float = Field(0.0, ge=0, le=1e6)
    """radius of the collimated beam [m]; 0 is a pencil beam"""
    wavelength_nm: float = Field(532.0, ge=1e-9, le=1e6)
    """vacuum wavelength [nm]; with a spectrum that at which photons and water are counted"""
    linewidth_nm: float = Field(0.0, ge=0, le=1e5)
    """full width at half maximum of a Gaussian spectrum about wavelength_nm [nm]; 0: one line"""
    spectrum: CsvFile = None
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
        if self.profile in ("gaussian", "measured") and self.half_angle_deg >= 90:
            self._refuse("half_angle_deg", f"is outside (0, 90), the range of a {self.profile} profile")
        if self.profile == "measured" and self.profile_image is None:
            raise ValueError("needs profile_image with profile = 'measured': the path of an image of the beam")
        self._only_with("profile = 'measured'", self.profile == "measured", "profile_image")
        if self.linewidth_nm > (most := 0.2 * self.wavelength_nm):
            reason = f"is outside [0, {most:g}], a fifth of wavelength_nm; a broader source needs spectrum"
            self._refuse("linewidth_nm", reason)
        if self.spectrum is not None and self.linewidth_nm > 0.0:
            self._refuse("linewidth_nm", "cannot be combined with spectrum")
        return self

    @model_validator(mode="after")
    def _has_one_energy(self) -> Self:
        # What was given stays in model_fields_set, from where to_dict() knows it.
        if len(self.given) > 1:
            raise ValueError(f"needs one of {', '.join(ENERGIES)}; given: {', '.join(self.given)}")
        (given,) = self.given
        duration, rate = _GAUSSIAN_AREA * self.pulse_fwhm_ps * 1e-12, self.repetition_rate
        if given == "peak_power" and duration == 0.0:
            self._refuse("peak_power", "needs pulse_fwhm_ps > 0, from which the energy follows")
        energy = self.pulse_energy
        if given == "average_power":
            energy = self.average_power / rate
        elif given == "peak_power":
            energy = self.peak_power * duration
        if energy not in (allowed := field_range(Laser, "pulse_energy")):
            self._refuse(given, f"makes pulses of {energy:.3g} J, outside {allowed}")
        powers = {"average_power": energy * rate, "peak_power": energy / duration if duration else math.inf}
        derived = {"pulse_energy": energy} | powers
        self.__dict__.update({name: value for name, value in derived.items() if name != given})
        return self

    @property
    def given(self) -> tuple[str, ...]:
        """Which of pulse_energy, average_power and peak_power was given; the others follow from it."""
        return super().given or ("pulse_energy",)

    @property
    def half_angle(self) -> float:
        """θ [rad]."""
        return math.radians(self.half_angle_deg)

    @property
    def axis(self) -> tuple[float, float, float]:
        """`direction` as a unit vector."""
        return unit_vector(self.direction)

    @property
    def is_visible(self) -> bool:
        """Whether its wavelength is one for which the optics of water are known, 400 to 700 nm."""
        return self.wavelength_nm in Interval.read(RANGES["wavelength_nm"])

    @property
    def photons_per_pulse(self) -> float:
        """E0·λ/(hc)."""
        return self.pulse_energy * self.wavelength_nm * 1e-9 / (PLANCK * SPEED_OF_LIGHT)


def load_profile(laser: Laser) -> NDArray[np.float64]:
    """The image of `laser.profile_image`: irradiance on a plane across the beam, `[H, W]`, any unit.

    `.npy` as it is; `.exr` and `.png` with the mean of their colours, taken as linear; alpha is left out.

    Raises:
        FileError: The file cannot be read, or holds no image of finite values ≥ 0 with light in it.
    """
    path = Path(laser.profile_image or "")
    where = f"laser.profile_image = {str(path)!r}"
    endings = (".npy", ".exr", ".png")
    if path.suffix.lower() not in endings:
        raise FileError(f"{where}: ending {path.suffix!r} is not one of {', '.join(endings)}")
    try:
        image = _read_image(existing_file(path))
    except SpadwarpError as error:
        raise FileError(f"{where}: {error}") from error
    except Exception as error:  # what a reader raises depends on the format
        raise FileError(f"{where}: damaged or not readable: {error}") from error
    if image.ndim != 2 or image.size == 0 or image.dtype.kind not in "biuf":
        raise FileError(f"{where}: {image.dtype} {image.shape}; real numbers [height, width] are needed")
    values = image.astype(np.float64)
    if not (np.isfinite(values).all() and values.min() >= 0.0 and values.max() > 0.0):
        raise FileError(f"{where}: holds {values.min()} to {values.max()}; finite values >= 0 with light are needed")
    return values


def profile_extent(laser: Laser) -> tuple[float, float]:
    """Tangents of half the width and half the height of a measured beam; its image has square pixels."""
    height, width = load_profile(laser).shape
    wide = math.tan(laser.half_angle)
    return wide, wide * height / width


def profile_axes(axis: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions of a measured beam's columns (to the right) and rows (down) for the unit vector of its axis.

    Those of the camera for a beam along z; "right" has no y component.
    """
    x, _, z = forward = np.asarray(axis, np.float64)
    level = math.hypot(x, z)
    right = np.array([z, 0.0, -x]) / level if level > 1e-6 else np.array([1.0, 0.0, 0.0])
    return right, np.cross(forward, right)


def _read_image(path: Path) -> NDArray[np.generic]:
    """The pixels of an image, with the mean of its colours."""
    if path.suffix.lower() == ".npy":
        return read_npy(path, largest=_LARGEST)
    if path.suffix.lower() == ".exr":
        channels, _ = read_exr(path, largest=4 * _LARGEST)
        colours = [pixels.astype(np.float64) for name, pixels in channels.items() if name.rsplit(".", 1)[-1] != "A"]
        return np.mean(colours, axis=0)
    from matplotlib.image import imread
    from PIL import Image

    with warnings.catch_warnings(), Image.open(path, formats=("PNG",)) as image:
        warnings.simplefilter("ignore")  # of Pillow's own limit
        width, height = image.size
    if width * height > _LARGEST:
        raise FileError(f"{width} x {height} pixels; at most {_LARGEST} are read")
    pixels = np.asarray(imread(path))
    without_alpha = {2: 1, 4: 3}.get(pixels.shape[-1], pixels.shape[-1])
    return pixels if pixels.ndim == 2 else pixels[..., :without_alpha].mean(axis=-1)
