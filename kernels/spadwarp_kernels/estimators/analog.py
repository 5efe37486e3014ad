"""The analog estimator: a photon counts when it passes through the aperture itself."""

import warp as wp

from spadwarp_kernels.base.philox import u01
from spadwarp_kernels.optics.port import PortKind
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import TOO_LONG, Contribution, PhotonState, World, tally_index
from spadwarp_kernels.tally.tally import BACKSCATTER, BALLISTIC, FORWARD_SCATTERED

from .estimator import Estimator


def make_analog(spec: TransportSpec) -> Estimator:
    """Photons that enter the lens within the view; slow to converge, and the reference for the others."""
    if spec.port is not None:
        return Estimator(cross=_make_cross_port(spec, spec.port))
    reflecting = spec.reflecting
    image_of, scatterings = spec.image_of, _make_scatterings(spec.reflecting)

    @wp.func
    def cross(s: wp.ref[PhotonState], world: wp.ref[World]) -> Contribution:
        """The photon's weight, if its flight passes through the aperture before anything else happens to it."""
        found = Contribution()
        found.index = -3
        if s.u[2] < 0.0 and scatterings(s) > 0:
            crossing = -s.x[2] / s.u[2]
            on_lens = s.x + crossing * s.u
            pixel = image_of(world.camera, s.view, s.target, s.x, on_lens)
            radius2 = on_lens[0] * on_lens[0] + on_lens[1] * on_lens[1]
            inside = radius2 <= world.camera.aperture_radius * world.camera.aperture_radius
            if pixel >= 0 and inside and crossing <= wp.min(s.flight.distance, world.limits.max_path - s.path):
                found.value = s.weight.value
                found.index = tally_index(world.camera, world.gate, pixel, s.path + crossing, _component(s))
                found.rounding_sample = u01(s.flight.block[2])
        if wp.static(reflecting):
            found = _drop_long_leg(found, s, world)
        return found

    return Estimator(cross=cross)


def _make_scatterings(reflecting: bool) -> wp.Function:
    """The Warp function ``s -> int``: events but reflections, which alone bring no light that next events could."""

    @wp.func
    def scatterings(s: wp.ref[PhotonState]) -> int:
        count = s.collisions
        if wp.static(reflecting):
            count -= s.bounces.count
        return count

    return scatterings


@wp.func
def _drop_long_leg(found: Contribution, s: wp.ref[PhotonState], world: wp.ref[World]) -> Contribution:
    """Nothing, marked to be counted, by more reflections than next events take."""
    if found.value > 0.0 and s.bounces.leg > world.limits.boundary.max_reflections:
        found.value = 0.0
        found.index = TOO_LONG
    return found


@wp.func
def _component(s: wp.ref[PhotonState]) -> int:
    component = wp.where(s.surface_count > 0, FORWARD_SCATTERED, BACKSCATTER)
    if s.surface_count == 1 and s.collisions == 1:
        component = BALLISTIC
    return component


def _make_cross_port(spec: TransportSpec, port: PortKind) -> wp.Function:
    """As `cross` of `make_analog`, for a photon that is refracted by a port and must hit the aperture behind it."""
    reflecting = spec.reflecting
    image_of, leave, scatterings = spec.image_of, port.leave, _make_scatterings(spec.reflecting)

    @wp.func
    def cross_port(s: wp.ref[PhotonState], world: wp.ref[World]) -> Contribution:
        found = Contribution()
        found.index = -3
        passage = leave(world.camera.port, s.x, s.u)
        on_lens = passage.x
        inside = (
            on_lens[0] * on_lens[0] + on_lens[1] * on_lens[1]
            <= world.camera.aperture_radius * world.camera.aperture_radius
        )
        if scatterings(s) > 0 and inside and passage.water > 0.0 and passage.transmission > 0.0:
            pixel = image_of(world.camera, s.view, s.target, on_lens - passage.u, on_lens)
            if pixel >= 0 and passage.water <= wp.min(s.flight.distance, world.limits.max_path - s.path):
                found.value = s.weight.value * passage.transmission
                found.index = tally_index(
                    world.camera, world.gate, pixel, s.path + passage.water + passage.path, _component(s)
                )
                found.rounding_sample = u01(s.flight.block[2])
        if wp.static(reflecting):
            found = _drop_long_leg(found, s, world)
        return found

    return cross_port
