"""Fixed-point tallies, their batches, and the energy balance."""

from .flux import *
from .ledger import *
from .tally import *
from .windows import *
