"""What a photon's history does to the derivatives of its light: scores, by flight and by event."""

from .crossing import make_crossing_scores
from .history import make_event_scores, make_flight_scores
from .request import make_request_scores, make_turn_scores

__all__ = ["make_crossing_scores", "make_event_scores", "make_flight_scores", "make_request_scores", "make_turn_scores"]
