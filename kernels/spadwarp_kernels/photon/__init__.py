"""What a photon carries and adds to, the choices that make a kernel, and the queue of a warp."""

from typing import TYPE_CHECKING

from .derivatives import *
from .spec import *
from .state import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = derivatives.__all__ + spec.__all__ + state.__all__
