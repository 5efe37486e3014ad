"""The estimators by name."""

from collections.abc import Callable

from spadwarp_kernels.base.arguments import check_choice
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.photon.spec import TransportSpec

from .analog import make_analog
from .contribution import make_event_request, make_score
from .estimator import Estimator
from .guided import make_guided

__all__ = ["ESTIMATORS"]


def make_none(spec: TransportSpec) -> Estimator:
    """Scores nothing."""
    return Estimator()


def make_next_event(spec: TransportSpec) -> Estimator:
    """A contribution from every collision and surface, by way of a uniform point of the lens."""
    return Estimator(request_event=make_event_request(spec), score=make_score(spec))


ESTIMATORS: dict[str, Callable[[TransportSpec], Estimator]] = {
    "none": make_none,
    "analog": make_analog,
    "next_event": make_next_event,
    "guided": make_guided,
}
"""A function of a spec for each name that `TransportSpec.estimator` may have; add a line for one of your own."""


@memoised
def make_estimator(spec: TransportSpec) -> Estimator:
    """The estimator of a spec, made once: each launch asks for it, and its Warp functions take milliseconds to make."""
    check_choice("estimator", spec.estimator, ESTIMATORS)
    return ESTIMATORS[spec.estimator](spec)
