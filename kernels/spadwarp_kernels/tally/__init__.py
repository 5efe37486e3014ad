"""Tallies in fixed point, the ledger of weights, and batches for standard errors."""

from .batches import Batches
from .tally import (
    COUNTERS,
    LEDGER_ENTRIES,
    LEDGER_SLOTS,
    LEDGER_UNIT,
    LEDGER_WIDTH,
    add_to_ledger,
    deposit,
    to_fixed_point,
    to_ledger,
)

__all__ = [
    "COUNTERS",
    "LEDGER_ENTRIES",
    "LEDGER_SLOTS",
    "LEDGER_UNIT",
    "LEDGER_WIDTH",
    "Batches",
    "add_to_ledger",
    "deposit",
    "to_fixed_point",
    "to_ledger",
]
