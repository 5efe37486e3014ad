"""The riders of a spec."""

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.photon.spec import TransportSpec

from .blocks import make_blocks_rider
from .derivatives import make_derivatives_rider
from .polarisation import make_polarisation_rider
from .rider import NOTHING, Rider, join


@memoised
def make_rider(spec: TransportSpec) -> Rider:
    """All that rides along for a spec; `NOTHING` where nothing does."""
    rider = NOTHING
    for wanted, make in (
        (spec.blocks, make_blocks_rider),
        (spec.derivatives, make_derivatives_rider),
        (spec.polarised, make_polarisation_rider),
    ):
        if wanted:
            rider = make(spec) if rider is NOTHING else join(rider, make(spec))
    return rider
