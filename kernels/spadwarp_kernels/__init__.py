"""Warp functions and kernels for photon transport, SPAD detection and depth; needs warp and numpy only.

Functions marked `wp.func` go into the caller's own kernels; `launch_transport` walks photons against the caller's own
`wp.Mesh`. A folder for each topic; what is not listed here is in its folder's `__all__`.
"""

from typing import TYPE_CHECKING

from .analytic import *
from .base import *
from .detection import *
from .estimators import *
from .optics import *
from .photon import *
from .surface import *
from .tally import *
from .transport import *
from .water import *
from .worlds import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = (
        analytic.__all__
        + base.__all__
        + detection.__all__
        + estimators.__all__
        + optics.__all__
        + photon.__all__
        + surface.__all__
        + tally.__all__
        + transport.__all__
        + water.__all__
        + worlds.__all__
    )

__version__ = "0.1.0"
