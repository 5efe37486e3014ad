"""What a receiver takes of the light that comes to the lens."""

import warp as wp

from spadwarp_kernels.math.once import made_once
from spadwarp_kernels.math.rotations import set_apart
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.sensor.camera import Camera
from spadwarp_kernels.tally.tally import Contribution

from .fresnel import make_port_elements
from .request import Polarisation
from .stokes import transport_stokes, turn_stokes


@made_once
def make_leave_water(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(camera, stokes, x, u, inside) -> vec4`` of light at x in the water along u that arrives at
    the lens along `inside`: what a port does to it."""
    has_port = spec.port is not None
    elements = make_port_elements(spec.port)

    @wp.func
    def leave_water(camera: Camera, stokes: wp.vec4, x: wp.vec3, u: wp.vec3, inside: wp.vec3) -> wp.vec4:
        if wp.static(has_port):
            before = set_apart(u)
            return turn_stokes(stokes, before, set_apart(inside), elements(camera.port, set_apart(x), before))
        return stokes

    return leave_water


@made_once
def make_receive(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(stokes, u) -> vec4`` of light that arrives at the lens along u: with respect to the image's
    x, to which the lens turns all light by the smallest rotation to the optical axis."""
    channels = spec.channels

    @wp.func
    def receive(stokes: wp.vec4, u: wp.vec3) -> wp.vec4:
        if wp.static(channels == 0):
            return stokes
        return transport_stokes(stokes, set_apart(u), wp.vec3(0.0, 0.0, -1.0))

    return receive


@made_once
def make_add_channels(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(contribution, polarisation, stokes) -> Contribution``: its value times I, and what the
    channels take, over that, as scores."""
    channels = spec.channels

    @wp.func
    def add_channels(c: Contribution, polarisation: Polarisation, stokes: wp.vec4) -> Contribution:
        c.value *= stokes[0]
        for k in range(wp.static(channels)):
            c.scores[k] = wp.dot(polarisation.channels[k], stokes) / wp.max(stokes[0], 1.0e-30)
        return c

    return add_channels
