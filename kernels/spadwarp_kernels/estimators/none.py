"""No estimator: photons travel without a camera."""

from spadwarp_kernels.photon.spec import TransportSpec

from .estimator import Estimator


def make_none(spec: TransportSpec) -> Estimator:
    """Scores nothing."""
    return Estimator(max_registers=(56, 64))
