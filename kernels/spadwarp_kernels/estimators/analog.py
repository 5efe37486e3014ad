"""The analog estimator: a photon counts when it passes through the aperture itself."""

import warp as wp

from spadwarp_kernels.base.philox import u01
from spadwarp_kernels.optics.port import FLAT_PORT, PortRay
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import TOO_LONG, Contribution, PhotonState, World, tally_index
from spadwarp_kernels.tally.tally import BACKSCATTER, BALLISTIC, FORWARD_SCATTERED

from .estimator import Estimator


def make_analog(spec: TransportSpec) -> Estimator:
    """Photons that enter the lens within the view; slow to converge, and the reference for the others."""
    reflecting, has_port = spec.reflecting, spec.port is not None
    image_of, leave = spec.image_of, (spec.port or FLAT_PORT).leave

    @wp.func
    def cross(s: wp.ref[PhotonState], world: wp.ref[World]) -> Contribution:
        """The photon's weight, if its flight passes through the aperture, refracted where there is a port, before
        anything else happens to it."""
        found = Contribution()
        found.index = -3
        ray = PortRay()
        seen = s.x
        if wp.static(has_port):
            ray = leave(world.camera.port, s.x, s.u)
            seen = ray.x - ray.u
        elif s.u[2] < 0.0:
            ray.water = -s.x[2] / s.u[2]
            ray.x = s.x + ray.water * s.u
            ray.transmission = 1.0
        # Events but reflections, which alone bring no light that next events could.
        scatterings = s.collisions
        if wp.static(reflecting):
            scatterings -= s.bounces.count
        radius2 = ray.x[0] * ray.x[0] + ray.x[1] * ray.x[1]
        inside = radius2 <= world.camera.aperture_radius * world.camera.aperture_radius
        if scatterings > 0 and inside and ray.water > 0.0 and ray.transmission > 0.0:
            pixel = image_of(world.camera, s.view, s.target, seen, ray.x)
            if pixel >= 0 and ray.water <= wp.min(s.flight.distance, world.limits.max_path - s.path):
                component = wp.where(s.surface_count > 0, FORWARD_SCATTERED, BACKSCATTER)
                if s.surface_count == 1 and s.collisions == 1:
                    component = BALLISTIC
                found.value = s.weight.value * ray.transmission
                path = s.path + ray.water + ray.path
                found.index = tally_index(world.camera, world.gate, pixel, path, component)
                found.rounding_sample = u01(s.flight.block[2])
        if wp.static(reflecting):
            # By more reflections than next events take: nothing, marked to be counted.
            if found.value > 0.0 and s.bounces.leg > world.limits.boundary.max_reflections:
                found.value = 0.0
                found.index = TOO_LONG
        return found

    return Estimator(cross=cross)
