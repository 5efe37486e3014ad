"""The Stokes vector of a photon that enters the water."""

import warp as wp

from spadwarp_kernels.math.once import made_once
from spadwarp_kernels.math.rotations import set_apart
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.source.laser import Laser, beam_frame
from spadwarp_kernels.source.scan import Scan

from .fresnel import make_port_elements
from .request import Polarisation
from .stokes import stokes_from, transport_stokes, turn_stokes


@made_once
def make_first_stokes(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(polarisation, laser, scan, target, emitted, x, u) -> vec4`` of a photon that was emitted,
    see `make_emit`, and is in the water at x on its way along u.

    A beam's field on its axis is turned to the direction of each photon by the smallest rotation.
    """
    polarised, confocal, has_port = spec.polarised, spec.confocal, spec.laser_port is not None
    elements = make_port_elements(spec.laser_port)

    @wp.func
    def first_stokes(
        polarisation: Polarisation,
        laser: Laser,
        scan: Scan,
        target: int,
        emitted: wp.spatial_vector,
        x: wp.vec3,
        u: wp.vec3,
    ) -> wp.vec4:
        if wp.static(not polarised):
            return wp.vec4()
        axis = laser.axis
        if wp.static(confocal):
            axis = scan.axis[target]
        axis = set_apart(axis)
        right, _down = beam_frame(axis)
        heading = set_apart(wp.spatial_bottom(emitted))
        stokes = transport_stokes(stokes_from(polarisation.laser, right, axis), axis, heading)
        if wp.static(has_port):
            leaving = set_apart(u)
            stokes = turn_stokes(stokes, heading, leaving, elements(laser.port, set_apart(x), leaving))
        return stokes

    return first_stokes
