"""What an estimator is: the Warp functions with which the transport kernel scores photons.

An estimator is a function ``make_<name>(spec) -> Estimator`` and its line in `ESTIMATORS`.
"""

from typing import NamedTuple

import warp as wp

__all__ = ["Estimator"]


@wp.struct
class FlightPlan:
    """What an estimator draws for a flight before it is traced."""

    lens: wp.vec3  # the point of the lens that the flight is scored through [m]
    lens_weight: float  # its density if it were uniform, over that of the draw
    interval: wp.vec2  # the part of it that is scored, unless a surface stands before it [m]; empty for none


@wp.struct
class Direction:
    """A new direction after an event."""

    u: wp.vec3  # unit vector
    factor: float  # by which the weight changes: density of the physics over that of the draw


@wp.struct
class Meeting:
    """How a flight with a face ahead of it ends."""

    meets: bool  # on the face; else in the water before it
    factor: float  # by which the weight changes: probability in the physics over that of the draw


class Estimator(NamedTuple):
    """What a photon adds to the histogram, as Warp functions made for a spec; None for what the estimator does without.

    Every function may be any mixture of physics and chance as long as the expectation of the histogram is that of the
    analog walk. They take the state of the photon and the world by reference and return a small struct; the stages
    alone change the state.
    """

    cross: wp.Function | None = None
    """``(s, world) -> Contribution``, what the photon itself brings on the flight that ends in its event; needs no
    shadow ray."""
    plan_flight: wp.Function | None = None
    """``(s, block, world) -> FlightPlan``, before a flight is traced; `block`: random words, the third and fourth for
    the lens."""
    meet: wp.Function | None = None
    """``(s, world, distance) -> Meeting``, whether the flight ends on the face at that distance [m], with another
    chance than in the physics."""
    request_flight: wp.Function | None = None
    """``(s) -> Request``, the score of a flight whose planned interval is not empty."""
    request_event: wp.Function | None = None
    """``(s, world) -> Request``, the score of the event that the photon has come to."""
    score: wp.Function | None = None
    """``(request, world) -> Scored``; needed with either request. It delivers what rides along, see `Rider`."""
    direct: wp.Function | None = None
    """``(s, reflected, lobe, world, id) -> Direction``, instead of the phase function and the surface's law;
    `reflected` is the draw of a rough specular surface."""

    @property
    def scores(self) -> bool:
        """Whether it adds anything to the histogram."""
        return self.cross is not None or self.score is not None
