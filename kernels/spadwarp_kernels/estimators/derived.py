"""Contributions with their scores: what an estimator brings, for a spec with derivatives or of polarised light."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.optics.camera import Camera, Gate
from spadwarp_kernels.optics.laser import Scan
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState
from spadwarp_kernels.riders.blocks import make_block_scores
from spadwarp_kernels.riders.derivatives import make_crossing_scores, make_request_scores, make_to_lens
from spadwarp_kernels.riders.polarisation import (
    Polarisation,
    make_add_channels,
    make_crossing_stokes,
    make_event_stokes,
    make_leave_water,
    make_receive,
)
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.tally.scores import Derivatives
from spadwarp_kernels.tally.tally import Contribution
from spadwarp_kernels.water.limits import Limits
from spadwarp_kernels.water.medium import Layers, Medium

from .contribution import Request, Scored


@memoised
def make_derived_cross(spec: TransportSpec, cross: wp.Function | None) -> wp.Function | None:
    """The Warp function ``(s, camera, gate, limits, layers, derivatives, polarisation) -> Contribution``:
    `Estimator.cross`, with scores."""
    if cross is None:
        return None
    derives, crossing_scores = bool(spec.derivatives), make_crossing_scores(spec)
    by_block, to_lens = make_block_scores(spec), make_to_lens(spec)
    in_blocks = by_block is not None
    if by_block is not None:
        fly, copy = by_block.fly, by_block.copy
    polarised, crossing_stokes, add_channels = spec.polarised, make_crossing_stokes(spec), make_add_channels(spec)

    @wp.func
    def derived_cross(
        s: PhotonState,
        camera: Camera,
        gate: Gate,
        limits: Limits,
        layers: Layers,
        derivatives: Derivatives,
        polarisation: Polarisation,
    ) -> Contribution:
        c = cross(s, camera, gate, limits)
        if wp.static(derives):
            if c.value > 0.0:
                c.scores = crossing_scores(s, camera, layers, derivatives)
        if wp.static(in_blocks):
            if c.value > 0.0:
                copy(derivatives.blocks)
                fly(derivatives.blocks, 1, s.x, s.u, to_lens(camera, s.x, s.u))
        if wp.static(polarised):
            if c.value > 0.0:
                c = add_channels(c, polarisation, crossing_stokes(s, camera))
        return c

    return derived_cross


@memoised
def make_derived_score(spec: TransportSpec, score: wp.Function | None) -> wp.Function | None:
    """The Warp function ``(request, medium, layers, camera, gate, surfaces, scan, derivatives, polarisation)
    -> Scored``: `Estimator.score`, with scores."""
    if score is None:
        return None
    derives, request_scores = bool(spec.derivatives), make_request_scores(spec)
    by_block = make_block_scores(spec)
    in_blocks = by_block is not None
    if by_block is not None:
        fly, turn, copy = by_block.fly, by_block.turn, by_block.copy
    polarised, event_stokes, add_channels = spec.polarised, make_event_stokes(spec), make_add_channels(spec)
    leave_water, receive = make_leave_water(spec), make_receive(spec)

    @wp.func
    def derived_score(
        request: Request,
        medium: Medium,
        layers: Layers,
        camera: Camera,
        gate: Gate,
        surfaces: Surfaces,
        scan: Scan,
        derivatives: Derivatives,
        polarisation: Polarisation,
    ) -> Scored:
        found = score(request, medium, layers, camera, gate, surfaces, scan)
        if wp.static(derives):
            if found.contribution.value > 0.0:
                found.contribution.scores = request_scores(
                    request.scores,
                    request.x,
                    request.u,
                    request.slot,
                    found.origin,
                    found.lens,
                    derivatives,
                    medium,
                    layers,
                    surfaces,
                )
        if wp.static(in_blocks):
            if found.contribution.value > 0.0:
                point, way = found.origin, found.lens - found.origin
                length = wp.length(way)
                copy(derivatives.blocks)
                fly(derivatives.blocks, 1, request.x, request.u, wp.length(point - request.x))
                if request.slot < 0:
                    turn(derivatives.blocks, 1, medium, layers, point)
                fly(derivatives.blocks, 1, point, way / length, length)
        if wp.static(polarised):
            if found.contribution.value > 0.0:
                stokes = event_stokes(
                    request.stokes, polarisation, surfaces, request.slot, found.origin, request.u, found.to_lens
                )
                inside = wp.normalize(found.inside)
                stokes = receive(leave_water(camera, stokes, found.lens, found.to_lens, inside), inside)
                found.contribution = add_channels(found.contribution, polarisation, stokes)
        return found

    return derived_score
