"""Optical properties of natural water over wavelength, temperature, salinity and chlorophyll; particles, polarisation,
daylight."""

from typing import TYPE_CHECKING

from spadwarp.values import guarded
from spadwarp.water.daylight import *
from spadwarp.water.particles import *
from spadwarp.water.scattering_matrix import *
from spadwarp.water.seawater import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = guarded(
        __name__, [name for module in (daylight, particles, scattering_matrix, seawater) for name in module.__all__]
    )
