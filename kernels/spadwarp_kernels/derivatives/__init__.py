"""What a photon's history does to the derivatives of its light: scores, by flight and by event."""

from .blocks import make_begin_history, make_block_scores, make_fly_history
from .crossing import make_crossing_scores, make_to_lens
from .history import make_event_scores, make_flight_scores
from .request import make_request_scores, make_turn_scores

__all__ = [
    "make_begin_history",
    "make_block_scores",
    "make_crossing_scores",
    "make_event_scores",
    "make_flight_scores",
    "make_fly_history",
    "make_request_scores",
    "make_to_lens",
    "make_turn_scores",
]
