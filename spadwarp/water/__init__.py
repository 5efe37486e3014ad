"""Optical properties of natural water over wavelength, temperature, salinity and chlorophyll; particles, polarisation,
daylight."""

from spadwarp.values import guarded
from spadwarp.water.daylight import *
from spadwarp.water.particles import *
from spadwarp.water.scattering_matrix import *
from spadwarp.water.seawater import *

guarded(__name__)
