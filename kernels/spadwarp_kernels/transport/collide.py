"""Stage collide: the end of a flight, in the water, on a surface or at a limit."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.photon.sink import Sink
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import END, SCATTER, PhotonState, next_bounce
from spadwarp_kernels.photon.world import World
from spadwarp_kernels.riders.rider import NOTHING
from spadwarp_kernels.riders.riders import make_rider
from spadwarp_kernels.surface.ray_cast import offset_from_surface
from spadwarp_kernels.tally.ledger import EXIT, MAX_PATH
from spadwarp_kernels.tally.tally import TOO_LONG
from spadwarp_kernels.water.limits import face_index, make_domain


@wp.struct
class Collision:
    """The end of a flight.

    Attributes:
        distance: Length of the flight [m].
        reason: Ledger entry of the limit that ended the history, or of its last event; else -1.
        mirror: Face of the domain that reflects the photon there; else 0.
    """

    distance: float
    reason: int
    mirror: int


@memoised
def make_collide(spec: TransportSpec, flies_on: bool) -> wp.Function:
    """The Warp function ``(s, world)``: takes a photon to the end of its flight, and on to SCATTER or to END.

    `flies_on`: see `make_continues`.
    """
    has_mesh, reflecting = spec.mesh, spec.reflecting
    bounded = spec.bounded and not reflecting
    local_albedo = spec.varies and not spec.random_albedo
    water_at, fly_carried = spec.water.at, make_rider(spec).fly
    domain = make_domain(spec.rotated_domain)
    outside, exit_of, to_exit = domain.is_outside, domain.exit, domain.exit_distance

    @wp.func
    def end_of_flight(s: wp.ref[PhotonState], world: wp.ref[World]) -> Collision:
        c = Collision()
        c.distance = s.flight.distance
        c.reason = -1
        limit = world.limits.max_path - s.path
        if s.flight.distance > limit:
            c.reason = MAX_PATH
            c.distance = limit
        if wp.static(bounded):
            if outside(world.limits, s.x + c.distance * s.u):
                leaves = exit_of(world.limits, s.x, s.u)
                c.reason = EXIT + leaves.face
                c.distance = wp.min(c.distance, leaves.distance)
        if wp.static(reflecting):
            # By distance: a photon that has been reflected may be outside by a rounding error.
            exit = to_exit(world.limits, s.x, s.u)
            if exit < c.distance:
                c.distance = exit
                c.reason = -1
                face = exit_of(world.limits, s.x, s.u).face
                if face_index(world.limits.boundary, face) > 0.0:
                    c.mirror = face
                else:
                    c.reason = EXIT + face
        if wp.static(flies_on):
            if s.collisions > 0 and s.reason >= 0:
                c.reason = s.reason
                if wp.static(reflecting):
                    # The light of the last event ends at the next, or with the longest leg that may be scored.
                    c.mirror = wp.where(s.bounces.leg < world.limits.boundary.max_reflections, c.mirror, 0)
        return c

    @wp.func
    def collide(s: wp.ref[PhotonState], world: wp.ref[World]):
        c = end_of_flight(s, world)
        fly_carried(s.carried, world, s.x, s.u, c.distance)
        s.x = s.x + c.distance * s.u
        s.path += c.distance
        s.reason = c.reason
        s.stage = END
        if c.reason < 0:
            if wp.static(local_albedo):
                s.albedo = water_at(world.medium, world.layers, s.x).albedo
            if wp.static(has_mesh):
                if s.hit.face >= 0 and c.mirror == 0:
                    s.x = offset_from_surface(s.x, s.hit.normal, c.distance)
        if wp.static(reflecting):
            next_bounce(s.bounces, c.mirror)
        if c.reason < 0 or c.mirror > 0:
            s.stage = SCATTER

    return collide


@memoised
def make_cross(spec: TransportSpec, cross: wp.Function | None, deposit: wp.Function) -> wp.Function:
    """The Warp function ``(s, world, sink)``: what a photon brings that flies through the aperture itself, if an
    estimator says so, with what rides along."""
    crosses, reflecting, has_port = cross is not None, spec.reflecting, spec.port is not None
    leave = spec.port.leave if spec.port is not None else None
    rider = make_rider(spec)
    rides, (_begin, fork, fly, _event, _mirror, deliver) = rider is not NOTHING, rider

    @wp.func
    def cross_aperture(s: wp.ref[PhotonState], world: wp.ref[World], sink: wp.ref[Sink]):
        if wp.static(crosses):
            c = cross(s, world)
            if wp.static(reflecting):
                s.bounces.dropped += wp.where(c.index == TOO_LONG, 1, 0)
            if wp.static(rides):
                if c.value > 0.0:
                    carried = s.carried
                    to_lens = -s.x[2] / s.u[2]
                    inside = s.u
                    if wp.static(has_port):
                        passage = leave(world.camera.port, s.x, s.u)
                        to_lens = passage.water
                        inside = passage.u
                    fork(carried, world)
                    fly(carried, world, s.x, s.u, to_lens)
                    deliver(c, carried, world, s.x, s.u, inside)
            if not c.value <= 0.0:
                s.contributions += 1
                deposit(s.account, sink, world, c)

    return cross_aperture
