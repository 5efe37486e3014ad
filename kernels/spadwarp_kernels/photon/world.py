"""What the photons of a launch meet, which is the same for each, and the random numbers that they draw."""

import warp as wp

from spadwarp_kernels.base.philox import RoundKeys
from spadwarp_kernels.optics.camera import Camera, Gate
from spadwarp_kernels.optics.laser import Laser, Scan
from spadwarp_kernels.optics.polarisation import Polarisation
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.tally.scores import Derivatives
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import Layers, Medium
from spadwarp_kernels.water.phase_functions import Guiding


@wp.struct
class World:
    """The fields of a `Model`, and the seed with the keys that Philox makes of it. No stage writes to it."""

    medium: Medium
    layers: Layers
    laser: Laser
    camera: Camera
    gate: Gate
    limits: Limits
    guiding: Guiding
    surfaces: Surfaces
    scan: Scan
    derivatives: Derivatives
    polarisation: Polarisation
    seed: wp.uint64
    keys: RoundKeys


@wp.struct
class Draws:
    """The random numbers of a thread.

    Attributes:
        base: Id of the launch's first photon.
        keys: Those of the world, held in registers on CUDA.
    """

    base: wp.uint64
    keys: RoundKeys
