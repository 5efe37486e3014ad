"""What a photon carries, the choices that make a kernel, and the lanes and queue of a warp."""

from typing import TYPE_CHECKING

from .spec import *
from .state import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = spec.__all__ + state.__all__
