"""Derivatives of the logarithm of what light has met, by the water's coefficients and the surfaces' reflectances.

Per flight -length for absorption and scattering; per event 1/b, the derivative of the phase function, and the part of
the Lambertian reflectance.
"""

import warp as wp

from spadwarp_kernels.base.rotations import one_minus_cosine, snap_from
from spadwarp_kernels.photon.derivatives import LogDerivatives
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import Carried, CarriedRef, Contribution, WorldRef
from spadwarp_kernels.surface.triangle import face_in
from spadwarp_kernels.water.medium import boundary_ahead, layer_index
from spadwarp_kernels.water.phase_functions import henyey_greenstein_log_derivative

from .rider import NOTHING, Rider


def parameters_of(spec: TransportSpec, *kinds: str) -> int:
    """Bit p is set where the derivative p of a spec is of one of these kinds.

    Bits, since a `wp.static` that reads the index of a loop does not enter the hash of Warp's kernel cache.
    """
    return sum(1 << p for p, kind in enumerate(spec.derivatives) if kind in kinds)


def make_derivatives_rider(spec: TransportSpec) -> Rider:
    """Of the parameters of a spec."""
    return NOTHING._replace(begin=_begin, fly=_make_fly(spec), event=_make_event(spec), deliver=_deliver)


@wp.func
def _begin(c: CarriedRef, world: WorldRef, target: int, emitted: wp.spatial_vector, x: wp.vec3, u: wp.vec3):
    c.log_derivatives = LogDerivatives()


@wp.func
def _deliver(k: wp.ref[Contribution], c: Carried, world: WorldRef, end: wp.vec3, u: wp.vec3, inside: wp.vec3):
    k.factors = c.log_derivatives


def _make_fly(spec: TransportSpec) -> wp.Function:
    count, layered = len(spec.derivatives), spec.water.layered
    on_path = parameters_of(spec, "absorption", "scattering")

    @wp.func
    def shorter(d: LogDerivatives, parameters: int, length: float) -> LogDerivatives:
        for p in range(wp.static(count)):
            if (parameters >> p) & 1 == 1:
                d[p] = d[p] - length
        return d

    @wp.func
    def fly(c: CarriedRef, world: WorldRef, x: wp.vec3, u: wp.vec3, length: float):
        if wp.static(not layered):
            c.log_derivatives = shorter(c.log_derivatives, wp.static(on_path), length)
        else:
            d = c.log_derivatives
            along = wp.dot(world.layers.axis, x)
            slope = wp.dot(world.layers.axis, u)
            step = wp.where(slope > 0.0, 1, -1)
            layer = layer_index(world.layers, along)
            begin = float(0.0)
            boundary = boundary_ahead(world.layers, layer, step, along, slope)
            while boundary < length:
                d = shorter(d, world.derivatives.waters[layer] & wp.static(on_path), boundary - begin)
                layer += step
                begin = boundary
                boundary = boundary_ahead(world.layers, layer, step, along, slope)
            c.log_derivatives = shorter(d, world.derivatives.waters[layer] & wp.static(on_path), length - begin)

    return fly


def _make_event(spec: TransportSpec) -> wp.Function:
    count, layered, shares = len(spec.derivatives), spec.water.layered, spec.faces.shares
    by_scattering, by_anisotropy, by_reflectance = (
        parameters_of(spec, kind) for kind in ("scattering", "anisotropy", "reflectance")
    )
    in_water = by_scattering | by_anisotropy

    @wp.func
    def in_the_water(d: LogDerivatives, world: WorldRef, x: wp.vec3, u: wp.vec3, v: wp.vec3) -> LogDerivatives:
        here = int(wp.static(in_water))
        if wp.static(layered):
            here = here & world.derivatives.waters[layer_index(world.layers, wp.dot(world.layers.axis, x))]
        t = one_minus_cosine(snap_from(u, world.medium.axis_threshold), v)
        for p in range(wp.static(count)):
            if (wp.static(by_scattering) >> p) & 1 == 1:
                d[p] = d[p] + wp.where((here >> p) & 1 == 1, 1.0 / world.derivatives.value[p], 0.0)
            if (wp.static(by_anisotropy) >> p) & 1 == 1:
                slope = henyey_greenstein_log_derivative(t, world.derivatives.value[p])
                d[p] = d[p] + wp.where((here >> p) & 1 == 1, slope, 0.0)
        return d

    @wp.func
    def on_a_face(d: LogDerivatives, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3) -> LogDerivatives:
        part = shares(world.surfaces, slot, x, u, v)[0]
        here = world.derivatives.faces[face_in(world.surfaces.order, slot)]
        for p in range(wp.static(count)):
            if (wp.static(by_reflectance) >> p) & 1 == 1:
                d[p] = d[p] + wp.where((here >> p) & 1 == 1, part / world.derivatives.value[p], 0.0)
        return d

    @wp.func
    def event(c: CarriedRef, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3):
        if slot >= 0:
            if wp.static(by_reflectance > 0):
                c.log_derivatives = on_a_face(c.log_derivatives, world, slot, x, u, v)
        elif wp.static(in_water > 0):
            c.log_derivatives = in_the_water(c.log_derivatives, world, x, u, v)

    return event
