"""Stage emit: where a photon starts."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.optics.laser import Laser, Scan, emit_along, emit_measured
from spadwarp_kernels.optics.port import Port, PortKind, PortRay
from spadwarp_kernels.photon.lanes import exchange
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState, Weight, full_weight, give, reweigh
from spadwarp_kernels.tally.ledger import LASER_PORT


@wp.struct
class Start:
    """A photon in the water.

    Attributes:
        x: Position [m].
        u: Unit direction.
        path: What it has behind it, as length in water that takes as long [m].
        weight: Its weight, less what a port has reflected.
    """

    x: wp.vec3
    u: wp.vec3
    path: float
    weight: Weight


@memoised
def make_enter(port: PortKind | None) -> wp.Function:
    """The Warp function ``(laser, emitted, s, ledger, thread) -> Start`` of a photon that a laser has emitted,
    behind a port or in the water."""
    has_port = port is not None
    enter_port = port.enter if port is not None else _no_port_ray

    @wp.func
    def enter(
        laser: Laser, emitted: wp.spatial_vector, s: PhotonState, ledger: wp.array(dtype=wp.int64), thread: int
    ) -> Start:
        start = Start()
        start.x = wp.spatial_top(emitted)
        start.u = wp.spatial_bottom(emitted)
        start.weight = full_weight(s.weight)
        if wp.static(has_port):
            passage = enter_port(laser.port, start.x, start.u)
            start.weight = reweigh(start.weight, passage.transmission)
            if passage.transmission > 0.0:
                start.x = passage.x
                start.u = passage.u
                start.path = passage.path
            start.weight = give(start.weight, ledger, thread, LASER_PORT)
        return start

    return enter


@wp.func
def _no_port_ray(port: Port, x: wp.vec3, u: wp.vec3) -> PortRay:
    return PortRay()


@memoised
def make_emit(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(laser, scan, seed, id) -> spatial_vector``: start position [m], then unit direction."""
    confocal = spec.confocal
    emit_from = emit_measured if spec.measured_beam else emit_along

    @wp.func
    def emit(laser: Laser, scan: Scan, seed: wp.uint64, id: wp.uint64) -> wp.spatial_vector:
        axis = laser.axis
        if wp.static(confocal):
            axis = scan.axis[int(id % wp.uint64(scan.count))]
        start, heading = emit_from(laser, axis, seed, id)
        return wp.spatial_vector(start, heading)

    return emit


@memoised
def make_take_emitted(spec: TransportSpec, cuda: bool) -> wp.Function:
    """The Warp function ``(laser, scan, seed, id, entry) -> spatial_vector`` of a photon: on CUDA the one that a lane
    of the warp has put at an entry, see `exchange`."""
    emit = make_emit(spec)

    @wp.func
    def take_emitted(
        memory: int, laser: Laser, scan: Scan, seed: wp.uint64, id: wp.uint64, entry: int
    ) -> wp.spatial_vector:
        if wp.static(cuda):
            return exchange(memory, False, entry, wp.spatial_vector())
        return emit(laser, scan, seed, id)

    return take_emitted


@memoised
def make_first_photon(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(first_id, offset) -> uint64``: the id of a launch's first photon."""
    stepped = spec.stepped

    @wp.func
    def first_photon(first_id: wp.uint64, offset: wp.array(dtype=wp.uint64)) -> wp.uint64:
        first = wp.uint64(first_id)
        if wp.static(stepped):
            first += offset[0]
        return first

    return first_photon
