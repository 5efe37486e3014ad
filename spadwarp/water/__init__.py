"""Optical properties of natural water over wavelength, temperature, salinity and chlorophyll; particles, polarisation,
daylight."""

from spadwarp.water.daylight import Skylight, clear_sky_irradiance, daylight_attenuation, surface_reflectance
from spadwarp.water.particles import (
    ParticleOptics,
    SizeDistribution,
    kopelevich_particles,
    log_normal,
    mie_particles,
    mixture,
    power_law,
    save_matrix_table,
    save_phase_table,
    single_size,
)
from spadwarp.water.scattering_matrix import (
    MATRIX_COLUMNS,
    WATER_DEPOLARISATION,
    rayleigh_matrix,
    read_matrix_table,
    scaled_rayleigh_matrix,
    voss_fry_matrix,
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

__all__ = [
    "MATRIX_COLUMNS",
    "WATER_DEPOLARISATION",
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
    "rayleigh_matrix",
    "read_matrix_table",
    "refractive_index",
    "save_matrix_table",
    "save_phase_table",
    "scaled_rayleigh_matrix",
    "single_size",
    "surface_reflectance",
    "voss_fry_matrix",
    "water_optics",
]
