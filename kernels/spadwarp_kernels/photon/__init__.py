"""What a kernel is compiled for, the state of a photon, its record, and the lanes of a CUDA warp that carry photons."""

from spadwarp_kernels.intersect.patches import BRUTE_FORCE_FACES

from .lanes import BLOCK_SIZE, count_lanes
from .records import Records, make_records
from .spec import TransportSpec
from .state import Flight, PhotonState, Weight, give, reweigh

__all__ = [
    "BLOCK_SIZE",
    "BRUTE_FORCE_FACES",
    "Flight",
    "PhotonState",
    "Records",
    "TransportSpec",
    "Weight",
    "count_lanes",
    "give",
    "make_records",
    "reweigh",
]
