"""Daylight on the water and below its surface: clear sky, calm surface, attenuation, radiance in any direction.

>>> spadwarp.water.clear_sky_irradiance(532.0, sun_elevation_deg=60.0)

Angles of the sun are elevations above the horizon; below the surface its light is refracted. Wavelengths are in vacuum,
400 to 700 nm; irradiance and radiance are per nm.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from spadwarp.values import check_real
from spadwarp.water.seawater import RANGES, check_ranges, table_columns

__all__ = ["Skylight", "clear_sky_irradiance", "daylight_attenuation", "surface_reflectance"]

SKY_REFLECTANCE = 0.066
"""Of a calm surface for an evenly bright sky (Burt 1954; Gregg & Carder 1990)."""

# The atmosphere of ASTM G173, but for the aerosol; the ground is the sea.
_WATER_VAPOUR = 1.416  # precipitable [cm]
_OZONE = 0.3438  # [atm cm]
_GROUND = 0.06
_ANGSTROM = 1.14  # exponent of the aerosol's optical depth, and the three numbers of a rural aerosol
_ALBEDO_400, _ALBEDO_SLOPE, _ASYMMETRY = 0.945, 0.095, 0.65


class Skylight(NamedTuple):
    """Irradiance on a horizontal surface [W/m²/nm]: `direct` of the sun's disc, `diffuse` of the sky."""

    direct: Any
    diffuse: Any

    @property
    def total(self) -> Any:
        """Both."""
        return self.direct + self.diffuse


def clear_sky_irradiance(
    wavelength_nm: ArrayLike, *, sun_elevation_deg: float, aerosol_optical_depth: float = 0.084
) -> Skylight:
    """Spectral irradiance of sun and clear sky on a horizontal surface at sea level.

    The simple spectral model of Bird & Riordan (SERI/TR-215-2436, 1984; J. Clim. Appl. Meteorol. 25, 87, 1986), at the
    sun's mean distance (it varies by 3.4 % over the year), with the ozone and water vapour of ASTM G173 over the sea.

    Args:
        wavelength_nm: 400 to 700 [nm].
        sun_elevation_deg: (0, 90] [°].
        aerosol_optical_depth: Of the aerosol at 500 nm, vertically; 0.084 is that of ASTM G173, 0.05 very clear air,
            0.3 haze.

    Raises `ArgumentError`: a value outside its range.
    """
    elevation = check_real("sun_elevation_deg", sun_elevation_deg, RANGES["sun_elevation_deg"])
    turbidity = check_real("aerosol_optical_depth", aerosol_optical_depth, RANGES["aerosol_optical_depth"])
    check_ranges(wavelength_nm=wavelength_nm)
    nm = np.asarray(wavelength_nm, np.float64)
    rows = table_columns("clear_sky")
    sun, vapour, ozone, mixed = (np.interp(nm, rows[0], row) for row in rows[1:])
    cosine = math.sin(math.radians(elevation))
    optical_depth = turbidity * (nm / 500.0) ** -_ANGSTROM
    albedo = _ALBEDO_400 * np.exp(-_ALBEDO_SLOPE * np.log(nm / 400.0) ** 2)
    um2, ozone_mass = (nm / 1000.0) ** 2, (1.0 + 22.0 / 6370.0) / math.sqrt(cosine**2 + 2.0 * 22.0 / 6370.0)

    def through(mass: float) -> tuple[Any, ...]:
        """Parts that an air mass lets through: air, scattering and absorbing aerosol, vapour, gases."""
        of_vapour, of_gases = vapour * _WATER_VAPOUR * mass, mixed * mass
        return (
            np.exp(-mass / (um2**2 * (115.6406 - 1.3366 / um2))),
            np.exp(-albedo * optical_depth * mass),
            np.exp(-(1.0 - albedo) * optical_depth * mass),
            np.exp(-0.2385 * of_vapour / (1.0 + 20.07 * of_vapour) ** 0.45),
            np.exp(-1.41 * of_gases / (1.0 + 118.3 * of_gases) ** 0.45),
        )

    # eq 2-4 to 2-11, 3-9 and 3-10 of the report, as in its code
    mass = _air_mass(elevation)
    rayleigh, scattered, absorbed, of_vapour, of_mixed = through(mass)
    above_rayleigh, above_scattered, above_absorbed, above_vapour, above_mixed = through(1.8)
    of_ozone, aerosol = np.exp(-ozone * _OZONE * ozone_mass), np.exp(-optical_depth * mass)
    direct = sun * cosine * rayleigh * aerosol * of_vapour * of_ozone * of_mixed

    logarithm = math.log(1.0 - _ASYMMETRY)
    forward = logarithm * (1.459 + logarithm * (0.1595 + logarithm * 0.4129))
    backward = logarithm * (0.0783 + logarithm * (-0.3824 - logarithm * 0.5874))
    downwards = 1.0 - 0.5 * math.exp((forward + backward * cosine) * cosine)
    downwards_above = 1.0 - 0.5 * math.exp((forward + backward / 1.8) / 1.8)
    common = sun * cosine * of_ozone * of_mixed * of_vapour * absorbed
    by_air = common * (1.0 - rayleigh**0.95) * 0.5
    by_aerosol = common * rayleigh**1.5 * (1.0 - scattered) * downwards
    back = 0.5 * (1.0 - above_rayleigh) + (1.0 - downwards_above) * above_rayleigh * (1.0 - above_scattered)
    sky = above_mixed * above_vapour * above_absorbed * back * _GROUND
    again = (direct + by_air + by_aerosol) * sky / (1.0 - sky)
    correction = np.where(nm <= 450.0, ((nm + 550.0) / 1000.0) ** 1.8, 1.0)
    diffuse = (by_air + by_aerosol + again) * correction
    return Skylight(direct, diffuse) if nm.ndim else Skylight(float(direct), float(diffuse))


