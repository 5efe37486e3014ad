"""SPAD and TCSPC: counts from expected detections, and arrival times from histograms."""

from typing import TYPE_CHECKING

from .arrival_time import *
from .events import *
from .expected import *
from .first_photon import *
from .rates import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = arrival_time.__all__ + events.__all__ + expected.__all__ + first_photon.__all__ + rates.__all__
