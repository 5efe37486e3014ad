"""Fixed-point tallies, the energy balance, batches, derivatives."""

from typing import TYPE_CHECKING

from .batches import *
from .blocks import *
from .ledger import *
from .scores import *
from .tally import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = batches.__all__ + blocks.__all__ + ledger.__all__ + scores.__all__ + tally.__all__