def _air_mass(elevation_deg: float) -> float:
    """Relative air mass (Kasten & Young 1989)."""
    return 1.0 / (math.sin(math.radians(elevation_deg)) + 0.50572 * (elevation_deg + 6.07995) ** -1.6364)


def refracted_cosine(sun_elevation_deg: float, index: float) -> float:
    """Cosine of the sun's zenith angle below a calm surface of water of a refractive index in [1, 4]."""
    check_real("sun_elevation_deg", sun_elevation_deg, "[-90, 90] °")
    check_real("index", index, "[1, 4]")
    return math.sqrt(1.0 - (math.cos(math.radians(sun_elevation_deg)) / index) ** 2)


def surface_reflectance(sun_elevation_deg: float, index: float = 1.3415) -> float:
    """Part of the sun's light that a calm surface reflects: Fresnel's, for unpolarised light."""
    outside, inside = math.sin(math.radians(sun_elevation_deg)), refracted_cosine(sun_elevation_deg, index)
    s = (outside - index * inside) / (outside + index * inside)
    p = (index * outside - inside) / (index * outside + inside)
    return 0.5 * (s * s + p * p)


def daylight_attenuation(absorption: ArrayLike, backscattering: ArrayLike, *, sun_elevation_deg: float) -> Any:
    """Diffuse attenuation coefficient K_d of the downwelling irradiance [1/m], after Lee, Du & Arnone (2005).

    K_d = (1 + 0.005·θ)·a + 4.18·(1 − 0.52·exp(−10.8·a))·b_b, θ the sun's zenith angle in air [°], mean from the surface
    to where a tenth of the light is left; 2 % from full radiative transfer on average, 12 % at most (J. Geophys. Res.
    110, C02016).

    Args:
        absorption: a [1/m].
        backscattering: b_b [1/m], what is scattered by more than 90°.
        sun_elevation_deg: (0, 90] [°].
    """
    a, backward = np.asarray(absorption, np.float64), np.asarray(backscattering, np.float64)
    zenith = 90.0 - check_real("sun_elevation_deg", sun_elevation_deg, RANGES["sun_elevation_deg"])
    attenuation = (1.0 + 0.005 * zenith) * a + 4.18 * (1.0 - 0.52 * np.exp(-10.8 * a)) * backward
    return attenuation if attenuation.ndim else float(attenuation)
