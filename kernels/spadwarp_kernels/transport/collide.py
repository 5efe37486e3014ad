"""Stage collide: the end of a flight, in the water, on a surface or at a limit."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.photon.lanes import MOST_LEFT
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import EVENT, PhotonState, is_planned
from spadwarp_kernels.surface.ray_cast import offset_from_surface
from spadwarp_kernels.tally.ledger import EXIT, MAX_PATH
from spadwarp_kernels.water.limits import (
    Limits,
    exit_distance,
    exit_distance_rotated,
    exit_face,
    exit_face_rotated,
    face_index,
    first_exit,
    first_exit_rotated,
    is_outside,
    is_outside_rotated,
)
from spadwarp_kernels.water.medium import Layers, Medium


@wp.struct
class Collision:
    """The end of a flight.

    Attributes:
        x: Where the photon is [m]; off the surface by a bound of its rounding error.
        distance: Length of the flight [m].
        albedo: Of the water there.
        reason: Ledger entry of the limit that ended the history, or of its last event; else -1.
        mirror: Face of the domain that reflects the photon there; else 0.
    """

    x: wp.vec3
    distance: float
    albedo: float
    reason: int
    mirror: int


@memoised
def make_collide(spec: TransportSpec, flies_on: bool = False) -> wp.Function:
    """The Warp function ``(s, medium, layers, limits) -> Collision``; `flies_on`: see `make_flies`."""
    has_mesh, reflecting = spec.mesh, spec.reflecting
    bounded = spec.bounded and not reflecting
    local_albedo = spec.varies and not spec.random_albedo
    water_at = spec.water.at
    to_exit, face_of_exit, exit_of, outside = (
        (exit_distance_rotated, exit_face_rotated, first_exit_rotated, is_outside_rotated)
        if spec.rotated_domain
        else (exit_distance, exit_face, first_exit, is_outside)
    )

    @wp.func
    def collide(s: PhotonState, medium: Medium, layers: Layers, limits: Limits) -> Collision:
        c = Collision()
        c.distance = s.flight.distance
        c.albedo = s.albedo
        c.reason = -1
        limit = limits.max_path - s.path
        if s.flight.distance > limit:
            c.reason = MAX_PATH
            c.distance = limit
        if wp.static(bounded):
            if outside(limits, s.x + c.distance * s.u):
                leaves = exit_of(limits, s.x, s.u)
                c.reason = EXIT + leaves.face
                c.distance = wp.min(c.distance, leaves.distance)
        if wp.static(reflecting):
            # By distance: a photon that has been reflected may be outside by a rounding error.
            exit = to_exit(limits, s.x, s.u)
            if exit < c.distance:
                c.distance = exit
                c.reason = -1
                face = face_of_exit(limits, s.x, s.u)
                if face_index(limits.boundary, face) > 0.0:
                    c.mirror = face
                else:
                    c.reason = EXIT + face
        c.x = s.x + c.distance * s.u
        if wp.static(flies_on):
            if s.collisions > 0 and s.reason >= 0:
                c.reason = s.reason
                if wp.static(reflecting):
                    # The light of the last event ends at the next, or with the longest leg that may be scored.
                    c.mirror = wp.where(s.bounces.leg < limits.boundary.max_reflections, c.mirror, 0)
        if c.reason < 0:
            if wp.static(local_albedo):
                c.albedo = water_at(medium, layers, c.x).albedo
            if wp.static(has_mesh):
                if s.hit.face >= 0 and c.mirror == 0:
                    c.x = offset_from_surface(c.x, s.hit.normal, c.distance)
        return c

    return collide


@memoised
def make_arrives(flights: bool, traces: bool, queues: bool, at_once: bool) -> tuple[wp.Function, wp.Function]:
    """Two Warp functions: ``(s, queued) -> bool``, whether the photon's flight is to be scored, and
    ``(s, queued, flies) -> bool``, whether, that being done, it is at the end of its flight and free to collide.

    Args:
        flights: Whether flights are scored; then collisions in the water are not.
        traces: Whether what is scored may wait for a shadow ray.
        queues: Whether it waits in the warp's queue before; else the thread's last one must have been traced.
        at_once: Whether nothing is waited for: a photon that has flown arrives.
    """

    @wp.func
    def has_room(s: PhotonState, queued: int) -> bool:
        room = bool(True)
        if wp.static(traces and queues):
            room = queued <= wp.static(MOST_LEFT)
        if wp.static(traces and not queues):
            room = not s.hidden
        return room

    @wp.func
    def flown(s: PhotonState, queued: int) -> bool:
        return s.stage == EVENT and is_planned(s.flight) and has_room(s, queued)

    @wp.func
    def arrives(s: PhotonState, queued: int, flies: bool) -> bool:
        if wp.static(at_once):
            return flies
        room = has_room(s, queued)
        if wp.static(flights):
            room = (room or (wp.static(not queues) and s.hit.face < 0)) and not is_planned(s.flight)
        return s.stage == EVENT and room

    return flown, arrives
