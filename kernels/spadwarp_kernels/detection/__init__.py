"""SPAD and TCSPC: counts from expected detections, and arrival times of what is significant in histograms."""

from typing import TYPE_CHECKING

from .arrival_time import *
from .counts import *
from .significance import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = arrival_time.__all__ + counts.__all__ + significance.__all__
