"""What a photon adds to the histogram."""

from typing import TYPE_CHECKING

from .estimator import *
from .registry import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = estimator.__all__ + registry.__all__
