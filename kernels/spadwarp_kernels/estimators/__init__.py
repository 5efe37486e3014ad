"""What a photon adds to the histogram."""

from .analog import make_analog
from .contribution import Request, Scored, make_event_request, make_score
from .estimator import Direction, Estimator, FlightPlan
from .flight_sampling import make_sample_flight
from .guided import make_guided
from .link import Link, make_link, next_event_value
from .next_event import make_next_event
from .none import make_none
from .registry import ESTIMATORS

__all__ = [
    "ESTIMATORS",
    "Direction",
    "Estimator",
    "FlightPlan",
    "Link",
    "Request",
    "Scored",
    "make_analog",
    "make_event_request",
    "make_guided",
    "make_link",
    "make_next_event",
    "make_none",
    "make_sample_flight",
    "make_score",
    "next_event_value",
]
