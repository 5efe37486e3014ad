"""The water: its coefficients, layers, cells and phase functions; its walls and the limits that end a history."""

from typing import TYPE_CHECKING

from .grid import *
from .limits import *
from .medium import *
from .phase_functions import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = grid.__all__ + limits.__all__ + medium.__all__ + phase_functions.__all__
