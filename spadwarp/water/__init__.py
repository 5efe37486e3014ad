"""Optical properties of natural water over wavelength, temperature, salinity and chlorophyll."""

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
    "WaterOptics",
    "group_index",
    "molecular_density",
    "pure_water_absorption",
    "pure_water_scattering",
    "refractive_index",
    "water_optics",
]
