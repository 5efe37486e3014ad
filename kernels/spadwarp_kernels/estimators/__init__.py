"""What a photon adds to the histogram."""

from .contribution import COMPONENTS, Contribution, Request, make_score, next_event_value, tally_index
from .guided import make_sample_flight

__all__ = [
    "COMPONENTS",
    "Contribution",
    "Request",
    "make_sample_flight",
    "make_score",
    "next_event_value",
    "tally_index",
]
