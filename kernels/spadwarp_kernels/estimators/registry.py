"""The estimators by name."""

from collections.abc import Callable

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.photon.spec import TransportSpec

from .analog import make_analog
from .estimator import Estimator
from .guided import make_guided
from .next_event import make_next_event
from .none import make_none

__all__ = ["ESTIMATORS"]

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
    return ESTIMATORS[spec.estimator](spec)
