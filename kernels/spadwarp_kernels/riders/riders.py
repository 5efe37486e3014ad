"""The riders of a spec."""

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.photon.spec import TransportSpec

from .blocks import make_blocks_rider
from .derivatives import make_derivatives_rider
from .polarisation import make_polarisation_rider
from .rider import NOTHING, Rider


@memoised
def make_rider(spec: TransportSpec) -> Rider:
    """All that rides along for a spec; `NOTHING` where nothing does."""
    rider = NOTHING
    if spec.polarised:
        rider = make_polarisation_rider(spec)
    if spec.derivatives:
        rider = make_derivatives_rider(spec)
    if spec.blocks:
        rider = make_blocks_rider(spec, rider)
    return rider
