"""What rides along with a photon: derivatives, those of blocks of cells, polarisation."""

from typing import TYPE_CHECKING

from .polarisation import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = polarisation.__all__
