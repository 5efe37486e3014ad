"""Optical properties of natural water over wavelength, temperature, salinity and chlorophyll; daylight in it."""

from spadwarp.water.daylight import Skylight, clear_sky_irradiance, daylight_attenuation, surface_reflectance
from spadwarp.water.seawater import (
    WaterOptics,
    group_index,
    molecular_density,
    pure_water_absorption,
    pure_water_scattering,
    refractive_index,
    water_optics,
)

__all__ = [
    "Skylight",
    "WaterOptics",
    "clear_sky_irradiance",
    "daylight_attenuation",
    "group_index",
    "molecular_density",
    "pure_water_absorption",
    "pure_water_scattering",
    "refractive_index",
    "surface_reflectance",
    "water_optics",
]
