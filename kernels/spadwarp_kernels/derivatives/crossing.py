"""Scores of a photon that enters the aperture itself."""

import warp as wp

from spadwarp_kernels.math.once import made_once
from spadwarp_kernels.medium.layers import Layers
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState
from spadwarp_kernels.sensor.camera import Camera
from spadwarp_kernels.tally.scores import Derivatives
from spadwarp_kernels.tally.tally import Scores

from .history import make_flight_scores


@wp.func
def _to_lens(camera: Camera, x: wp.vec3, u: wp.vec3) -> float:
    return -x[2] / u[2]


@made_once
def make_to_lens(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(camera, x, u) -> float``: the way in water of a photon at x whose flight along u leads to
    the lens [m]."""
    if spec.port is None:
        return _to_lens
    leave = spec.port.leave

    @wp.func
    def to_port(camera: Camera, x: wp.vec3, u: wp.vec3) -> float:
        return leave(camera.port, x, u).water

    return to_port


@made_once
def make_crossing_scores(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, camera, layers, derivatives) -> Scores`` of a photon whose flight leads to the lens."""
    flight_scores, to_lens = make_flight_scores(spec), make_to_lens(spec)

    @wp.func
    def crossing_scores(s: PhotonState, camera: Camera, layers: Layers, derivatives: Derivatives) -> Scores:
        return flight_scores(s.scores, derivatives, layers, s.x, s.u, to_lens(camera, s.x, s.u))

    return crossing_scores
