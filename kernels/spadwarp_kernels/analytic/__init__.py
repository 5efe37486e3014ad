"""The analytic simulator: photon budget, Cramér–Rao bound, depth frames."""

from typing import TYPE_CHECKING

from .backscatter import *
from .behind_port import *
from .cramer_rao import *
from .depth_frames import *
from .labelled_frames import *
from .lidar import *
from .outliers import *
from .signal import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = (
        backscatter.__all__
        + behind_port.__all__
        + cramer_rao.__all__
        + depth_frames.__all__
        + labelled_frames.__all__
        + lidar.__all__
        + outliers.__all__
        + signal.__all__
    )
