"""Optical properties of natural water over wavelength, temperature, salinity and chlorophyll.

>>> spadwarp.water.water_optics(532.0, chlorophyll=0.5, temperature=10.0).extinction

Pure water absorbs as Pope & Fry (1997) measured it and scatters as Zhang, Hu & He (2009) compute it; its index is that
of Quan & Fry (1995). What lives in it follows the chlorophyll concentration as in the open ocean, where nothing comes
from land (case-1 water): absorption by particles after Bricaud et al. (1998); by dissolved matter, and scattering by
particles, after Morel & Maritorena (2001). These are averages over many stations; a single water may differ by a factor
of two.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.values import ArgumentError, Interval, shown

__all__ = ["WATER_DEPOLARISATION", "WaterOptics", "group_index", "molecular_density", "pure_water_absorption"]
__all__ += ["pure_water_scattering", "refractive_index", "water_optics"]

WATER_DEPOLARISATION = 0.039
"""Depolarisation ratio of pure water, of unpolarised light scattered by 90° (Farinato & Rowell 1976; measured again by
Zhang et al., Appl. Opt. 58, 991 (2019): 0.039 ± 0.001, and 1e-4 to 2e-4 more for each g/kg of salt)."""

RANGES = {
    "wavelength_nm": "[400, 700] nm",
    "temperature": "[0, 30] °C",
    "salinity": "[0, 40] g/kg",
    "chlorophyll": "[0, 30] mg/m³",
    "sun_elevation_deg": "(0, 90] °",
    "aerosol_optical_depth": "[0, 5]",
    "depolarisation_ratio": "[0, 0.5]",
    "largest": "[0, 1]",
}
"""Ranges in which the formulas hold, by the name of the argument; wavelengths in vacuum."""

Value = Any  # a float for a float, else an array


@dataclass(frozen=True)
class Coefficients:
    """Absorption a and scattering b [1/m] at a wavelength in vacuum [nm]."""

    wavelength_nm: float
    absorption: float
    scattering: float

    @property
    def extinction(self) -> float:
        """c = a + b [1/m]."""
        return self.absorption + self.scattering

    @property
    def albedo(self) -> float:
        """b/c."""
        return self.scattering / self.extinction


@dataclass(frozen=True)
class WaterOptics(Coefficients):
    """Optical properties of one water at one wavelength; `absorption` and `scattering` are of all that is in it,
    `water_absorption` and `water_scattering` of the water itself [1/m]; the group index is for the time of flight."""

    water_absorption: float
    water_scattering: float
    phase_index: float
    group_index: float


def water_optics(
    wavelength_nm: float, *, chlorophyll: float = 0.0, temperature: float = 20.0, salinity: float = 35.0
) -> WaterOptics:
    """Absorption, scattering and indices of case-1 water.

    a = a_w + A(λ)·C^E(λ) + 0.2·A(440)·C^E(440)·exp(−0.014(λ − 440)): water, particles, dissolved matter;
    b = b_w + 0.416·C^0.766·(λ/550)^ν, ν = (log₁₀C − 0.3)/2 up to C = 2 and 0 beyond, never below −1.

    Args:
        wavelength_nm: In vacuum, 400 to 700 [nm].
        chlorophyll: C, 0 (pure water) to 30 [mg/m³]; 0.05 is the clearest ocean, 10 a bloom.
        temperature: 0 to 30 [°C]; absorption does not follow it (less than 1 % a degree, in the red).
        salinity: 0 to 40 [g/kg]; 35 is the ocean.

    Raises `ArgumentError`: a value outside its range.
    """
    check_ranges(wavelength_nm=wavelength_nm, chlorophyll=chlorophyll, temperature=temperature, salinity=salinity)
    water = {"temperature": temperature, "salinity": salinity}
    absorption, scattering = pure_water_absorption(wavelength_nm), pure_water_scattering(wavelength_nm, **water)
    particles, dissolved, scatterers = _case_1(wavelength_nm, chlorophyll) if chlorophyll > 0.0 else (0.0, 0.0, 0.0)
    return WaterOptics(
        wavelength_nm=float(wavelength_nm),
        absorption=absorption + particles + dissolved,
        scattering=scattering + scatterers,
        water_absorption=absorption,
        water_scattering=scattering,
        phase_index=refractive_index(wavelength_nm, **water),
        group_index=group_index(wavelength_nm, **water),
    )


def refractive_index(wavelength_nm: ArrayLike, *, temperature: ArrayLike = 20.0, salinity: ArrayLike = 35.0) -> Value:
    """Phase index of fresh or sea water at normal pressure, after Quan & Fry, Appl. Opt. 34, 3477 (1995).

    Wavelength in vacuum 400 to 700 [nm], temperature 0 to 30 [°C], salinity 0 to 40 [g/kg] (the fit: to 35); arrays
    broadcast. Raises `ArgumentError` for a value outside its range.
    """
    check_ranges(wavelength_nm=wavelength_nm, temperature=temperature, salinity=salinity)
    constant, first, second, third = _quan_fry(temperature, salinity)
    wavelength = np.asarray(wavelength_nm, float)
    return _value(constant + first / wavelength + second / wavelength**2 + third / wavelength**3)


def group_index(wavelength_nm: ArrayLike, *, temperature: ArrayLike = 20.0, salinity: ArrayLike = 35.0) -> Value:
    """Group index n − λ·dn/dλ of fresh or sea water, with which pulses travel; arguments as in `refractive_index`."""
    check_ranges(wavelength_nm=wavelength_nm, temperature=temperature, salinity=salinity)
    constant, first, second, third = _quan_fry(temperature, salinity)
    wavelength = np.asarray(wavelength_nm, float)
    return _value(constant + 2.0 * first / wavelength + 3.0 * second / wavelength**2 + 4.0 * third / wavelength**3)


def pure_water_absorption(wavelength_nm: ArrayLike) -> Value:
    """Absorption coefficient of pure water [1/m] at 22 °C, interpolated linearly between the rows (2.5 nm apart) of
    Pope & Fry, Appl. Opt. 36, 8710 (1997).

    Wavelength in vacuum 400 to 700 [nm]. Raises `ArgumentError` for one outside.
    """
    check_ranges(wavelength_nm=wavelength_nm)
    wavelength, absorption = table_columns("pure_water_absorption")
    return _value(np.interp(np.asarray(wavelength_nm, float), wavelength, absorption))


def pure_water_scattering(
    wavelength_nm: ArrayLike, *, temperature: ArrayLike = 20.0, salinity: ArrayLike = 35.0
) -> Value:
    """Scattering coefficient of pure water or pure seawater [1/m], after Zhang, Hu & He, Opt. Express 17, 5698 (2009).

    By fluctuations of density and of the salts' concentration; symmetric about 90° and nearly even in all directions.
    Arguments as in `refractive_index`.
    """
    check_ranges(wavelength_nm=wavelength_nm, temperature=temperature, salinity=salinity)
    wavelength, t, s = np.broadcast_arrays(*(np.asarray(one, float) for one in (wavelength_nm, temperature, salinity)))
    # Quan & Fry's index counts from air (Ciddor 1996).
    inverse = (1000.0 / wavelength) ** 2
    air = 1.0 + (5792105.0 / (238.0185 - inverse) + 167917.0 / (57.362 - inverse)) * 1e-8
    index = refractive_index(wavelength, temperature=t, salinity=s) * air
    slope = (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2 + 0.01155 / wavelength) * air  # ∂n/∂S

    # Isothermal compressibility [1/Pa] from the secant bulk modulus [bar] (Millero 1980).
    modulus = (
        19652.21 + 148.4206 * t - 2.327105 * t**2 + 1.360477e-2 * t**3 - 5.155288e-5 * t**4
        + (54.6746 - 0.603459 * t + 1.09987e-2 * t**2 - 6.167e-5 * t**3) * s
        + (7.944e-2 + 1.6483e-2 * t - 5.3009e-4 * t**2) * s**1.5
    )  # fmt: skip
    compressibility = 1e-5 / modulus
    # Density [kg/m³] (UNESCO 1981).
    density = (
        999.842594 + 6.793952e-2 * t - 9.09529e-3 * t**2 + 1.001685e-4 * t**3 - 1.120083e-6 * t**4 + 6.536332e-9 * t**5
        + (0.824493 - 4.0899e-3 * t + 7.6438e-5 * t**2 - 8.2467e-7 * t**3 + 5.3875e-9 * t**4) * s
        + (-5.72466e-3 + 1.0227e-4 * t - 1.6546e-6 * t**2) * s**1.5
        + 4.8314e-4 * s**2
    )  # fmt: skip
    # ∂ln(water activity)/∂S (fitted to Millero & Leung 1976).
    activity = (
        -5.58651e-4 + 2.40452e-7 * t - 3.12165e-9 * t**2 + 2.40808e-11 * t**3
        + 1.5 * (1.79613e-5 - 9.9422e-8 * t + 2.08919e-9 * t**2 - 1.39872e-11 * t**3) * np.sqrt(s)
        + 2.0 * (-2.31065e-6 - 1.37674e-9 * t - 1.93316e-11 * t**2) * s
    )  # fmt: skip
    # ρ·∂n²/∂ρ (Proutiere, Megnassan & Hucteau 1992).
    n2 = index**2
    stiffness = (n2 - 1.0) * (1.0 + 2.0 / 3.0 * (n2 + 2.0) * (index / 3.0 - 1.0 / (3.0 * index)) ** 2)

    boltzmann, avogadro, molar_mass = 1.380649e-23, 6.02214076e23, 0.018
    cabannes = (6.0 + 6.0 * WATER_DEPOLARISATION) / (6.0 - 7.0 * WATER_DEPOLARISATION)
    of_density = 0.5 * boltzmann * (t + 273.15) * compressibility * stiffness**2
    of_salt = 2.0 * n2 * s * molar_mass * slope**2 / (density * -activity * avogadro)
    at_90_degrees = np.pi**2 / (wavelength * 1e-9) ** 4 * (of_density + of_salt) * cabannes
    return _value(8.0 * np.pi / 3.0 * at_90_degrees * (2.0 + WATER_DEPOLARISATION) / (1.0 + WATER_DEPOLARISATION))


def molecular_density(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Phase function [1/sr] of pure water over t = 1 − cosθ: 1 + cos²θ·(1 − δ)/(1 + δ), δ the depolarization ratio."""
    spread = 1.0 + WATER_DEPOLARISATION + (1.0 - WATER_DEPOLARISATION) * (1.0 - t) ** 2
    return 3.0 / (4.0 * np.pi) * spread / (4.0 + 2.0 * WATER_DEPOLARISATION)


