"""What may ride along with light: derivatives, those by block of cells, polarisation; one interface for all.

The stages of a photon and the contributions that it makes call the same functions, on the photon's `Carried` or on a
copy of it. So a rider need not know which estimator scores, nor an estimator what rides along.
"""

from typing import NamedTuple

import warp as wp

from spadwarp_kernels.photon.state import Carried, CarriedRef, Contribution, WorldRef


@wp.func
def _begin(c: CarriedRef, world: WorldRef, target: int, emitted: wp.spatial_vector, x: wp.vec3, u: wp.vec3):
    pass


@wp.func
def _fork(c: CarriedRef, world: WorldRef):
    pass


@wp.func
def _fly(c: CarriedRef, world: WorldRef, x: wp.vec3, u: wp.vec3, length: float):
    pass


@wp.func
def _event(c: CarriedRef, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3):
    pass


@wp.func
def _mirror(c: CarriedRef, u: wp.vec3, v: wp.vec3, index: float):
    pass


@wp.func
def _deliver(k: wp.ref[Contribution], c: Carried, world: WorldRef, end: wp.vec3, u: wp.vec3, inside: wp.vec3):
    pass


class Rider(NamedTuple):
    """What becomes of what rides along, as Warp functions."""

    begin: wp.Function = _begin
    """``(carried, world, target, emitted, x, u)``, for a photon that was emitted, see `Beam.emit`, and is in the water
    at x on its way along u."""
    fork: wp.Function = _fork  # ``(carried, world)``: what follows is of a contribution, no longer of the photon
    fly: wp.Function = _fly  # ``(carried, world, x, u, length)``, a way in the water
    event: wp.Function = _event
    """``(carried, world, slot, x, u, v)``, an event at x that turns light from u to v, on the face of a slot of the
    mesh's tree, (-1) in the water, or (SEA_SLOT) at the surface of a sea, which reflects or refracts it."""
    mirror: wp.Function = _mirror
    """``(carried, u, v, index)``, a smooth boundary that mirrors light from u to v, for the index behind it over that
    of the water."""
    deliver: wp.Function = _deliver
    """``(contribution, carried, world, end, u, inside)``: light along u that leaves the water at `end` for the lens,
    where it arrives along the unit vector `inside`."""

    @property
    def rides(self) -> bool:
        """Whether anything does."""
        return self != NOTHING


NOTHING = Rider()
