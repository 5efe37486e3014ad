"""What all packages use: checks of arguments, kernels made once, random numbers, tables, rotations."""

from typing import TYPE_CHECKING

from .check import *
from .kernels import *
from .philox import *
from .rotations import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = check.__all__ + kernels.__all__ + philox.__all__ + rotations.__all__
