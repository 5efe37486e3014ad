"""Optical properties of natural water over wavelength, temperature, salinity and chlorophyll; particles, daylight."""

from spadwarp.water.daylight import Skylight, clear_sky_irradiance, daylight_attenuation, surface_reflectance
from spadwarp.water.particles import (
    ParticleOptics,
    SizeDistribution,
    kopelevich_particles,
    log_normal,
    mie_particles,
    mixture,
    power_law,
    save_phase_table,
    single_size,
)
from spadwarp.water.seawater import (
    WaterOptics,
    group_index,
    molecular_density,
    pure_water_absorption,
    pure_water_scattering,
    refractive_index,
    water_optics,
)
from spadwarp.water.voss_fry import voss_fry_matrix

__all__ = [
    "ParticleOptics",
    "SizeDistribution",
    "Skylight",
    "WaterOptics",
    "clear_sky_irradiance",
    "daylight_attenuation",
    "group_index",
    "kopelevich_particles",
    "log_normal",
    "mie_particles",
    "mixture",
    "molecular_density",
    "power_law",
    "pure_water_absorption",
    "pure_water_scattering",
    "refractive_index",
    "save_phase_table",
    "single_size",
    "surface_reflectance",
    "voss_fry_matrix",
    "water_optics",
]
