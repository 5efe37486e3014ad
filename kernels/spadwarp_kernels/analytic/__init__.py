"""The analytic simulator: photon budget, Cramér–Rao bound, depth frames."""

from typing import TYPE_CHECKING

from .backscatter import *
from .cramer_rao import *
from .depth_frames import *
from .lidar import *
from .optics import *
from .signal import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = (
        backscatter.__all__
        + cramer_rao.__all__
        + depth_frames.__all__
        + lidar.__all__
        + optics.__all__
        + signal.__all__
    )
