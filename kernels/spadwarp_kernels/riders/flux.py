"""The tally of flux: what the legs and collisions of a photon add to the sections of a spec's kinds."""

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.philox import u01
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonRef, SinkRef, WorldRef
from spadwarp_kernels.tally.flux import Leg, add_flux_collision, add_flux_crossings, add_flux_track


@memoised
def make_flux_score(spec: TransportSpec) -> wp.Function | None:
    """The Warp function ``(s, world, sink, length, collides)``, of a leg of that length [m], which may end in a
    collision with the water; None without flux. Legs are drawn with the extinction itself, so that their weight is
    that of the light all the way. Legs in the air above a sea add nothing."""
    if not spec.flux:
        return None
    tracks, collisions, planes = (kind in spec.flux for kind in ("track", "collision", "planes"))

    @wp.func
    def score_flux(s: PhotonRef, world: WorldRef, sink: SinkRef, length: float, collides: bool):
        if wp.static(spec.sight.sea is not None):
            if s.above:
                return
        leg = Leg(s.x, s.u, length, s.path, s.weight.value, u01(s.flight.block[3]))
        if wp.static(tracks):
            for k in range(world.flux.tracks.shape[0]):
                add_flux_track(world.flux.tracks[k], sink.flux, sink.flux_halves, leg)
        if wp.static(planes):
            for k in range(world.flux.planes.shape[0]):
                add_flux_crossings(world.flux.planes[k], world.flux.positions, sink.flux, sink.flux_halves, leg)
        if wp.static(collisions):
            if collides:
                extinction = spec.water.at(world.medium, world.layers, leg.x + length * leg.u).extinction
                add_flux_collision(world.flux.collision, sink.flux, sink.flux_halves, leg, extinction)
                for k in range(1, world.flux.collisions.shape[0]):
                    add_flux_collision(world.flux.collisions[k], sink.flux, sink.flux_halves, leg, extinction)

    return score_flux
