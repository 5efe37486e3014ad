"""The estimators by name, and those that are short."""

from collections.abc import Callable

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import u01
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import TOO_LONG, Contribution, PhotonState, World, tally_index
from spadwarp_kernels.tally.tally import BACKSCATTER, BALLISTIC, FORWARD_SCATTERED

from .contribution import make_event_request, make_score, sea_component
from .estimator import Estimator
from .guided import make_guided

__all__ = ["ESTIMATORS"]


def make_none(spec: TransportSpec) -> Estimator:
    """Scores nothing."""
    return Estimator()


def make_analog(spec: TransportSpec) -> Estimator:
    """Photons that enter the lens within the view; slow to converge, and the reference for the others."""
    reflects, sight, sea = spec.domain.reflects, spec.sight, spec.sight.sea is not None

    @wp.func
    def cross(s: wp.ref[PhotonState], world: wp.ref[World]) -> Contribution:
        """The photon's weight, if its flight passes through the aperture, refracted where there is a port, before
        anything else happens to it."""
        found = Contribution()
        found.index = -3
        ray = sight.leave(
            world.camera, sight.pose.point_in(world.scan, s.target, s.x), sight.pose.turn_in(world.scan, s.target, s.u)
        )
        # Events but reflections, which alone bring no light that next events could.
        scatterings = s.collisions
        if wp.static(not sea):
            scatterings -= s.bounces.count
        radius2 = ray.x[0] * ray.x[0] + ray.x[1] * ray.x[1]
        inside = radius2 <= world.camera.aperture_radius * world.camera.aperture_radius
        if scatterings > 0 and inside and ray.water > 0.0 and ray.transmission > 0.0:
            pixel = sight.project(world.camera, s.view, s.target, ray.seen, ray.x)
            if pixel >= 0 and ray.water <= wp.min(s.flight.distance, world.limits.max_path - s.path):
                component = wp.where(s.surface_count > 0, FORWARD_SCATTERED, BACKSCATTER)
                if s.surface_count == 1 and s.collisions == 1:
                    component = BALLISTIC
                found.value = s.weight.value * ray.transmission
                path = s.path + ray.water + ray.path
                if wp.static(sea):
                    component = sea_component(s, scatterings - s.bounces.count)
                    if s.above:
                        path = s.path + world.sea.delay * ray.water
                        found.value *= wp.exp(-world.sea.extinction * ray.water)
                found.path = path
                found.index = tally_index(world.camera, world.gate, pixel, path, component)
                found.rounding_sample = u01(s.flight.block[2])
        if wp.static(reflects):
            # By more reflections than next events take: nothing, marked to be counted.
            if found.value > 0.0 and s.bounces.leg > world.limits.boundary.max_reflections:
                found.value = 0.0
                found.index = TOO_LONG
        return found

    return Estimator(cross=cross)


def make_next_event(spec: TransportSpec) -> Estimator:
    """A contribution from every collision and surface, by way of a uniform point of the lens."""
    return Estimator(request_event=make_event_request(spec), score=make_score(spec))


ESTIMATORS: dict[str, Callable[[TransportSpec], Estimator]] = {
    "none": make_none,
    "analog": make_analog,
    "next_event": make_next_event,
    "guided": make_guided,
}
"""A function of a spec for each name that `TransportSpec.estimator` may have; add a line for one of your own."""


@memoised
def make_estimator(spec: TransportSpec) -> Estimator:
    """The estimator of a spec, made once: each launch asks for it, and its Warp functions take milliseconds to make."""
    check.choice("estimator", spec.estimator, ESTIMATORS)
    return ESTIMATORS[spec.estimator](spec)
