"""Lasers: the section `laser`, measured beam profiles, and which part of the spectrum passes the detector's filter.

A laser without `linewidth_nm` and `spectrum` is one line at `wavelength_nm`.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from spadwarp.arrays import Floats
from spadwarp.io.arrays import read_exr, read_npy
from spadwarp.io.paths import existing_file, reading
from spadwarp.scene.port import Port
from spadwarp.scene.pose import unit_vector
from spadwarp.scene.sections import CsvFile, Direction, File, Section, Vector, field, field_range, file_of, read_table
from spadwarp.scene.settings import Detector
from spadwarp.values import PLANCK, SPEED_OF_LIGHT, ConfigError, FileError, Interval
from spadwarp.water.seawater import RANGES

__all__ = ["Laser", "SpectralLine", "filter_transmission", "spectral_lines"]

ENERGIES = ("pulse_energy", "average_power", "peak_power")
"""How the energy of a pulse is given."""

_GAUSSIAN_AREA = math.sqrt(math.pi / (4.0 * math.log(2.0)))  # of a Gaussian of unit height, over its FWHM
_LARGEST = 1 << 25  # pixels of a profile: more than cameras for beams have, and little beside a computer's memory


class Laser(Section):
    """The pulsed source. Photons leave it at the middle of the pulse, time 0."""

    section: ClassVar[str] = "laser"
    alternatives: ClassVar = ENERGIES
    displaces: ClassVar = {
        **{name: tuple(set(ENERGIES) - {name}) for name in ENERGIES},
        **{"linewidth_nm": ("spectrum",), "spectrum": ("linewidth_nm",)},
    }
    preset: str | None = field(None, "a named laser, see `spadwarp list presets laser`")
    position: Vector = field((0.0, 0.0, 0.0), "where the beam begins [m]")
    direction: Direction = field((0.0, 0.0, 1.0), "axis of the beam; any length but 0; a scan sets it")
    frame: Literal["camera", "world"] = field("camera", "of position and direction: moves with the camera, or stays")
    port: Port | Literal["camera"] | None = None
    """what it shines through: a port of its own, whose lengths start at `position`, or that of the camera"""
    profile: Literal["uniform_cone", "gaussian", "collimated", "measured"] = "uniform_cone"
    """even over a cone; exp(-2 tan²α/tan²θ); parallel; or an image"""
    profile_image: File = field(None, "irradiance across a measured beam: .npy, .exr, .png (linear), rows downwards")
    half_angle_deg: float = field(15.0, "θ of the cone, 1/e² of the gaussian, half the image [°]", "[1e-6, 180]")
    beam_radius: float = field(0.0, "radius of the collimated beam [m]; 0 is a pencil beam", "[0, 1e6]")
    wavelength_nm: float = field(532.0, "in vacuum [nm]; with a spectrum that of photons and water", "[1e-9, 1e6]")
    linewidth_nm: float = field(0.0, "of a Gaussian spectrum, width at half maximum [nm]; 0: one line", "[0, 100000]")
    spectrum: CsvFile = field(None, "a measured spectrum: .csv file of wavelength [nm] and power per nm of any scale")
    wavelengths_nm: (
        Literal["spectrum"] | Annotated[tuple[Annotated[float, Field(ge=1e-9, le=1e6)], ...], Field(max_length=64)]
    ) = ()
    """lines that `spadwarp simulate` traces with the same photons, each in its own water [nm]; "spectrum": those of the
    laser's spectrum that the filter passes; everything else takes wavelength_nm"""
    polarisation: Literal["none", "linear", "right_circular", "left_circular"] = "none"
    """of the light; right is clockwise for who looks towards the laser"""
    polarisation_angle_deg: float = Field(0.0, ge=-180, le=180)
    """linear: direction of the field, from the beam's right towards its down, in the image from +x towards +y [°]"""
    pulse_energy: float = field(37.5e-9, "energy of one pulse [J]", "[1e-30, 1e6]")
    average_power: float = field(0.0, "mean power, in place of pulse_energy [W]", "[1e-30, 1e15]")
    peak_power: float = Field(0.0, ge=1e-30, le=1e21)
    """power at the peak of the pulse, in place of pulse_energy: for a Gaussian pulse pulse_energy/(1.0645 FWHM) [W]"""
    repetition_rate: float = field(20e6, "pulses per second [Hz]", "[1e-6, 1e15]")
    pulse_fwhm_ps: float = field(85.0, "pulse duration, full width at half maximum [ps]", "[0, 1e12]")

    def _problems(self) -> Iterator[str]:
        if self.profile in ("gaussian", "measured") and self.half_angle_deg >= 90:
            yield self._that("half_angle_deg", f"is outside (0, 90) °, the range of a {self.profile} profile")
        if self.profile == "measured" and self.profile_image is None:
            yield "needs profile_image with profile = 'measured': the path of an image of the beam"
        yield from self._only_with("profile = 'measured'", self.profile == "measured", "profile_image")
        if self.linewidth_nm > (most := 0.2 * self.wavelength_nm):
            reason = f"is outside [0, {most:g}] nm, a fifth of wavelength_nm; a broader source needs spectrum"
            yield self._that("linewidth_nm", reason)
        if self.spectrum is not None and self.linewidth_nm > 0.0:
            yield self._that("linewidth_nm", "cannot be combined with spectrum")
        if len(set(self.wavelengths_nm)) < len(self.wavelengths_nm) and self.wavelengths_nm != "spectrum":
            yield self._that("wavelengths_nm", "names one twice")
        if len(self.given) > 1:
            yield f"needs one of {', '.join(ENERGIES)}; given: {', '.join(self.given)}"
        # What was given stays in model_fields_set, from where to_dict() knows it.
        given, duration, rate = self.given[0], _GAUSSIAN_AREA * self.pulse_fwhm_ps * 1e-12, self.repetition_rate
        if given == "peak_power" and duration == 0.0:
            yield self._that("peak_power", "needs pulse_fwhm_ps > 0, from which the energy follows")
        energies = {"average_power": self.average_power / rate, "peak_power": self.peak_power * duration}
        energy = energies.get(given, self.pulse_energy)
        if energy not in (allowed := field_range(Laser, "pulse_energy")):
            yield self._that(given, f"makes pulses of {energy:.3g} J, outside {allowed}")
        derived = {"average_power": energy * rate, "peak_power": energy / duration if duration else math.inf}
        derived["pulse_energy"] = energy
        self.__dict__.update({name: value for name, value in derived.items() if name != given})

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


