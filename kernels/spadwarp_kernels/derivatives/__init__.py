"""What a photon's history does to the derivatives of its light: scores, by flight and by event."""

from .blocks import make_block_scores
from .crossing import make_crossing_scores, make_to_lens
from .history import make_event_scores, make_flight_scores
from .request import make_request_scores, make_turn_scores

__all__ = [
    "make_block_scores",
    "make_crossing_scores",
    "make_event_scores",
    "make_flight_scores",
    "make_request_scores",
    "make_to_lens",
    "make_turn_scores",
]
