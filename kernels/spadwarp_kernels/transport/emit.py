"""Stage emit: where a photon starts."""

import functools

import warp as wp

from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.source.laser import Laser, emit_along, emit_measured
from spadwarp_kernels.source.scan import Scan


@functools.cache
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


@functools.cache
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
