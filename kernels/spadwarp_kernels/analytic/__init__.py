"""The analytic simulator: photon budget, Cramér–Rao bound, depth frames."""

from typing import TYPE_CHECKING

from .cramer_rao import *
from .depth_frames import *
from .optics import *
from .rates import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = cramer_rao.__all__ + depth_frames.__all__ + optics.__all__ + rates.__all__