def load_profile(laser: Laser) -> Floats:
    """The image of `laser.profile_image`: irradiance on a plane across the beam, `[H, W]`, any unit.

    `.npy` as it is; `.exr` and `.png` with the mean of their colours, taken as linear; alpha is left out. Raises
    `FileError` if the file cannot be read, or holds no image of finite values ≥ 0 with light in it.
    """
    path = Path(laser.profile_image or "")
    with file_of("laser.profile_image"), reading(path):
        if (ending := path.suffix.lower()) not in _READERS:
            raise FileError(f"{path}: ending {path.suffix!r} is not one of {', '.join(_READERS)}")
        image = _READERS[ending](existing_file(path))
        if image.ndim != 2 or image.size == 0 or image.dtype.kind not in "biuf":
            raise FileError(f"{path}: {image.dtype} {image.shape}; real numbers [height, width] are needed")
        values = image.astype(np.float64)
        if not (np.isfinite(values).all() and values.min() >= 0.0 and values.max() > 0.0):
            raise FileError(f"{path}: holds {values.min()} to {values.max()}; finite values >= 0 with light are needed")
    return values


def _read_colours(path: Path) -> NDArray[np.generic]:
    channels, _ = read_exr(path, largest=4 * _LARGEST)
    colours = [pixels.astype(np.float64) for name, pixels in channels.items() if name.rsplit(".", 1)[-1] != "A"]
    return np.mean(colours, axis=0)


def _read_png(path: Path) -> NDArray[np.generic]:
    from matplotlib.image import imread
    from PIL import Image

    with warnings.catch_warnings(), Image.open(path, formats=("PNG",)) as image:
        warnings.simplefilter("ignore")  # of Pillow's own limit
        width, height = image.size
    if width * height > _LARGEST:
        raise FileError(f"{path}: {width} x {height} pixels; at most {_LARGEST} are read")
    pixels = np.asarray(imread(path))
    without_alpha = {2: 1, 4: 3}.get(pixels.shape[-1], pixels.shape[-1])
    return pixels if pixels.ndim == 2 else pixels[..., :without_alpha].mean(axis=-1)


_READERS = {".npy": lambda path: read_npy(path, largest=_LARGEST), ".exr": _read_colours, ".png": _read_png}


def profile_extent(laser: Laser) -> tuple[float, float]:
    """Tangents of half the width and half the height of a measured beam; its image has square pixels."""
    height, width = load_profile(laser).shape
    wide = math.tan(laser.half_angle)
    return wide, wide * height / width


def profile_axes(axis: ArrayLike) -> tuple[Floats, Floats]:
    """Directions of a measured beam's columns (to the right) and rows (down) for the unit vector of its axis.

    Those of the camera for a beam along z; "right" has no y component.
    """
    x, _, z = forward = np.asarray(axis, np.float64)
    level = math.hypot(x, z)
    right = np.array([z, 0.0, -x]) / level if level > 1e-6 else np.array([1.0, 0.0, 0.0])
    return right, np.cross(forward, right)


# The spectrum and the filter

_WAVELENGTHS = str(field_range(Laser, "wavelength_nm"))
SPECTRUM_COLUMNS = {"wavelength_nm": _WAVELENGTHS, "power": "[0, 1e30]"}  # per nm, of any scale
FILTER_COLUMNS = {"wavelength_nm": _WAVELENGTHS, "transmission": "[0, 1]"}

_MOST_LINES = 32
_REACH = 2.0  # FWHM to either side, where a Gaussian has fallen to 1.5e-5 of its height
_NODES = 513  # of a Gaussian


