"""Stage traverse: rays against the target."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.estimators.contribution import Scored
from spadwarp_kernels.optics.camera import Camera
from spadwarp_kernels.optics.visibility import may_be_hidden
from spadwarp_kernels.photon.lanes import count_lanes
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import NO_RAY, RAY, SHADOW_RAY, SURFACE_RAY, PhotonState
from spadwarp_kernels.surface.bvh import NO_NODE, TreeWalk, segment_meets_box
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.ray_cast import intersect_surfaces, meets_faces


@wp.struct
class Ray:
    """The ray that a photon waits for: origin [m], unit direction and length [m]."""

    origin: wp.vec3
    direction: wp.vec3
    length: float


@memoised
def make_aim(spec: TransportSpec, scores: bool) -> wp.Function:
    """The Warp function ``s -> Ray``: the flight, or the way from the scored point to the lens."""

    @wp.func
    def aim(s: PhotonState) -> Ray:
        ray = Ray()
        ray.origin = s.x
        ray.direction = s.u
        ray.length = s.flight.reach
        if wp.static(scores):
            if s.ray == SHADOW_RAY:
                ray.origin = s.origin
                ray.direction = wp.normalize(s.lens - s.origin)
                ray.length = wp.length(s.lens - s.origin)
        return ray

    return aim


@wp.func
def _may_hide_behind_port(view: wp.vec4, near_depth: wp.array2d(dtype=float), x: wp.vec3) -> bool:
    """True: the map is of straight lines to the lens."""
    return True


@memoised
def make_look(spec: TransportSpec, brute_force: bool) -> wp.Function:
    """The Warp function ``(found, camera, surfaces) -> Scored``: whether a shadow ray is needed; by brute force it is
    traced here."""
    has_mesh = spec.mesh
    may_hide = may_be_hidden if spec.port is None else _may_hide_behind_port
    view_of = spec.lens.view

    @wp.func
    def look(found: Scored, camera: Camera, surfaces: Surfaces) -> Scored:
        found.seen = True
        if wp.static(has_mesh):
            if may_hide(view_of(camera, camera.view), surfaces.near_depth, found.origin):
                to = found.lens - found.origin
                found.seen = not segment_meets_box(found.origin, to, 1.0, surfaces.lower, surfaces.upper)
                if wp.static(brute_force):
                    if not found.seen:
                        found.shadow_queries = 1
                        length = wp.length(to)
                        hidden = meets_faces(surfaces, found.origin, to / length, length)
                        found.contribution.value = wp.where(hidden, 0.0, found.contribution.value)
                        found.seen = True
        return found

    return look


@memoised
def make_begin_walk(spec: TransportSpec, cuda: bool) -> wp.Function:
    """The Warp function ``(surfaces, ray, any_hit) -> TreeWalk``: at the root on CUDA, at its end on the CPU and with
    Warp's own queries."""
    whole = spec.use_warp_bvh or not cuda

    @wp.func
    def begin_walk(surfaces: Surfaces, ray: Ray, any_hit: bool) -> TreeWalk:
        walk = TreeWalk()
        walk.found = -1
        walk.nearest = ray.length
        walk.depth = 1  # below everything stands NO_NODE
        if wp.static(whole):
            hit = intersect_surfaces(surfaces, ray.origin, ray.direction, ray.length, any_hit)
            walk.found = hit.slot
            walk.nearest = hit.distance
            walk.node = NO_NODE
        return walk

    return begin_walk


@wp.func
def next_ray(s: PhotonState) -> int:
    """The ray that a thread traces: that which it has begun, that of its photon, or a shadow ray."""
    ray = s.ray
    if ray == NO_RAY:
        ray = wp.where(s.stage == RAY, SURFACE_RAY, wp.where(s.hidden, SHADOW_RAY, NO_RAY))
    return ray


@memoised
def make_free_lanes(traces: bool) -> wp.Function:
    """The Warp function ``s -> int``, called by all lanes together: how many have room for a contribution that waits
    for its shadow ray. `traces`: whether rays wait at all."""

    @wp.func
    def free_lanes(s: PhotonState) -> int:
        free = int(32)
        if wp.static(traces):
            free = count_lanes(not s.hidden)
        return free

    return free_lanes
