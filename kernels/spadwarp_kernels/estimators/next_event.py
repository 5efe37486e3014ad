"""The next-event estimator: every event also sends its light straight to the lens."""

from spadwarp_kernels.photon.spec import TransportSpec

from .contribution import make_event_request, make_score
from .estimator import Estimator


def make_next_event(spec: TransportSpec) -> Estimator:
    """A contribution from every collision and surface, by way of a uniform point of the lens."""
    # In a tree, 72 keep more warps ready while others wait for nodes of a large mesh.
    in_tree = 80 if spec.derivatives or spec.grid is not None else 72
    return Estimator(
        max_registers=(96, 96) if spec.polarised else (64, in_tree),
        request_event=make_event_request(spec),
        score=make_score(spec),
    )
