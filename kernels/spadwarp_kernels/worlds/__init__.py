"""SPAD cameras in simulations: many worlds in one launch, moving shapes, nothing read back."""

from typing import TYPE_CHECKING

from .shapes import *
from .simulators import *
from .spad_camera import *
from .spad_config import *
from .spad_tracer import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = shapes.__all__ + simulators.__all__ + spad_camera.__all__ + spad_config.__all__ + spad_tracer.__all__
