"""The Stokes vector of a photon that enters the aperture itself."""

import warp as wp

from spadwarp_kernels.math.once import made_once
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState
from spadwarp_kernels.sensor.camera import Camera

from .receiver import make_leave_water, make_receive


@made_once
def make_crossing_stokes(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, camera) -> vec4`` of a photon whose flight leads to the lens, see `make_receive`."""
    has_port, leave_water, receive = spec.port is not None, make_leave_water(spec), make_receive(spec)
    leave = None if spec.port is None else spec.port.leave

    @wp.func
    def crossing_stokes(s: PhotonState, camera: Camera) -> wp.vec4:
        inside = s.u
        if wp.static(has_port):
            inside = leave(camera.port, s.x, s.u).u
        return receive(leave_water(camera, s.stokes, s.x, s.u, inside), inside)

    return crossing_stokes