def _quan_fry(temperature: ArrayLike, salinity: ArrayLike) -> tuple[Any, Any, float, float]:
    """Quan & Fry's index as a polynomial in 1/λ [1/nm]: its four coefficients."""
    t, s = np.asarray(temperature, float), np.asarray(salinity, float)
    constant = 1.31405 + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2) * s - 2.02e-6 * t**2
    return constant, 15.868 + 0.01155 * s - 0.00423 * t, -4382.0, 1.1455e6


def _case_1(wavelength_nm: float, chlorophyll: float) -> tuple[float, float, float]:
    """Absorption by particles and by dissolved matter, and scattering by particles [1/m]."""
    wavelength, factor, exponent = table_columns("particle_absorption")

    def particles(at: float) -> float:
        return float(np.interp(at, wavelength, factor) * chlorophyll ** np.interp(at, wavelength, exponent))

    dissolved = 0.2 * particles(440.0) * np.exp(-0.014 * (wavelength_nm - 440.0))
    slope = 0.0 if chlorophyll > 2.0 else max(0.5 * (np.log10(chlorophyll) - 0.3), -1.0)
    scattering = 0.416 * chlorophyll**0.766 * (wavelength_nm / 550.0) ** slope
    return particles(wavelength_nm), float(dissolved), float(scattering)


@functools.cache
def table_columns(name: str) -> tuple[NDArray[np.float64], ...]:
    """Columns of a table that comes with the package."""
    lines = (files("spadwarp.water") / "tables" / f"{name}.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines if line[0].isdigit()]
    return tuple(np.array(rows, dtype=float).T)


def check_ranges(**values: ArrayLike) -> None:
    """Raises `ArgumentError` for a number, or one of an array, outside the range of its name."""
    for name, value in values.items():
        interval = Interval.read(RANGES[name])
        try:
            array = np.asarray(value, float)
        except (TypeError, ValueError):
            raise ArgumentError(f"{name} = {shown(value)} is not a number") from None
        if not interval.holds(array).all():
            raise ArgumentError(f"{name} = {shown(value)} is outside {interval}")


def _value(array: Any) -> Value:
    return array if np.ndim(array) else float(array)
