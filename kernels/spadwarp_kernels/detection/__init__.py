"""SPAD and TCSPC: counts from expected detections, and arrival times from histograms."""

from typing import TYPE_CHECKING

from .arrival_time import *
from .counts import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = arrival_time.__all__ + counts.__all__