class SpectralLine(NamedTuple):
    """A part of a pulse's spectrum: the mean wavelength of its photons [nm], and their number that passes the filter
    over that of a pulse of one line at `laser.wavelength_nm`."""

    wavelength_nm: float
    share: float


def filter_transmission(laser: Laser, detector: Detector, wavelength_nm: ArrayLike) -> Floats:
    """Transmission of the detector's filter at vacuum wavelengths [nm]; 1 without a filter.

    Raises `FileError` or `ConfigError` if its table cannot be read.
    """
    wavelength = np.asarray(wavelength_nm, np.float64)
    if detector.filter_table is not None:
        at, value = _table("detector.filter_table", detector.filter_table, FILTER_COLUMNS)
        return np.interp(wavelength, at, value, left=0.0, right=0.0)
    if detector.filter_fwhm_nm is None:
        return np.ones_like(wavelength)
    centre = laser.wavelength_nm if detector.filter_centre_nm is None else detector.filter_centre_nm
    return detector.filter_peak * _gaussian((wavelength - centre) / detector.filter_fwhm_nm)


def filter_band(laser: Laser, detector: Detector) -> Floats | None:
    """Wavelengths [nm] between which the filter's transmission is as good as straight; None without a filter."""
    if detector.filter_table is not None:
        return _table("detector.filter_table", detector.filter_table, FILTER_COLUMNS)[0]
    if detector.filter_fwhm_nm is None:
        return None
    centre = laser.wavelength_nm if detector.filter_centre_nm is None else detector.filter_centre_nm
    nodes = centre + detector.filter_fwhm_nm * np.linspace(-_REACH, _REACH, _NODES)
    return nodes[nodes > 0.0]


def spectral_lines(laser: Laser, detector: Detector) -> tuple[SpectralLine, ...]:
    """Lines of a pulse's photons that pass the filter, up to 32; one for a laser of one line.

    Raises `FileError` or `ConfigError` if a table cannot be read.
    """
    if laser.spectrum is None and laser.linewidth_nm == 0.0:
        return (SpectralLine(laser.wavelength_nm, float(filter_transmission(laser, detector, laser.wavelength_nm))),)
    wavelength, photons = _passed(laser, detector)
    total = float(photons.sum())
    if not total > 0.0:
        return (SpectralLine(laser.wavelength_nm, 0.0),)
    reached = np.cumsum(photons) / total
    low, high = wavelength[np.searchsorted(reached, [1e-6, 1.0 - 1e-6])]
    group = np.clip((wavelength - low) / max(high - low, 1e-300) * _MOST_LINES, 0, _MOST_LINES - 1).astype(int)
    share = np.bincount(group, photons, _MOST_LINES)
    moment = np.bincount(group, photons * wavelength, _MOST_LINES)
    return tuple(SpectralLine(float(m / s), float(s)) for s, m in zip(share, moment, strict=True) if s > 0.0)


def _passed(laser: Laser, detector: Detector) -> tuple[Floats, Floats]:
    """Wavelengths [nm] and the photons about each that pass the filter, over those of a pulse of one line."""
    if laser.spectrum is not None:
        at, power = _table("laser.spectrum", laser.spectrum, SPECTRUM_COLUMNS)
    else:
        at = laser.wavelength_nm + laser.linewidth_nm * np.linspace(-_REACH, _REACH, _NODES)
        power = _gaussian((at - laser.wavelength_nm) / laser.linewidth_nm)
    band = filter_band(laser, detector)
    nodes = np.unique(np.concatenate([at, np.empty(0) if band is None else band]))
    # Both may be steep between the nodes of a coarse table.
    nodes = np.unique(np.concatenate([np.linspace(a, b, 9) for a, b in itertools.pairwise(nodes)]))
    density = np.interp(nodes, at, power, left=0.0, right=0.0) / np.trapezoid(power, at)
    passed = filter_transmission(laser, detector, nodes)
    return nodes, density * widths_of(nodes) * passed * nodes / laser.wavelength_nm


def widths_of(nodes: Floats) -> Floats:
    """Widths that ascending wavelengths stand for, half of what is between it and its neighbours."""
    widths = np.gradient(nodes)
    widths[0], widths[-1] = 0.5 * (nodes[1] - nodes[0]), 0.5 * (nodes[-1] - nodes[-2])
    return widths


def _gaussian(offset: Any) -> Any:
    """A Gaussian of unit height and unit full width at half maximum."""
    return np.exp(-4.0 * math.log(2.0) * np.square(offset))


def _table(field: str, path: str, columns: dict[str, str]) -> tuple[Floats, Floats]:
    """Two columns of rising wavelengths and what is not all 0."""
    at, values = read_table(field, path, columns)
    if len(at) < 2 or (np.diff(at) <= 0.0).any():
        raise ConfigError(f"{field}: {path}: two rows or more with rising wavelengths are needed")
    if not values.max() > 0.0:
        raise ConfigError(f"{field}: {path}: holds no {next(reversed(columns))} above 0")
    return at, values
