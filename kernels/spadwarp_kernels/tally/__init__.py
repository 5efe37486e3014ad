"""Tallies in fixed point, the ledger of weights, and batches for standard errors."""

from .batches import Batches
from .blocks import BLOCK_DERIVATIVES, MOST_BLOCK_DERIVATIVES, Blocks, make_blocks
from .ledger import COUNTERS, LEDGER_ENTRIES, LEDGER_SLOTS, LEDGER_UNIT, LEDGER_WIDTH, add_to_ledger, to_ledger
from .rates import tally_rates
from .scores import DERIVATIVES, MOST_DERIVATIVES, Derivatives, make_derivatives
from .tally import COMPONENTS, Contribution, Scores, add_tallies, deposit, has_overflowed, tally_index, to_fixed_point

__all__ = [
    "BLOCK_DERIVATIVES",
    "COMPONENTS",
    "COUNTERS",
    "DERIVATIVES",
    "LEDGER_ENTRIES",
    "LEDGER_SLOTS",
    "LEDGER_UNIT",
    "LEDGER_WIDTH",
    "MOST_BLOCK_DERIVATIVES",
    "MOST_DERIVATIVES",
    "Batches",
    "Blocks",
    "Contribution",
    "Derivatives",
    "Scores",
    "add_tallies",
    "add_to_ledger",
    "deposit",
    "has_overflowed",
    "make_blocks",
    "make_derivatives",
    "tally_index",
    "tally_rates",
    "to_fixed_point",
    "to_ledger",
]
