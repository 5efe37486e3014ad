"""Fixed-point tallies, their batches, and the energy balance."""

from typing import TYPE_CHECKING

from .flux import *
from .ledger import *
from .tally import *
from .windows import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = flux.__all__ + ledger.__all__ + tally.__all__ + windows.__all__
